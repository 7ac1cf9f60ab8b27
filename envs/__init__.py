"""Tasks with hidden physics, and the registry: `names`, `get`, `make`, `make_vec`, `make_dm`.

A new task is one file, one MJCF and two lines here: its import, and its class in TASKS. Importing this package also
registers every task with gymnasium, so that `gymnasium.make("deconf/SlipperyCartpole-v0")` works.
"""

from __future__ import annotations

import difflib
import os
from typing import Any

_gl = os.environ.pop("MUJOCO_GL", None)  # `import mujoco` dies of a backend that is not there; pictures can wait
import mujoco  # noqa: F401

if _gl is not None:
    os.environ["MUJOCO_GL"] = _gl

import gymnasium

from deconfounded.envs.adapters import DmEnv, GymEnv, GymVectorEnv
from deconfounded.envs.bandit import Bandit
from deconfounded.envs.batch import BatchEnv
from deconfounded.envs.check import check_task
from deconfounded.envs.forked_path import ForkedPath
from deconfounded.envs.heavy_payload import HeavyPayload
from deconfounded.envs.hidden_goal import HiddenGoal
from deconfounded.envs.icy_road import IcyRoad
from deconfounded.envs.physics import MujocoTask
from deconfounded.envs.slippery_cartpole import SlipperyCartpole
from deconfounded.envs.slippery_walker import SlipperyWalker
from deconfounded.envs.task import InputError, Latent, Task
from deconfounded.envs.tilted_cartpole import TiltedCartpole

__all__ = [
    "BatchEnv",
    "GymEnv",
    "GymVectorEnv",
    "InputError",
    "Latent",
    "MujocoTask",
    "Task",
    "check_task",
    "get",
    "make",
    "make_dm",
    "make_vec",
    "names",
]

TASKS: dict[str, type[Task]] = {
    cls.name: cls
    for cls in (
        Bandit,
        TiltedCartpole,
        SlipperyCartpole,
        HeavyPayload,
        IcyRoad,
        SlipperyWalker,
        HiddenGoal,
        ForkedPath,
    )
}


def names() -> list[str]:
    """The registered tasks."""
    return list(TASKS)


def closest(kind: str, given: str, known: list[str], remedy: str = "") -> InputError:
    """The error for a name that is not known: it names the nearest one, and what else may help."""
    near = difflib.get_close_matches(given, known, 1, 0.6)
    hint = f"did you mean {near[0]!r}? " if near else ""
    return InputError(f"{kind} {given!r} is unknown; {hint}there are {', '.join(known)}{remedy}")


def get(name: str) -> Task:
    """The task of that name. Raises InputError, naming the nearest, if there is none."""
    if name not in TASKS:
        raise closest("task", name, names(), "; a new one must be in TASKS in envs/__init__.py")
    return TASKS[name]()


def make(name: str, privileged: bool = False, render_mode: str | None = None) -> GymEnv:
    """A gymnasium environment; `privileged` appends theta to the observation, for experts."""
    return GymEnv(get(name), privileged, render_mode)


def make_vec(
    name: str, n: int, privileged: bool = False, episodes: int = 1, render_mode: str | None = None
) -> GymVectorEnv:
    """n environments in one gymnasium VectorEnv, stepped natively in a thread pool; trials are of `episodes` each."""
    return GymVectorEnv(get(name), n, privileged, episodes, render_mode)


def make_registered_vec(
    name: str, num_envs: int = 1, max_episode_steps: int | None = None, **kwargs: Any
) -> GymVectorEnv:
    """`make_vec` as gymnasium.make_vec calls it, with the registered time limit. Raises InputError for another one."""
    horizon = get(name).horizon
    if max_episode_steps not in (None, horizon):
        raise InputError(
            f"max_episode_steps of {name} was {max_episode_steps}; it must be {horizon} here, or left out:"
            " vectorization_mode='sync' takes shorter ones"
        )
    return make_vec(name, num_envs, **kwargs)


def make_dm(name: str, privileged: bool = False, seed: int | None = None) -> DmEnv:
    """A dm_env environment."""
    return DmEnv(get(name), privileged, seed)


for _task in (cls() for cls in TASKS.values()):
    gymnasium.register(
        _task.gym_id,
        entry_point="deconfounded.envs:make",
        vector_entry_point="deconfounded.envs:make_registered_vec",
        max_episode_steps=_task.horizon,
        kwargs={"name": _task.name},
    )
