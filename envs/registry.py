"""The registry of tasks: `register`, `names`, `get`, `make`, `make_vec`, `make_dm`."""

import copyreg
import difflib
import re
from importlib.metadata import entry_points
from typing import Any

import gymnasium
from gymnasium.vector import AutoresetMode

from deconfounded.envs import blackbox
from deconfounded.envs.adapters import DmEnv, GymEnv, GymVectorEnv
from deconfounded.envs.latent import Latent
from deconfounded.envs.support import outside
from deconfounded.envs.support.errors import error_line
from deconfounded.envs.task import InputError, Task

TASKS: dict[str, type[Task]] = {}
GROUP = "deconfounded.tasks"  # group of entry points of installed packages: name = "package.module:Class"


def register(cls: type[Task]) -> type[Task]:
    """Add a task to the registry and to gymnasium; usable as a decorator. Raises InputError for an invalid class."""
    if not isinstance(cls, type):
        raise InputError(f"register was given {cls!r}; it takes a class of tasks, not one of its tasks")
    name, where = getattr(cls, "name", None), _where(cls)
    if not isinstance(name, str) or not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        right = "it must be of a-z, 0-9 and _, from a letter on"
        raise InputError(f"name of {cls.__name__} in {where} was {name!r}; {right}")
    if missing := sorted(cls.__abstractmethods__):
        raise InputError(f"task {name} of {where} lacks {', '.join(missing)}")
    for part in ("latents", "horizon", "action_space", "observation"):
        if not hasattr(cls, part):
            raise InputError(f"task {name} of {where} does not state its {part}")
    try:
        task = cls()
    except TypeError as error:
        raise InputError(f"task {name} of {where}: {error_line(error)}; {cls.__name__}() must do") from None
    _check_latents(task)
    before = TASKS.get(name, cls)
    if (before.__module__, before.__qualname__) != (cls.__module__, cls.__qualname__):  # not the same, defined again
        if (where, cls.__qualname__) == (_where(before), before.__qualname__):
            raise InputError(f"{where} is the file of {name}, which is registered; use that name")
        raise InputError(f"task name {name!r} of {where} is taken by {_where(before)}; give it another name")
    if "reference" not in vars(cls):
        ours = cls.__module__.startswith(f"{__package__}.")
        cls.reference = name if ours else outside.reference(cls) or name
    if outside.is_outside(cls.reference):
        copyreg.pickle(cls, _parts)
    gym_id, steps = task.gym_id, task.horizon
    if twins := [each for each in TASKS if each != name and TASKS[each]().gym_id == gym_id]:
        raise InputError(f"task {name!r} of {where} would be {gym_id}, as {twins[0]} is; give it another name")
    TASKS[name] = cls
    for stale in (before().gym_id, gym_id):
        gymnasium.registry.pop(stale, None)
    one, many, arguments = f"{__name__}:make", f"{__name__}:make_registered_vec", {"name": cls.reference}
    gymnasium.register(gym_id, one, max_episode_steps=steps, vector_entry_point=many, kwargs=arguments)
    return cls


def _check_latents(task: Task) -> None:
    given = task.latents
    if not isinstance(given, tuple) or not given or not all(isinstance(latent, Latent) for latent in given):
        raise InputError(f"latents of {task.name} were {given!r}; they must be a tuple of Latent, at least one")
    names = [str(latent.name) for latent in given]
    if len(set(names)) < len(names):
        raise InputError(f"latents of {task.name} were called {', '.join(names)}; each must have a name of its own")


def _parts(task: Task) -> tuple[Any, ...]:
    """Pickle's parts of a task from outside, whose module has no name that another process could import."""
    return get, (task.reference,), vars(task) or None


def _where(cls: type[Task]) -> str:
    return str(outside.source(cls) or cls.__module__)


def names() -> list[str]:
    """Names of registered tasks, and of those that installed packages offer as entry points."""
    return list(dict.fromkeys([*TASKS, *(point.name for point in entry_points(group=GROUP))]))


def closest(kind: str, given: str, choices: list[str], remedy: str = "") -> InputError:
    """The error for an unknown name, which suggests the closest of the choices; remedy: appended to the message."""
    near = difflib.get_close_matches(given, choices, 1, 0.6)
    hint = f"did you mean {near[0]!r}? " if near else ""
    return InputError(f"{kind} {given!r} is unknown; {hint}there are {', '.join(choices)}{remedy}")


def get(name: str) -> Task:
    """The task of a name, or of a reference: path/file.py:Class, or package.module:Class.

    Raises InputError, which suggests the closest name, if there is none.
    """
    if not isinstance(name, str):
        raise InputError(f"task was {name!r}; it must be a name, or path/file.py:Class")
    if name in TASKS:
        return TASKS[name]()
    name = {point.name: point.value for point in entry_points(group=GROUP)}.get(name, name)
    if not outside.is_outside(name):
        if name.endswith(".py"):
            raise InputError(f"task was {name!r}; it must name a class of that file: {name}:CLASS")
        raise closest("task", name, names(), "; your own is path/file.py:Class")
    reference = outside.absolute(name)
    before = next((task for task in TASKS.values() if task.reference == reference), None)
    if before and not outside.edited(before):
        return before()
    cls = outside.find("task", name)
    if any(cls is task for task in TASKS.values()):  # one of this package's, by the module that it is in
        return cls()
    if not isinstance(cls, type):
        raise InputError(f"task {name!r} is {cls!r}; it must be a subclass of deconfounded.envs.Task, or a world")
    if not issubclass(cls, Task):
        cls = blackbox.task_of(cls)
    cls.reference = reference
    if before:
        del TASKS[before.name]
    try:
        return register(cls)()
    except InputError:
        if before:
            TASKS[before.name] = before
        raise


def make(name: str, privileged: bool = False, render_mode: str | None = None, episodes: int = 1) -> GymEnv:
    """A gymnasium environment; `privileged` appends theta to the observation, for experts; see GymEnv."""
    return GymEnv(get(name), privileged, render_mode, episodes)


make.metadata = {"render_modes": ["rgb_array"]}  # type: ignore[attr-defined]  # gymnasium.make adds modes of its own


def make_vec(
    name: str,
    n: int,
    privileged: bool = False,
    episodes: int = 1,
    render_mode: str | None = None,
    autoreset_mode: AutoresetMode = AutoresetMode.NEXT_STEP,
) -> GymVectorEnv:
    """A gymnasium VectorEnv of n environments, stepped natively in a thread pool; a trial has `episodes` episodes."""
    return GymVectorEnv(get(name), n, privileged, episodes, render_mode, autoreset_mode)


def make_registered_vec(name: str, num_envs: int = 1, max_episode_steps: int | None = None, **kw: Any) -> GymVectorEnv:
    """`make_vec` as gymnasium.make_vec calls it. Raises InputError for a time limit other than the registered one."""
    task = get(name)
    if max_episode_steps not in (None, task.horizon):
        right = f"{task.horizon} here, or left out: vectorization_mode='sync' takes shorter ones"
        raise InputError(f"max_episode_steps of {task.name} was {max_episode_steps}; it must be {right}")
    return make_vec(name, num_envs, **kw)


def make_dm(name: str, privileged: bool = False, seed: int | None = None) -> DmEnv:
    """A dm_env environment."""
    return DmEnv(get(name), privileged, seed)
