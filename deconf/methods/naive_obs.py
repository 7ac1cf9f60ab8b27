"""Cloning of past observations alone (Swamy et al., 2022): a cure for delusion, at a price.

What the imitator did is then no evidence of theta, but neither can it tell what of the motion was its own doing: where
theta shows only in what follows an action, as on the bandit, it learns nothing of it. All else is naive_rnn's.
"""

from __future__ import annotations

import torch
from torch import Tensor

from deconfounded.deconf.core.beliefs import GruMemory
from deconfounded.deconf.core.data import Batch
from deconfounded.deconf.given import Given
from deconfounded.deconf.method import uses
from deconfounded.deconf.methods.clones import clone_by_chunks
from deconfounded.deconf.methods.recurrent import RecurrentAgent, RecurrentConfig


class ObsMemory(GruMemory):
    """A GRU over transitions (s, s'), whatever the action was."""

    def _embed(self, batch: Batch) -> Tensor:
        return super()._embed(Batch(batch.obs, torch.zeros_like(batch.action), batch.next_obs, batch.mask))


class ObsAgent(RecurrentAgent):
    """Acts on observations, past and present."""

    memory_kind = ObsMemory


@uses(
    "demonstrations",
    cost=2,
    on_control=RecurrentConfig(learning_rate=9e-4),
    on_bandit=RecurrentConfig(updates=2000, batch=128, chunk=50, learning_rate=3e-3),
    smoke={"updates": 60},
    smoke_bandit={"updates": 500},
)
def fit(given: Given) -> ObsAgent:
    """Clone the demonstrations."""
    return clone_by_chunks(ObsAgent, given.source, given.config, given.rngs, given.monitor)
