"""Provides a method with the data that it declares that it uses, counts it, and keeps all else out of its reach.

The methods of this package are handed it in this process: what they hold refers to a provider by a number alone.
A method from outside asks from a process of its own (`guest_host.py`).
"""

import itertools
import weakref
from collections.abc import Callable, Sequence
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deconfounded import envs
from deconfounded.benchmarks.engine.catalogue import METHODS
from deconfounded.benchmarks.engine.context import EXPLORATION, Context, stream
from deconfounded.deconf import methods
from deconfounded.deconf.core.monitor import Monitor, Training
from deconfounded.deconf.given import Given
from deconfounded.deconf.method import ENVIRONMENT, Method
from deconfounded.envs.streams import Array, unseeded
from deconfounded.envs.support.numbers import is_seed
from deconfounded.experts.agent import Agent
from deconfounded.experts.rollout import trial_seeds

OPENS = {  # what a method may ask for, by what it declares that it uses
    "demonstrations": ("demonstrations", "fresh demonstrations"),
    "exploration": ("exploration", "environments", "reset", "step"),
    "queries": ("queries",),
    "theta": ("theta", "acting theta"),
    ENVIRONMENT: ("environment",),
}
IN_DEPLOYMENT = ("acting theta", "environment")


class Provider:
    """The data of a context, for one method. `rngs`: a generator a seed; exploration draws its seeds from them."""

    def __init__(self, context: Context, uses: Sequence[str], rngs: Sequence[np.random.Generator]) -> None:
        self.context, self.uses, self.rngs, self.fitted = context, uses, rngs, False
        self.open = {kind for use in uses for kind in OPENS[use]}
        if {"exploration", "theta"} <= set(uses):
            self.open.add("exploration with theta")
        self._vectors: list[Vector] = []

    def about(self) -> dict[str, Any]:
        """What a method may know of the task."""
        task, fresh = self.context.task, self.context.preset.fresh > 0
        sizes = {"observations": len(task.observation), "episodes": task.episodes, "horizon": task.horizon}
        return {**sizes, "action_space": task.action_space, "fresh": fresh}

    def __call__(self, kind: str, *what: Any, agent: Agent | None = None) -> Any:
        """The data of a kind. Raises InputError for what was not declared, or is asked for after training."""
        if kind not in self.open:
            raise envs.InputError(f"it asked for {kind}, and declares that it uses {', '.join(self.uses) or 'nothing'}")
        if self.fitted and kind not in IN_DEPLOYMENT:
            raise envs.InputError(f"it asked for {kind} after training, for which data is")
        context = self.context
        match kind:
            case "demonstrations":
                return context.demonstrations
            case "fresh demonstrations":
                return context.demonstrate(self.rngs)
            case "theta":
                return self._theta
            case "exploration":
                return context.explore(agent, self.rngs, _number(*what))
            case "exploration with theta":
                return context.explore_with_theta(agent, self.rngs)
            case "queries":
                return context.query(agent, self.rngs, _number(*what))
            case "environments":
                seed, n = what
                if not is_seed(seed) or seed >= len(self.rngs):
                    right = f"it has {len(self.rngs)}, numbered from 0"
                    raise envs.InputError(f"it asked for environments of seed {seed!r}; {right}")
                self._vectors.append(Vector(context, seed, n, int(self.rngs[seed].integers(2**31))))
                return len(self._vectors) - 1
            case "reset":
                return self._vector(what[0]).reset()
            case "step":
                return self._vector(what[0]).step(what[1])
            case "acting theta":
                return context.task.encode_theta(context.env.theta)
            case _:
                return context.env, context.expert

    def _vector(self, number: Any) -> "Vector":
        if not is_seed(number) or number >= len(self._vectors):
            raise envs.InputError(f"it asked for environments number {number!r}; it was given {len(self._vectors)}")
        return self._vectors[number]

    @cached_property
    def _theta(self) -> Array:
        context = self.context
        context.monitor.spend("thetas", [context.preset.expert_trials] * len(context.seeds))
        return context.task.encode_theta(context.demonstrated_theta)


def _number(trials: Any) -> int | None:
    if trials is not None and not (is_seed(trials) and trials > 0):
        raise envs.InputError(f"it asked for {trials!r} trials; it must be a number from 1 up")
    return trials


class Vector:
    """Environments of one seed of a context, in trials of the task's episodes, whose use is counted."""

    def __init__(self, context: Context, index: int, n: int, seed: int) -> None:
        self.context, self.index, self.batch = context, index, envs.BatchEnv(context.task, n)
        self.seeds = trial_seeds(n, stream(EXPLORATION, seed))

    def _spend(self, **amounts: int) -> None:
        for kind, amount in amounts.items():
            each = [amount if i == self.index else 0 for i in range(len(self.context.seeds))]
            self.context.monitor.spend(kind, each)

    def reset(self) -> Array:
        """See deconf.given.Environments; a reset starts the same trials again."""
        self.episode = np.ones(self.batch.n, int)
        self._spend(exploration_trials=self.batch.n)
        return self.batch.reset(self.seeds)

    def step(self, action: Array) -> tuple[Array, Array, NDArray[np.bool_], NDArray[np.bool_]]:
        """See deconf.given.Environments."""
        obs, _, terminated, truncated = self.batch.step(action)
        over, following = terminated | truncated, obs
        done = over & (self.episode >= self.context.task.episodes)
        if over.any():
            following = self.batch.reset(options={"keep_theta": ~done}, where=over)
            self.episode = np.where(done, 1, self.episode + over)
        self._spend(exploration_trials=int(done.sum()), interactions=self.batch.n)
        return obs, following, over, done


_PROVIDERS: dict[int, Provider] = {}
_NUMBERS = itertools.count()


def _ask(number: int, kind: str, *what: Any, agent: Agent | None = None) -> Any:
    return _PROVIDERS[number](kind, *what, agent=agent)


def _forget(number: int) -> None:
    del _PROVIDERS[number]


class NumberedMonitor(Monitor):
    """Stands for the monitor of a run, which it finds by a number: so a method cannot reach the run's context by it."""

    def __init__(self, number: int) -> None:
        self._number = number

    def update(self, done: int, total: int, losses: dict[str, float], agent: Agent | None = None) -> None:
        _PROVIDERS[self._number].context.monitor.update(done, total, losses, agent)

    def save(self, state: Callable[[], Training]) -> None:
        """Offer a checkpoint to the run's monitor."""
        _PROVIDERS[self._number].context.monitor.save(state)

    def load(self) -> Training | None:
        """The checkpoint that the run's monitor has, of an interrupted training; it loads nothing into this object."""
        return _PROVIDERS[self._number].context.monitor.load()


def fit(context: Context, name: str) -> Agent:
    """Train a method of this package with the context's seeds; returns its agent."""
    function = methods.load(name)
    method: Method = function.method  # type: ignore[attr-defined]
    provider, number = Provider(context, method.uses, rngs := [unseeded(rng) for rng in context.rngs]), next(_NUMBERS)
    _PROVIDERS[number] = provider
    config = method.config(context.preset.configs.get(name, {}))
    given = Given(partial(_ask, number), provider.about(), config, rngs, NumberedMonitor(number))
    weakref.finalize(given, _forget, number)  # an oracle's agent keeps it
    agent = function(given)
    provider.fitted = True
    return agent


def deployed(name: str, agent: Agent) -> dict[str, Agent]:
    """The agent by its way of deployment: under the empty name as it is, then the method's further ways."""
    return {"": agent, **{way: deploy(agent) for way, deploy in METHODS[name].deployments.items()}}
