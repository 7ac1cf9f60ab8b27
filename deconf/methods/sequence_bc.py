"""Behavioural cloning by sequence models: the training loop of naive_rnn, of its variants and of naive_transformer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypeVar

from torch import Tensor

from deconfounded.deconf.core.agents import Checkpoint, LearnedAgent, Monitor
from deconfounded.deconf.core.data import Batch, Draws, Rngs, Signature, Source, as_generators, trials_of
from deconfounded.deconf.core.nets import Adam, Scaler

Kind = TypeVar("Kind", bound=LearnedAgent)


class SequenceConfig(Protocol):
    """Settings that the loop reads; batch counts trials."""

    @property
    def batch(self) -> int: ...
    @property
    def device(self) -> str: ...


class Trainer(Protocol):
    """Takes updates of an agent; `done` and `total` count them."""

    optimizer: Adam
    done: int
    total: int

    def learn(self, batch: Batch, label: Tensor) -> None:
        """Update on trials [S, B, T]; label [S, B, T, A]: the expert's action at each step."""


def train_sequence(
    trials: Source,
    config: SequenceConfig,
    rng: Rngs,
    new_agent: Callable[[Signature, Scaler, Draws], Kind],
    new_trainer: Callable[[Kind, int, Monitor], Trainer],
    monitor: Monitor | None = None,
) -> Kind:
    """Clone the expert's trials, which are in as many equal groups as there are generators in rng.

    Of a function that draws trials, each batch is fresh trials. new_agent: makes the untrained agent; the scaler is of
    the expert's observations. new_trainer: makes its trainer; the number is of steps of a trial.
    """
    rngs, monitor = as_generators(rng), monitor or Monitor()
    first = trials_of(trials)
    data, draws = Batch.of(first, len(rngs), config.device), Draws(rngs, config.device)
    agent = new_agent(Signature.of(first), Scaler(data.obs, data.mask), draws)
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
