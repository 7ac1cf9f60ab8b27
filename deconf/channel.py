"""A guest's end of the connection: requests of a method from outside for data, and calls of its agent."""

from __future__ import annotations

import time
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from deconfounded.deconf.core.agents import Monitor
from deconfounded.deconf.wire import pack
from deconfounded.envs.support.errors import InputError
from deconfounded.experts.rollout import Agent

RETURNING = ("act", "features")  # calls whose result is sent back


class ChannelMonitor(Monitor):
    """Sends progress over the connection; a method from outside has no checkpoints."""

    def __init__(self, channel: Connection) -> None:
        self._channel = channel

    def update(self, done: int, total: int, losses: dict[str, float], agent: Agent | None = None) -> None:
        self._channel.send_bytes(pack(["progress", done / total, losses]))


class ChannelAsk:
    """Requests data over the connection, and meanwhile serves the agent that is rolled out for it.

    Raises InputError for a request during another, or after `close`.
    """

    def __init__(self, channel: Connection) -> None:
        self._channel: Connection | None = channel

    def __call__(self, kind: str, *details: Any, agent: Agent | None = None) -> Any:
        channel, self._channel = self._channel, None
        if channel is None:
            raise InputError(f"{kind} were asked for while an agent acts, or when fitting was over; ask in between")
        try:
            channel.send_bytes(pack([kind, agent is not None, *details]))
            return serve(channel, agent)
        finally:
            self._channel = channel

    def close(self) -> None:
        """Refuse requests from now on: fitting is over."""
        self._channel = None


def serve(channel: Connection, agent: Agent | None) -> Any:
    """Call the agent as the other end asks, until its message `over`; returns the data of that message."""
    while True:
        call, *arguments = channel.recv()
        if call == "over":
            return arguments[0]
        if call == "refused":
            raise InputError(arguments[0])
        if call == "reset":
            arguments = [[np.random.default_rng(seed) for seed in arguments[0]]]
        result = getattr(agent, call)(*arguments)
        channel.send_bytes(pack(["done", result if call in RETURNING else None, time.process_time()]))
