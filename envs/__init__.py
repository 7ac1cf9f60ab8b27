"""Tasks with hidden physics, and the registry: `names`, `get`, `register`, `make`, `make_vec`, `make_dm`.

A new task is one file, one MJCF and two lines here: its import, and its class in the list at the end. One of your own
stays in your own folder: `get("path/file.py:Class")`. Importing this package also registers every task with gymnasium,
so that `gymnasium.make("deconf/SlipperyCartpole-v1")` works.
"""

from __future__ import annotations

import os

_gl = os.environ.pop("MUJOCO_GL", None)  # `import mujoco` dies of a backend that is not there; pictures can wait
import mujoco  # noqa: F401

if _gl is not None:
    os.environ["MUJOCO_GL"] = _gl

from deconfounded.envs.adapters import DmEnv, GymEnv, GymVectorEnv
from deconfounded.envs.bandit import Bandit
from deconfounded.envs.batch import BatchEnv
from deconfounded.envs.check import check_task
from deconfounded.envs.forked_path import ForkedPath
from deconfounded.envs.heavy_payload import HeavyPayload
from deconfounded.envs.hidden_goal import HiddenGoal
from deconfounded.envs.icy_road import IcyRoad
from deconfounded.envs.physics import MujocoTask
from deconfounded.envs.registry import (
    TASKS,
    closest,
    get,
    make,
    make_dm,
    make_registered_vec,
    make_vec,
    names,
    register,
    suite,
)
from deconfounded.envs.slippery_cartpole import SlipperyCartpole
from deconfounded.envs.slippery_walker import SlipperyWalker
from deconfounded.envs.task import InputError, Latent, Task
from deconfounded.envs.tilted_cartpole import TiltedCartpole

__all__ = [
    "TASKS",
    "BatchEnv",
    "DmEnv",
    "GymEnv",
    "GymVectorEnv",
    "InputError",
    "Latent",
    "MujocoTask",
    "Task",
    "check_task",
    "closest",
    "get",
    "make",
    "make_dm",
    "make_registered_vec",
    "make_vec",
    "names",
    "register",
    "suite",
]

for _task in (
    Bandit,
    TiltedCartpole,
    SlipperyCartpole,
    HeavyPayload,
    IcyRoad,
    SlipperyWalker,
    HiddenGoal,
    ForkedPath,
):
    register(_task)
