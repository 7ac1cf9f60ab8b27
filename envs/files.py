"""Output folders, and files that hold all of what was written or what they held before."""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path
from typing import Any

from deconfounded.envs.task import InputError


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
    try:
        partial.write_bytes(data.encode() if isinstance(data, str) else data)
        os.replace(partial, file)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise OSError(error.errno, error.strerror, str(file)) from None


def write_json(file: Path, data: Any) -> None:
    """JSON, atomically. Raises InputError for NaN or infinity, which JSON does not have."""
    try:
        text = json.dumps(data, indent=2, allow_nan=False)
    except ValueError:
        raise InputError(f"{file} would hold NaN or infinity; nothing was written") from None
    write_atomically(file, text + "\n")
