"""Messages of a guest: json and plain arrays as bytes, so that reading them runs none of the guest's code."""

import json
from typing import Any

import numpy as np

from deconfounded.envs.support.errors import InputError


def pack(value: Any) -> bytes:
    """Encode None, booleans, numbers, strings, lists, dictionaries and arrays. Raises InputError for other types."""
    arrays: list[bytes] = []

    def plain(part: Any) -> Any:
        if part is None or isinstance(part, bool | str):
            return part
        if isinstance(part, int | np.integer):
            return int(part)
        if isinstance(part, float | np.floating):
            return float(part)
        if isinstance(part, list | tuple):
            return [plain(item) for item in part]
        if isinstance(part, dict):
            return {str(key): plain(item) for key, item in part.items()}
        try:
            array = np.ascontiguousarray(part)
        except Exception:
            array = np.empty(0, object)
        if array.dtype.kind not in "biuf":
            raise InputError(f"it gave {type(part).__name__}; it must be numbers, or arrays of them")
        arrays.append(array.tobytes())
        return {"array": array.dtype.str, "shape": list(np.shape(part)), "bytes": len(arrays[-1])}

    head = json.dumps(plain(value)).encode()
    return b"".join([len(head).to_bytes(8, "little"), head, *arrays])


def unpack(data: bytes) -> Any:
    """Decode the bytes of `pack`, tuples as lists. Raises InputError for other bytes."""
    try:
        size = int.from_bytes(data[:8], "little")
        at = 8 + size

        def whole(part: Any) -> Any:
            nonlocal at
            if isinstance(part, list):
                return [whole(item) for item in part]
            if isinstance(part, dict) and set(part) == {"array", "shape", "bytes"}:
                dtype = np.dtype(str(part["array"]))
                if dtype.kind not in "biuf":
                    raise ValueError(dtype)
                at += int(part["bytes"])
                return np.frombuffer(data[at - int(part["bytes"]) : at], dtype).reshape(part["shape"]).copy()
            return {key: whole(item) for key, item in part.items()} if isinstance(part, dict) else part

        return whole(json.loads(data[8 : 8 + size]))
    except (ValueError, TypeError, KeyError, OverflowError, SyntaxError, RecursionError) as error:
        raise InputError(f"what it sent cannot be read ({error})") from None
