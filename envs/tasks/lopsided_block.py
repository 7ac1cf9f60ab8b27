"""A pusher drives a block along a line, and the block's left foot is rougher or smoother than its right one.

Tier 2. The block turns towards its rough foot, unless it is pushed on that side: how far off its middle has to be
known in advance, since it is steered through its turning alone, and slowly. One control step shows the drag only
through process noise.

Latent: drag, of the left foot, in units of the right one's .6 N, uniform. The block also has a drag of 1 N s/m, all
round. Noise a step: std 5e-4 m and .01 m/s of the block along x, .001 m and .02 m/s along y, .006 rad and .1 rad/s of
its yaw, 5e-4 m and .005 m/s of the pusher.

Action: the pusher's speed across the line, in units of .6 m/s; ahead it is 1 m/s. Reward: at y m off the line, .8
exp(-(y / .06)^2 / 2) + .2 exp(-5 |y|). An episode is 6 s, and ends with the block .5 m off the line, turned by more
than .9 rad, or lost by the pusher.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from deconfounded.envs.physics import Edit, MujocoTask
from deconfounded.envs.streams import Streams
from deconfounded.envs.task import Array, Latent

AHEAD, ACROSS = 1.0, 0.6  # m/s
OFF, TURNED, HALF_WIDTH = 0.5, 0.9, 0.2  # m, rad, m
REST, PRESSED = -0.19, 0.02  # of the pusher, behind the block, and further on once it pushes, m


class LopsidedBlock(MujocoTask):
    """Joints x, y, yaw of the block, pusher_x and pusher_y."""

    name = "lopsided_block"
    latents = (Latent("drag", "", 0.0, 2.0),)
    horizon = 120
    expert_noise = 0.02
    process_noise = {
        **{"x": (0.0005, 0.01), "y": (0.001, 0.02), "yaw": (0.006, 0.1)},
        **{"pusher_x": (0.0005, 0.005), "pusher_y": (0.0005, 0.005)},
    }
    observation = {
        **{"y": (-3, 3), "yaw": (-3, 3), "pusher_behind": (-3, 3), "pusher_off": (-3, 3)},
        **{"x_velocity": (-10, 10), "y_velocity": (-10, 10), "yaw_velocity": (-40, 40)},
    }

    def apply_latent(self, edit: Edit, theta: Array) -> None:
        edit.actuator_gain("left_foot", float(theta[0]))

    def control(self, action: Array) -> Array:
        one = np.ones_like(action)
        return np.concatenate([AHEAD * one, ACROSS * action, one, one], -1)

    def init_state(self, rng: Streams) -> Array:
        y, yaw, off = rng.uniform((-0.1, -0.1, -0.05), (0.1, 0.1, 0.05))
        return self.state(x=(0, AHEAD), y=(y, 0), yaw=(yaw, 0), pusher_x=(PRESSED, AHEAD), pusher_y=(y + off, 0))

    def _pusher(self, state: Array) -> tuple[Array, Array]:
        """Where the pusher is along and across the block, from its middle, m."""
        x = REST + self.qpos(state, "pusher_x") - self.qpos(state, "x")
        y, yaw = self.qpos(state, "pusher_y") - self.qpos(state, "y"), self.qpos(state, "yaw")
        return x * np.cos(yaw) + y * np.sin(yaw), y * np.cos(yaw) - x * np.sin(yaw)

    def observe(self, state: Array) -> Array:
        places = self.qpos(state, "y"), self.qpos(state, "yaw"), *self._pusher(state)
        return np.stack([*places, *(self.qvel(state, joint) for joint in ("x", "y", "yaw"))], -1)

    def reward(self, state: Array, action: Array, next_state: Array, theta: Array) -> Array:
        off = np.abs(self.qpos(next_state, "y"))
        return 0.8 * np.exp(-0.5 * (off / 0.06) ** 2) + 0.2 * np.exp(-5 * off)

    def terminated(self, state: Array) -> NDArray[np.bool_]:
        turned = np.abs(self.qpos(state, "yaw")) > TURNED
        lost = np.abs(self._pusher(state)[1]) > HALF_WIDTH
        return turned | lost | (np.abs(self.qpos(state, "y")) > OFF)
