"""Protocols over BatchEnv: gymnasium Env and VectorEnv, and dm_env. No maths of any task lives here."""

from __future__ import annotations

import copy
from typing import Any

import dm_env
import gymnasium as gym
import numpy as np
from dm_env import specs
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from deconfounded.envs.batch import BatchEnv
from deconfounded.envs.task import InputError, Painter, Task


def _observation_space(task: Task, privileged: bool) -> spaces.Box:
    base = task.observation_space
    if not privileged:
        return base
    features = sum(lat.features for lat in task.latents)
    low, high = np.append(base.low, [-1.0] * features), np.append(base.high, [1.0] * features)
    return spaces.Box(low.astype(np.float32), high.astype(np.float32))


class GymEnv(gym.Env[Any, Any]):
    """One environment with gymnasium's interface: the batch of one.

    `reset(options={"keep_theta": True})` starts the next episode of a trial; `options={"theta": [...]}` forces theta.
    theta is in no observation (but for privileged=True, for experts) and in no info. Raises InputError for bad input.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 25}

    def __init__(self, task: Task, privileged: bool = False, render_mode: str | None = None) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise InputError(f"render_mode of {task.name} was {render_mode!r}; it must be 'rgb_array' or None")
        self.task, self.render_mode = task, render_mode
        self.batch = BatchEnv(task, 1, privileged)
        self.observation_space = _observation_space(task, privileged)
        self.action_space = copy.deepcopy(task.action_space)
        self.metadata = {**self.metadata, "render_fps": round(1 / task.control_dt)}
        self._action = np.zeros(self.action_space.shape or (1,))
        self._painter: Painter | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        super().reset(seed=seed)
        if not (options or {}).get("keep_theta"):
            self._painter = None
        return self.batch.reset(seed, options)[0], {}

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        self._action = np.asarray(action)
        row = np.reshape(self._action, (1,)) if self._action.size == 1 else self._action
        obs, reward, terminated, truncated = self.batch.step(row[None])
        return obs[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), {}

    def render(self) -> Any:
        if self.render_mode is None:
            return None
        if not self.batch.state.size:
            raise InputError("render was called before the first reset; reset once")
        if self._painter is None:
            self._painter = self.task.painter(self.batch.theta[0])
        return self._painter(self.batch.state[0], self._action.reshape(-1))


class GymVectorEnv(VectorEnv[Any, Any, NDArray[Any]]):
    """n environments stepped natively; equal, bit for bit, to gymnasium's SyncVectorEnv over n GymEnv.

    A finished environment is reset by the next step (AutoresetMode.NEXT_STEP), with a theta of its own.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(self, task: Task, n: int, privileged: bool = False) -> None:
        if n < 1:
            raise InputError(f"the number of environments was {n}; it must be at least 1")
        self.task, self.num_envs = task, n
        self.batch = BatchEnv(task, n, privileged)
        self.single_observation_space = _observation_space(task, privileged)
        self.single_action_space = copy.deepcopy(task.action_space)
        self.observation_space = batch_space(self.single_observation_space, n)
        self.action_space = batch_space(task.action_space, n)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        return self.batch.reset(seed, options), {}

    def step(
        self, actions: Any
    ) -> tuple[NDArray[np.float32], NDArray[Any], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        array = np.asarray(actions)
        rows = array[:, None] if array.ndim == 1 else array
        return *self.batch.step(rows, autoreset=True), {}


class DmEnv(dm_env.Environment):
    """One environment with dm_env's interface. The discount is 0 on termination and 1 on truncation."""

    def __init__(self, task: Task, privileged: bool = False, seed: int | None = None) -> None:
        self.task, self._batch = task, BatchEnv(task, 1, privileged)
        self._space = _observation_space(task, privileged)
        self._batch.seed(seed)

    def reset(self, options: dict[str, Any] | None = None) -> dm_env.TimeStep:
        """Start an episode; `options` as in GymEnv.reset."""
        return dm_env.restart(self._batch.reset(options=options)[0])

    def step(self, action: Any) -> dm_env.TimeStep:
        if not self._batch.alive[0]:
            return self.reset()
        obs, reward, terminated, truncated = self._batch.step(np.reshape(action, (1, -1)))
        if terminated[0]:
            return dm_env.termination(float(reward[0]), obs[0])
        end = dm_env.truncation if truncated[0] else dm_env.transition
        return end(float(reward[0]), obs[0])

    def observation_spec(self) -> specs.BoundedArray:
        space = self._space
        return specs.BoundedArray(space.shape, space.dtype, space.low, space.high, "observation")

    def action_spec(self) -> specs.BoundedArray:
        space = self.task.action_space
        if isinstance(space, spaces.Discrete):
            return specs.DiscreteArray(int(space.n), name="action")
        return specs.BoundedArray(space.shape, space.dtype, space.low, space.high, "action")
