"""What tests share."""

from __future__ import annotations

from itertools import product

import numpy as np
from gymnasium import spaces

import envs
from envs import render
from envs.streams import Array, Streams


def actions(task: envs.Task, n: int, steps: int) -> Array:
    """[steps, n, A] actions, the same for the same arguments."""
    rng = np.random.default_rng(99)
    if isinstance(task.action_space, spaces.Discrete):
        return rng.integers(task.action_space.n, size=(steps, n, 1)).astype(float)
    return rng.uniform(-1, 1, (steps, n, *task.action_space.shape))


def far_thetas(task: envs.Task) -> Array:
    """[J, L] thetas that span the range of every latent."""
    return np.array(list(product(*(lat.grid(5)[::2] for lat in task.latents))))


def streams(*seeds: int) -> Streams:
    """A generator for each environment."""
    return Streams([np.random.default_rng(seed) for seed in seeds])


def gl_works() -> bool:
    """Whether pictures can be made here."""
    try:
        render.backend()
    except envs.InputError:
        return False
    return True
