"""Tasks with hidden physics, and their registry: `names`, `get`, `register`, `make`, `make_vec`, `make_dm`.

The suite's tasks are in tasks/; a task of your own stays in your folder: `get("path/file.py:Class")`. Importing this
package also registers every task with gymnasium, so that `gymnasium.make("deconf/SlipperyCartpole-v1")` works.
"""

import os

_gl = os.environ.get("MUJOCO_GL")
os.environ["MUJOCO_GL"] = "off"  # `import mujoco` fails if the backend is missing, which only rendering needs
import mujoco  # noqa: F401

if _gl is None:
    del os.environ["MUJOCO_GL"]
else:
    os.environ["MUJOCO_GL"] = _gl

from deconfounded.envs.adapters import DmEnv, GymEnv, GymVectorEnv
from deconfounded.envs.batch import BatchEnv
from deconfounded.envs.contract.check import check_task
from deconfounded.envs.latent import Latent
from deconfounded.envs.physics import MujocoTask
from deconfounded.envs.registry import TASKS, closest, get, make, make_dm, make_vec, names, register
from deconfounded.envs.support.errors import InputError
from deconfounded.envs.task import Task
from deconfounded.envs.tasks import HARD, SUITE
from deconfounded.envs.trial import TrialEnv

__all__ = ["HARD", "SUITE", "TASKS", "BatchEnv", "DmEnv", "GymEnv", "GymVectorEnv", "InputError", "Latent"]
__all__ += [
    "MujocoTask",
    "Task",
    "TrialEnv",
    "check_task",
    "closest",
    "get",
    "make",
    "make_dm",
    "make_vec",
    "names",
    "register",
]
