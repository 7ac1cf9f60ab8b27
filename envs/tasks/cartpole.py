"""The body of the cartpole tasks: a cart has to stay at a mark on its rail with its pole upright."""

import numpy as np

from deconfounded.envs.physics import MujocoTask
from deconfounded.envs.task import Array, Mask, Streams

FALLEN = 1.2  # rad


class Cartpole(MujocoTask):
    """Joints `slider` (m) and `hinge` (rad; at 0 the pole is at right angles to the rail, tilted or not); action: the
    drive's force in units of its gear.

    Noise a step, where a task does not say otherwise: std .004 m and .1 m/s of the cart, .004 rad and .1 rad/s of the
    pole. Reward: (1 + cos pole) / 2 (.3 + .7 exp(-8 x^2)), at x m from the mark; a fallen pole ends the episode, of
    at most 150 steps.
    """

    horizon = 150
    expert_noise = 0.02
    process_noise = {"slider": (0.004, 0.1), "hinge": (0.004, 0.1)}
    observation = {"x": (-4, 4), "cos": (-1, 1), "sin": (-1, 1), "velocity": (-20, 20), "pole_velocity": (-40, 40)}

    def init_state(self, rng: Streams) -> Array:
        spread = np.array((0.3, 0.05, 0.05, 0.05))
        x, pole, velocity, pole_velocity = rng.uniform(-spread, spread)
        return self.state(slider=(x, velocity), hinge=(pole, pole_velocity))

    def observe(self, state: Array) -> Array:
        pole = self.qpos(state, "hinge")
        readings = [self.qpos(state, "slider"), np.cos(pole), np.sin(pole)]
        return np.stack([*readings, self.qvel(state, "slider"), self.qvel(state, "hinge")], -1)

    def reward(self, state: Array, action: Array, next_state: Array, theta: Array) -> Array:
        upright = (1 + np.cos(self.qpos(next_state, "hinge"))) / 2
        at_mark = np.exp(-0.5 * (self.qpos(next_state, "slider") / 0.25) ** 2)
        return upright * (0.3 + 0.7 * at_mark)

    def terminated(self, state: Array) -> Mask:
        """Whether the pole has fallen. Otherwise experts would spin it, and theta would hardly matter."""
        return np.abs(self.qpos(state, "hinge")) > FALLEN
