"""Output folders, atomic writes, and JSON files with a checksum."""

import contextlib
import hashlib
import json
import os
import tempfile
from pathlib import Path
from typing import Any

from deconfounded.envs.support.errors import InputError

PARTIAL = ".partial"  # suffix of a file that is being written


def check_folder(folder: Path) -> None:
    """Create an output folder. Raises InputError if it cannot be written."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(f"output folder {folder} cannot be written: {error.strerror}; give another one") from None


def check_file(file: Path) -> None:
    """Create an output file's folder. Raises InputError if the path is no plain file, or cannot be written."""
    if (file.exists() or file.is_symlink()) and not file.is_file():
        raise InputError(f"output file {file} is {'a folder' if file.is_dir() else 'no plain file'}; give another one")
    check_folder(file.parent)


def write_atomically(file: Path, data: str | bytes) -> None:
    """Write a file in one step: it holds all of the data, or what it held before. A link is followed.

    Data are on the disk before the file has its name, so that a loss of power leaves no empty file.
    """
    target = file.resolve()
    partial = target.with_name(f".{target.name}.{os.getpid()}{PARTIAL}")
    try:
        with partial.open("wb") as out:
            out.write(data.encode("utf-8", "surrogateescape") if isinstance(data, str) else data)
            out.flush()
            os.fsync(out.fileno())
        os.replace(partial, target)
    except BaseException as error:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise OSError(error.errno, error.strerror, str(file)) from None
        raise


def sweep(folder: Path) -> None:
    """Remove partial files that a killed process left in a folder; no other process may be writing there."""
    for partial in folder.glob(f".*{PARTIAL}"):
        partial.unlink(missing_ok=True)


def as_json(file: Path, data: Any) -> str:
    """The text that `write_json` writes. Raises InputError for NaN or infinity, which JSON does not have."""
    try:
        return json.dumps(data, indent=2, allow_nan=False) + "\n"
    except ValueError:
        raise InputError(f"{file} would hold NaN or infinity; nothing was written") from None


def write_json(file: Path, data: Any) -> None:
    """Write JSON atomically. Raises InputError for NaN or infinity, which JSON does not have."""
    write_atomically(file, as_json(file, data))


def _digest(data: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()


def sealed(data: dict[str, Any]) -> dict[str, Any]:
    """The data with its checksum added: `sha256`, of all other entries."""
    as_read = json.loads(json.dumps(data))  # whose keys are texts, which are sorted otherwise than numbers
    return {**data, "sha256": _digest(as_read)}


def write_sealed(file: Path, data: dict[str, Any]) -> None:
    """Write JSON with its checksum, which `read_sealed` compares."""
    write_json(file, sealed(data))


def unsealed(data: dict[str, Any]) -> dict[str, Any]:
    """The inverse of `sealed`. Raises ValueError if the checksum does not match."""
    rest = {key: value for key, value in data.items() if key != "sha256"}
    if data.get("sha256") != _digest(rest):
        raise ValueError("its checksum does not match")
    return rest


def read_sealed(file: Path) -> dict[str, Any]:
    """Read what `write_sealed` wrote. Raises OSError if there is no file, InputError if its checksum does not match."""
    try:
        return unsealed(json.loads(file.read_bytes()))
    except (ValueError, AttributeError, RecursionError):  # no JSON, or no object
        raise InputError(f"{file} is damaged, or was changed by hand") from None
