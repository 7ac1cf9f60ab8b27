"""What arrays must be to become Trials: real numbers that float32 holds, and nothing that could be read in padding."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from deconfounded.envs.support.errors import InputError

LARGEST = 1e15  # size of an observation: squares of larger ones, summed, exceed float32


def size(array: NDArray[Any]) -> float:
    """The largest absolute value; that of the least integer of a type is no number of the type."""
    return max(float(array.max()), -float(array.min()))


def numbers(name: str, given: Any) -> NDArray[Any]:
    """An array of real numbers. Raises InputError for complex ones, dates, text, objects and masked arrays."""
    try:
        array = np.asarray(given)
    except (TypeError, ValueError, RuntimeError) as error:  # rows of many lengths; a tensor with a gradient
        raise InputError(f"{name} of Trials must be an array of numbers ({' '.join(str(error).split())})") from None
    if array.dtype.kind not in "biuf" or isinstance(given, np.ma.MaskedArray):
        kind = "a masked array" if isinstance(given, np.ma.MaskedArray) else f"of {array.dtype}"
        raise InputError(f"{name} of Trials was {kind}; it must be an array of real numbers")
    return array


def padded(obs: NDArray[Any], mask: NDArray[np.bool_]) -> NDArray[Any]:
    """Observations [B, E, T + 1, O], each that no step [B, E, T] began or ended with replaced by the one before it."""
    never = np.zeros((*mask.shape[:2], 1), bool)
    taken = np.concatenate([mask, never], -1) | np.concatenate([never, mask], -1)
    last = np.maximum.accumulate(np.where(taken, np.arange(taken.shape[-1]), -1), -1)[..., None]
    return np.where(last < 0, 0, np.take_along_axis(obs, last.clip(0), 2))
