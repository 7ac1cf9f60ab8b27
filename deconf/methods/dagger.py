"""Tier 3: expert queries, after DAgger (Ross et al., 2011). A policy with memory learns from labels on its roll-outs.

This is on-policy distillation of a privileged expert, also called SequIL, or counterfactual teaching (Ortega et al.,
2021). Unlike in DAgger, no roll-out is the expert's or a mixture with it: the first are random.

The expert, which sees theta, labels each step of the imitator's roll-outs with the action that it would take. Actions
in these histories are the imitator's, and so no evidence of theta: the optimum is the interventional policy (Ortega et
al., 2021) for any dynamics. Expert roll-outs are not used, since their actions are evidence of theta.

The memory is a sum of evidence over transitions, in any order (see EvidenceBelief). A GRU in its place took 1.6 times
as long, and scored .11 on `swapped_lander`, not .9.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from deconfounded.deconf.core.adam import Adam
from deconfounded.deconf.core.agents import Checkpoint, LearnedAgent
from deconfounded.deconf.core.beliefs import EvidenceBelief
from deconfounded.deconf.core.data import (
    Batch,
    Draws,
    Rngs,
    Signature,
    as_generators,
    joined_trials,
    take,
    take_steps,
    trials_and,
)
from deconfounded.deconf.core.drift import split_episodes
from deconfounded.deconf.core.monitor import Monitor
from deconfounded.deconf.core.nets import ActionHead, Scales
from deconfounded.deconf.core.sizes import Configuration
from deconfounded.deconf.equations import imitation_loss
from deconfounded.deconf.given import Given
from deconfounded.deconf.method import uses
from deconfounded.experts.agent import Agent
from deconfounded.experts.trials import Trials

Query = Callable[[Agent | None], tuple[Trials, NDArray[np.float32]]]
"""Rolls out a behaviour (None: uniformly random actions) under fresh thetas, as many trials for each seed.

Returns trials, and the expert's action at each of their steps [B, E, T, A]."""


@dataclass(frozen=True)
class DaggerConfig(Configuration):
    """Hyperparameters for each seed. Each round labels fresh roll-outs of the current policy."""

    width: int = 64
    latent: int = 16  # width of the features of the memory that the policy reads
    rounds: int = 16
    updates: int = 4000  # in all; later rounds, with more labels, get more of them
    batch: int = 16  # trials, whose every step is evidence
    shortest: float = 1 / 16  # least share of these trials that an update reads: see Batch.beginnings
    steps: int | None = 1024  # whose label is predicted, of these trials; None: all
    learning_rate: float = 3e-3
    drifts: bool = False  # theta changes between episodes: the memory is reset at each
    device: str = "cpu"


class DaggerAgent(LearnedAgent):
    """A policy of the observation and of a sum of evidence over the agent's transitions."""

    def __init__(self, memory: EvidenceBelief, policy: ActionHead, latent: int, forgets: bool) -> None:
        super().__init__(policy)
        self.memory, self.latent, self.forgets = memory, latent, forgets

    @staticmethod
    def new(width: int, latent: int, forgets: bool, scales: Scales, draws: Draws) -> "DaggerAgent":
        """An untrained agent. forgets: its memory is reset at each episode."""
        memory = EvidenceBelief(latent, width, scales, draws)
        policy = ActionHead(memory.inputs.obs_width + latent, width, scales, draws)
        return DaggerAgent(memory, policy, latent, forgets)

    @classmethod
    def blank(cls, shape: dict[str, Any], scales: Scales, draws: Draws) -> "DaggerAgent":
        sizes = (shape["width"], shape["latent"], shape["forgets"])
        return cls.new(*sizes, scales, draws)

    def shape(self) -> dict[str, Any]:
        return {"width": self.memory.width, "latent": self.latent, "forgets": self.forgets}

    def parts(self) -> dict[str, nn.Module]:
        return {"memory": self.memory, "policy": self.policy}

    def begin(self, n: int) -> None:
        super().begin(n)
        self._memory = self.memory.start(self._n)

    def reset(self, rngs: Sequence[np.random.Generator]) -> None:
        super().reset(rngs)
        if self.forgets:
            self._memory = self.memory.start(self._n)

    def _inputs(self, obs: Tensor, memory: Tensor) -> Tensor:
        """Features for the policy."""
        return torch.cat([self.memory.inputs.obs(obs), self.memory.posterior(memory)[0]], -1)

    def choose(self, obs: Tensor) -> Tensor:
        return self.policy.sample(self._inputs(obs, self._memory), self._draws)

    def remember(self, step: Batch) -> None:
        self._memory = self.memory.update(self._memory, step)

    @torch.no_grad()
    def remembered(self) -> NDArray[np.float32]:
        return self.memory.posterior(self._memory)[0].flatten(0, 1).cpu().numpy()

    def loss(self, batch: Batch, label: Tensor, steps: int | None, draws: Draws) -> Tensor:
        """The imitation loss [S] of labels [S, B, T, A] at so many steps of trials."""
        index = batch.draw_steps(steps, draws)
        memories = self.memory(batch)[:, :, :-1].flatten(1, 2)
        inputs = self._inputs(take_steps(batch.obs, index), take(memories, index))
        return imitation_loss(self.policy.log_prob(inputs, take_steps(label, index)), take_steps(batch.mask, index))


