"""A recurrent policy pi_eta(a_t | s_1, a_1, ..., s_t) and its training by likelihood: naive_rnn's."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from deconfounded.deconf.core.agents import LearnedAgent
from deconfounded.deconf.core.beliefs import GruMemory
from deconfounded.deconf.core.data import Batch, Draws, Signature
from deconfounded.deconf.core.monitor import Monitor
from deconfounded.deconf.core.nets import ActionHead, Adam, Scaler
from deconfounded.deconf.core.sizes import Configuration
from deconfounded.deconf.equations import imitation_loss


@dataclass(frozen=True)
class RecurrentConfig(Configuration):
    """Widths and amounts, for each seed; batch counts trials, chunk the steps of truncated backpropagation."""

    width: int = 64
    updates: int = 1500
    batch: int = 32
    chunk: int = 50
    learning_rate: float = 3e-3
    cooled: bool = True  # the learning rate falls to 0 along a cosine
    device: str = "cpu"


class RecurrentAgent(LearnedAgent):
    """Acts on the observation and on a memory of its own transitions, carried over resets.

    The policy reads the observation itself, scaled, beside the memory: through the memory's embedding it cannot tell
    the expert's small action noise from its own error, and clones less well.
    """

    memory_kind: ClassVar[type[GruMemory]] = GruMemory
    noise: Draws

    def __init__(self, memory: GruMemory, policy: ActionHead) -> None:
        super().__init__(policy)
        self.memory = memory

    @classmethod
    def new(cls, width: int, signature: Signature, obs: Scaler, draws: Draws) -> Self:
        """One that knows nothing yet; `noise` is for its training."""
        memory = cls.memory_kind(width, signature, obs, draws)
        agent = cls(memory, ActionHead(width + signature.obs, width, signature, draws))
        agent.noise = draws
        return agent

    def configure(self, config: Any) -> None:
        """Take what training needs of a configuration, beside the width."""

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


class Cloner:
    """Trains an agent by likelihood: passes through trials, an update a chunk, the memory passed on between chunks.

    `done` and `total` count updates; there is at least one pass.
    """

    def __init__(self, agent: RecurrentAgent, config: RecurrentConfig, steps: int, monitor: Monitor) -> None:
        self.agent, self.chunk, self.monitor, self.done = agent, config.chunk, monitor, 0
        self.chunks = -(-steps // config.chunk)
        self.total = max(1, round(config.updates / self.chunks)) * self.chunks
        cooled = self.total if config.cooled else None
        self.optimizer = Adam([agent.memory, agent.policy], config.learning_rate, cooled)

    def learn(self, batch: Batch, label: Tensor) -> None:
        """One pass. label [S, B, T, A]: the expert's action at each step, which need not be the one taken."""
        state, losses = self.agent.memory.start(len(batch)), []
        for begin in range(0, self.chunks * self.chunk, self.chunk):
            part = slice(begin, begin + self.chunk)
            loss, state = self.agent.loss(batch[:, :, part], label[:, :, part], state)
            self.optimizer.step(loss)
            losses.append(loss.mean().item())
        self.done += self.chunks
        self.monitor.update(self.done, self.total, {"imitation": sum(losses) / self.chunks}, self.agent)
