"""Gymnasium's classic control: a pendulum in the wind, carts with a hidden motor or pole, a car, and an acrobot."""

from typing import Any, SupportsFloat

import gymnasium
import numpy as np

from deconfounded.benchmarks.studies.foreign.world import Controller, World
from deconfounded.envs.streams import Array

Step = tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]
WIND, GUST, DT = 3.5, 0.15, 0.05  # rad/s^2; rad/s a step; s


class Windy(gymnasium.Wrapper):
    """A steady angular acceleration of a pendulum, and a gust on its speed after each step."""

    def __init__(self, env: gymnasium.Env, wind: float, gust: float) -> None:
        super().__init__(env)
        self.wind, self.gust = wind, gust

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        return self.env.reset(seed=seed, options={"x_init": 0.2, "y_init": 0.2})

    def step(self, action: Array) -> Step:
        obs, *rest = self.env.step(action)
        state = self.get_wrapper_attr("state")
        state[1] += DT * self.wind + self.gust * self.np_random.standard_normal()
        obs[2] = state[1]
        return obs, *rest


class PendulumWind(World):
    """Pendulum-v1, held upright in a hidden steady wind: confounded, and Tier 2 suffices."""

    noise, gust = 0.05, GUST
    evidence = [2]

    def make(self, theta: Array) -> gymnasium.Env:
        env = gymnasium.make("Pendulum-v1", max_episode_steps=self.steps, disable_env_checker=True)
        return Windy(env, float(theta[0]), self.gust)

    def sample_theta(self, rng: np.random.Generator) -> Array:
        return rng.uniform(-WIND, WIND, 1)

    def expert(self, obs: Array, theta: Array) -> Array:
        return -(8 * np.arctan2(obs[1], obs[0]) + 3 * obs[2] + theta / 3)


class PendulumCalm(PendulumWind):
    """The same wind without gusts: one transition reveals it, but a naive clone does not make use of it."""

    gust = 0.0


class Turned(gymnasium.Wrapper):
    """A cart whose motor may turn the other way, with gusts on its speed and the pole's after each step."""

    def __init__(self, env: gymnasium.Env, sign: float, gust: float) -> None:
        super().__init__(env)
        self.sign, self.gust = sign, gust

    def step(self, action: int) -> Step:
        _, reward, terminated, truncated, info = self.env.step(action if self.sign > 0 else 1 - action)
        state = np.array(self.get_wrapper_attr("state"), float)
        state[[1, 3]] += self.gust * self.np_random.standard_normal(2)
        self.env.unwrapped.state = tuple(state)  # type: ignore[attr-defined]
        return state.astype(np.float32), reward, terminated, truncated, info


class ReversedCart(World):
    """CartPole-v1 whose motor turns the other way in half the trials: one transition reveals it."""

    noise, gust = 0.1, 0.0  # share of the expert's actions that are random; m/s and rad/s a step

    def make(self, theta: Array) -> gymnasium.Env:
        env = gymnasium.make("CartPole-v1", max_episode_steps=self.steps, disable_env_checker=True)
        return Turned(env, float(theta[0]), self.gust)

    def sample_theta(self, rng: np.random.Generator) -> Array:
        return rng.choice([-1.0, 1.0], 1)

    def expert(self, obs: Array, theta: Array) -> Array:
        push = float(obs @ (0.3, 0.6, 12.0, 2.5)) * theta[0]
        return np.asarray(int(push > 0))

    def controller(self, theta: Array, rng: np.random.Generator) -> Controller:
        return lambda obs: np.asarray(rng.integers(2)) if rng.random() < self.noise else self.expert(obs, theta)


class PoleLength(ReversedCart):
    """theta: half the length [1] of CartPole-v1's pole in m. The expert weighs the pole's speed by it, to no effect."""

    def make(self, theta: Array) -> gymnasium.Env:
        env = gymnasium.make("CartPole-v1", max_episode_steps=self.steps, disable_env_checker=True)
        cart: Any = env.unwrapped
        cart.length = float(theta[0])
        cart.polemass_length = cart.masspole * cart.length
        return env

    def sample_theta(self, rng: np.random.Generator) -> Array:
        return rng.uniform(0.3, 0.9, 1)

    def expert(self, obs: Array, theta: Array) -> Array:
        return np.asarray(int(obs @ (0.3, 0.6, 12.0, 5.0 * theta[0]) > 0))


class GustyCart(ReversedCart):
    """The same in gusts, which hide for a while which way it turns: confounded, and Tier 2 suffices."""

    noise, gust = 0.02, 0.4
    evidence = [1, 3]


class MountainPower(World):
    """MountainCarContinuous-v0 with a hidden power: the expert pumps with the speed, whatever it is."""

    episodes, steps, noise = 1, 100, 0.1

    def make(self, theta: Array) -> gymnasium.Env:
        env = gymnasium.make("MountainCarContinuous-v0", max_episode_steps=self.steps, disable_env_checker=True)
        env.unwrapped.power = float(theta[0])  # type: ignore[attr-defined]
        return env

    def sample_theta(self, rng: np.random.Generator) -> Array:
        return rng.uniform(0.0015, 0.0025, 1)

    def expert(self, obs: Array, theta: Array) -> Array:
        return np.array([0.8 * np.tanh(obs[1] / 0.005)])


class AcrobotPauses(World):
    """Acrobot-v1, nothing hidden: the operator waits for 0 to 25 steps at the start of an episode."""

    episodes, steps = 1, 110

    def make(self, theta: Array) -> gymnasium.Env:
        return gymnasium.make("Acrobot-v1", max_episode_steps=self.steps, disable_env_checker=True)

    def sample_theta(self, rng: np.random.Generator) -> Array:
        return np.zeros(1)

    def expert(self, obs: Array, theta: Array) -> Array:
        """Swings up by torque along the elbow's speed."""
        return np.asarray(2 * int(obs[5] > 0))

    def controller(self, theta: Array, rng: np.random.Generator) -> Controller:
        pause, step = int(rng.integers(26)), iter(range(10**9))

        def act(obs: Array) -> Array:
            return np.asarray(1) if next(step) < pause else self.expert(obs, theta)

        return act
