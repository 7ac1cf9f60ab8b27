"""A method from outside, in a process of its own: no theta, environment, seed or expert is in that process's memory.

This side keeps them. It answers what the method asks for if it declared that it uses it, counts it, and steps the
environments in which the method's agent acts.
"""

import contextlib
import hashlib
import os
import secrets
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Sequence
from multiprocessing import Pipe
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import deconfounded
from deconfounded import envs
from deconfounded.benchmarks.engine.context import GUEST, Context, stream
from deconfounded.benchmarks.engine.provider import Provider
from deconfounded.deconf.given import Given
from deconfounded.deconf.guest import MARK, kill_marked
from deconfounded.deconf.method import Method
from deconfounded.deconf.wire import unpack
from deconfounded.envs.support import outside
from deconfounded.envs.task import Array
from deconfounded.experts.agent import Agent, AgentWrapper


def _environ(mark: str) -> dict[str, str]:
    """The environment of a guest: this package is found in any folder, and its processes carry a mark."""
    return {**os.environ, "PYTHONPATH": str(Path(deconfounded.__file__).parents[1]), MARK: mark}


class Guest(Agent):
    """The agent of one seed of a method from outside; it acts over there. `close` it in the end."""

    def __init__(self, context: Context, name: str, reference: str, uses: Sequence[str]) -> None:
        self.context, self.name, self.cpu = context, name, 0.0
        self.provider = Provider(context, uses, context.rngs)
        self.provider.open -= {"acting theta"}
        self.mark, self.folder = secrets.token_hex(16), tempfile.TemporaryDirectory(prefix="deconfounded-")
        self.channel, theirs = Pipe()  # no named socket: these fail where the path of temporary files is long
        with theirs:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "deconfounded.deconf.wall", self.folder.name, str(theirs.fileno())],
                cwd=self.folder.name,
                env=_environ(self.mark),
                stdin=subprocess.PIPE,  # which nothing is written to: it closes when this process ends
                start_new_session=True,
                pass_fds=[theirs.fileno()],
            )
        threading.Thread(target=self._disconnect, args=(os.dup(self.channel.fileno()),), daemon=True).start()
        path = [str(Path(entry).resolve()) for entry in sys.path if entry not in outside.FOLDERS]  # of others
        config, rng = context.preset.configs.get(name, {}), stream(GUEST, context.seeds[0], context.salt)
        try:
            with contextlib.suppress(ConnectionError):  # it ended; how, it is asked next
                self.channel.send((reference, path))
                self.channel.send({**self.provider.about(), "config": config, "rng": rng})
            self._fit()
        except BaseException:
            self.close()
            raise

    def _disconnect(self, channel: int) -> None:
        """End the connection when its process has ended: a child that it forked may still hold the other end open."""
        self.process.wait()
        with socket.socket(fileno=channel) as ours, contextlib.suppress(OSError):  # it is over already
            ours.shutdown(socket.SHUT_RDWR)

    def _hear(self) -> list[Any]:
        """What it says next: never unpickled, since that would run its code here."""
        try:
            said = unpack(self.channel.recv_bytes())
        except (EOFError, ConnectionError):
            raise envs.InputError(f"method {self.name}: its process {self._end()}") from None
        except envs.InputError as error:
            raise envs.InputError(f"method {self.name}: {error}") from None
        if not isinstance(said, list) or not said or not isinstance(said[0], str):
            raise envs.InputError(f"method {self.name}: it said {said!r}, out of turn")
        if said[0] == "failed":
            failure = envs.InputError(f"method {self.name}: {said[1]}")
            failure.add_note(str(said[-1]))  # its traceback
            raise failure
        return said

    def _end(self) -> str:
        """How its process ended."""
        try:
            status = self.process.wait(2)
        except subprocess.TimeoutExpired:
            return "closed the connection"
        killed = "was killed (out of memory?)" if status == -signal.SIGKILL else f"was ended by signal {-status}"
        return f"ended with status {status}" if status >= 0 else killed

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
        self._say(answer)

    def _say(self, message: tuple[Any, ...]) -> None:
        try:
            self.channel.send(message)
        except ConnectionError:
            raise envs.InputError(f"method {self.name}: its process {self._end()}") from None

    def _do(self, what: str, *given: Any) -> Any:
        self._say((what, *given))
        said = self._hear()
        if said[0] != "done" or len(said) != 3 or not isinstance(said[2], float):
            raise envs.InputError(f"method {self.name}: it said {said[0]!r}, out of turn")
        self.cpu = said[2]
        return said[1]

    def begin(self, n: int) -> None:
        self.n = n
        self._do("begin", n)

    def reset(self, rngs: Sequence[np.random.Generator]) -> None:
        """A generator knows the seed it came from: what the guest gets is a number drawn from it."""
        self._do("reset", fresh(rngs, self.context.salt))

    def act(self, obs: NDArray[np.float32]) -> Array:
        """Clipped to [-1, 1] if continuous, as environments do. Raises InputError for what is not a row for each."""
        given, task = self._do("act", obs), self.context.task
        width = task.action_width
        if not isinstance(given, np.ndarray):
            right = f"an array ({len(obs)}, {width})"
            what = "None" if given is None else f"a {type(given).__name__}"
            raise envs.InputError(f"method {self.name} gave {what} for actions; they must be {right}")
        action = given.astype(float)
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
        features = self._do("features")
        shape: tuple[int, ...] = getattr(features, "shape", ())
        fits = len(shape) == 2 and shape[0] == self.n and shape[1] > 0
        if features is not None and not (fits and np.isfinite(features).all()):
            what = "NaN or infinity" if fits else f"shape {shape}"
            right = f"None, or finite, of shape ({self.n}, F), F from 1 up"
            raise envs.InputError(f"method {self.name} gave features of {what}; they must be {right}")
        return features

    def keep(self, folder: Path, about: dict[str, Any]) -> str:
        """Let the guest save its agent; returns why it could not."""
        return str(self._do("over", (folder.absolute(), about)))  # it works in another folder

    def close(self) -> None:
        """Let it go, and all that it started."""
        self.channel.close()
        assert self.process.stdin is not None
        self.process.stdin.close()
        try:
            self.process.wait(2)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        with contextlib.suppress(OSError, AttributeError):  # gone already; or a system without process groups
            os.killpg(self.process.pid, signal.SIGKILL)
        kill_marked(self.mark)
        self.folder.cleanup()


