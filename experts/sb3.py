"""Batched environments as a Stable-Baselines3 VecEnv, for fast training of experts."""

from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from deconfounded import envs


class BatchVecEnv(VecEnv):
    """A VecEnv that is stepped as a batch: it has no separate environments to get attributes of, or to call."""

    def close(self) -> None:
        """Nothing to close."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [None for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise NotImplementedError

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]


class Sb3VecEnv(BatchVecEnv):
    """A VecEnv of n privileged environments; a finished environment is reset in the same step, as SB3 expects."""

    def __init__(self, task: envs.Task, n: int, seed: int) -> None:
        self.env = envs.GymVectorEnv(task, n, privileged=True)
        super().__init__(n, self.env.single_observation_space, self.env.single_action_space)
        self.seed(seed)  # of the next reset
        self._returns, self._lengths = np.zeros(n), np.zeros(n, int)

    def reset(self) -> Any:
        self._returns[:], self._lengths[:] = 0, 0
        seeds = None if None in self._seeds else self._seeds
        self._reset_seeds()
        return self.env.reset(seed=seeds)[0]

    def close(self) -> None:
        self.env.close()

    def step_async(self, actions: Any) -> None:
        self._actions = actions

    def step_wait(self) -> Any:
        batch = self.env.batch
        actions = self._actions[:, None] if self._actions.ndim == 1 else self._actions
        obs, reward, terminated, truncated = batch.step(actions)
        done = terminated | truncated
        self._returns += reward
        self._lengths += 1
        infos: list[dict[str, Any]] = [{} for _ in done]
        for i in np.flatnonzero(done):
            episode = {"r": self._returns[i], "l": self._lengths[i], "t": 0.0}
            infos[i] = {"terminal_observation": obs[i], "episode": episode}
            infos[i]["TimeLimit.truncated"] = bool(truncated[i] & ~terminated[i])
        if done.any():
            self._returns[done], self._lengths[done] = 0, 0
            obs = batch.reset(where=done)
        return obs, reward.astype(np.float32), done, infos
