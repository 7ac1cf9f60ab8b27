"""Whether observations show the whole state: all that decides, with the action, what comes next."""

import numpy as np
from numpy.typing import NDArray

from deconfounded.deconf.diagnosis import fits
from deconfounded.experts.datasets.logs import Log
from deconfounded.experts.trials import Trials

FEWEST, ENOUGH = 16, 8  # trials; steps for each feature of a fit: near one, its errors say nothing
LEAST = 0.1  # share of variance that the step before has to explain; nothing hidden has about 0, or less


def incomplete(trials: Trials) -> list[int]:
    """Observations whose next value depends on the step before, too, as where a speed is not observed, or a delay.

    What a fit of the present observation and action leaves of the change is predicted by the step before. Each half of
    the trials is predicted by fits to the other half. Of too few steps nothing is said. Where trials differ in their
    dynamics, the step before tells of that too, so that nothing follows there.
    """
    b, e, t = np.nonzero(trials.mask[:, :, 1:] & trials.mask[:, :, :-1])
    apart = 1 + len(b) // (2 * fits.FITTED)  # trials: fits to so many steps suffice
    kept = b % apart == 0
    b, e, t = b[kept], e[kept], t[kept]
    before, now, then = (trials.obs[b, e, t + i].astype(float) for i in range(3))
    acted, action = (fits.one_hot(trials.action[b, e, t + i].astype(float), trials.actions) for i in range(2))
    present = fits.random_features(fits.clipped(np.concatenate([now, action], 1)), fits.FINE)
    both = np.concatenate([present, fits.clipped(np.concatenate([now - before, acted], 1))], 1)
    if len(trials) < FEWEST or len(b) < ENOUGH * both.shape[1]:
        return []
    left, less = (_held_out(x, then - now, b // apart % 2 == 0) for x in (present, both))
    unit = fits.usual_size(left, then - now)
    rest, better = ((np.clip(x / unit, -fits.CLIP, fits.CLIP) ** 2).sum(0) for x in (left, less))
    return [int(i) for i in np.flatnonzero(better < (1 - LEAST) * rest)]


def named(explore: Trials | None) -> list[str]:
    """Names of those columns of exploration."""
    if explore is None:
        return []
    names = (explore if isinstance(explore, Log) else Log.of(explore)).units.obs
    return [names[i] for i in incomplete(explore)]


def _held_out(x: fits.Array, y: fits.Array, first: NDArray[np.bool_]) -> fits.Array:
    """What fits of y [N, K] by x [N, F] leave, where each half is fitted to the other; first [N]: which half."""
    left = np.empty_like(y)
    for half in (first, ~first):
        left[half] = y[half] - x[half] @ fits.ridge(x[~half], y[~half], fits.RIDGE)
    return left
