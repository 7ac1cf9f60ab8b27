"""Does a task hold together? Asked before anything is trained or measured: a slip in a task file is one line then."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from envs.batch import BatchEnv
from envs.physics import MujocoTask
from envs.task import InputError, Task


@contextmanager
def _part(task: Task, name: str) -> Iterator[None]:
    try:
        yield
    except InputError:
        raise
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        text = " ".join(str(error.args[0] if error.args else error).split())
        raise InputError(f"{name} of {task.name}: {text}") from error


def check_task(task: Task) -> None:
    """Build it and take one step. Raises InputError that names the part of the task which does not fit the others."""
    if isinstance(task, MujocoTask):
        with _part(task, f"the model (assets/{task.name}.xml, or what `spec` makes)"):
            task.spec()
            task.model  # noqa: B018 (compiles it)
        with _part(task, "process_noise"):
            task._noisy  # noqa: B018
        with _part(task, "apply_latent"):
            task.simulator(1)
    with _part(task, "init_state"):
        state = task.init_state(np.random.default_rng(0))[None]
    with _part(task, "observe"):
        width = task.observe(state).shape[-1]
        if width != len(task.observation):
            raise InputError(
                f"observe of {task.name} gave {width} numbers; it must be {len(task.observation)}, as `observation`"
            )
    with _part(task, "a step"):
        env = BatchEnv(task, 1)
        env.reset(0)
        env.step(np.zeros((1, *(task.action_space.shape or (1,)))))
