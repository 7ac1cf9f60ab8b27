"""Cloning with dropout of past actions (Swamy et al., 2022).

The memory reads each past action with probability 1 - dropout in training, and all of them in deployment. All else is
naive_rnn's.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from deconfounded.deconf.core.beliefs import GruMemory
from deconfounded.deconf.core.data import Batch
from deconfounded.deconf.given import Given
from deconfounded.deconf.method import uses
from deconfounded.deconf.methods.clones import clone_by_chunks
from deconfounded.deconf.methods.recurrent import RecurrentAgent, RecurrentConfig


class DroppingMemory(GruMemory):
    """A GRU over transitions (s, a, s'), of whose actions some are kept: `kept` [S, B, T, 1] multiplies them."""

    kept: Tensor | None = None

    def _embed(self, batch: Batch) -> Tensor:
        inputs, action = self.inputs, self.inputs.signature.encode_action(batch.action)
        if self.kept is not None:
            action = action * self.kept
        embedded = [inputs.obs(batch.obs), inputs.embed_action(action), inputs.obs(batch.next_obs)]
        return self.input(torch.cat(embedded, -1))


@dataclass(frozen=True)
class DropoutConfig(RecurrentConfig):
    """dropout: the probability with which a past action is not heard of, in training."""

    dropout: float = 0.5


class DroppingAgent(RecurrentAgent):
    """Acts on all of its history, having learned not to count on its actions."""

    memory_kind = DroppingMemory
    memory: DroppingMemory
    dropout: float = 0.0  # while it is trained

    def configure(self, config: DropoutConfig) -> None:
        self.dropout = config.dropout

    def loss(self, batch: Batch, label: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        if self.dropout:
            heard = self.noise.uniform(*batch.mask.shape[1:], 1) >= self.dropout
            self.memory.kept = heard.float() / (1 - self.dropout)
        try:
            return super().loss(batch, label, state)
        finally:
            self.memory.kept = None

    @torch.no_grad()
    def held_out_loss(self, batch: Batch) -> Tensor:
        return super().loss(batch, batch.action, self.memory.start(len(batch)))[0]


@uses(
    "demonstrations",
    cost=2,
    on_control=DropoutConfig(learning_rate=9e-4),
    on_bandit=DropoutConfig(updates=2000, batch=128, chunk=50, learning_rate=3e-3),
    smoke={"updates": 60},
    smoke_bandit={"updates": 500},
)
def fit(given: Given) -> DroppingAgent:
    """Clone the demonstrations."""
    return clone_by_chunks(DroppingAgent, given.source, given.config, given.rngs, given.monitor)
