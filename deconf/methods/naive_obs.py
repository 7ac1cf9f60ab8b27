"""Two imitators that look away from their own past actions (Swamy et al., 2022): a cure for delusion, at a price.

naive_obs reads past observations alone. What it did is then no evidence of theta, but neither can it tell what of the
motion was its own doing: where theta shows only in what follows an action, as on the bandit, it learns nothing of it.
naive_dropout hears of each past action with probability 1 - dropout in training, and of all of them in deployment.
Both are naive_rnn in all else.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from deconfounded.deconf.core.agents import Monitor
from deconfounded.deconf.core.beliefs import GruMemory
from deconfounded.deconf.core.data import Batch, Draws, Rngs, Signature, Source
from deconfounded.deconf.core.nets import ActionHead, Scaler
from deconfounded.deconf.methods.clones import by_chunks, clone
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


@dataclass(frozen=True)
class DropoutConfig(RecurrentConfig):
    """dropout: the probability with which a past action is not heard of, in training."""

    dropout: float = 0.5


class DroppingAgent(RecurrentAgent):
    """Acts on all of its history, having learned not to count on its actions."""

    memory: DroppingMemory
    dropout: float = 0.0  # while it is trained
    noise: Draws

    @staticmethod
    def new(width: int, signature: Signature, obs: Scaler, draws: Draws) -> DroppingAgent:
        memory = DroppingMemory(width, signature, obs, draws)
        agent = DroppingAgent(memory, ActionHead(width + signature.obs, width, signature, draws))
        agent.noise = draws
        return agent

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


def fit(trials: Source, config: RecurrentConfig, rng: Rngs, monitor: Monitor | None = None) -> ObsAgent:
    """naive_obs. Trials are in as many equal groups as there are generators in rng."""

    def start(signature: Signature, obs: Scaler, draws: Draws) -> ObsAgent:
        return ObsAgent.new(config.width, signature, obs, draws)

    return clone(trials, config, rng, start, by_chunks(config), monitor)


def fit_dropout(trials: Source, config: DropoutConfig, rng: Rngs, monitor: Monitor | None = None) -> DroppingAgent:
    """naive_dropout. Trials are in as many equal groups as there are generators in rng."""

    def start(signature: Signature, obs: Scaler, draws: Draws) -> DroppingAgent:
        agent = DroppingAgent.new(config.width, signature, obs, draws)
        agent.dropout = config.dropout
        return agent

    return clone(trials, config, rng, start, by_chunks(config), monitor)