def fresh(rngs: Sequence[np.random.Generator], salt: str = "") -> list[int]:
    """A number from each generator, to make another one of that does not know where it came from.

    A generator comes from a seed of 31 bits, which thetas are drawn by: all of these could be tried. With a salt, what
    was drawn cannot be told from the number.
    """
    drawn = [int(rng.integers(2**63)) for rng in rngs]
    digests = (hashlib.sha256(f"{number} {salt}".encode("utf-8", "surrogateescape")).digest() for number in drawn)
    return [int.from_bytes(digest[:8]) >> 1 for digest in digests] if salt else drawn


class ReseededAgent(AgentWrapper):
    """An agent of somebody else's class in this process: it gets the random numbers that it would get as a guest.

    So are arrays copies of its own, which it may change. salt: of a guest's training.
    """

    def __init__(self, agent: Agent, salt: str = "") -> None:
        super().__init__(agent)
        self.salt = salt

    def reset(self, rngs: Sequence[np.random.Generator]) -> None:
        super().reset([np.random.default_rng(seed) for seed in fresh(rngs, self.salt)])

    def act(self, obs: NDArray[np.float32]) -> Array:
        return super().act(obs.copy())

    def observe(
        self, obs: NDArray[np.float32], action: Array, next_obs: NDArray[np.float32], alive: NDArray[np.bool_]
    ) -> None:
        super().observe(obs.copy(), action.copy(), next_obs.copy(), alive.copy())

    def features(self) -> NDArray[np.float32] | None:
        return self.agent.features()


def fit_guest(context: Context, name: str, method: Method) -> Agent:
    """The agent of a method from outside, fitted in this process to the data that `Guest` would hand it."""
    provider, function = Provider(context, method.uses, context.rngs), outside.find("method", method.reference)
    provider.open -= {"acting theta"}
    if (file := outside.file(method.reference)) and method.reference.rpartition(":")[0].endswith(".py"):
        outside.check_helpers(file)

    def ask(kind: str, *details: Any, agent: Agent | None = None) -> Any:
        return provider(kind, *details, agent=agent and ReseededAgent(agent, context.salt))

    rngs = [np.random.default_rng(stream(GUEST, context.seeds[0], context.salt))]
    config = function.method.config(context.preset.configs.get(name, {}))
    agent = function(Given(ask, provider.about(), config, rngs, context.monitor))
    provider.fitted = True
    if not isinstance(agent, Agent):
        raise envs.InputError(f"method {name} returned {agent!r}; it must return a deconfounded.experts.agent.Agent")
    return ReseededAgent(agent, context.salt)
