"""Gymnasium's CartPole-v1 whose motor may be wired the wrong way round: a hidden sign, in gusts.

Discrete.
"""

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]
GUST = 0.25  # m/s a step; the motor changes the cart's speed by .2 m/s


class Wired(gymnasium.Wrapper):
    """The motor pushes by a multiple of the force that it is asked for, and gusts push the cart."""

    def __init__(self, env: gymnasium.Env, sign: float) -> None:
        super().__init__(env)
        self.unwrapped.force_mag *= sign

    def step(self, action):
        cart = self.unwrapped
        x, speed, angle, turning = cart.state
        cart.state = np.array([x, speed + GUST * cart.np_random.standard_normal(), angle, turning])
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
