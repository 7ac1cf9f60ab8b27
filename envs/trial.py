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

    After an earlier episode's end the next step takes no action: it returns the first observation of the next episode,
    under the same theta, and reward 0, as Gymnasium's vector environments do by AutoresetMode.NEXT_STEP. So a memory
    sees every transition. `reset` starts a new trial. Observations [O + F + 1]: the environment's; the action before,
    one-hot if discrete, without which what the world does tells little of theta; and 1 where an episode starts, which
    has no such action. Raises InputError for an environment without `episodes`.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        if getattr(env.unwrapped, "episodes", 1) < 2:
            raise InputError("TrialEnv was given an environment of one episode a trial; make it with episodes=5, say")
        inner, acts, (width, self._actions) = env.observation_space, env.action_space, action_sizes(env.action_space)
        assert isinstance(inner, spaces.Box)
        self._before = np.zeros(self._actions or width, np.float32)
        self._range = (acts.low, acts.high) if isinstance(acts, spaces.Box) else (self._before, self._before + 1)
        low = np.concatenate([inner.low, self._range[0].clip(max=0), [0]])  # 0 where there is no action before
        high = np.concatenate([inner.high, self._range[1].clip(min=0), [1]])
        self.observation_space = spaces.Box(low.astype(np.float32), high.astype(np.float32))
        self._left, self._over = 0, False

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Obs, Info]:
        given = {} if options is None else options
        if isinstance(given, dict):
            given = {"keep_theta": False, **given}  # else `env` might go on with an earlier trial
        obs, info = self.env.reset(seed=seed, options=given)
        self._left, self._over = int(self.env.unwrapped.episodes) - 1, False  # type: ignore[attr-defined]
        return self._started(obs), info

    def step(self, action: Any) -> tuple[Obs, SupportsFloat, bool, bool, Info]:
        if self._over:
            self._left, self._over = self._left - 1, False
            following, info = self.env.reset(options={"keep_theta": True})
            return self._started(following), 0.0, False, False, info
        obs, reward, terminated, truncated, info = self.env.step(action)
        if self._left and (terminated or truncated):
            self._over, terminated, truncated = True, False, False
        taken = np.asarray(action).reshape(-1)
        before = np.eye(self._actions)[int(taken[0])] if self._actions else taken.clip(*self._range)
        return np.concatenate([obs, before, [0]], dtype=np.float32), reward, terminated, truncated, info

    def _started(self, obs: Obs) -> Obs:
        return np.concatenate([obs, self._before, [1]], dtype=np.float32)
