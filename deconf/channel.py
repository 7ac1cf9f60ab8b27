"""The guest's end of the wall: what a method from outside asks for, and its agent, over a connection."""

from __future__ import annotations

import time
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from deconfounded.deconf.core.agents import Monitor
from deconfounded.deconf.wire import pack
from deconfounded.envs.support.errors import InputError
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