def labelled(
    query: Query, behaviour: Agent | None, seeds: int, drifts: bool, device: str
) -> tuple[Signature, Batch, Tensor]:
    """Roll-outs, and labels [S, B, T, A] aligned with their actions; where theta drifts, each episode is a trial."""
    trials, labels = trials_and("labels [B, E, T, A]", query(behaviour))
    unit = split_episodes if drifts else lambda trials: trials
    relabelled = Trials(trials.obs, labels, trials.mask, trials.actions)
    batch, label = (Batch.of(unit(x), seeds, device) for x in (trials, relabelled))
    return Signature.of(trials), batch, label.action


def by_round(updates: int, rounds: int) -> list[int]:
    """Updates of each round: later rounds, with more labels, get more of them."""
    share = updates / (rounds * (rounds + 1) / 2)
    return [max(1, round(share * i)) for i in range(1, rounds + 1)]


def train(query: Query, config: DaggerConfig, rng: Rngs, monitor: Monitor | None = None) -> DaggerAgent:
    """In rounds, label roll-outs and train on all labels so far."""
    rngs, monitor = as_generators(rng), monitor or Monitor()
    draws = Draws(rngs, config.device)
    asked = len(rngs), config.drifts, config.device
    signature, data, label = labelled(query, None, *asked)
    agent = DaggerAgent.new(
        config.width, config.latent, config.drifts, Scales(signature, data, label, data.mask), draws
    )
    updates = by_round(config.updates, config.rounds)
    optimizer, done = Adam([agent.memory, agent.policy], config.learning_rate, sum(updates)), 0
    agent.memory.whiten.updates_left = sum(updates) // 2  # moments change with each round's roll-outs
    checkpoint, begin = Checkpoint(monitor, rngs, **agent.parts(), optimizer=optimizer, draws=draws), 0
    if before := checkpoint.load():
        begin, data, label = before["round"], Batch(*before["data"]), before["label"]
        done = sum(updates[:begin])
    for i in range(begin, config.rounds):
        if i > 0:
            _, more, new = labelled(query, agent, *asked)
            data, label = data.joined(more), joined_trials(label, new)
        for _ in range(updates[i]):
            index, batch = draws.integers(len(data), config.batch), data.beginnings(done, config.shortest)
            target = take(label[:, :, : batch.mask.shape[2]], index)
            own = batch.trials(index)
            loss = agent.loss(own, target, config.steps, draws)
            optimizer.step(loss + agent.memory.innovation_loss(own.steps(own.draw_steps(config.steps, draws))))
            done += 1
            monitor.update(done, sum(updates), {"imitation": loss.mean().item()}, agent)
        checkpoint.save(round=i + 1, data=data.tensors, label=label)
    return agent


@uses(
    "queries",
    version=2,
    cost=4,
    on_control=DaggerConfig(),
    on_bandit=DaggerConfig(batch=64, shortest=1.0, updates=1000),
    smoke={"updates": 60, "rounds": 4},
    smoke_bandit={"updates": 500, "rounds": 4},
)
def fit(given: Given) -> DaggerAgent:
    """Train on labelled roll-outs."""
    return train(given.query, given.config, given.rngs, given.monitor)
