"""Output folders, and files that hold all of what was written or what they held before."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import tempfile
from pathlib import Path
from typing import Any

from deconfounded.envs.support.errors import InputError

PARTIAL = ".partial"  # the end of the name of a file that is being written


def check_folder(folder: Path) -> None:
    """Make an output folder. Raises InputError if it cannot be written."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(f"output folder {folder} cannot be written: {error.strerror}; give another one") from None


def check_file(file: Path) -> None:
    """Make an output file's folder. Raises InputError if the file is something else, or cannot be written."""
    if (file.exists() or file.is_symlink()) and not file.is_file():
        raise InputError(f"output file {file} is {'a folder' if file.is_dir() else 'no plain file'}; give another one")
    check_folder(file.parent)


def write_atomically(file: Path, data: str | bytes) -> None:
    """The file holds all of data, or what it held before."""
    partial = file.with_name(f".{file.name}.{os.getpid()}{PARTIAL}")
    try:
        partial.write_bytes(data.encode("utf-8", "surrogateescape") if isinstance(data, str) else data)
        os.replace(partial, file)
    except BaseException as error:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise OSError(error.errno, error.strerror, str(file)) from None
        raise


def sweep(folder: Path) -> None:
    """Remove what was being written in a folder when a process was killed; nobody else may be at work in it."""
    for partial in folder.glob(f".*{PARTIAL}"):
        partial.unlink(missing_ok=True)


def as_json(file: Path, data: Any) -> str:
    """What `write_json` writes. Raises InputError for NaN or infinity, which JSON does not have."""
    try:
        return json.dumps(data, indent=2, allow_nan=False) + "\n"
    except ValueError:
        raise InputError(f"{file} would hold NaN or infinity; nothing was written") from None


def write_json(file: Path, data: Any) -> None:
    """JSON, atomically. Raises InputError for NaN or infinity, which JSON does not have."""
    write_atomically(file, as_json(file, data))


def _digest(data: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()


def sealed(data: dict[str, Any]) -> dict[str, Any]:
    """The data with a checksum of its own: `sha256`, of the rest."""
    return {**data, "sha256": _digest(data)}


def write_sealed(file: Path, data: dict[str, Any]) -> None:
    """JSON that tells, when it is read, whether it is as it was written: with the sha256 of the rest."""
    write_json(file, sealed(data))


def unsealed(data: dict[str, Any]) -> dict[str, Any]:
    """What `sealed` was given, out of what it returned. Raises ValueError if it is not as it was."""
    rest = {key: value for key, value in data.items() if key != "sha256"}
    if data.get("sha256") != _digest(rest):
        raise ValueError("it is not as it was written")
    return rest


def read_sealed(file: Path) -> dict[str, Any]:
    """What `write_sealed` wrote. Raises OSError if there is no file, and InputError if it is not as it was written."""
    try:
        return unsealed(json.loads(file.read_bytes()))
    except (ValueError, AttributeError, RecursionError):  # no json, or no object
        raise InputError(f"{file} is damaged, or was changed by hand") from None
