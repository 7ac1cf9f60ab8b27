"""What is odd about single columns: tails, codes for missing values, angles that wrap, two units, labels of trials."""

from collections.abc import Iterator

import numpy as np

from deconfounded.deconf.core.sizes import HEAVY
from deconfounded.deconf.diagnosis import fits, labels
from deconfounded.deconf.diagnosis.fits import Array, Steps
from deconfounded.deconf.diagnosis.remark import Remark, listed
from deconfounded.experts.datasets.logs import Log

CODES = {sign * (10**digits - 1.0) for digits in range(2, 8) for sign in (-1, 1)} | {-32768.0, 32767.0, 65535.0}
UNITS, APART, FEWEST = 20.0, 5.0, 3  # times as widely spread; from the nearest of the others; trials of each unit
TURNS, CLOSE, JUMPS = (2 * np.pi, 360.0), 0.05, 3  # of angles; share by which a range may differ; times that it jumps


def _continuous(log: Log, steps: Steps) -> list[tuple[str, Array]]:
    """Names and values of observations, and of continuous actions, in the units of the log."""
    columns = list(zip(log.units.obs, steps.obs.T, strict=True))
    if not log.actions:
        columns += zip(log.units.action, log.units.unscaled(steps.action).T, strict=True)
    return columns


def extremes(log: Log, steps: Steps) -> Iterator[Remark]:
    """Columns with codes for missing values, or with heavy tails, and what mends them."""
    for name, x in _continuous(log, steps):
        if (code := _code(x)) is not None:
            rest = x[x != code]
            text = (
                f"{name} is {code:g} in {(x == code).sum():,} steps, and {rest.min():.4g} to {rest.max():.4g} in all"
                " others: a code for missing values? Leave out trials that have it, or fill it in."
            )
            yield Remark("code", text, True)
        elif (heavy := fits.kurtosis(x)) >= HEAVY:
            how, left = fits.mended(name, x)
            low, high = np.quantile(x, [0.005, 0.995])
            text = (
                f"{name} has heavy tails: 99% of it lies within {low:.4g} and {high:.4g}, all within {x.min():.4g} and"
                f" {x.max():.4g} (excess kurtosis {heavy:.0f}). {how} mends it ({left:.1f})."
            )
            yield Remark("tails", text, True)


def _code(x: Array) -> float | None:
    """An extreme that is one of the usual codes, and further from all others than these are from each other."""
    for code in (float(x.min()), float(x.max())):
        rest = x[x != code]
        if len(rest) and round(code) in CODES and np.abs(rest - code).min() > np.ptp(rest) > 0:
            return code
    return None


def angles(log: Log, steps: Steps) -> Iterator[Remark]:
    """Angles that jump by a whole turn."""
    for name, x, then in zip(log.units.obs, steps.obs.T, steps.then.T, strict=True):
        width, jump = np.ptp(np.concatenate([x, then])), np.abs(then - x)
        turn = next((turn for turn in TURNS if abs(width - turn) < CLOSE * turn), 0.0)
        far = jump > turn / 2
        if turn and far.sum() >= JUMPS and (jump[far] > 0.75 * turn).all():
            text = (
                f"{name} jumps by about {turn:.4g} in {far.sum():,} steps: an angle that wraps. A model takes that for"
                " a fast motion; give its sine and cosine in its place."
            )
            yield Remark("angle", text, True)


def units(log: Log, steps: Steps) -> Iterator[Remark]:
    """Columns that are spread far more widely in some trials than in all others, as where they are in another unit."""
    for name, x in _continuous(log, steps):
        variance = fits.by_trial(x**2, steps.trial, len(log)) - fits.by_trial(x, steps.trial, len(log)) ** 2
        spread = np.sqrt(variance.clip(0))
        order = np.argsort(spread)
        order = order[spread[order] > 1e-6 * max(float(x.std()), 1e-12)]  # in the others it does not move
        if len(order) < 2 * FEWEST:
            continue
        apart = spread[order[1:]] / spread[order[:-1]]
        groups = np.split(order, [int(apart.argmax()) + 1])
        few = min(groups, key=len)
        ratio = float(np.median(spread[groups[1]]) / np.median(spread[groups[0]]))
        if len(few) >= FEWEST and apart.max() >= APART and ratio >= UNITS:
            more = "more" if few is groups[1] else "less"
            text = (
                f"{name} varies {ratio:.0f} times {more} in {len(few)} of {len(order)} trials than in the others:"
                f" another unit? These are {listed([log.names[i] for i in np.sort(few)])}."
            )
            yield Remark("unit", text, True)


def of_trials(log: Log) -> Iterator[Remark]:
    """Columns that are constant in each trial."""
    if columns := [log.units.obs[i] for i in labels.constant(log)]:
        text = (
            f"Constant in each trial, and another in others, as what is hidden would be: {listed(columns)}. A diagnosis"
            " is of an imitator that observes it. If yours will not, leave it out of --obs."
        )
        yield Remark("label", text, True)
