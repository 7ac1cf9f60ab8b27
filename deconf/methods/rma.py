"""Teacher and student as in rapid motor adaptation (Kumar et al., 2021): theta is seen in training alone.

The teacher is oracle BC, pi(a | s, theta), cloned from demonstrations labelled with theta. The student acts by the
teacher's policy on an estimate of theta, which a recurrent network regresses on the student's roll-outs: their actions
are the student's, and so no evidence of theta. The estimate is a point, the mean, without uncertainty.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from deconfounded.deconf.core.adam import Adam
from deconfounded.deconf.core.agents import Checkpoint, LearnedAgent
from deconfounded.deconf.core.data import (
    Batch,
    Draws,
    Rngs,
    as_generators,
    joined_theta,
    joined_trials,
    take,
    trials_and,
)
from deconfounded.deconf.core.gru import GruMemory
from deconfounded.deconf.core.layers import Mlp
from deconfounded.deconf.core.monitor import Monitor
from deconfounded.deconf.core.nets import ActionHead, Scales
from deconfounded.deconf.core.sizes import Configuration
from deconfounded.deconf.equations import masked_mean
from deconfounded.deconf.given import Given
from deconfounded.deconf.method import uses
from deconfounded.deconf.methods import memoryless_bc
from deconfounded.deconf.methods.memoryless_bc import MemorylessConfig
from deconfounded.envs.streams import Array
from deconfounded.experts.agent import Agent
from deconfounded.experts.trials import Trials

Explore = Callable[[Agent | None], tuple[Trials, Array]]
"""Rolls out a behaviour (None: uniformly random actions) under fresh thetas, as many trials for each seed.

Returns trials, and the encoded theta of their episodes [B, E, F], or of their steps [B, E, T, F]."""


@dataclass(frozen=True)
class RmaConfig(Configuration):
    """Hyperparameters for each seed; batch counts trials, chunk the steps of truncated backpropagation.

    Updates are of the student; each round adds roll-outs of the current student, and later rounds get more updates.
    """

    width: int = 64
    updates: int = 1500
    batch: int = 32
    chunk: int = 50
    rounds: int = 8
    learning_rate: float = 3e-3
    teacher_updates: int = 2000
    teacher_batch: int = 1024  # steps
    teacher_rate: float = 2e-3
    device: str = "cpu"


class Adapter(GruMemory):
    """The adaptation module: regresses theta on the history of transitions."""

    def __init__(self, width: int, theta: int, scales: Scales, draws: Draws) -> None:
        super().__init__(width, scales, draws)
        self.theta, self.out = theta, Mlp(width, width, theta, draws)


class RmaAgent(LearnedAgent):
    """A policy of the observation and of the estimate of theta, with a memory that outlives resets."""

    def __init__(self, adapter: Adapter, policy: ActionHead) -> None:
        super().__init__(policy)
        self.adapter = adapter

    @classmethod
    def blank(cls, shape: dict[str, Any], scales: Scales, draws: Draws) -> "RmaAgent":
        width, theta = shape["width"], shape["theta"]
        policy = ActionHead(scales.signature.obs + theta, shape["teacher"], scales, draws)
        return cls(Adapter(width, theta, scales, draws), policy)

    def shape(self) -> dict[str, Any]:
        teacher = next(self.policy.parameters()).shape[-1]
        return {"width": self.adapter.width, "theta": self.adapter.theta, "teacher": teacher}

    def parts(self) -> dict[str, nn.Module]:
        return {"adapter": self.adapter, "policy": self.policy}

    def begin(self, n: int) -> None:
        super().begin(n)
        self._state = self.adapter.start(self._n)

    def choose(self, obs: Tensor) -> Tensor:
        features = [self.adapter.inputs.scales.obs(obs), self.adapter.out(self._state)]
        return self.policy.sample(torch.cat(features, -1), self._draws)

    def remember(self, step: Batch) -> None:
        self._state = self.adapter.update(self._state, step)

    @torch.no_grad()
    def remembered(self) -> NDArray[np.float32]:
        return self.adapter.out(self._state).flatten(0, 1).cpu().numpy()

    def loss(self, batch: Batch, theta: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Squared error [S] of theta [S, B, T, F] after a memory [S, B, W], and the memory after the batch."""
        states = self.adapter(batch, state)
        error = (self.adapter.out(states[:, :, :-1]) - theta).square().sum(-1)
        return masked_mean(error.flatten(1), batch.mask.flatten(1)), states[:, :, -1].detach()


