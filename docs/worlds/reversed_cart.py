"""Gymnasium's CartPole-v1 whose motor may be wired the wrong way round: a hidden sign, in gusts.

Discrete.
"""

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]
FORCE, GUST = 10.0, 12.0  # N, of the motor and of a gust


class Wired(gymnasium.Wrapper):
    """The motor's force has a sign, and a gust adds to it: one step shows little of that sign."""

    def __init__(self, env: gymnasium.Env, sign: float) -> None:
        super().__init__(env)
        self.sign = sign

    def step(self, action):
        cart = self.unwrapped
        cart.force_mag = self.sign * FORCE + GUST * cart.np_random.standard_normal()
        return self.env.step(action)


class ReversedCart:
    """theta is the sign of the motor, 1 or -1. The expert pushes under the pole, and knows which way that is."""

    episodes, steps, noise = 2, 80, 0.05

    def make(self, theta: Array) -> gymnasium.Env:
        return Wired(gymnasium.make("CartPole-v1", disable_env_checker=True), theta[0])

    def sample_theta(self, rng: np.random.Generator) -> Array:
        return rng.choice([-1.0, 1.0], 1)

    def expert(self, obs: Array, theta: Array) -> int:
        push = obs @ [0.1, 0.3, 2.0, 1.0]
        return int(push * theta[0] > 0)
