"""Does a task hold together? Asked before anything is trained or measured: a slip in a task file is one line then."""

from __future__ import annotations

import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from deconfounded.envs.batch import BatchEnv
from deconfounded.envs.physics import MujocoTask
from deconfounded.envs.streams import Streams
from deconfounded.envs.task import InputError, Task


@contextmanager
def _part(task: Task, name: str) -> Iterator[None]:
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        text = " ".join(str(error.args[0] if error.args else error).split())
        frame = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{Path(frame.filename).name}:{frame.lineno}"
        raise InputError(f"{name} of {task.name}: {text} ({type(error).__name__}, {where})") from error


def check_task(task: Task) -> None:
    """Build it and take one step, twice side by side. Raises InputError that names the part which does not fit."""
    if isinstance(task, MujocoTask):
        with _part(task, f"the model (assets/{task.name}.xml, or what `spec` makes)"):
            task.model  # noqa: B018 (compiles it)
        with _part(task, "process_noise"):
            task.noise  # noqa: B018
    n = 2
    rng = Streams([np.random.default_rng(seed) for seed in range(n)])
    action = np.zeros((n, *(task.action_space.shape or (1,))))
    with _part(task, "apply_latent"):
        env = BatchEnv(task, n)
    with _part(task, "init_state"):
        state = task.init_state(rng)
    with _part(task, "outcome"):
        noise = task.sample_noise(rng)[:, 0]
        then = task.apply_noise(env.simulator.outcome(state, action), noise)
    for name, shape, ask in (
        ("observe", (n, len(task.observation)), lambda: task.observe(state)),
        ("reward", (n,), lambda: task.reward(state, action, then, env.theta)),
        ("terminated", (n,), lambda: task.terminated(then)),
    ):
        with _part(task, name):
            given = np.asarray(ask())
            if given.shape != shape:
                raise InputError(f"{name} of {task.name} gave {given.shape} of {n} environments; it must be {shape}")
            if not np.isfinite(given).all():
                raise InputError(f"{name} of {task.name} gave {given.tolist()}; it must be finite")
    with _part(task, "an episode"):
        env.reset(0)
        env.step(action)
