"""What a guest sends home: json and plain arrays as bytes, so that reading them runs none of the guest's code."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from deconfounded.envs.support.errors import InputError


def pack(value: Any) -> bytes:
    """None, booleans, numbers, strings, lists, dictionaries, arrays of numbers. Raises InputError for anything else."""
    arrays: list[bytes] = []

    def plain(thing: Any) -> Any:
        if thing is None or isinstance(thing, bool | str):
            return thing
        if isinstance(thing, int | np.integer) and not isinstance(thing, bool):
            return int(thing)
        if isinstance(thing, float | np.floating):
            return float(thing)
        if isinstance(thing, list | tuple):
            return [plain(one) for one in thing]
        if isinstance(thing, dict):
            return {str(key): plain(one) for key, one in thing.items()}
        try:
            array = np.ascontiguousarray(thing)
        except Exception:
            array = np.empty(0, object)
        if array.dtype.kind not in "biuf":
            raise InputError(f"it gave {type(thing).__name__}; it must be numbers, or arrays of them")
        arrays.append(array.tobytes())
        return {"array": array.dtype.str, "shape": list(np.shape(thing)), "bytes": len(arrays[-1])}

    head = json.dumps(plain(value)).encode()
    return b"".join([len(head).to_bytes(8, "little"), head, *arrays])


def unpack(data: bytes) -> Any:
    """What `pack` was given, tuples as lists. Raises InputError for anything else."""
    try:
        size = int.from_bytes(data[:8], "little")
        at = 8 + size

        def whole(thing: Any) -> Any:
            nonlocal at
            if isinstance(thing, list):
                return [whole(one) for one in thing]
            if isinstance(thing, dict) and set(thing) == {"array", "shape", "bytes"}:
                kind = np.dtype(str(thing["array"]))
                if kind.kind not in "biuf":
                    raise ValueError(kind)
                at += int(thing["bytes"])
                return np.frombuffer(data[at - int(thing["bytes"]) : at], kind).reshape(thing["shape"]).copy()
            return {key: whole(one) for key, one in thing.items()} if isinstance(thing, dict) else thing

        return whole(json.loads(data[8 : 8 + size]))
    except (ValueError, TypeError, KeyError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"what it sent cannot be read ({error})") from None
