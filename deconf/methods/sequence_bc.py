"""Behavioural cloning by sequence models: the training loop of all, and the recurrent policy of naive_rnn's family.

A recurrent policy pi_eta(a_t | s_1, a_1, ..., s_t) is trained by maximum likelihood with truncated backpropagation.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, Self, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from deconfounded.deconf.core.adam import Adam
from deconfounded.deconf.core.agents import Checkpoint, LearnedAgent
from deconfounded.deconf.core.data import Batch, Draws, Rngs, Signature, Source, as_generators, trials_of
from deconfounded.deconf.core.gru import GruMemory
from deconfounded.deconf.core.monitor import Monitor
from deconfounded.deconf.core.nets import ActionHead, Scales
from deconfounded.deconf.core.sizes import Configuration
from deconfounded.deconf.equations import imitation_loss

Kind = TypeVar("Kind", bound=LearnedAgent)
Recurrent = TypeVar("Recurrent", bound="RecurrentAgent")


class Trainer(Protocol):
    """Takes updates of an agent; `done` and `total` count them."""

    optimizer: Adam
    done: int
    total: int

    def learn(self, batch: Batch, label: Tensor) -> None:
        """Update on trials [S, B, T]; label [S, B, T, A]: the expert's action at each step."""


def train_sequence(
    trials: Source,
    config: Any,
    rng: Rngs,
    new_agent: Callable[[Scales, Draws], Kind],
    new_trainer: Callable[[Kind, int, Monitor], Trainer],
    monitor: Monitor | None = None,
) -> Kind:
    """Clone the expert's trials, which are in as many equal groups as there are generators in rng.

    Of a function that draws trials, each batch is fresh trials. config: has `batch`, in trials, and `device`.
    new_agent: makes the untrained agent, given scales of the expert's trials. new_trainer: makes its trainer,
    given the number of steps of a trial.
    """
    rngs, monitor = as_generators(rng), monitor or Monitor()
    first = trials_of(trials)
    data, draws = Batch.of(first, len(rngs), config.device), Draws(rngs, config.device)
    agent = new_agent(Scales.of(Signature.of(first), data), draws)
    trainer = new_trainer(agent, data.mask.shape[2], monitor)
    checkpoint = Checkpoint(monitor, rngs, **agent.parts(), optimizer=trainer.optimizer, draws=draws)
    if before := checkpoint.load():
        trainer.done = before["done"]
    while trainer.done < trainer.total:
        if first is trials:
            batch = data.draw_trials(config.batch, draws)
        else:
            batch = Batch.of(trials_of(trials), len(rngs), config.device)
        trainer.learn(batch, batch.action)
        checkpoint.save(done=trainer.done)
    return agent


@dataclass(frozen=True)
class RecurrentConfig(Configuration):
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
    def new(cls, width: int, scales: Scales, draws: Draws) -> Self:
        """An untrained agent; `noise` is for training."""
        memory = cls.memory_kind(width, scales, draws)
        agent = cls(memory, ActionHead(width + scales.signature.obs, width, scales, draws))
        agent.noise = draws
        return agent

    def configure(self, config: Any) -> None:
        """Take over further settings that the loss needs."""

    @classmethod
    def blank(cls, shape: dict[str, Any], scales: Scales, draws: Draws) -> "RecurrentAgent":
        return cls.new(shape["width"], scales, draws)

    def shape(self) -> dict[str, Any]:
        return {"width": self.memory.width}

    def parts(self) -> dict[str, nn.Module]:
        return {"memory": self.memory, "policy": self.policy}

    def begin(self, n: int) -> None:
        super().begin(n)
        self._state = self.memory.start(self._n)

    def choose(self, obs: Tensor) -> Tensor:
        return self.policy.sample(torch.cat([self._state, self.memory.inputs.scales.obs(obs)], -1), self._draws)

    def remember(self, step: Batch) -> None:
        self._state = self.memory.update(self._state, step)

    def remembered(self) -> NDArray[np.float32]:
        return self._state.flatten(0, 1).cpu().numpy()

    def loss(self, batch: Batch, label: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """The imitation loss [S] of labels [S, B, T, A] after a memory [S, B, W], and the memory after the batch."""
        log_policy, states = self._log_policy(batch, label, state)
        return imitation_loss(log_policy.flatten(1), batch.mask.flatten(1)), states[:, :, -1].detach()

    def _log_policy(self, batch: Batch, label: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        states = self.memory(batch, state)
        features = torch.cat([states[:, :, :-1], self.memory.inputs.scales.obs(batch.obs)], -1)
        return self.policy.log_prob(features, label), states

    @torch.no_grad()
    def log_prob(self, batch: Batch) -> Tensor:
        """log pi [S, B, T] of the actions of whole trials."""
        return self._log_policy(batch, batch.action, self.memory.start(len(batch)))[0]

    @torch.no_grad()
    def held_out_loss(self, batch: Batch) -> Tensor:
        """The imitation loss [S] on the expert's trials, without what a subclass adds to it in training."""
        return RecurrentAgent.loss(self, batch, batch.action, self.memory.start(len(batch)))[0]


class RecurrentTrainer:
    """Trains by truncated backpropagation: in a pass through trials, each chunk is an update and hands its memory on.

    `done` and `total` count updates; there is at least one pass. A chunk in which no trial of the batch has a step, as
    where one trial of the data is much longer than the others, is an update too: it moves weights by Adam's moments.
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


def train_recurrent(
    kind: type[Recurrent], trials: Source, config: RecurrentConfig, rng: Rngs, monitor: Monitor | None = None
) -> Recurrent:
    """Clone the expert's trials with an agent of that kind: see `train_sequence`."""

    def new_agent(scales: Scales, draws: Draws) -> Recurrent:
        agent = kind.new(config.width, scales, draws)
        agent.configure(config)
        return agent

    def new_trainer(agent: Recurrent, steps: int, monitor: Monitor) -> RecurrentTrainer:
        return RecurrentTrainer(agent, config, steps, monitor)

    return train_sequence(trials, config, rng, new_agent, new_trainer, monitor)


SMOKE: dict[str, Any] = {"smoke": {"updates": 60}, "smoke_bandit": {"updates": 500}}  # of methods of recurrent BC
