"""What checks of a task share: actions, thetas and generators to ask it with, and sentences for what they find."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import product

import numpy as np

from deconfounded.envs import render
from deconfounded.envs.physics import MujocoTask
from deconfounded.envs.streams import Array, Streams
from deconfounded.envs.support.errors import InputError
from deconfounded.envs.task import Task


class Skipped(Exception):  # noqa: N818 (nothing is wrong)
    """A check that does not apply, or that cannot be made here: one line that says why."""


def require(condition: object, message: str) -> None:
    """Raises AssertionError with the message unless the condition holds; under `python -O`, too."""
    if not condition:
        raise AssertionError(message)


def same(one: object, other: object, what: str) -> None:
    """Raises AssertionError, with the first place where they differ, unless two arrays are equal; NaN equals NaN."""
    a, b = np.asarray(one), np.asarray(other)
    require(a.shape == b.shape, f"{what} differ: their shapes are {a.shape} and {b.shape}")
    places = np.argwhere((a != b) & ((a == a) | (b == b)))
    if len(places):
        at = tuple(places[0].tolist())
        raise AssertionError(
            f"{what} differ: {a[at]} and {b[at]} at {list(at)}, the first of {len(places)} such places"
        )


@contextmanager
def refused(what: str, says: str) -> Iterator[None]:
    """Raises AssertionError unless an InputError that matches `says`, a regular expression, is raised within."""
    try:
        yield
    except InputError as error:
        require(re.search(says, str(error)), f"{what} was refused by {str(error)!r}, which does not match {says!r}")
    else:
        raise AssertionError(f"{what} was let through; it must be an InputError")


@contextmanager
def told_by(whom: str) -> Iterator[None]:
    """Whatever another library's checker raises is an AssertionError that names the library."""
    try:
        yield
    except Exception as error:
        raise AssertionError(f"{whom}: {' '.join(str(error).split())} ({type(error).__name__})") from error


def physics(task: Task) -> MujocoTask:
    """The task itself. Raises Skipped if it is not MuJoCo's."""
    if not isinstance(task, MujocoTask):
        raise Skipped("this is of MuJoCo tasks")
    return task


def actions(task: Task, n: int, steps: int) -> Array:
    """[steps, n, A] random actions, the same for the same arguments."""
    rng = np.random.default_rng(99)
    shape = (steps, n, task.action_width)
    return rng.integers(task.n_actions, size=shape).astype(float) if task.n_actions else rng.uniform(-1, 1, shape)


def far_thetas(task: Task) -> Array:
    """[J, L] thetas that span the range of every latent."""
    return np.array(list(product(*(lat.grid(5)[::2] for lat in task.latents))))


def streams(*seeds: int) -> Streams:
    """A generator for each environment."""
    return Streams([np.random.default_rng(seed) for seed in seeds])


def gl_works() -> bool:
    """Whether pictures can be made here."""
    try:
        render.backend()
    except InputError:
        return False
    return True


def beyond_bounds(task: Task, state: Array) -> str:
    """A sentence about an observation of states [N, S] beyond its bounds by more than 1e-3, which clips it; or ""."""
    if not len(state):
        return ""
    seen = task.observe(state)
    for i, (name, (low, high)) in enumerate(task.observation.items()):
        if (bad := ~((seen[:, i] >= low - 1e-3) & (seen[:, i] <= high + 1e-3))).any():
            return (
                f"observation {name} of {task.name} was {seen[bad, i][0]:g}; its bounds, {low:g} to {high:g}, must be"
                f" wide enough never to clip"
            )
    return ""
