"""Numbers that are given from outside: counts, seeds, and columns of observations."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

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


def check_rounding(whose: str, obs: NDArray[Any], mask: NDArray[np.bool_]) -> None:
    """Raise InputError for a column whose spread, or change in a step, is no more than ten times what float32 rounds.

    obs [B, ..., T + 1, O], and whether its steps took place, mask [B, ..., T]; whose: what has them, for the message.
    Such columns have a large offset, or are Unix times. Columns that hardly vary count as constant: see Scaler.
    """
    wide = obs.reshape(-1, obs.shape[-1]).astype(float)
    change = np.diff(obs.astype(float), axis=-2)[mask]
    lost = np.abs(wide - wide.astype(np.float32)).max(0)
    for what, extent in (("spread", wide.std(0)), ("change in a step", np.sqrt((change**2).mean(0)))):
        if (bad := (extent > 1e-6) & (extent < 10 * lost)).any():
            i = int(np.flatnonzero(bad)[0])
            raise InputError(
                f"observation {i} of {whose} is about {wide[:, i].mean():.9g}, and its {what} {extent[i]:.3g}: float32"
                f" rounds it by up to {lost[i]:.2g}; subtract its mean"
            )