def train(
    trials: Trials, theta: Array, explore: Explore, config: RmaConfig, rng: Rngs, monitor: Monitor | None = None
) -> RmaAgent:
    """Clone the teacher, then train the student on its own roll-outs.

    trials: of the expert, in as many equal groups as there are generators in rng; theta: of their episodes [B, E, F],
    or of their steps [B, E, T, F].
    """
    rngs, monitor = as_generators(rng), monitor or Monitor()
    draws = Draws(rngs, config.device)
    teacher = memoryless_bc.train(trials, _teacher(config), rngs, theta)
    adapter = Adapter(config.width, theta.shape[-1], teacher.scales, draws)
    agent = RmaAgent(adapter, teacher.policy)
    first = trials_and("their theta [B, E, F]", explore(None))
    chunks = -(-first[0].mask[0].size // config.chunk)  # of roll-outs, whatever length the expert's trials have
    share = config.updates / (chunks * config.rounds * (config.rounds + 1) / 2)
    passes = [max(1, round(share * (i + 1))) for i in range(config.rounds)]
    total = sum(passes) * chunks
    optimizer = Adam([adapter], config.learning_rate, total)
    checkpoint = Checkpoint(monitor, rngs, **agent.parts(), optimizer=optimizer, draws=draws)
    data, targets, begin = None, torch.empty(0), 0
    if before := checkpoint.load():
        begin, data, targets = before["round"], Batch(*before["data"]), before["targets"]
    for i in range(begin, config.rounds):
        own, thetas = trials_and("their theta [B, E, F]", explore(agent)) if i > 0 else first
        new, target = Batch.of(own, len(rngs), config.device), joined_theta(own, thetas, len(rngs), config.device)
        data, targets = (new, target) if data is None else (data.joined(new), joined_trials(targets, target))
        for j in range(passes[i]):
            index = draws.integers(len(data), config.batch)
            error = _pass(agent, optimizer, data.trials(index), take(targets, index), config.chunk)
            monitor.update((sum(passes[:i]) + j + 1) * chunks, total, {"theta": error}, agent)
        checkpoint.save(round=i + 1, data=data.tensors, targets=targets)
    return agent


def _teacher(config: RmaConfig) -> MemorylessConfig:
    return MemorylessConfig(
        config.width, config.teacher_updates, config.teacher_batch, config.teacher_rate, device=config.device
    )


def _pass(agent: RmaAgent, optimizer: Adam, batch: Batch, theta: Tensor, chunk: int) -> float:
    """One pass through trials [S, B, T]: an update a chunk, the memory passed on; returns the mean error.

    A chunk in which no trial has a step, as in round 0 where random actions end episodes early, is an update too.
    """
    state, errors = agent.adapter.start(len(batch)), []
    for begin in range(0, batch.mask.shape[2], chunk):
        part = slice(begin, begin + chunk)
        error, state = agent.loss(batch[:, :, part], theta[:, :, part], state)
        optimizer.step(error)
        errors.append(error.mean().item())
    return sum(errors) / len(errors)


@uses(
    *("demonstrations", "exploration", "theta"),
    version=2,
    cost=4,
    on_control=RmaConfig(updates=3000, learning_rate=6e-4),
    on_bandit=RmaConfig(updates=2000, batch=128, rounds=2, learning_rate=3e-3, teacher_updates=500),
    smoke={"updates": 60, "rounds": 2, "teacher_updates": 400},
    smoke_bandit={"updates": 500, "rounds": 2, "teacher_updates": 400},
)
def fit(given: Given) -> RmaAgent:
    """Clone the teacher, then train the student on its roll-outs."""
    theta = given.theta
    return train(given.demonstrations, theta, given.explore_with_theta, given.config, given.rngs, given.monitor)
