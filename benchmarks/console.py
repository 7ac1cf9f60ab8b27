"""What commands share: their arguments, and one line for bad input and for signals. It imports what is quick alone."""

import argparse
import contextlib
import difflib
import io
import os
import re
import select
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
CLEANING_S = 5.0  # for which a signal after the first changes nothing
NO_READER = 141  # 128 + SIGPIPE
ROOT = Path(__file__).resolve().parents[1]


def place(text: str) -> Path:
    """An argument that names a file or folder; nothing is no name."""
    if not text.strip():
        raise argparse.ArgumentTypeError("it must be a name")
    return Path(text)


def whole(least: int, most: int | None = None) -> Callable[[str], int]:
    """The type of an argument that is a whole number of that range."""

    def number(text: str) -> int:
        with contextlib.suppress(ValueError):
            if least <= (value := int(text)) and (most is None or value <= most):
                return value
        reach = "up" if most is None else f"to {most:,}"
        raise argparse.ArgumentTypeError(f"it was {text!r}; it must be a whole number from {least:,} {reach}")

    return number


COMMON: dict[str, dict[str, Any]] = {
    "--agent": {"type": Path, "required": True, "help": "a folder under a run's agents/"},
    "--task": {"required": True, "help": "its name, or path/file.py:Class"},
    "--expert": {"help": "another expert: weights.safetensors, or path/file.py:name of a callable"},
    "--device": {"default": "cpu", "help": "torch device of training, e.g. cuda"},
}


class Parser(argparse.ArgumentParser):
    """A command line, described by its module's docstring, whose errors are one line; with some of COMMON."""

    def __init__(self, description: str | None, *common: str) -> None:
        form = argparse.RawDescriptionHelpFormatter
        super().__init__(description=description, formatter_class=form, allow_abbrev=False)
        for name in common:
            self.add_argument(name, **COMMON[name])

    def error(self, message: str) -> NoReturn:
        from deconfounded.envs.support.errors import InputError

        unknown = re.match(r"unrecognized arguments: (--[^ =]+)", message)
        near = difflib.get_close_matches(unknown[1], self._option_string_actions, 1) if unknown else []
        raise InputError(f"{message}; {f'did you mean {near[0]}? ' if near else ''}see --help")


class Stopped(KeyboardInterrupt):
    """A signal that asks to stop: Ctrl-C, SIGTERM, or the terminal is gone."""


def _heed(handler: Callable[[int, FrameType | None], None]) -> dict[int, Any]:
    """Take signals, but those that are ignored (nohup); returns what took them before."""
    return {one: signal.signal(one, handler) for one in SIGNALS if signal.getsignal(one) is not signal.SIG_IGN}


def stop_at_once() -> None:
    """Until `run_command` a signal ends this process with one line: there is nothing yet to clean up."""

    def stop(number: int, frame: FrameType | None) -> None:
        with contextlib.suppress(OSError):  # the terminal is gone
            os.write(2, b"interrupted\n")
        os._exit(128 + number)

    _heed(stop)


def escape_output() -> None:
    """Characters that the output's encoding lacks (of a file's name, in the C locale) are escaped from now on."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # as Python's own for standard error


def end(line: str, code: int = 2) -> NoReturn:
    """End this process with a line on standard error, though a name in it holds several; bad input is code 2."""
    with contextlib.suppress(OSError):  # the terminal is gone
        print(" ".join(line.splitlines()), file=sys.stderr)
    sys.exit(code)


def _flush() -> None:
    """Flush stdout and stderr; what cannot be written there is dropped from now on."""
    for stream in filter(None, (sys.stdout, sys.stderr)):
        try:
            stream.flush()
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _unread() -> bool:
    """Whether stdout or stderr is a pipe that nobody reads any more."""
    watched = select.poll()
    for stream in filter(None, (sys.stdout, sys.stderr)):
        watched.register(stream, 0)
    return any(event & select.POLLERR for _, event in watched.poll(0))


@contextlib.contextmanager
def quiet_pipe() -> Iterator[None]:
    """If nobody reads what is printed any more (`| head -1`), end as other programs do: without a word."""
    try:
        yield
        print(end="", flush=True)  # and not at exit, where it would be a traceback
    except BrokenPipeError:
        if not _unread():  # it was another pipe
            raise
        _flush()
        sys.exit(NO_READER)
    except BaseException:  # what --help printed is not flushed yet
        _flush()
        raise


class Stoppable:
    """Meanwhile signals raise Stopped; those that come while it is being cleaned up do nothing."""

    stopped: int | None = None  # by which signal

    def __enter__(self) -> "Stoppable":
        self._last = -CLEANING_S
        self._before = _heed(self._stop)
        return self

    def _stop(self, number: int, frame: FrameType | None) -> None:
        if time.monotonic() - self._last >= CLEANING_S:
            self.stopped, self._last = number, time.monotonic()
            raise Stopped(number)

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)


def _from_outside(error: SystemExit) -> bool:
    """Whether it was raised by neither a command nor argparse: by a task's reward, for example."""
    file = traceback.extract_tb(error.__traceback__)[-1].filename
    return file != argparse.__file__ and not Path(file).resolve().is_relative_to(ROOT / "benchmarks")


def run_command(main: Callable[[], None], interrupted: str = "nothing was written") -> None:
    """Run a command. Bad input, or a full disk, ends it with a line and exit code 2, signal n with one and 128 + n."""
    escape_output()
    signals = Stoppable()
    try:
        with signals, quiet_pipe():
            main()
        return
    except (Exception, KeyboardInterrupt, SystemExit) as error:
        # imported here, since `deconf --help` does without
        from deconfounded.envs.support.errors import InputError, error_line, users_line

        if isinstance(error, SystemExit):
            if not _from_outside(error):
                raise
            line, code = f"error: it was ended by {error_line(error)}", 2
        elif isinstance(error, KeyboardInterrupt) or signals.stopped:  # an import turns it into an error of its own
            line, code = f"interrupted; {interrupted}", 128 + (signals.stopped or signal.SIGINT)
        elif isinstance(error, InputError):
            line, code = f"error: {error}", 2
        elif isinstance(error, OSError):
            line, code = f"error: {error.filename or 'file'}: {error.strerror or error}", 2
        elif isinstance(error, MemoryError):
            line, code = f"error: not enough memory{f': {error}' if str(error) else ''}", 2
        elif users_line(error):  # in the code of a plug-in
            line, code = f"error: {error_line(error)}", 2
        else:
            raise
    end(line, code)
