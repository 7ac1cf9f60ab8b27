"""Cloning of past observations alone (Swamy et al., 2022): a cure for delusion, at a price.

What the imitator did is then no evidence of theta, but neither can it tell what of the motion was its own doing: where
theta shows only in what follows an action, as on the bandit, it learns nothing of it. All else is naive_rnn's.
"""

from __future__ import annotations

import torch
from torch import Tensor

from deconfounded.deconf.core.agents import Monitor
from deconfounded.deconf.core.beliefs import GruMemory
from deconfounded.deconf.core.data import Batch, Draws, Rngs, Signature, Source
from deconfounded.deconf.core.nets import ActionHead, Scaler
from deconfounded.deconf.given import Given
from deconfounded.deconf.method import uses
from deconfounded.deconf.methods.clones import by_chunks, clone
from deconfounded.deconf.methods.recurrent import RecurrentAgent, RecurrentConfig


class ObsMemory(GruMemory):
    """A GRU over transitions (s, s'), whatever the action was."""

    def _embed(self, batch: Batch) -> Tensor:
        return super()._embed(Batch(batch.obs, torch.zeros_like(batch.action), batch.next_obs, batch.mask))


class ObsAgent(RecurrentAgent):
    """Acts on observations, past and present."""

    @staticmethod
    def new(width: int, signature: Signature, obs: Scaler, draws: Draws) -> ObsAgent:
        memory = ObsMemory(width, signature, obs, draws)
        return ObsAgent(memory, ActionHead(width + signature.obs, width, signature, draws))


def train(trials: Source, config: RecurrentConfig, rng: Rngs, monitor: Monitor | None = None) -> ObsAgent:
    """Clone. Trials are in as many equal groups as there are generators in rng."""

    def start(signature: Signature, obs: Scaler, draws: Draws) -> ObsAgent:
        return ObsAgent.new(config.width, signature, obs, draws)

    return clone(trials, config, rng, start, by_chunks(config), monitor)


@uses(
    "demonstrations",
    cost=2,
    on_control=RecurrentConfig(learning_rate=9e-4),
    on_bandit=RecurrentConfig(updates=2000, batch=128, chunk=50, learning_rate=3e-3),
    smoke={"updates": 60},
    smoke_bandit={"updates": 500},
)
def fit(given: Given) -> ObsAgent:
    """The same, on what is given."""
    return train(given.source, given.config, given.rngs, given.monitor)
