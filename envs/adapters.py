"""Interfaces of a BatchEnv: gymnasium Env and VectorEnv, and dm_env. They hold no maths of any task."""

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

from deconfounded.envs.batch import BatchEnv, Seed
from deconfounded.envs.streams import Obs
from deconfounded.envs.support.errors import InputError
from deconfounded.envs.support.numbers import check_number
from deconfounded.envs.task import Mask, Renderer, Task

Info = dict[str, Any]


def _array(action: Any) -> NDArray[Any]:
    try:
        return np.asarray(action)
    except (ValueError, RuntimeError):  # lists of several lengths; a tensor with a gradient
        raise InputError(f"action was {action!r}; it must be numbers, as many in each row") from None


def _observation_space(task: Task, privileged: bool) -> spaces.Box:
    base, more = task.observation_space, np.ones(task.seen_width if privileged else 0, np.float32)
    return spaces.Box(np.append(base.low, -more), np.append(base.high, more))


def _metadata(task: Task, render_mode: str | None) -> dict[str, Any]:
    """Gymnasium's metadata for rendering. Raises InputError for an unknown render_mode."""
    modes = ["rgb_array"] if task.has_likelihood else []  # a black box has no pictures
    if render_mode not in (None, *modes):
        right = "'rgb_array' or None" if modes else "None, as a black box has no pictures"
        raise InputError(f"render_mode of {task.name} was {render_mode!r}; it must be {right}")
    return {"render_modes": modes, "render_fps": max(1, round(1 / task.control_dt))}


class _Pictures:
    """Pictures of a batch's environments; each has a renderer of its own, which is replaced when its theta changes."""

    def __init__(self, batch: BatchEnv) -> None:
        self._batch = batch
        self._renderers: dict[int, tuple[NDArray[Any], Renderer]] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_renderers": {}}  # a copy creates its own

    def __call__(self, i: int) -> NDArray[np.uint8]:
        """Environment i -> [H, W, 3]. Raises InputError before the first reset, and where no picture can be made."""
        if not self._batch.state.size:
            raise InputError("render was called before the first reset; reset once")
        theta = self._batch.theta[i].copy()
        if i not in self._renderers or (self._renderers[i][0] != theta).any():
            self._renderers[i] = theta, self._batch.task.renderer(theta)
        return self._renderers[i][1](self._batch.state[i], self._batch.action[i])


class GymEnv(gym.Env[Any, Any]):
    """One environment with gymnasium's interface: the batch of one.

    `reset(options={"keep_theta": True})` starts the next episode of a trial; `options={"theta": [...]}` forces theta.
    With `episodes`, a reset without seed and options does so too, until the trial has had as many: for clients that
    reset without options. theta is in no info, and in no observation unless privileged=True, for experts. Raises
    InputError for bad input.
    """

    def __init__(self, task: Task, privileged: bool = False, render_mode: str | None = None, episodes: int = 1) -> None:
        check_number("episodes", episodes)
        self.metadata = _metadata(task, render_mode)
        self.task, self.render_mode, self.episodes, self._episode = task, render_mode, episodes, 0
        self.batch = BatchEnv(task, 1, privileged)
        self.observation_space = _observation_space(task, privileged)
        self.action_space = copy.deepcopy(task.action_space)
        self._pictures, self._warned = _Pictures(self.batch), False

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Obs, Info]:
        self._warned = False
        if seed is None and not options and 0 < self._episode < self.episodes:
            options = {"keep_theta": True}
        obs = self.batch.reset(seed, options)[0]
        first = np.ravel(np.array(seed, object))[0]  # a batch takes a list of one
        super().reset(seed=None if first is None else int(first))
        self._episode = self._episode + 1 if (options or {}).get("keep_theta", False) else 1
        return obs, {}

    def step(self, action: Any) -> tuple[Obs, float, bool, bool, Info]:
        row, alive = _array(action), self.batch.alive
        obs, reward, terminated, truncated = self.batch.step(row.reshape(1, 1) if row.size == 1 else row[None])
        if not alive[0] and not self._warned:
            gym.logger.warn(f"step of {self.task.name} was called after the end of an episode; it moves nothing: reset")
            self._warned = True
        return obs[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), {}

    def render(self) -> Any:
        return None if self.render_mode is None else self._pictures(0)

    def close(self) -> None:
        self.batch.close()


