"""highway-env's lane-keeping, by a dynamic bicycle model: a side wind, bent or reversed steering, habits, late logs."""

from typing import Any, SupportsFloat

import gymnasium
import highway_env  # noqa: F401 (registers its environments)
import numpy as np
from gymnasium import spaces

from deconfounded.benchmarks.studies.foreign.world import World
from deconfounded.envs.streams import Array
from deconfounded.experts.trials import Trials

WIND, GUST, DT = 12.0, 1.2, 0.1  # m/s^2 to the side; m/s to the side a step; s
BIAS, SWAY = 0.25, 1.5  # added to the action, of which 1 is full lock; rad/s of yaw a step
DRIFT, SPEED, STEERING = 0.195, 8.3, np.pi / 3  # s, sideways speed by wind; m/s; rad an action of 1


class SideWind(gymnasium.Wrapper):
    """A side wind and gusts on the vehicle's lateral speed after each step.

    Observes offset, heading error, lateral speed and yaw rate.
    """

    def __init__(self, env: gymnasium.Env, wind: float, gust: float) -> None:
        super().__init__(env)
        self.wind, self.gust = wind, gust
        self.observation_space = spaces.Box(-np.inf, np.inf, (4,), np.float64)

    def _observed(self) -> Array:
        env = self.env.unwrapped
        lane, vehicle = env.lane, env.vehicle  # type: ignore[attr-defined]
        along, offset = lane.local_coordinates(vehicle.position)
        return np.array([offset, vehicle.heading - lane.heading_at(along), vehicle.lateral_speed, vehicle.yaw_rate])

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        _, info = self.env.reset(seed=seed, options=options)
        env = self.env.unwrapped
        along, _ = env.lane.local_coordinates(env.vehicle.position)  # type: ignore[attr-defined]
        env.vehicle.position = env.lane.position(along, self.np_random.uniform(-2, 2))  # type: ignore[attr-defined]
        return self._observed(), info

    def step(self, action: Array) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        _, reward, terminated, _, info = self.env.step(action)
        vehicle = self.env.unwrapped.vehicle  # type: ignore[attr-defined]
        vehicle.lateral_speed += DT * self.wind + self.gust * self.np_random.standard_normal()
        return self._observed(), reward, terminated, False, info


class LaneWind(World):
    """theta: the side wind [1] in m/s^2, against which the expert steers: confounded, and Tier 2 suffices.

    Episodes are on the straight road alone.
    """

    steps, noise, gust = 35, 0.02 / STEERING, GUST
    evidence = [2]

    def make(self, theta: Array) -> gymnasium.Env:
        env = gymnasium.make("lane-keeping-v0", disable_env_checker=True)
        return SideWind(env.unwrapped, float(theta[0]), self.gust)

    def sample_theta(self, rng: np.random.Generator) -> Array:
        return rng.uniform(-WIND, WIND, 1)

    def expert(self, obs: Array, theta: Array) -> Array:
        """Heads into the wind, and slowly back to the middle."""
        heading = -DRIFT * theta / SPEED - 0.03 * obs[0]
        return (heading - obs[1]) / STEERING


class Bent(SideWind):
    """A steering with a bias that is added to each action, and gusts on the yaw rate after each step."""

    def __init__(self, env: gymnasium.Env, bias: float, sway: float) -> None:
        super().__init__(env, 0.0, 0.0)
        self.bias, self.sway = bias, sway

    def step(self, action: Array) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        _, reward, terminated, truncated, info = super().step(np.clip(action + self.bias, -1, 1))
        vehicle = self.env.unwrapped.vehicle  # type: ignore[attr-defined]
        vehicle.yaw_rate += self.sway * self.np_random.standard_normal()
        return self._observed(), reward, terminated, truncated, info


class LaneBias(LaneWind):
    """theta: the steering's bias [1]. A naive clone infers it by itself, in spite of the gusts."""

    gust = SWAY
    evidence = [2, 3]

    def make(self, theta: Array) -> gymnasium.Env:
        env = gymnasium.make("lane-keeping-v0", disable_env_checker=True)
        return Bent(env.unwrapped, float(theta[0]), self.gust)

    def sample_theta(self, rng: np.random.Generator) -> Array:
        return rng.uniform(-BIAS, BIAS, 1)

    def expert(self, obs: Array, theta: Array) -> Array:
        return super().expert(obs, np.zeros(1)) - theta


class LaneReversed(LaneWind):
    """theta: 1, or -1 where the steering turns the other way [1], which gusts on the yaw rate hide for a while."""

    gust = SWAY
    evidence = []

    def make(self, theta: Array) -> gymnasium.Env:
        env = gymnasium.make("lane-keeping-v0", disable_env_checker=True)
        bent = Bent(env.unwrapped, 0.0, self.gust)
        return gymnasium.wrappers.TransformAction(bent, lambda action: theta[0] * action, None)

    def sample_theta(self, rng: np.random.Generator) -> Array:
        return rng.choice([-1.0, 1.0], 1)

    def expert(self, obs: Array, theta: Array) -> Array:
        return theta * super().expert(obs, np.zeros(1))


class LaneHabits(LaneWind):
    """No wind: each driver keeps an offset of their own, of up to a metre, which costs nothing to speak of."""

    gust = 0.4
    evidence = []

    def make(self, theta: Array) -> gymnasium.Env:
        return super().make(np.zeros(1))

    def sample_theta(self, rng: np.random.Generator) -> Array:
        return rng.uniform(-1, 1, 1)

    def expert(self, obs: Array, theta: Array) -> Array:
        return super().expert(obs - (theta[0], 0.0, 0.0, 0.0), np.zeros(1))


class LaneLate(LaneWind):
    """No wind, nothing hidden: each action is logged a step late."""

    gust = 0.4
    evidence = []

    def sample_theta(self, rng: np.random.Generator) -> Array:
        return np.zeros(1)

    def logged(self, trials: Trials) -> Trials:
        action = np.concatenate([trials.action[:, :, :1], trials.action[:, :, :-1]], 2)
        return Trials(trials.obs, action, trials.mask, trials.actions)
