"""What tests share."""

from __future__ import annotations

from itertools import product

import numpy as np
from gymnasium import spaces

from deconfounded import envs
from deconfounded.benchmarks.methods import Preset
from deconfounded.deconf.cloning import CloningConfig
from deconfounded.deconf.dagger import DaggerConfig
from deconfounded.deconf.deconfounded import DeconfoundedConfig
from deconfounded.deconf.offline import OfflineConfig
from deconfounded.deconf.recurrent import RecurrentConfig
from deconfounded.envs import render
from deconfounded.envs.streams import Array, Streams


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


def tiny_preset() -> Preset:
    """Two or three updates of each kind, on four trials."""
    few = {"rounds": 2, "inference_updates": 2, "inference_batch": 4, "imitation_updates": 2, "final_updates": 2}
    return Preset(
        seeds=3,
        expert_trials=4,
        explore_trials=4,
        eval_trials=4,
        query_trials=4,
        fresh=0,
        grid=3,
        deconfounded=DeconfoundedConfig(**few),
        discrete=DeconfoundedConfig(model="discrete", **few),
        offline=OfflineConfig(
            offline_updates=2, online_updates=2, online_batch=4, offline_batch=4, synthetic=4, online_steps=64
        ),
        naive=RecurrentConfig(updates=2, batch=4),
        dagger=DaggerConfig(updates=2, rounds=2, batch=4),
        cloning=CloningConfig(updates=3, batch=64),
    )