class GymVectorEnv(VectorEnv[Any, Any, NDArray[Any]]):
    """n environments stepped natively; equal, bit for bit, to gymnasium's SyncVectorEnv over n GymEnv.

    A finished environment is reset by the next step, or with AutoresetMode.SAME_STEP by the step that finished it, and
    info then has `final_obs`. The new episode is under the same theta until its trial has had `episodes` episodes, then
    under a new theta. `reset` does so too, if it is given neither seed nor options. It takes the options of
    GymEnv.reset; keep_theta may be a mask [N]: where True, the next episode of the trial starts, elsewhere the first
    episode of a new trial.
    """

    def __init__(
        self,
        task: Task,
        n: int,
        privileged: bool = False,
        episodes: int = 1,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode = AutoresetMode.NEXT_STEP,
    ) -> None:
        check_number("episodes", episodes)
        modes = (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP)
        if autoreset_mode not in (*modes, *(mode.value for mode in modes)):
            right = "it must be AutoresetMode.NEXT_STEP or SAME_STEP"
            raise InputError(f"autoreset_mode of {task.name} was {autoreset_mode!r}; {right}")
        self.metadata = {**_metadata(task, render_mode), "autoreset_mode": AutoresetMode(autoreset_mode)}
        self.batch = BatchEnv(task, n, privileged)
        self.task, self.num_envs, self.episodes, self.render_mode = task, n, episodes, render_mode
        self._pictures, self._episode = _Pictures(self.batch), np.zeros(n, int)
        self.single_observation_space = _observation_space(task, privileged)
        self.single_action_space = copy.deepcopy(task.action_space)
        self.observation_space = batch_space(self.single_observation_space, n)
        self.action_space = batch_space(task.action_space, n)

    def reset(self, *, seed: Seed = None, options: Info | None = None) -> tuple[Obs, Info]:
        if seed is None and not options and (going_on := (self._episode > 0) & (self._episode < self.episodes)).any():
            options = {"keep_theta": going_on}
        obs = self.batch.reset(seed, options)
        super().reset(seed=int(seed) if isinstance(seed, int | np.integer) else None)
        self._episode = np.where((options or {}).get("keep_theta", False), self._episode + 1, 1)
        return obs, {}

    def step(self, actions: Any) -> tuple[Obs, NDArray[Any], Mask, Mask, Info]:
        rows, over = _array(actions), ~self.batch.alive
        ended = self.batch.advance(rows[:, None] if rows.ndim == 1 else rows)
        info: Info = {}
        if self.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP and (over := ~self.batch.alive).any():
            final, last = np.full(self.num_envs, None, object), self.batch.observe()
            for i in np.flatnonzero(over):
                final[i] = last[i]
            info = {"final_obs": final, "_final_obs": over, "final_info": {}, "_final_info": over.copy()}
        if not over.any():
            return self.batch.observe(), *ended, info
        keep = self._episode < self.episodes
        obs = self.batch.reset(options={"keep_theta": keep}, where=over)
        self._episode = np.where(over, np.where(keep, self._episode + 1, 1), self._episode)
        return obs, *ended, info

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """A picture [H, W, 3] of each environment; None without a render_mode."""
        return None if self.render_mode is None else tuple(self._pictures(i) for i in range(self.num_envs))

    def close_extras(self, **_: Any) -> None:
        self.batch.close()


class DmEnv(dm_env.Environment):
    """One environment with dm_env's interface. The discount is 0 on termination and 1 on truncation."""

    def __init__(self, task: Task, privileged: bool = False, seed: int | None = None) -> None:
        self.task, self._batch = task, BatchEnv(task, 1, privileged)
        self._space, self._pictures = _observation_space(task, privileged), _Pictures(self._batch)
        self._batch.seed(seed)

    def reset(self, options: Info | None = None) -> dm_env.TimeStep:
        """Start an episode; `options` as in GymEnv.reset."""
        return dm_env.restart(self._batch.reset(options=options)[0])

    def step(self, action: Any) -> dm_env.TimeStep:
        if not self._batch.alive[0]:
            return self.reset()
        obs, reward, terminated, truncated = self._batch.step(_array(action).reshape(1, -1))
        ended = dm_env.truncation if truncated[0] else dm_env.transition
        return (dm_env.termination if terminated[0] else ended)(float(reward[0]), obs[0])

    def render(self) -> NDArray[np.uint8]:
        """The picture [H, W, 3] of the present state. Raises InputError before the first reset."""
        return self._pictures(0)

    def observation_spec(self) -> specs.BoundedArray:
        return _spec(self._space, "observation")

    def action_spec(self) -> specs.BoundedArray:
        return _spec(self.task.action_space, "action")

    def close(self) -> None:
        self._batch.close()


def _spec(space: spaces.Box | spaces.Discrete, name: str) -> specs.BoundedArray:
    if isinstance(space, spaces.Discrete):
        return specs.DiscreteArray(int(space.n), name=name)
    return specs.BoundedArray(space.shape, space.dtype, space.low, space.high, name)
