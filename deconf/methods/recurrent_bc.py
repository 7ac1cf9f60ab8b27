"""Recurrent behavioural cloning: a policy pi_eta(a_t | s_1, a_1, ..., s_t), and its training by maximum likelihood."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Self, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from deconfounded.deconf.core.agents import LearnedAgent, Monitor
from deconfounded.deconf.core.beliefs import GruMemory
from deconfounded.deconf.core.data import Batch, Draws, Rngs, Signature, Source
from deconfounded.deconf.core.nets import ActionHead, Adam, Scaler
from deconfounded.deconf.equations import imitation_loss
from deconfounded.deconf.methods.sequence_bc import train_sequence


@dataclass(frozen=True)
class RecurrentConfig:
    """Hyperparameters for each seed; batch counts trials, chunk the steps of truncated backpropagation."""

    width: int = 64
    updates: int = 1500
    batch: int = 32
    chunk: int = 50
    learning_rate: float = 3e-3
    cooled: bool = True  # the learning rate falls to 0 along a cosine
    device: str = "cpu"


class RecurrentAgent(LearnedAgent):
    """A policy of the observation and of a memory of the agent's transitions, which outlives resets.

    The policy reads the scaled observation itself, not the memory's embedding of it, which resolves the expert's small
    action noise less well.
    """

    memory_kind: ClassVar[type[GruMemory]] = GruMemory
    noise: Draws

    def __init__(self, memory: GruMemory, policy: ActionHead) -> None:
        super().__init__(policy)
        self.memory = memory

    @classmethod
    def new(cls, width: int, signature: Signature, obs: Scaler, draws: Draws) -> Self:
        """An untrained agent; `noise` is for training."""
        memory = cls.memory_kind(width, signature, obs, draws)
        agent = cls(memory, ActionHead(width + signature.obs, width, signature, draws))
        agent.noise = draws
        return agent

    def configure(self, config: Any) -> None:
        """Take over further settings that the loss needs."""

    @classmethod
    def blank(cls, shape: dict[str, Any], signature: Signature, obs: Scaler, draws: Draws) -> RecurrentAgent:
        return cls.new(shape["width"], signature, obs, draws)

    def shape(self) -> dict[str, Any]:
        return {"width": self.memory.width}

    def parts(self) -> dict[str, nn.Module]:
        return {"memory": self.memory, "policy": self.policy}

    def begin(self, n: int) -> None:
        super().begin(n)
        self._state = self.memory.start(self._n)

    def choose(self, obs: Tensor) -> Tensor:
        return self.policy.sample(torch.cat([self._state, self.memory.inputs.scaler(obs)], -1), self._draws)

    def remember(self, step: Batch) -> None:
        self._state = self.memory.update(self._state, step)

    def features(self) -> NDArray[np.float32]:
        return self._state.flatten(0, 1).cpu().numpy()

    def loss(self, batch: Batch, label: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """The imitation loss [S] of labels [S, B, T, A] after a memory [S, B, W], and the memory after the batch."""
        states = self.memory(batch, state)
        features = torch.cat([states[:, :, :-1], self.memory.inputs.scaler(batch.obs)], -1)
        log_policy = self.policy.log_prob(features, label)
        return imitation_loss(log_policy.flatten(1), batch.mask.flatten(1)), states[:, :, -1].detach()

    @torch.no_grad()
    def held_out_loss(self, batch: Batch) -> Tensor:
        """The imitation loss [S] on the expert's trials."""
        return self.loss(batch, batch.action, self.memory.start(len(batch)))[0]


class RecurrentTrainer:
    """Trains by truncated backpropagation: in a pass through trials, each chunk is an update and hands its memory on.

    `done` and `total` count updates; there is at least one pass.
    """

    def __init__(self, agent: RecurrentAgent, config: RecurrentConfig, steps: int, monitor: Monitor) -> None:
        self.agent, self.chunk, self.monitor, self.done = agent, config.chunk, monitor, 0
        self.chunks = -(-steps // config.chunk)
        self.total = max(1, round(config.updates / self.chunks)) * self.chunks
        schedule = self.total if config.cooled else None
        self.optimizer = Adam([agent.memory, agent.policy], config.learning_rate, schedule)

    def learn(self, batch: Batch, label: Tensor) -> None:
        """Take one pass. label [S, B, T, A]: the expert's action at each step."""
        state, losses = self.agent.memory.start(len(batch)), []
        for begin in range(0, self.chunks * self.chunk, self.chunk):
            part = slice(begin, begin + self.chunk)
            loss, state = self.agent.loss(batch[:, :, part], label[:, :, part], state)
            self.optimizer.step(loss)
            losses.append(loss.mean().item())
        self.done += self.chunks
        self.monitor.update(self.done, self.total, {"imitation": sum(losses) / self.chunks}, self.agent)


Kind = TypeVar("Kind", bound=RecurrentAgent)


def train_recurrent(
    kind: type[Kind], trials: Source, config: RecurrentConfig, rng: Rngs, monitor: Monitor | None = None
) -> Kind:
    """Clone the expert's trials with an agent of that kind: see `train_sequence`."""

    def new_agent(signature: Signature, obs: Scaler, draws: Draws) -> Kind:
        agent = kind.new(config.width, signature, obs, draws)
        agent.configure(config)
        return agent

    def new_trainer(agent: Kind, steps: int, monitor: Monitor) -> RecurrentTrainer:
        return RecurrentTrainer(agent, config, steps, monitor)

    return train_sequence(trials, config, rng, new_agent, new_trainer, monitor)
