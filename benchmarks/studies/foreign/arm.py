"""Gymnasium's Reacher-v5 whose joints carry hidden loads, in gusts: confounded, and Tier 2 suffices."""

from typing import Any, SupportsFloat

import gymnasium
import numpy as np

from deconfounded.benchmarks.studies.foreign.world import World
from deconfounded.envs.streams import Array

GEAR, LOAD, GUST, DT = 200.0, 40.0, 1.0, 0.02  # N m an action of 1; N m; rad/s a step; s
STIFFNESS, DAMPING = 50.0, 14.0  # of the expert's error dynamics: 1/s^2, 1/s
INNER, OUTER = 0.1, 0.11  # m, links


class Loaded(gymnasium.Wrapper):
    """A constant torque [2] at both joints, and a gust on their speeds after each step."""

    def __init__(self, env: gymnasium.Env, load: Array) -> None:
        super().__init__(env)
        self.load = load

    def step(self, action: Array) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        data, gust = self.env.get_wrapper_attr("data"), GUST * self.np_random.standard_normal(2)
        data.qfrc_applied[:2] = self.load
        obs, *rest = self.env.step(action)
        data.qvel[:2] += gust
        obs[6:8] += gust
        return obs, *rest


class Arm(World):
    """theta: load torques [2] in N m. Observations and actions are Reacher's own."""

    noise = 2.0 / GEAR
    evidence = [6, 7]

    def make(self, theta: Array) -> gymnasium.Env:
        env = gymnasium.make(
            "Reacher-v5", max_episode_steps=self.steps, disable_env_checker=True, reward_control_weight=0.1
        )
        return Loaded(env, theta)

    def sample_theta(self, rng: np.random.Generator) -> Array:
        return rng.uniform(-LOAD, LOAD, 2)

    def expert(self, obs: Array, theta: Array) -> Array:
        """Computed torque, to the joint angles at which the fingertip is at the target."""
        angle, target, speed = np.arctan2(obs[2:4], obs[:2]), obs[4:6], obs[6:8]
        cos = (target @ target - INNER**2 - OUTER**2) / (2 * INNER * OUTER)
        elbow = np.arccos(np.clip(cos, -1, 1)).clip(max=2.9)
        shoulder = np.arctan2(target[1], target[0]) - np.arctan2(OUTER * np.sin(elbow), INNER + OUTER * np.cos(elbow))
        error = np.array([shoulder, elbow]) - angle
        error[0] = (error[0] + np.pi) % (2 * np.pi) - np.pi
        return (STIFFNESS * error - DAMPING * speed + speed - theta) / GEAR  # inertia and friction of a joint are 1
