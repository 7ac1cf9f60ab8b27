"""The data of a method: the kinds that it declares with `uses`, and nothing else.

A method has no reference to environments, their seeds, theta or the expert: it holds arrays, and a function that
requests more of them. A method from outside runs in a process of its own. This prevents accidental leakage, not
cheating: files can be read, and the seeds of a run without a salt are public.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from deconfounded.envs.streams import Array
from deconfounded.envs.support.errors import InputError
from deconfounded.experts.agent import Agent
from deconfounded.experts.trials import Trials

if TYPE_CHECKING:
    from deconfounded.deconf.core.monitor import Monitor

FloatArray = NDArray[np.float32]


class Ask(Protocol):
    """Requests data of a kind; `agent` is rolled out for it. Raises InputError for kinds that were not declared."""

    def __call__(self, kind: str, *details: Any, agent: Agent | None = None) -> Any: ...


class Given:
    """The data of one or more seeds, which are trained side by side.

    observations: O, the width of an observation. action_space: Box in [-1, 1], or Discrete. episodes: of a trial.
    horizon: the most steps of an episode. config: the method's configuration, of the class that it declared. rngs: a
    generator for each seed. monitor: receives progress and checkpoints. Trials are in as many equal groups as there are
    seeds, one after another. Methods and properties raise InputError for kinds of data that were not declared.
    """

    def __init__(
        self, ask: Ask, about: Mapping[str, Any], config: Any, rngs: Sequence[np.random.Generator], monitor: "Monitor"
    ) -> None:
        self._ask, self.config, self.rngs, self.monitor = ask, config, list(rngs), monitor
        self.observations: int = about["observations"]
        self.action_space: spaces.Box | spaces.Discrete = about["action_space"]
        self.episodes: int = about["episodes"]
        self.horizon: int = about["horizon"]
        self._fresh: bool = about["fresh"]

    @property
    def rng(self) -> np.random.Generator:
        """The first seed's generator. A method from outside has one seed at a time."""
        return self.rngs[0]

    @property
    def demonstrations(self) -> Trials:
        """Expert trials, without theta; the same at each request."""
        return self._ask("demonstrations")

    @property
    def source(self) -> Trials | Callable[[], Trials]:
        """The demonstrations; or, if the preset says so, a function that draws fresh ones."""
        return (lambda: self._ask("fresh demonstrations")) if self._fresh else self.demonstrations

    @property
    def theta(self) -> Array:
        """The encoded theta [B, E, F] of the demonstrations' episodes, of about unit scale.

        Where theta switches within episodes, it is [B, E, T, F], that of each step.
        """
        return self._ask("theta")

    def explore(self, agent: Agent | None = None, trials: int | None = None) -> Trials:
        """Roll out an agent (None: random actions) under fresh thetas. trials: for each seed; None: the preset's."""
        return self._roll_out("exploration", agent, trials)

    def explore_with_theta(self, agent: Agent | None = None) -> tuple[Trials, Array]:
        """Roll out an agent as in `explore`, with the encoded theta, as `theta` has it."""
        return self._roll_out("exploration with theta", agent, None)

    def query(self, agent: Agent | None = None, trials: int | None = None) -> tuple[Trials, FloatArray]:
        """Roll out an agent as in `explore`, with the expert's action at each step [B, E, T, A]."""
        return self._roll_out("queries", agent, trials)

    def _roll_out(self, kind: str, agent: Agent | None, trials: int | None) -> Any:
        if not isinstance(agent, Agent | None):
            right = "an Agent, or None: random actions; a number of trials is trials=..."
            raise InputError(f"agent of {kind} was {agent!r}; it must be {right}")
        return self._ask(kind, trials, agent=agent)

    def environments(self, seed: int, n: int) -> "Environments":
        """n environments of the seed of that index, under fresh thetas, for exploration step by step."""
        return Environments(self._ask, self._ask("environments", seed, n), n)

    def acting_theta(self) -> Array:
        """The encoded theta [N, F] of the environments that the agent acts in, for an oracle in deployment."""
        return self._ask("acting theta")

    @property
    def environment(self) -> Any:
        """The environments of evaluation, and the expert: for reference policies alone."""
        return self._ask("environment")

    def progress(self, share: float, **losses: float) -> None:
        """Report the share of the training that is done, from 0 to 1, and losses for the learning curve."""
        try:
            share, *values = map(float, (share, *losses.values()))  # of arrays and tensors that are a number
            finite = bool(np.isfinite([share, *values]).all())
        except Exception:  # any error of a class from outside
            finite = False
        if not finite:
            raise InputError(f"progress was {share}, {losses}; it must be finite numbers")
        self.monitor.update(round(1000 * min(max(share, 0), 1)), 1000, dict(zip(losses, values, strict=True)))


class Environments:
    """n environments, in trials of several episodes under one hidden theta."""

    def __init__(self, ask: Ask, number: int, n: int) -> None:
        self._ask, self._number, self.n = ask, number, n

    def reset(self) -> FloatArray:
        """Start trials; returns observations [n, O]. A later reset starts the same trials again."""
        return self._ask("reset", self._number)

    def step(self, action: FloatArray) -> tuple[FloatArray, FloatArray, NDArray[np.bool_], NDArray[np.bool_]]:
        """Actions [n, A] -> next observations [n, O], these after resets [n, O], ends of episodes and of trials [n]."""
        return self._ask("step", self._number, action)
