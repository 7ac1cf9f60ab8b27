"""Recurrent behavioural cloning with dropout of past actions (Swamy et al., 2022).

The memory reads each past action with probability 1 - dropout in training, divided by that probability, as torch's
Dropout does; in deployment it reads all of them as they are. All else is naive_rnn's.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from deconfounded.deconf.core.data import Batch
from deconfounded.deconf.core.gru import GruMemory
from deconfounded.deconf.given import Given
from deconfounded.deconf.method import uses
from deconfounded.deconf.methods.sequence_bc import SMOKE, RecurrentAgent, RecurrentConfig, train_recurrent


class ActionDropoutMemory(GruMemory):
    """A GRU over transitions (s, a, s'), with actions multiplied by `action_mask` [S, B, T, 1]."""

    action_mask: Tensor | None = None

    def _embed(self, batch: Batch) -> Tensor:
        inputs, action = self.inputs, self.inputs.scales.encode(batch.action)
        if self.action_mask is not None:
            action = action * self.action_mask
        embedded = [inputs.obs(batch.obs), inputs.embed_action(action), inputs.obs(batch.next_obs)]
        return self.input(torch.cat(embedded, -1))


@dataclass(frozen=True)
class DropoutConfig(RecurrentConfig):
    """Those of naive_rnn, and dropout: the probability that the memory misses a past action, in training."""

    dropout: float = 0.5


class ActionDropoutAgent(RecurrentAgent):
    """naive_rnn's agent, trained with dropout of past actions."""

    memory_kind = ActionDropoutMemory
    memory: ActionDropoutMemory
    dropout: float = 0.0  # in training

    def configure(self, config: DropoutConfig) -> None:
        self.dropout = config.dropout

    def loss(self, batch: Batch, label: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        if self.dropout:
            kept = self.noise.uniform(*batch.mask.shape[1:], 1) >= self.dropout
            self.memory.action_mask = kept.float() / (1 - self.dropout)
        try:
            return super().loss(batch, label, state)
        finally:
            self.memory.action_mask = None


@uses(
    "demonstrations",
    version=2,
    cost=2,
    on_control=DropoutConfig(learning_rate=9e-4),
    on_bandit=DropoutConfig(updates=2000, batch=128, chunk=50, learning_rate=3e-3),
    **SMOKE,
)
def fit(given: Given) -> ActionDropoutAgent:
    """Clone the demonstrations."""
    return train_recurrent(ActionDropoutAgent, given.source, given.config, given.rngs, given.monitor)
