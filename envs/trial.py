"""A trial of several episodes as a single one, for gymnasium clients whose memory ends with an episode."""

from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from deconfounded.envs.streams import Obs
from deconfounded.envs.support.errors import InputError
from deconfounded.envs.support.spaces import action_sizes

Info = dict[str, Any]


class TrialEnv(gym.Wrapper[Any, Any, Any, Any]):
    """Ends (terminated or truncated) with the last episode of a trial; `env` is made with `episodes`.

    The step that ends an earlier episode returns the first observation of the next, under the same theta, and info then
    has `final_obs`, the ended episode's last. `reset` starts a new trial. Observations [O + F + 1]: the environment's;
    the action before, one-hot if discrete, without which what the world does tells little of theta; and 1 where an
    episode starts, which has no such action. Raises InputError for an environment without `episodes`.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        if getattr(env.unwrapped, "episodes", 1) < 2:
            raise InputError("TrialEnv was given an environment of one episode a trial; make it with episodes=5, say")
        inner, (width, self._actions) = env.observation_space, action_sizes(env.action_space)
        assert isinstance(inner, spaces.Box)
        self._before = np.zeros(self._actions or width, np.float32)
        more = np.ones(len(self._before) + 1, np.float32)
        low = np.array([0 if self._actions else -1] * len(self._before) + [0], np.float32)
        self.observation_space = spaces.Box(np.append(inner.low, low), np.append(inner.high, more))
        self._left = 0

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Obs, Info]:
        given = {} if options is None else options
        if isinstance(given, dict):
            given = {"keep_theta": False, **given}  # else `env` might go on with an earlier trial
        obs, info = self.env.reset(seed=seed, options=given)
        self._left = int(self.env.unwrapped.episodes) - 1  # type: ignore[attr-defined]
        return self._started(obs), info

    def step(self, action: Any) -> tuple[Obs, SupportsFloat, bool, bool, Info]:
        obs, reward, terminated, truncated, info = self.env.step(action)
        if self._left and (terminated or truncated):
            self._left -= 1
            following, _ = self.env.reset(options={"keep_theta": True})
            return self._started(following), reward, False, False, {**info, "final_obs": obs}
        taken = np.asarray(action, np.float32).reshape(-1).clip(-1, 1)
        before = np.eye(self._actions, dtype=np.float32)[int(action)] if self._actions else taken
        return np.concatenate([obs, before, [0]], dtype=np.float32), reward, terminated, truncated, info

    def _started(self, obs: Obs) -> Obs:
        return np.concatenate([obs, self._before, [1]], dtype=np.float32)
