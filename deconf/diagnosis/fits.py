"""Fits for the first look at logs: of actions by observations, and of the dynamics, in all trials and in each."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray

from deconfounded.experts.rollout import Trials

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]
FEW = 6  # columns, up to which their products are features too
ENOUGH = 8  # steps of a trial for each feature of a fit of its own
SHRINKAGE = (0.1, 1.0, 10.0)  # of a trial's own fit, in steps of each half
CERTAIN = 4.0  # standard errors
LEAST = 0.01  # share of variance that counts


@dataclass(frozen=True)
class Steps:
    """Steps in a row: observations before and after [N, O], actions [N, A], and the trial [N] of each."""

    obs: Array
    then: Array
    action: Array
    trial: Numbers

    @staticmethod
    def of(trials: Trials) -> "Steps":
        """The steps that took place."""
        now, then = trials.obs[:, :, :-1][trials.mask], trials.obs[:, :, 1:][trials.mask]
        action = trials.action[trials.mask].astype(float)
        return Steps(now.astype(float), then.astype(float), action, np.nonzero(trials.mask)[0])


def by_trial(x: Array, trial: Numbers, count: int) -> Array:
    """The mean [B] of x [N] in each trial."""
    return np.bincount(trial, x, count) / np.maximum(np.bincount(trial, minlength=count), 1)


def kurtosis(x: Array) -> float:
    """Excess kurtosis; 0 of what does not vary."""
    centred = x - x.mean()
    variance = float((centred**2).mean())
    return float((centred**4).mean()) / variance**2 - 3 if variance > 1e-12 * (1 + x.mean() ** 2) else 0.0


def _standard(x: Array) -> Array:
    std = x.std(0)
    return (x - x.mean(0)) / np.where(std > 1e-9, std, np.inf)


def features(x: Array) -> Array:
    """Standardised columns [N, F], and their products where columns are few."""
    x = _standard(x)
    pairs = combinations_with_replacement(range(x.shape[1]), 2) if x.shape[1] <= FEW else ()
    return np.stack([*x.T, *(x[:, i] * x[:, j] for i, j in pairs)], 1)


def _one_hot(action: Array, n_actions: int) -> Array:
    return np.eye(n_actions)[action[..., 0].astype(int)][..., 1:] if n_actions else action


def residual(y: Array, x: Array, trial: Numbers) -> tuple[Array, bool]:
    """What linear fits of y [N, A] by x [N, F] leave, and whether they are of each trial alone, as of long ones."""
    count = int(trial.max()) + 1
    own = float(np.median(np.bincount(trial, minlength=count))) >= ENOUGH * (x.shape[1] + 1)
    centred = [np.stack([c - by_trial(c, trial, count)[trial] for c in part.T], 1) for part in (y, x)]
    if not own:
        return centred[0] - centred[1] @ np.linalg.lstsq(centred[1], centred[0], rcond=None)[0], False
    left = centred[0].copy()
    order = np.argsort(trial, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(trial[order])) + 1):
        if len(rows) > x.shape[1] + 1:
            fit = np.linalg.lstsq(centred[1][rows], centred[0][rows], rcond=None)[0]
            left[rows] -= centred[1][rows] @ fit
            left[rows] *= np.sqrt(len(rows) / (len(rows) - x.shape[1] - 1))
    return left, True


def unexplained(y: Array, x: Array, trial: Numbers) -> float:
    """The share of the variance of y, within trials, that is left."""
    count = int(trial.max()) + 1
    total = sum(float(((c - by_trial(c, trial, count)[trial]) ** 2).sum()) for c in y.T)
    return float((residual(y, _standard(x), trial)[0] ** 2).sum()) / max(total, 1e-12)


@dataclass(frozen=True)
class Window:
    """Steps with observations at several lags: obs[k] [N, O] is that of k rows before the action [N, A]."""

    obs: dict[int, Array]
    action: Array
    trial: Numbers

    @staticmethod
    def of(trials: Trials, most: int) -> "Window":
        """Steps with `most` rows before them, and the one after."""
        length = trials.mask.shape[2]
        valid = np.zeros_like(trials.mask)
        valid[:, :, most:] = trials.mask[:, :, most:]
        b, e, t = np.nonzero(valid)
        obs = {lag: trials.obs[b, e, t - lag].astype(float) for lag in range(-1, most + 1)} if length > most else {}
        return Window(obs, _one_hot(trials.action[b, e, t].astype(float), trials.actions), b)

    def __len__(self) -> int:
        return len(self.action)

    def unexplained(self, lags: Sequence[int]) -> float:
        """The share of the variance of actions that observations at these lags leave."""
        return unexplained(self.action, np.concatenate([features(self.obs[lag]) for lag in lags], 1), self.trial)


def lasting(trials: Trials, steps: Steps) -> tuple[float, float] | None:
    """What a trial's own fit by observations leaves of its actions: correlation from step to step, share of variance.

    None where trials are too short for fits of their own, by which a latent is taken out.
    """
    action = _one_hot(steps.action, trials.actions)
    for x in (features(steps.obs), _standard(steps.obs)):
        left, own = residual(action, x, steps.trial)
        if own:
            break
    else:
        return None
    grid = np.zeros((*trials.mask.shape, left.shape[1]))
    grid[trials.mask] = left
    both = trials.mask[:, :, 1:] & trials.mask[:, :, :-1]
    first, second = grid[:, :, :-1][both], grid[:, :, 1:][both]
    power = float((first**2).sum() * (second**2).sum()) ** 0.5
    return float((first * second).sum()) / max(power, 1e-12), float(
        (left**2).sum() / max(action.var(0).sum(), 1e-12) / len(left)
    )


def own_dynamics(trials: Trials, steps: Steps) -> tuple[float | None, int] | None:
    """The share of the motion that one half of a trial explains in the other, and the column where it is largest.

    Of what a fit of all trials leaves, and less what half of another trial explains. The share is None where it is not
    beyond chance; the whole is None for too little data. Columns that observation and action decide are left out.
    """
    count = len(trials)
    lengths = np.bincount(steps.trial, minlength=count)
    if count < 8 or np.median(lengths) < 8:
        return None
    action = _one_hot(steps.action, trials.actions)
    change = steps.then - steps.obs
    x = features(np.concatenate([steps.obs, action], 1))
    x = x if x.shape[1] > steps.obs.shape[1] + action.shape[1] else _with_products(steps.obs, action)
    x = np.concatenate([np.ones((len(x), 1)), x], 1)
    left = change - x @ np.linalg.lstsq(x, change, rcond=None)[0]
    scale = left.std(0)
    kept = np.flatnonzero((change.std(0) > 1e-9) & (scale > 1e-4 * change.std(0)))
    if not len(kept):
        return None
    left = left[:, kept] / scale[kept]
    inputs = np.concatenate([np.ones((len(x), 1)), _standard(np.concatenate([steps.obs, action], 1))], 1)
    order = np.argsort(steps.trial, kind="stable")
    trialwise = [rows for rows in np.split(order, np.flatnonzero(np.diff(steps.trial[order])) + 1) if len(rows) >= 4]
    best: tuple[float | None, int] = None, 0
    for shrinkage in SHRINKAGE:
        pairs = [(rows[: len(rows) // 2], rows[len(rows) // 2 :]) for rows in trialwise]
        fits = [[_ridge(inputs[part], left[part], shrinkage) for part in pair] for pair in pairs]
        gains = np.zeros((len(pairs), len(kept)))
        for i, pair in enumerate(pairs):
            for half in (0, 1):
                part = pair[1 - half]
                own, other = (left[part] - inputs[part] @ fits[j][half] for j in (i, (i + 1) % len(pairs)))
                gains[i] += ((left[part] ** 2 - own**2).sum(0) - (left[part] ** 2 - other**2).sum(0).clip(min=0)) / len(
                    trialwise[i]
                )
        mean, error = gains.mean(0), gains.std(0) / len(gains) ** 0.5
        for j in np.flatnonzero((mean > LEAST) & (mean > CERTAIN * error)):
            if best[0] is None or mean[j] > best[0]:
                best = float(mean[j]), int(kept[j])
    return best


def _with_products(obs: Array, action: Array) -> Array:
    """Observations, actions, squares, and products of each observation with each action."""
    obs, action = _standard(obs), _standard(action)
    products = (obs[:, :, None] * action[:, None, :]).reshape(len(obs), -1) if action.shape[1] <= FEW else obs[:, :0]
    return np.concatenate([obs, action, obs**2, products], 1)


def _ridge(x: Array, y: Array, shrinkage: float) -> Array:
    return np.linalg.solve(x.T @ x + shrinkage * len(x) * np.eye(x.shape[1]), x.T @ y)
