"""Helpers of checks: actions, thetas and generators to test a task with, and assertions with a message."""

import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import product
from typing import Any

import numpy as np

from deconfounded.envs import render
from deconfounded.envs.batch import BatchEnv
from deconfounded.envs.task import Array, InputError, Streams, Task


class Skipped(Exception):  # noqa: N818 (nothing is wrong)
    """A check that does not apply, or cannot be made here; the message says why."""


def needs_likelihood(task: Task) -> None:
    """Raise Skipped for a black box."""
    if not task.has_likelihood:
        raise Skipped(f"{task.name} is a black box, whose distributions are not stated")


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
        first = f"{a[at]} and {b[at]} at {list(at)}, the first of {len(places)} such places"
        raise AssertionError(f"{what} differ: {first}")


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
    """Context that turns any error or warning of another library's checker into an AssertionError that names it."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            yield
    except Exception as error:
        text = re.sub(r"\x1b\[\d*m", "", str(error))  # colours
        raise AssertionError(f"{checker}: {' '.join(text.split())} ({type(error).__name__})") from error


def actions(task: Task, n: int, steps: int) -> Array:
    """Random actions [steps, n, A], the same for the same arguments."""
    rng = np.random.default_rng(99)
    shape = (steps, n, task.action_width)
    return rng.integers(task.n_actions, size=shape).astype(float) if task.n_actions else rng.uniform(-1, 1, shape)


def observations(task: Task, acts: Array, seed: int | list[int], **options: Any) -> Array:
    """Observations [T + 1, N, O] of environments that are reset with a seed and options, and take actions [T, N, A]."""
    batch = BatchEnv(task, acts.shape[1])
    return np.array([batch.reset(seed, options)] + [batch.step(action)[0] for action in acts])


def far_thetas(task: Task) -> Array:
    """Thetas [J, L] that span the range of every latent."""
    if not task.has_likelihood:  # nor stated bounds
        return np.unique(task.theta_grid(3), axis=0)
    grids = [lat.grid(5) for lat in task.latents]
    if len(grids) > 3:  # one latent at a time
        middle, turns = np.array([grid[len(grid) // 2] for grid in grids]), range(len(grids))
        turned = [np.where(np.arange(len(grids)) == i, grids[i][end], middle) for i in turns for end in (0, -1)]
        return np.array([middle, *turned])
    return np.array(list(product(*(grid[sorted({0, len(grid) // 2, len(grid) - 1})] for grid in grids))))


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
    for seen, (name, (low, high)) in zip(task.observe(state).T, task.observation.items(), strict=True):
        bad = seen[~((seen >= low - 1e-3) & (seen <= high + 1e-3))]
        if bad.size:
            right = f"its bounds, {low:g} to {high:g}, must be wide enough never to clip"
            return f"observation {name} of {task.name} was {bad[0]:g}; {right}"
    return ""
