"""Observations that are constant in each trial and differ between trials, as theta is where a log holds it."""

import numpy as np

from deconfounded.deconf.diagnosis import trial_dynamics
from deconfounded.deconf.diagnosis.fits import Steps
from deconfounded.experts.datasets.logs import Log
from deconfounded.experts.trials import Trials


def constant(trials: Trials) -> list[int]:
    """Observations that are the same in all steps of a trial, and differ between trials."""
    obs, mask = trials.obs[:, :, :-1], trials.mask[..., None]
    low, high = np.where(mask, obs, np.inf).min((1, 2)), np.where(mask, obs, -np.inf).max((1, 2))
    low, high = (x[trials.mask.any((1, 2))] for x in (low, high))
    same = (low == high).all(0) & (low.max(0) > low.min(0))
    return [int(i) for i in np.flatnonzero(same)]


def decisive(trials: Trials) -> list[int]:
    """Those columns, if trials differ in their dynamics without them."""
    columns = constant(trials)
    rest = np.delete(trials.obs, columns, axis=-1)
    if not columns or not rest.shape[-1]:
        return []
    return columns if _differ(Trials(rest, trials.action, trials.mask, trials.actions)) else []


def of_dynamics(trials: Trials) -> list[int]:
    """Those columns, if they show how trials differ in their dynamics: without them trials do, and with them not."""
    columns = decisive(trials)
    return [] if columns and _differ(trials) else columns


def named(trials: Trials, explore: Trials | None) -> list[str]:
    """Names of columns that show how trials of exploration differ in their dynamics; without any, expert trials."""
    data = trials if explore is None else explore
    names = (data if isinstance(data, Log) else Log.of(data)).units.obs
    return [names[i] for i in of_dynamics(data)]


def _differ(trials: Trials) -> bool:
    measured = trial_dynamics.own_dynamics(trials, Steps.of(trials))
    return measured is not None and measured[0] > 0
