"""A planar walker, dm_control's, on ground of hidden friction and hidden slope.

Tier 2. On firm ground it runs, on ice it must shuffle; uphill it leans into the slope, downhill back. Told of more grip
than there is, it slips and falls, which ends the episode; told of less, it is late. Two latents at once: friction, the
ground's coefficient, log-uniform, with priority over the feet's; slope, rad, uniform, uphill if positive: it turns
gravity, and the ground stays where it is.

The MJCF is dm_control's own, from the installed package.
"""

from __future__ import annotations

from importlib.resources import files

import mujoco
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from envs.physics import Edit, MujocoTask
from envs.task import Array, Latent

CRAWL = 0.5  # m/s; walking more slowly does not pay
HEIGHT = 1.3  # of the torso's centre, standing, m
JOINTS = tuple(f"{side}_{joint}" for side in ("right", "left") for joint in ("hip", "knee", "ankle"))
ROOT = ("rootz", "rootx", "rooty")


class SlipperyWalker(MujocoTask):
    """Joints rootx, rootz and rooty of the torso, and hip, knee and ankle of each leg."""

    name = "slippery_walker"
    latents = (Latent("friction", "", 0.08, 0.5, "loguniform"), Latent("slope", "rad", -0.06, 0.06))
    horizon = 200
    substeps = 5
    costly = True
    expert_noise = 0.05
    process_noise = {
        **{"rootz": (0.001, 0.04), "rootx": (0.004, 0.08), "rooty": (0.005, 0.1)},
        **{joint: (0.01, 0.8) if "ankle" in joint else (0.005, 0.3) for joint in JOINTS},
    }
    action_space = spaces.Box(-1.0, 1.0, (6,), np.float32)
    observation = {
        **{"height": (0, 3), "pitch": (-4, 4), **{joint: (-4, 4) for joint in JOINTS}},
        **{f"{joint}_velocity": (-50, 50) for joint in (*ROOT, *JOINTS)},
    }

    def spec(self) -> mujoco.MjSpec:
        spec = mujoco.MjSpec.from_file(str(files("dm_control") / "suite" / "walker.xml"))
        spec.geom("floor").priority = 1
        spec.option.timestep = 0.005
        spec.body("torso").add_camera(
            name="view", mode=mujoco.mjtCamLight.mjCAMLIGHT_TRACK, pos=[0, -3.6, 0.2], quat=[0.7071, 0.7071, 0, 0]
        )
        return spec

    def apply_latent(self, edit: Edit, theta: Array) -> None:
        edit.geom_friction("floor", float(theta[0]))
        edit.slope(float(theta[1]))

    def init_state(self, rng: np.random.Generator) -> Array:
        pitch, *bend = rng.uniform(-0.05, 0.05, 1 + len(JOINTS))
        stride = np.array([0.2, -0.4, 0, 0, -0.2, 0]) + bend
        legs = {joint: (angle, 0.0) for joint, angle in zip(JOINTS, stride, strict=True)}
        return self.state(rootz=(-0.03, 0), rootx=(0, 0), rooty=(pitch, 0), **legs)

    def observe(self, state: Array) -> Array:
        readings = [HEIGHT + self.qpos(state, "rootz"), *(self.qpos(state, joint) for joint in ("rooty", *JOINTS))]
        return np.stack([*readings, *(self.qvel(state, joint) for joint in (*ROOT, *JOINTS))], -1)

    def reward(self, state: Array, action: Array, next_state: Array, theta: Array) -> Array:
        speed = (self.qpos(next_state, "rootx") - self.qpos(state, "rootx")) / self.control_dt
        return 0.05 + 0.95 * np.clip((speed - CRAWL) / 3, 0, 1) - 0.02 * np.square(action).mean(-1)

    def terminated(self, state: Array) -> NDArray[np.bool_]:
        fallen = HEIGHT + self.qpos(state, "rootz") < 0.8
        return fallen | (np.abs(self.qpos(state, "rooty")) > 1.0)
