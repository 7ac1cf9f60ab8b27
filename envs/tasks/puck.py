"""The body of the puck tasks: a puck on a plane, pushed along x and y, has to reach a hidden goal."""

from abc import abstractmethod

import numpy as np
from gymnasium import spaces

from deconfounded.envs.physics import MujocoTask
from deconfounded.envs.task import Array, Streams


class Puck(MujocoTask):
    """Joints `x` and `y` (m); action: the push along each, in units of the motors' gear.

    Noise a step: std .004 m and .05 m/s along each axis. Reward: at distance d from the goal, .8 exp(-d^2 / .18) + .2
    exp(-d); an episode is 100 steps, and nothing ends it early.
    """

    horizon = 100
    expert_noise = 0.02
    process_noise = {"x": (0.004, 0.05), "y": (0.004, 0.05)}
    action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
    observation = {"x": (-4, 4), "y": (-4, 4), "x_velocity": (-10, 10), "y_velocity": (-10, 10)}

    @abstractmethod
    def goal(self, theta: Array) -> Array:
        """Positions [N, 2] of the goal, m."""

    def init_state(self, rng: Streams) -> Array:
        x, y = rng.uniform([-0.03, -0.03], 0.03)
        return self.state(x=(x, 0), y=(y, 0))

    def reward(self, state: Array, action: Array, next_state: Array, theta: Array) -> Array:
        off = self.observe(next_state)[:, :2] - self.goal(theta)
        distance = np.linalg.norm(off, axis=-1)
        return 0.8 * np.exp(-0.5 * (distance / 0.3) ** 2) + 0.2 * np.exp(-distance)
