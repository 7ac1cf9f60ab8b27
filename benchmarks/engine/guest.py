"""A method from outside, in a process of its own: no theta, environment, seed or expert is in that process's memory.

This side keeps them. It answers what the method asks for if it declared that it uses it, counts it, and steps the
environments in which the method's agent acts.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deconfounded import envs
from deconfounded.benchmarks.engine.methods import Context
from deconfounded.envs import outside
from deconfounded.envs.task import Array
from deconfounded.experts.demos import Agent, Trials


def die_with_parent() -> None:
    """End this process when the one that started it has ended, however that came about."""

    def wait() -> None:
        parent = multiprocessing.parent_process()
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def live(reference: str, channel: Connection, about: dict[str, Any]) -> None:
    """The guest's process: fit, then be the agent until the channel is closed."""
    die_with_parent()
    from deconfounded.deconf.given import Given, serve

    try:
        given = Given(channel, about)
        agent = outside.find("method", reference)(given)
        given.close()
        if not isinstance(agent, Agent):
            raise envs.InputError(f"it returned {agent!r}; it must return a deconfounded.experts.demos.Agent")
        channel.send(("fitted",))
        while True:
            folder, described = serve(channel, agent)
            from deconfounded.experts.saved import save

            try:
                save(agent, folder, **described)
                channel.send(("done", ""))
            except envs.InputError as error:
                channel.send(("done", str(error)))
    except EOFError:
        return
    except envs.InputError as error:
        channel.send(("failed", str(error)))
    except Exception as error:
        channel.send(("failed", outside.told(error)))


class Guest(Agent):
    """The agent of one seed of a method from outside; it acts over there. Use it in a `with` statement."""

    def __init__(self, context: Context, name: str, reference: str, uses: Sequence[str]) -> None:
        self.context, self.name, self.uses = context, name, uses
        here, there = (made := multiprocessing.get_context("spawn")).Pipe()
        task = context.task
        about = {
            "observations": len(task.observation),
            "action_space": task.action_space,
            "episodes": task.episodes,
            "horizon": task.horizon,
            "rng": int(context.rngs[0].integers(2**63)),
        }
        self.channel: Connection = here
        self.process = made.Process(target=live, args=(reference, there, about), daemon=True)
        self.process.start()
        there.close()
        self._rngs = context.rngs
        self._fit()

    def _hear(self) -> tuple[str, list[Any]]:
        try:
            said, *rest = self.channel.recv()
        except (EOFError, ConnectionError):
            raise envs.InputError(f"method {self.name}: its process was killed (out of memory?)") from None
        if said == "failed":
            raise envs.InputError(f"method {self.name}: {rest[0]}")
        return said, rest

    def _fit(self) -> None:
        while True:
            asked, rest = self._hear()
            if asked == "fitted":
                return
            if asked == "progress":
                self.context.monitor.update(round(1000 * rest[0]), 1000, rest[1])
            elif asked not in self.uses:
                told = f"it asked for {asked}, and declares that it uses {', '.join(self.uses) or 'nothing'}"
                self.channel.send(("refused", told))
            else:
                self.channel.send(("over", self._data(asked, *rest)))

    def _data(self, kind: str, has_agent: bool, trials: int | None = None) -> Any:
        context, agent = self.context, self if has_agent else None
        if kind == "demonstrations":
            return context.demonstrations
        if kind == "theta":
            theta = context.task.encode_theta(context.demonstrated_theta)
            context.monitor.spend("thetas", [len(theta)])
            return theta
        if trials is not None and not (isinstance(trials, int | np.integer) and trials > 0):
            raise envs.InputError(f"method {self.name} asked for {trials!r} trials; it must be a number from 1 up")
        made: Trials | tuple[Trials, NDArray[np.float32]]
        made = (context.explore if kind == "exploration" else context.query)(agent, self._rngs, trials)
        return made

    def _do(self, what: str, *given: Any) -> Any:
        self.channel.send((what, *given))
        return self._hear()[1][0]

    def begin(self, n: int) -> None:
        self._do("begin", n)

    def reset(self, rngs: Sequence[np.random.Generator]) -> None:
        """A generator knows the seed it came from: what the guest gets is a number drawn from it."""
        self._do("reset", [int(rng.integers(2**63)) for rng in rngs])

    def act(self, obs: NDArray[np.float32]) -> Array:
        action = np.asarray(self._do("act", obs))
        if action.ndim != 2 or len(action) != len(obs):
            raise envs.InputError(f"method {self.name} gave actions of {action.shape} for {len(obs)} observations")
        return action

    def observe(
        self, obs: NDArray[np.float32], action: Array, next_obs: NDArray[np.float32], alive: NDArray[np.bool_]
    ) -> None:
        self._do("observe", obs, action, next_obs, alive)

    def features(self) -> NDArray[np.float32] | None:
        return self._do("features")

    def keep(self, folder: Path, about: dict[str, Any]) -> str:
        """Let the guest save its agent; returns why it could not."""
        return self._do("over", (folder, about))

    def close(self) -> None:
        """Let it go."""
        self.channel.close()
        self.process.join(5)
        self.process.terminate()
        self.process.join()
