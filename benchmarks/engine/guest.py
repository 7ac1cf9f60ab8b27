"""A method from outside, in a process of its own: no theta, environment, seed or expert is in that process's memory.

This side keeps them. It answers what the method asks for if it declared that it uses it, counts it, and steps the
environments in which the method's agent acts.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deconfounded import envs
from deconfounded.benchmarks.console import escape_output
from deconfounded.benchmarks.engine.context import GUEST, Context, stream
from deconfounded.benchmarks.engine.provider import Provider
from deconfounded.deconf.wire import unpack
from deconfounded.envs.support import outside
from deconfounded.envs.support.errors import error_line
from deconfounded.envs.task import Array
from deconfounded.experts.rollout import Agent


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
    escape_output()
    from deconfounded.deconf.channel import ChannelAsk, ChannelMonitor, serve
    from deconfounded.deconf.given import Given
    from deconfounded.deconf.method import Method
    from deconfounded.deconf.wire import pack
    from deconfounded.experts.store import save

    def say(*what: Any) -> None:
        with contextlib.suppress(OSError):  # nobody listens any more
            channel.send_bytes(pack(list(what)))

    try:
        fit, ask, rngs = outside.find("method", reference), ChannelAsk(channel), [np.random.default_rng(about["rng"])]
        config = getattr(fit, "method", Method(())).config(about["config"])
        agent = fit(Given(ask, about, config, rngs, ChannelMonitor(channel)))
        ask.close()
        if not isinstance(agent, Agent):
            raise envs.InputError(f"it returned {agent!r}; it must return a deconfounded.experts.rollout.Agent")
        say("fitted")
        while True:
            folder, described = serve(channel, agent)
            try:
                save(agent, folder, **described)
                say("done", "", time.process_time())
            except Exception as error:
                say("done", error_line(error), time.process_time())
    except (Exception, SystemExit) as error:  # or the other end is gone, and nobody hears it
        say("failed", error_line(error))


class Guest(Agent):
    """The agent of one seed of a method from outside; it acts over there. `close` it in the end."""

    def __init__(self, context: Context, name: str, reference: str, uses: Sequence[str]) -> None:
        self.context, self.name, self.cpu = context, name, 0.0
        self.provider = Provider(context, uses, context.rngs)
        self.provider.open -= {"acting theta"}
        here, there = (made := multiprocessing.get_context("spawn")).Pipe()
        config = context.preset.configs.get(name, {})
        about = {**self.provider.about(), "config": config, "rng": stream(GUEST, context.seeds[0])}
        self.channel: Connection = here
        self.process = made.Process(target=live, args=(reference, there, about), daemon=True)
        line, sys.argv = sys.argv, sys.argv[:1]  # which a new process gets, and evaluation's salt is in it
        self.process.start()
        sys.argv = line
        there.close()
        try:
            self._fit()
        except BaseException:
            self.close()
            raise

    def _hear(self) -> list[Any]:
        """What it says next: never unpickled, since that would run its code here."""
        try:
            said = unpack(self.channel.recv_bytes())
        except (EOFError, ConnectionError):
            raise envs.InputError(f"method {self.name}: its process was killed (out of memory?)") from None
        except envs.InputError as error:
            raise envs.InputError(f"method {self.name}: {error}") from None
        if not isinstance(said, list) or not said or not isinstance(said[0], str):
            raise envs.InputError(f"method {self.name}: it said {said!r}, out of turn")
        if said[0] == "failed":
            raise envs.InputError(f"method {self.name}: {said[1]}")
        return said

    def _fit(self) -> None:
        while True:
            asked, *rest = self._hear()
            if asked == "fitted":
                return
            if asked == "progress":
                self._progress(*rest)
            else:
                self._provide(asked, *rest)

    def _progress(self, share: Any, losses: Any) -> None:
        values = [share, *(losses.values() if isinstance(losses, dict) else [None])]
        if not all(isinstance(value, int | float) and np.isfinite(value) for value in values):
            raise envs.InputError(f"method {self.name}: progress was {share}, {losses}; it must be finite numbers")
        self.context.monitor.update(round(1000 * min(max(share, 0), 1)), 1000, losses)

    def _provide(self, kind: str, has_agent: Any = None, *what: Any) -> None:
        try:
            answer = ("over", self.provider(kind, *what, agent=self if has_agent else None))
        except envs.InputError as error:
            answer = ("refused", str(error))
        self.channel.send(answer)

    def _do(self, what: str, *given: Any) -> Any:
        self.channel.send((what, *given))
        said = self._hear()
        if said[0] != "done" or len(said) != 3 or not isinstance(said[2], float):
            raise envs.InputError(f"method {self.name}: it said {said[0]!r}, out of turn")
        self.cpu = said[2]
        return said[1]

    def begin(self, n: int) -> None:
        self._do("begin", n)

    def reset(self, rngs: Sequence[np.random.Generator]) -> None:
        """A generator knows the seed it came from: what the guest gets is a number drawn from it."""
        self._do("reset", fresh(rngs))

    def act(self, obs: NDArray[np.float32]) -> Array:
        """Clipped to [-1, 1] if continuous, as environments do. Raises InputError for what is not a row for each."""
        given, task = self._do("act", obs), self.context.task
        width = task.action_width
        action = np.asarray(given, float) if isinstance(given, np.ndarray) else np.empty(0)
        if action.shape != (len(obs), width) or not np.isfinite(action).all():
            what = f"shape {action.shape}" if action.shape != (len(obs), width) else "NaN or infinity"
            raise envs.InputError(
                f"method {self.name} gave actions of {what} for {len(obs)} observations;"
                f" they must be ({len(obs)}, {width}), finite"
            )
        return task.check_action(action, len(obs)) if task.n_actions else action.clip(-1, 1)

    def observe(
        self, obs: NDArray[np.float32], action: Array, next_obs: NDArray[np.float32], alive: NDArray[np.bool_]
    ) -> None:
        self._do("observe", obs, action, next_obs, alive)

    def features(self) -> NDArray[np.float32] | None:
        known = self._do("features")
        fits = isinstance(known, np.ndarray) and known.ndim == 2 and bool(np.isfinite(known).all())
        if known is not None and not fits:
            raise envs.InputError(f"method {self.name}: features must be None, or finite [N, F]")
        return known

    def keep(self, folder: Path, about: dict[str, Any]) -> str:
        """Let the guest save its agent; returns why it could not."""
        return str(self._do("over", (folder, about)))

    def close(self) -> None:
        """Let it go."""
        self.channel.close()
        self.process.join(2)
        self.process.terminate()
        self.process.join(2)
        self.process.kill()
        self.process.join()


def fresh(rngs: Sequence[np.random.Generator]) -> list[int]:
    """A number from each generator, to make another one of that does not know where it came from."""
    return [int(rng.integers(2**63)) for rng in rngs]


class Stranger(Agent):
    """An agent of somebody else's class in this process: it gets the random numbers that it would get as a guest."""

    def __init__(self, agent: Agent) -> None:
        self.agent = agent

    def begin(self, n: int) -> None:
        self.agent.begin(n)

    def reset(self, rngs: Sequence[np.random.Generator]) -> None:
        self.agent.reset([np.random.default_rng(seed) for seed in fresh(rngs)])

    def act(self, obs: NDArray[np.float32]) -> Array:
        return self.agent.act(obs)

    def observe(
        self, obs: NDArray[np.float32], action: Array, next_obs: NDArray[np.float32], alive: NDArray[np.bool_]
    ) -> None:
        self.agent.observe(obs, action, next_obs, alive)
