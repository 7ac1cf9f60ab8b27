"""What commands share: one line for bad input, output folders, and progress on a terminal or in a log."""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

from deconfounded.envs.task import InputError


class Parser(argparse.ArgumentParser):
    """A command line, described by its module's docstring, whose errors are one line."""

    def __init__(self, description: str | None) -> None:
        super().__init__(
            description=description, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
        )

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message}; see --help")


def run_command(main: Callable[[], None], interrupted: str = "nothing was written") -> None:
    """Run a command. Bad input, or a disk that is full, ends it with one line and exit code 2, Ctrl-C with 130."""
    try:
        main()
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except OSError as error:
        print(f"error: {error.filename or 'file'}: {error.strerror or error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print(f"interrupted; {interrupted}", file=sys.stderr)
        sys.exit(130)


def check_folder(folder: Path) -> None:
    """Make an output folder. Raises InputError if it cannot be written."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(f"output folder {folder} cannot be written: {error.strerror}; give another one") from None


def write_atomically(file: Path, data: str | bytes) -> None:
    """The file holds all of data, or what it held before."""
    partial = file.with_name(f".{file.name}.{os.getpid()}")
    partial.write_bytes(data.encode() if isinstance(data, str) else data)
    os.replace(partial, file)


def write_json(file: Path, data: Any) -> None:
    """JSON, atomically."""
    write_atomically(file, json.dumps(data, indent=2) + "\n")


class Progress:
    """A bar with an ETA on a terminal; elsewhere a plain line now and then."""

    def __init__(self, total: int, label: str, every_s: float = 15) -> None:
        self.total, self.done, self._label, self._every = total, 0, label, every_s
        self._start = self._last = time.monotonic()
        self._bar: Any = None
        if sys.stderr.isatty():
            from tqdm import tqdm  # who has the environments alone has no bars

            self._bar = tqdm(total=total, desc=label, file=sys.stderr, leave=False)

    def update(self, n: int, note: str = "") -> None:
        """n more are done."""
        self.done += n
        if self._bar is not None:
            self._bar.set_postfix_str(note, refresh=False)
            self._bar.update(n)
        elif time.monotonic() - self._last > self._every:
            self._last, share = time.monotonic(), self.done / self.total
            left = f"{(self._last - self._start) * (1 / share - 1):.0f} s left" if share > 0.01 else "just begun"
            print(f"{self._label}: {share:4.0%}, {left} {note}".rstrip(), flush=True)

    def line(self, text: str) -> None:
        """Print a line that stays."""
        if self._bar is not None:
            self._bar.write(text)
        else:
            print(text, flush=True)

    def close(self) -> None:
        """Take the bar away."""
        if self._bar is not None:
            self._bar.close()
