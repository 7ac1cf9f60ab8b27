"""The guest's end of the wall: what a method from outside asks for, and its agent, over a connection."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
import threading
import time
from multiprocessing.connection import Client, Connection
from typing import Any

import numpy as np

from deconfounded.deconf.core.monitor import Monitor
from deconfounded.deconf.wire import pack
from deconfounded.envs.support.errors import InputError, error_line
from deconfounded.experts.rollout import Agent

ANSWERED = ("act", "features")


class ChannelMonitor(Monitor):
    """Sends progress; a method from outside keeps no checkpoint."""

    def __init__(self, channel: Connection) -> None:
        self._channel = channel

    def update(self, done: int, total: int, losses: dict[str, float], agent: Agent | None = None) -> None:
        self._channel.send_bytes(pack(["progress", done / total, losses]))


class ChannelAsk:
    """Asks at the other end, and is the agent for it meanwhile. Raises InputError while it waits, or once closed."""

    def __init__(self, channel: Connection) -> None:
        self._channel: Connection | None = channel

    def __call__(self, kind: str, *what: Any, agent: Agent | None = None) -> Any:
        channel, self._channel = self._channel, None
        if channel is None:
            raise InputError(f"{kind} were asked for while an agent acts, or when fitting was over; ask in between")
        try:
            channel.send_bytes(pack([kind, agent is not None, *what]))
            return serve(channel, agent)
        finally:
            self._channel = channel

    def close(self) -> None:
        """Fitting is over."""
        self._channel = None


def serve(channel: Connection, agent: Agent | None) -> Any:
    """Be the agent for the other end, until it says that this is over; returns what it sends with that."""
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


def live(reference: str, channel: Connection, about: dict[str, Any]) -> None:
    """Fit, then be the agent until the channel is closed."""
    from deconfounded.deconf.given import Given
    from deconfounded.deconf.method import Method
    from deconfounded.envs.support import outside
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
            raise InputError(f"it returned {agent!r}; it must return a deconfounded.experts.rollout.Agent")
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


def _end_with_parent() -> None:
    """Standard input is open as long as the parent lives. It is read without Python's locks, which forks inherit."""
    while os.read(0, 1):
        pass
    if hasattr(os, "killpg"):
        os.killpg(0, signal.SIGKILL)  # this process leads a session
    os._exit(1)


def main() -> None:
    """Connect to the run that started this process, and serve it."""
    line = b""
    while not line.endswith(b"\n") and (more := os.read(0, 65536)):
        line += more
    begun, sys.stdin = json.loads(line), open(os.devnull, encoding="utf-8")  # noqa: SIM115
    sys.path[:] = begun["path"]
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with contextlib.suppress(AttributeError):  # characters that the output's encoding lacks are escaped
        sys.stdout.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
    with Client(begun["address"], authkey=bytes.fromhex(begun["key"])) as channel:
        live(begun["reference"], channel, channel.recv())
