"""A planar walker, dm_control's, set down on a mark where it has to stay: hidden friction, hidden slope.

Tier 2, two latents at once. It stands with its feet close together and has .4 of dm_control's strength, so that it has
to lean into the slope at once; told of another slope it leans the wrong way, drifts off the mark and falls, which ends
the episode. Friction decides how a recovery step ends. Both show in every step, through process noise: feet slip a
little.

Latents: friction, the ground's coefficient, log-uniform, with priority over the feet's; slope, rad, uniform, uphill if
positive: it turns gravity, and the ground stays where it is. Slopes are not centred on 0, as the feet reach further
forward.

The MJCF is dm_control's own, from the installed package. Action: torques, in units of .4 of the MJCF's. Reward: .2
+ .8 exp(-(x / .08 m)^2 / 2 - (pitch / .15 rad)^2 / 2), less .02 times the mean square of the action. An episode is 5 s,
and ends with the torso below 1 m or pitched by more than .6 rad.
"""

from __future__ import annotations

from importlib.resources import files

import mujoco
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from envs.physics import Edit, MujocoTask
from envs.task import Array, Latent

HEIGHT = 1.3  # of the torso's centre, standing, m
STRENGTH = 0.4  # of the MJCF's motors
JOINTS = tuple(f"{side}_{joint}" for side in ("right", "left") for joint in ("hip", "knee", "ankle"))
STANCE = (0.1, -0.2, 0.1, 0.0, -0.2, 0.2)  # rad, of the joints
ROOT = ("rootz", "rootx", "rooty")


class SlipperyWalker(MujocoTask):
    """Joints rootx, rootz and rooty of the torso, and hip, knee and ankle of each leg."""

    name = "slippery_walker"
    latents = (Latent("friction", "", 0.3, 1.0, "loguniform"), Latent("slope", "rad", -0.12, 0.24))
    horizon = 200
    substeps = 5
    costly = True
    expert_noise = 0.05
    process_noise = {
        **{"rootz": (0.001, 0.03), "rootx": (0.002, 0.05), "rooty": (0.003, 0.06)},
        **{joint: (0.005, 0.4) if "ankle" in joint else (0.003, 0.2) for joint in JOINTS},
    }
    action_space = spaces.Box(-1.0, 1.0, (6,), np.float32)
    observation = {
        **{"x": (-10, 10), "height": (0, 3), "pitch": (-4, 4), **{joint: (-4, 4) for joint in JOINTS}},
        **{f"{joint}_velocity": (-50, 50) for joint in (*ROOT, *JOINTS)},
    }

    def spec(self) -> mujoco.MjSpec:
        """The suite's walker, with a mark, and a small sky: every environment has a model of its own."""
        spec = mujoco.MjSpec.from_file(str(files("dm_control") / "suite" / "walker.xml"))
        spec.option.timestep = 0.005
        spec.geom("floor").priority = 1
        spec.texture("skybox").width, spec.texture("skybox").height = 32, 192
        box = mujoco.mjtGeom.mjGEOM_BOX
        spec.worldbody.add_site(name="mark", type=box, size=[0.08, 0.4, 0.002], rgba=[0.9, 0.3, 0.2, 1])
        spec.worldbody.add_camera(name="view", pos=[0, -2.9, 0.95], quat=[0.7071, 0.7071, 0, 0])
        return spec

    def apply_latent(self, edit: Edit, theta: Array) -> None:
        edit.geom_friction("floor", float(theta[0]))
        edit.slope(float(theta[1]))

    def control(self, action: Array) -> Array:
        return STRENGTH * action

    def init_state(self, rng: np.random.Generator) -> Array:
        x, pitch, *bend = rng.uniform(-0.05, 0.05, 2 + len(JOINTS))
        legs = {joint: (angle, 0.0) for joint, angle in zip(JOINTS, np.add(STANCE, bend), strict=True)}
        return self.state(rootz=(0.01, 0), rootx=(x, 0), rooty=(pitch, 0), **legs)

    def observe(self, state: Array) -> Array:
        x, z, *angles = (self.qpos(state, joint) for joint in ("rootx", "rootz", "rooty", *JOINTS))
        return np.stack([x, HEIGHT + z, *angles, *(self.qvel(state, joint) for joint in (*ROOT, *JOINTS))], -1)

    def reward(self, state: Array, action: Array, next_state: Array, theta: Array) -> Array:
        x, pitch = self.qpos(next_state, "rootx"), self.qpos(next_state, "rooty")
        there = np.exp(-0.5 * (x / 0.08) ** 2 - 0.5 * (pitch / 0.15) ** 2)
        return 0.2 + 0.8 * there - 0.02 * np.square(action).mean(-1)

    def terminated(self, state: Array) -> NDArray[np.bool_]:
        fallen = HEIGHT + self.qpos(state, "rootz") < 1.0
        return fallen | (np.abs(self.qpos(state, "rooty")) > 0.6)
