"""Counts and seeds that are given from outside."""

import numpy as np

from deconfounded.envs.support.errors import InputError


def check_number(what: str, given: object, most: float = np.inf) -> None:
    """Raise InputError unless `given` is a whole number from 1 to `most`. what: the things counted, for the message."""
    whole = isinstance(given, int | np.integer) and not isinstance(given, bool)
    if not whole or not 1 <= given <= most:  # type: ignore[operator]
        limit = "up" if most == np.inf else f"to {most:,}"
        raise InputError(f"the number of {what} was {given!r}; it must be a whole number from 1 {limit}")


def is_seed(given: object) -> bool:
    """Whether it is a whole number from 0 up."""
    return isinstance(given, int | np.integer) and not isinstance(given, bool) and bool(given >= 0)
