"""Gymnasium's Pendulum-v1 held off its rest by a hidden context, as CARL states one: a dictionary of physical numbers.

Continuous. A constant load pulls at the hinge, and gusts hide it: a step shows little of it, a few dozen tell it.
"""

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]
TORQUE, GUST = 15.0, 0.5  # N m, the motor's most; rad/s a step


class InContext(gymnasium.Wrapper):
    """The pendulum under a context {"g": m/s^2, "m": kg, "load": N m}, in gusts."""

    def __init__(self, env: gymnasium.Env, context: dict[str, float]) -> None:
        super().__init__(env)
        self.context = context
        pendulum = self.unwrapped
        pendulum.g, pendulum.m, pendulum.max_torque = context["g"], context["m"], TORQUE
        self.action_space = gymnasium.spaces.Box(-TORQUE, TORQUE, (1,), np.float32)

    def step(self, action):
        pendulum = self.unwrapped
        inertia = pendulum.m * pendulum.l**2 / 3
        angle, speed = pendulum.state
        pushed = speed + self.context["load"] / inertia * pendulum.dt + GUST * pendulum.np_random.standard_normal()
        pendulum.state = np.array([angle, pushed])
        return self.env.step(action)


class ContextPendulum:
    """The expert swings the pendulum up and holds it there, and leans against the load that it sees."""

    names = ("m", "load")
    episodes, steps, noise = 2, 60, 0.5

    def make(self, theta: Array) -> gymnasium.Env:
        context = {"g": 10.0, **dict(zip(self.names, theta.tolist(), strict=True))}
        return InContext(gymnasium.make("Pendulum-v1", disable_env_checker=True), context)

    def sample_theta(self, rng: np.random.Generator) -> Array:
        return rng.uniform([0.8, -6.0], [1.2, 6.0])

    def expert(self, obs: Array, theta: Array) -> Array:
        """Computed torque: angle 0 is upright, and what gravity and the load do is taken off."""
        mass, load = theta
        angle, speed, inertia = np.arctan2(obs[1], obs[0]), obs[2], mass / 3
        wanted = -6.0 * angle - 4.0 * speed
        return np.array([inertia * wanted - mass * 10.0 / 2 * np.sin(angle) - load])
