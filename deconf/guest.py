"""A guest's end of the connection: requests of a method from outside for data, and calls of its agent."""

import contextlib
import io
import os
import shutil
import signal
import sys
import threading
import time
import traceback
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from deconfounded.deconf.core.monitor import Monitor
from deconfounded.deconf.wall import METHOD_FILE
from deconfounded.deconf.wire import pack
from deconfounded.envs.support.errors import InputError, error_line
from deconfounded.experts.agent import Agent

MARK = "DECONFOUNDED_GUEST"  # environment variable of a guest's processes
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
            raise InputError(
                f"{kind} were asked for by an agent's method, or after fitting; ask in the function that fits"
            )
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


def live(reference: str, channel: Connection, about: dict[str, Any]) -> None:
    """Fit the method, then serve its agent until the connection is closed."""
    from deconfounded.deconf.given import Given
    from deconfounded.deconf.method import Method
    from deconfounded.envs.support import outside
    from deconfounded.experts.saved_agents import save

    def send(*message: Any) -> None:
        with contextlib.suppress(OSError):  # the other end is gone
            channel.send_bytes(pack(list(message)))

    try:
        fit, ask, rngs = outside.find("method", reference), ChannelAsk(channel), [np.random.default_rng(about["rng"])]
        config = getattr(fit, "method", Method(())).config(about["config"])
        agent = fit(Given(ask, about, config, rngs, ChannelMonitor(channel)))
        ask.close()
        if not isinstance(agent, Agent):
            raise InputError(f"it returned {agent!r}; it must return a deconfounded.experts.agent.Agent")
        send("fitted")
        while True:
            folder, described = serve(channel, agent)
            try:
                save(agent, folder, **described)
                send("done", "", time.process_time())
            except Exception as error:
                send("done", error_line(error), time.process_time())
    except (Exception, SystemExit) as error:  # among them that the other end is gone
        relative = isinstance(error, FileNotFoundError) and not os.path.isabs(error.filename or os.sep)
        hint = "; a method runs in an empty folder: give the file's whole path" if relative else ""
        send("failed", error_line(error) + hint, "".join(traceback.format_exception(error)))


def kill_marked(mark: str) -> None:
    """End what processes of a guest are left, in whatever session, but for this one, where the system lists them."""
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            marked = f"{MARK}={mark}".encode() in (folder / "environ").read_bytes().split(b"\0")
            if marked and int(folder.name) != os.getpid():
                os.kill(int(folder.name), signal.SIGKILL)


def _end_with_parent(folder: str, mark: str) -> None:
    """End with the parent, when standard input closes, and leave nothing: a parent that was killed does not clean up.

    The input is read without Python's locks, which forks inherit.
    """
    while os.read(0, 1):
        pass
    kill_marked(mark)
    shutil.rmtree(folder, ignore_errors=True)
    if hasattr(os, "killpg"):
        os.killpg(0, signal.SIGKILL)  # this process leads a session
    os._exit(1)


def main() -> None:
    """Serve the requests of the run that started this process.

    Arguments: a folder, which is removed in the end, and the number of the connection.
    """
    os.set_inheritable(number := int(sys.argv.pop()), False)  # else what the method starts would keep it open
    sys.stdin = io.StringIO()
    end = threading.Thread(target=_end_with_parent, args=(sys.argv.pop(), os.environ[MARK]), daemon=True)
    end.start()
    with contextlib.suppress(AttributeError):  # characters that the output's encoding lacks are escaped
        sys.stdout.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
    try:
        with Connection(number) as channel:
            reference, sys.path[:] = channel.recv()
            os.environ[METHOD_FILE] = reference.rpartition(":")[0]
            live(reference, channel, channel.recv())
    finally:
        end.join()  # which ends this process
