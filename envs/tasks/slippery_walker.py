"""A planar walker, dm_control's, has to stand upright at a mark on a slope; slope and friction are hidden.

Tier 2. Upright is along gravity: the torso has to lean into the slope, by its angle. But pitch and joints are observed
relative to the ground, which does not show the direction of gravity. An agent that leans by a wrong angle still stands,
and may take its own pitch for evidence. The true evidence of the slope is the torso's velocity along the ground, within
a few steps; that of friction is how feet slip while the walker recovers its balance. Friction limits how hard it may
push, and a wrong belief about it costs little.

Latents: friction, the ground's coefficient, log-uniform, with priority over the feet's; slope, rad, uniform, uphill if
positive: it turns gravity, and the ground stays where it is. Slopes are not centred on 0, as the feet reach further
forward.

The MJCF is dm_control's own, from the installed package, with joints damped so that it neither twitches nor bounces: by
4 (v + v |v| + v^3) N m at v rad/s. Action: torques, in units of the MJCF's. Reward: .1 + .9 exp(-(d^2 + a^2) / 2), with
d = x / .06 m and a = (pitch - slope) / .08 rad, less .1 times the mean square of the action. An episode is 5 s, and
ends with the torso below 1 m or pitched by more than .6 rad.
"""

from importlib.resources import files
from importlib.util import find_spec

import mujoco
import numpy as np
from gymnasium import spaces

from deconfounded.envs import render
from deconfounded.envs.physics import Edit, MujocoTask
from deconfounded.envs.task import Array, InputError, Latent, Mask, Streams

HEIGHT = 1.3  # of the torso's centre, standing, m
DAMPING = 4.0  # of joints: N m for each of v, v |v| and v^3, v in rad/s
JOINTS = tuple(f"{side}_{joint}" for side in ("right", "left") for joint in ("hip", "knee", "ankle"))
STANCE = (0.1, -0.2, 0.1, 0.0, -0.2, 0.2)  # rad, of the joints: feet close together
ROOT = ("rootz", "rootx", "rooty")


class SlipperyWalker(MujocoTask):
    """Joints rootx, rootz and rooty of the torso, and hip, knee and ankle of each leg."""

    name = "slippery_walker"
    version = 1
    latents = (Latent("friction", "", 0.2, 0.8, "loguniform"), Latent("slope", "rad", -0.1, 0.18))
    horizon = 200
    substeps = 3
    expert_noise = 0.05
    process_noise = {
        **{"rootz": (0.00025, 0.01), "rootx": (0.0008, 0.02), "rooty": (0.0008, 0.02)},
        **{joint: (0.002, 0.1) if "ankle" in joint else (0.001, 0.05) for joint in JOINTS},
    }
    action_space = spaces.Box(-1.0, 1.0, (6,), np.float32)
    observation = {
        **{"x": (-10, 10), "height": (0, 3), "pitch": (-4, 4), **{joint: (-4, 4) for joint in JOINTS}},
        **{f"{joint}_velocity": (-50, 50) for joint in (*ROOT, *JOINTS)},
    }

    def spec(self) -> mujoco.MjSpec:
        """The walker of dm_control with steps of 1/120 s, damped joints, and a floor that decides friction."""
        if find_spec("dm_control") is None:
            remedy = "`pip install --no-deps dm_control` brings it"
            raise InputError(f"{self.name} needs an MJCF of dm_control, which is not installed; {remedy}")
        spec = mujoco.MjSpec.from_file(str(files("dm_control") / "suite" / "walker.xml"))
        spec.option.timestep = 1 / 120
        spec.geom("floor").priority = 1
        for joint in JOINTS:
            spec.joint(joint).damping = np.full(3, DAMPING)
        spec.material("grid").textures = [""] * len(spec.material("grid").textures)
        for texture in spec.textures:
            spec.delete(texture)
        spec.worldbody.add_camera(name="view", pos=[0, -2.9, 0.95], quat=[0.7071, 0.7071, 0, 0])
        return spec

    def decorate(self, spec: mujoco.MjSpec) -> None:
        """Add a mark where the walker has to stand, and a chequered ground."""
        super().decorate(spec)
        render.chequer(spec, "grid")
        box = mujoco.mjtGeom.mjGEOM_BOX
        spec.worldbody.add_site(name="mark", type=box, size=[0.08, 0.4, 0.002], rgba=[0.9, 0.3, 0.2, 1])

    def apply_latent(self, edit: Edit, theta: Array) -> None:
        edit.geom_friction("floor", float(theta[0]))
        edit.slope(float(theta[1]))

    def init_state(self, rng: Streams) -> Array:
        x, pitch, *bend = rng.uniform(np.full(2 + len(JOINTS), -0.05), 0.05)
        legs = {joint: (angle + bent, 0) for joint, angle, bent in zip(JOINTS, STANCE, bend, strict=True)}
        return self.state(rootz=(0.01, 0), rootx=(x, 0), rooty=(pitch, 0), **legs)

    def observe(self, state: Array) -> Array:
        x, z, *angles = (self.qpos(state, joint) for joint in ("rootx", "rootz", "rooty", *JOINTS))
        return np.stack([x, HEIGHT + z, *angles, *(self.qvel(state, joint) for joint in (*ROOT, *JOINTS))], -1)

    def reward(self, state: Array, action: Array, next_state: Array, theta: Array) -> Array:
        x, lean = self.qpos(next_state, "rootx"), self.qpos(next_state, "rooty") - theta[..., 1]
        there = np.exp(-0.5 * (x / 0.06) ** 2 - 0.5 * (lean / 0.08) ** 2)
        return 0.1 + 0.9 * there - 0.1 * np.square(action).mean(-1)

    def failed(self, before: Array, after: Array, message: str) -> None:
        """A landing so hard that damping (v^3) is too much for the time step, of 1 in 10,000 or so, is a fall."""
        after[:] = before
        after[0] += self.control_dt
        self.qpos(after, "rootz")[...] = -HEIGHT

    def terminated(self, state: Array) -> Mask:
        fallen = HEIGHT + self.qpos(state, "rootz") < 1.0
        return fallen | (np.abs(self.qpos(state, "rooty")) > 0.6)
