"""What commands share: their arguments, and one line for bad input."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

from deconfounded.envs.task import InputError


class Parser(argparse.ArgumentParser):
    """A command line, described by its module's docstring, whose errors are one line."""

    def __init__(self, description: str | None) -> None:
        super().__init__(
            description=description, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
        )

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message}; see --help")


def place(text: str) -> Path:
    """An argument that names a file or folder; nothing is no name."""
    if not text.strip():
        raise argparse.ArgumentTypeError("it must be a name")
    return Path(text)


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
