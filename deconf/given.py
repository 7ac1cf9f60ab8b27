"""What a method from outside is handed: the data it declared that it uses, and nothing else.

The method runs in a process of its own. Environments, their seeds, theta and the expert are in another one, and come no
nearer than the arrays that this object asks for; what it asks for is counted. That keeps theta from who does not look
for it, and from who walks through all that is at hand; it is no prison: files on the disk are not out of reach, and the
seeds of a run without a salt are everybody's.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from deconfounded.deconf.wire import pack
from deconfounded.envs.task import InputError
from deconfounded.experts.rollout import Agent, Trials

ANSWERED = ("act", "features")
USES = {
    "demonstrations": "expert trials, without theta",
    "exploration": "roll-outs of a behaviour that is blind to theta",
    "queries": "what the expert would do at each step of such a roll-out",
    "theta": "the theta of each demonstration, in training",
}


def uses(*kinds: str) -> Callable[[Callable[[Given], Agent]], Callable[[Given], Agent]]:
    """Declares what a method may use, some of USES: `@uses("demonstrations")`. Raises InputError for anything else."""
    check_uses(kinds)

    def declare(fit: Callable[[Given], Agent]) -> Callable[[Given], Agent]:
        fit.uses = kinds  # type: ignore[attr-defined]
        return fit

    return declare


def check_uses(kinds: Iterable[str]) -> None:
    """Raises InputError for what is not one of USES."""
    if wrong := [kind for kind in kinds if kind not in USES]:
        raise InputError(f"a method uses {wrong[0]!r}; it may use {', '.join(USES)}")


class Given:
    """What one seed of a method may use.

    observations: O, the width of an observation. action_space: Box in [-1, 1], or Discrete. episodes: of a trial.
    horizon: steps of an episode, at most. rng: its random numbers. Raises InputError for what was not declared.
    """

    def __init__(self, channel: Connection, about: dict[str, Any]) -> None:
        self._channel: Connection | None = channel
        self.observations: int = about["observations"]
        self.action_space: spaces.Box | spaces.Discrete = about["action_space"]
        self.episodes: int = about["episodes"]
        self.horizon: int = about["horizon"]
        self.rng = np.random.default_rng(about["rng"])

    @property
    def demonstrations(self) -> Trials:
        """Expert trials, without theta; the same whenever it is asked for."""
        return self._ask("demonstrations")

    @property
    def theta(self) -> NDArray[np.float64]:
        """The encoded theta [B, E, F] of each demonstration's episodes, about unit size."""
        return self._ask("theta")

    def explore(self, agent: Agent | None = None, trials: int | None = None) -> Trials:
        """Roll an agent out under fresh thetas; None: uniformly random actions. trials: default, the preset's."""
        return self._ask("exploration", agent, trials)

    def query(self, agent: Agent | None = None, trials: int | None = None) -> tuple[Trials, NDArray[np.float32]]:
        """Such roll-outs, and what the expert would have done at each step [B, E, T, A]."""
        return self._ask("queries", agent, trials)

    def progress(self, share: float, **losses: float) -> None:
        """So much of the training is done, from 0 to 1; losses are for the learning curve."""
        if self._channel is not None:
            self._channel.send_bytes(pack(["progress", share, losses]))

    def _ask(self, kind: str, agent: Agent | None = None, *rest: Any) -> Any:
        channel, self._channel = self._channel, None
        if channel is None:
            raise InputError(f"{kind} were asked for while an agent acts, or when fitting was over; ask in between")
        try:
            channel.send_bytes(pack([kind, agent is not None, *rest]))
            return serve(channel, agent)
        finally:
            self._channel = channel

    def close(self) -> None:
        """Fitting is over."""
        self._channel = None


def serve(channel: Connection, agent: Agent | None) -> Any:
    """Be the agent for whoever is at the other end, until told that it is over; returns what came with that."""
    while True:
        asked, *given = channel.recv()
        if asked == "over":
            return given[0]
        if asked == "refused":
            raise InputError(given[0])
        if asked == "reset":
            given = [[np.random.default_rng(seed) for seed in given[0]]]
        answer = getattr(agent, asked)(*given)
        channel.send_bytes(pack(["done", answer if asked in ANSWERED else None, time.process_time()]))
