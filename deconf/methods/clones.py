"""Cloning the expert's trials, whatever it is that learns: the training of naive_rnn and of its variants."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypeVar

from torch import Tensor

from deconfounded.deconf.core.agents import Checkpoint, LearnedAgent
from deconfounded.deconf.core.data import Batch, Draws, Rngs, Signature, Source, drawn, listed
from deconfounded.deconf.core.monitor import Monitor
from deconfounded.deconf.core.nets import Adam, Scaler
from deconfounded.deconf.methods.recurrent import Cloner, RecurrentAgent, RecurrentConfig

Kind = TypeVar("Kind", bound=LearnedAgent)
Recurrent = TypeVar("Recurrent", bound=RecurrentAgent)


class Config(Protocol):
    """What of a configuration is needed here; batch counts trials."""

    @property
    def batch(self) -> int: ...
    @property
    def device(self) -> str: ...


class Learner(Protocol):
    """Counts its updates, done and in all."""

    optimizer: Adam
    done: int
    total: int

    def learn(self, batch: Batch, label: Tensor) -> None:
        """From trials [S, B, T]; label [S, B, T, A]: the expert's action at each step."""


def clone(
    trials: Source,
    config: Config,
    rng: Rngs,
    start: Callable[[Signature, Scaler, Draws], Kind],
    teach: Callable[[Kind, int, Monitor], Learner],
    monitor: Monitor | None = None,
) -> Kind:
    """Clone the expert's trials, which are in as many equal groups as there are generators in rng.

    Or clone what draws them: fresh ones for every batch. start: makes an agent that knows nothing yet; the scaler is of
    the expert's observations. teach: makes what trains it, on trials of so many steps.
    """
    rngs, monitor = listed(rng), monitor or Monitor()
    shown = drawn(trials)
    data, draws = Batch.of(shown, len(rngs), config.device), Draws(rngs, config.device)
    agent = start(Signature.of(shown), Scaler(data.obs, data.mask), draws)
    learner = teach(agent, data.mask.shape[2], monitor)
    checkpoint = Checkpoint(monitor, rngs, **agent.parts(), optimizer=learner.optimizer, draws=draws)
    if before := checkpoint.load():
        learner.done = before["done"]
    while learner.done < learner.total:
        if shown is trials:
            batch = data.draw_trials(config.batch, draws)
        else:
            batch = Batch.of(drawn(trials), len(rngs), config.device)
        learner.learn(batch, batch.action)
        checkpoint.save(done=learner.done)
    return agent


def clone_by_chunks(
    kind: type[Recurrent], trials: Source, config: RecurrentConfig, rng: Rngs, monitor: Monitor | None = None
) -> Recurrent:
    """Clone with an agent of that kind, an update a chunk of a trial: see `clone`."""

    def start(signature: Signature, obs: Scaler, draws: Draws) -> Recurrent:
        agent = kind.new(config.width, signature, obs, draws)
        agent.configure(config)
        return agent  # type: ignore[return-value]

    return clone(trials, config, rng, start, lambda agent, steps, watch: Cloner(agent, config, steps, watch), monitor)
