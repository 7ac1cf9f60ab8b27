"""Helpers of checks: actions, thetas and generators to test a task with, and assertions with a message."""

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
    """A check that does not apply, or cannot be made here; the message says why."""


def require(condition: object, message: str) -> None:
    """Raise AssertionError with a message unless a condition holds; under `python -O`, too."""
    if not condition:
        raise AssertionError(message)


def same(left: object, right: object, what: str) -> None:
    """Raise AssertionError, with the first differing entry, unless two arrays are equal; NaN equals NaN."""
    a, b = np.asarray(left), np.asarray(right)
    require(a.shape == b.shape, f"{what} differ: their shapes are {a.shape} and {b.shape}")
    places = np.argwhere((a != b) & ((a == a) | (b == b)))
    if len(places):
        at = tuple(places[0].tolist())
        raise AssertionError(
            f"{what} differ: {a[at]} and {b[at]} at {list(at)}, the first of {len(places)} such places"
        )


@contextmanager
def refused(what: str, says: str) -> Iterator[None]:
    """Context that raises AssertionError unless an InputError is raised in it that matches the pattern `says`."""
    try:
        yield
    except InputError as error:
        require(re.search(says, str(error)), f"{what} was refused by {str(error)!r}, which does not match {says!r}")
    else:
        raise AssertionError(f"{what} was let through; it must be an InputError")


@contextmanager
def reported_by(checker: str) -> Iterator[None]:
    """Context that turns any error of another library's checker into an AssertionError that names the checker."""
    try:
        yield
    except Exception as error:
        raise AssertionError(f"{checker}: {' '.join(str(error).split())} ({type(error).__name__})") from error


def physics(task: Task) -> MujocoTask:
    """The task, if it is a MujocoTask. Raises Skipped otherwise."""
    if not isinstance(task, MujocoTask):
        raise Skipped("this check is for MuJoCo tasks")
    return task


def actions(task: Task, n: int, steps: int) -> Array:
    """Random actions [steps, n, A], the same for the same arguments."""
    rng = np.random.default_rng(99)
    shape = (steps, n, task.action_width)
    return rng.integers(task.n_actions, size=shape).astype(float) if task.n_actions else rng.uniform(-1, 1, shape)


def far_thetas(task: Task) -> Array:
    """Thetas [J, L] that span the range of every latent."""
    return np.array(list(product(*(lat.grid(5)[::2] for lat in task.latents))))


def streams(*seeds: int) -> Streams:
    """Streams with a generator for each seed."""
    return Streams([np.random.default_rng(seed) for seed in seeds])


def gl_works() -> bool:
    """Whether a GL for pictures works here."""
    try:
        render.backend()
    except InputError:
        return False
    return True


def beyond_bounds(task: Task, state: Array) -> str:
    """A message about an observation of states [N, S] that is out of its bounds by more than 1e-3, or ""."""
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
