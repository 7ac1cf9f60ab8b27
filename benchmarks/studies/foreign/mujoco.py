"""Gymnasium's MuJoCo: an arm without loads, whose target is hidden or whose expert trembles, and pushed poles."""

from typing import Any, SupportsFloat

import gymnasium
import numpy as np
from gymnasium import spaces

from deconfounded.benchmarks.studies.foreign.arm import Arm
from deconfounded.benchmarks.studies.foreign.world import Controller, World
from deconfounded.envs.streams import Array

RADIUS, PUSH, GUST = 0.18, 20.0, 0.15  # m; N; m/s and rad/s a step
SHOVE, SWAY = 250.0, 0.1  # of the double pendulum: N; m/s and rad/s a step
SLOPE, SLIP, WEIGHT = 0.15, 0.05, 1.52  # rad; m/s and rad/s a step; of cart and pole, in actions
FEEDBACK = (0.5, 8.0, 0.8, 1.6)  # of cart and pole, their speeds


class ArmTrembles(Arm):
    """No loads, nothing hidden: the expert's noise is AR(1), and a step keeps .9 of it."""

    episodes, noise = 1, 0.1
    evidence = []

    def sample_theta(self, rng: np.random.Generator) -> Array:
        return np.zeros(2)

    def controller(self, theta: Array, rng: np.random.Generator) -> Controller:
        tremble = np.zeros(2)

        def act(obs: Array) -> Array:
            nonlocal tremble
            tremble = 0.9 * tremble + (1 - 0.9**2) ** 0.5 * self.noise * rng.standard_normal(2)
            return self.expert(obs, theta) + tremble

        return act


class Unseen(gymnasium.Wrapper):
    """Puts the target at a place, and observes the arm alone."""

    def __init__(self, env: gymnasium.Env, place: Array) -> None:
        super().__init__(env)
        self.place, self.observation_space = place, spaces.Box(-np.inf, np.inf, (6,), np.float64)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        obs, info = self.env.reset(seed=seed, options=options)
        env = self.env.unwrapped
        data = env.data  # type: ignore[attr-defined]
        env.set_state(np.concatenate([data.qpos[:2], self.place]), data.qvel.copy())  # type: ignore[attr-defined]
        return obs[[0, 1, 2, 3, 6, 7]], info

    def step(self, action: Array) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        obs, *rest = self.env.step(action)
        return obs[[0, 1, 2, 3, 6, 7]], *rest


class ArmTarget(Arm):
    """theta: where the target is [2] in m, which nothing but the reward reveals, and so no exploration helps."""

    episodes = 1
    evidence = []

    def make(self, theta: Array) -> gymnasium.Env:
        return Unseen(super().make(np.zeros(2)), theta)

    def sample_theta(self, rng: np.random.Generator) -> Array:
        angle = rng.uniform(-np.pi, np.pi)
        return RADIUS * rng.uniform() ** 0.5 * np.array([np.cos(angle), np.sin(angle)])

    def expert(self, obs: Array, theta: Array) -> Array:
        whole = np.concatenate([obs[:4], theta, obs[4:], np.zeros(2)])
        return super().expert(whole, np.zeros(2))


class PushedPole(World):
    """InvertedPendulum-v5 whose cart is pushed by a hidden force: feedback is enough to keep the pole up."""

    noise = 0.05

    def make(self, theta: Array) -> gymnasium.Env:
        env = gymnasium.make("InvertedPendulum-v5", max_episode_steps=self.steps, disable_env_checker=True)
        return Pushed(env, float(theta[0]), GUST)

    def sample_theta(self, rng: np.random.Generator) -> Array:
        return rng.uniform(-PUSH, PUSH, 1)

    def expert(self, obs: Array, theta: Array) -> Array:
        return np.array([obs @ FEEDBACK]) - theta / 100  # a motor of gear 100


class SlopingRail(World):
    """theta: the slope [1] of InvertedPendulum-v5's rail in rad, for which the expert leans the pole."""

    noise = 0.02
    evidence = [2, 3]

    def make(self, theta: Array) -> gymnasium.Env:
        env = gymnasium.make("InvertedPendulum-v5", max_episode_steps=self.steps, disable_env_checker=True)
        model = env.unwrapped.model  # type: ignore[attr-defined]
        model.opt.gravity[:] = 9.81 * np.sin(theta[0]), 0.0, -9.81 * np.cos(theta[0])
        return Pushed(env, 0.0, SLIP)

    def sample_theta(self, rng: np.random.Generator) -> Array:
        return rng.uniform(-SLOPE, SLOPE, 1)

    def expert(self, obs: Array, theta: Array) -> Array:
        return np.array([obs @ FEEDBACK]) + FEEDBACK[1] * theta - WEIGHT * np.sin(theta)


class PushedDouble(World):
    """theta: a force [1] on the cart of InvertedDoublePendulum-v5, in N: confounded, and Tier 2 suffices.

    The expert feeds it forward, and a linear-quadratic regulator's feedback.
    """

    noise = 0.005
    evidence = [5, 6, 7]

    def make(self, theta: Array) -> gymnasium.Env:
        env = gymnasium.make("InvertedDoublePendulum-v5", max_episode_steps=self.steps, disable_env_checker=True)
        return Pushed(Seen(env), float(theta[0]), SWAY)

    def sample_theta(self, rng: np.random.Generator) -> Array:
        return rng.uniform(-SHOVE, SHOVE, 1)

    def expert(self, obs: Array, theta: Array) -> Array:
        angles = np.arctan2(obs[1:3], obs[3:5])
        state = np.concatenate([obs[:1], angles, obs[5:]])
        return -np.array([state @ (0.21, 1.82, 5.59, 0.31, 0.9, 0.82)]) - theta / 500  # a motor of gear 500


class Seen(gymnasium.ObservationWrapper):
    """Observes all columns but the last, the force of constraints."""

    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        self.observation_space = spaces.Box(-np.inf, np.inf, (8,), np.float64)

    def observation(self, observation: Array) -> Array:
        return observation[:8]


class Pushed(gymnasium.Wrapper):
    """A constant force on a cart, and gusts on the speeds of all joints, the last columns, after each step."""

    def __init__(self, env: gymnasium.Env, force: float, gust: float) -> None:
        super().__init__(env)
        self.force, self.gust = force, gust

    def step(self, action: Array) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        data = self.get_wrapper_attr("data")
        gust = self.gust * self.np_random.standard_normal(len(data.qvel))
        data.qfrc_applied[0] = self.force
        obs, *rest = self.env.step(action)
        data.qvel += gust
        obs[-len(gust) :] += gust
        return obs, *rest
