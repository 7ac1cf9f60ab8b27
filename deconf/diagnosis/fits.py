"""Measures of the first look at logs: fits of actions, in all trials and in each; tails; copies."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from deconfounded.experts.datasets.logs import Log
from deconfounded.experts.trials import Trials

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]
Mask = NDArray[np.bool_]
FEW = 6  # columns, up to which their products are features too
ENOUGH = 8  # steps of a trial for each feature of a fit of its own
MENDED = 4.0  # excess kurtosis
HIDDEN, FITTED, RIDGE = 128, 20_000, 1e-4  # random features; steps, at most; of standardised features
FINE = 512  # features for dynamics: of 128 an acrobot's trials, with nothing hidden, left what looked like it
CLIP = 4.0  # usual deviations
ALIKE, APART = 24, 10  # trials in which alike observations are looked for; rows by which these are apart
CHANCE = 0.001  # probability that trials that are alike are said to differ, or that there is a doubt, each
LONGEST = 1500  # rows of a trial that are looked at for that
MOST, FEWEST = 50_000, 32  # steps of a look's fits; trials: fits of what differs between trials take 16


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


def sample(trials: Trials) -> Trials:
    """Evenly spaced trials of about MOST steps in all; of long ones FEWEST, and the beginnings of their episodes.

    They are distinct, since a copy would count as more evidence than there is.
    """
    trials = distinct(trials)
    if (total := trials.mask.sum()) <= MOST:
        return trials
    whole, horizon = len(trials) * MOST / total, trials.mask.shape[2]
    index = np.linspace(0, len(trials) - 1, min(len(trials), max(FEWEST, int(whole)))).astype(int)
    if whole < len(index):
        horizon = max(2, int(horizon * MOST / trials.mask[index].sum()))
    obs, action, mask = (x[index] for x in (trials.obs, trials.action, trials.mask))
    return Trials(obs[:, :, : horizon + 1], action[:, :, :horizon], mask[:, :, :horizon], trials.actions)


def by_trial(x: Array, trial: Numbers, count: int) -> Array:
    """The mean [B] of x [N] in each trial."""
    return np.bincount(trial, x, count) / np.maximum(np.bincount(trial, minlength=count), 1)


def halves(trials: Trials, steps: Steps) -> Numbers:
    """The half, 0 or 1, of each step's trial: every other episode; of a trial's only one, its second half."""
    _, episode, step = np.nonzero(trials.mask)
    took_place = trials.mask.any(2)
    number = (took_place.cumsum(1) - 1)[steps.trial, episode]  # of the episode, among those that took place
    taken = np.arange(len(step)) - np.searchsorted(steps.trial, steps.trial)  # steps of the trial before this one
    halfway = taken >= trials.mask.sum((1, 2))[steps.trial] / 2
    return np.where(took_place.sum(1)[steps.trial] > 1, number % 2, halfway).astype(int)


def in_both(group: Numbers, count: int) -> Mask:
    """Which of so many trials have three steps in each half; group: of each step, twice its trial, and the half."""
    return np.bincount(group, minlength=2 * count).reshape(count, 2).min(1) > 2


def deviations(tests: int) -> float:
    """By how many standard deviations the largest of so many normal numbers is off with probability CHANCE."""
    return NormalDist().inv_cdf(1 - CHANCE / tests)


def kurtosis(x: Array) -> float:
    """Excess kurtosis; 0 of what does not vary."""
    centred = x - x.mean()
    variance = float((centred**2).mean())
    return float((centred**4).mean()) / variance**2 - 3 if variance > 1e-12 * (1 + x.mean() ** 2) else 0.0


def mended(name: str, x: Array) -> tuple[str, float]:
    """The first transform of a column that leaves no heavy tails, or else the best, and its excess kurtosis."""
    centre = float(np.median(x))
    distance = np.abs(x - centre)
    scale = 1.48 * float(np.median(distance)) or float(np.quantile(distance, 0.9)) or 1.0
    low, high = np.quantile(x, [0.005, 0.995])
    transforms = {f"arcsinh(({name} - {centre:.3g}) / {scale:.3g})": np.arcsinh((x - centre) / scale)}
    if x.min() > 0:
        transforms[f"log({name})"] = np.log(x)
    transforms[f"{name} clipped to {low:.4g} and {high:.4g}"] = x.clip(low, high)
    tails = {how: kurtosis(written) for how, written in transforms.items()}
    how = next((how for how, left in tails.items() if left < MENDED), min(tails, key=tails.__getitem__))
    return how, tails[how]


def copies(trials: Trials) -> tuple[list[list[int]], ...]:
    """Three lists of groups of trials: alike in all, alike in their actions, and with an episode in common.

    Trials without a step are of none. Actions count where they are continuous, of ten steps or more, and not constant.
    """
    groups: tuple[dict[bytes, list[int]], ...] = {}, {}, {}
    for b, mask in ((b, mask) for b, mask in enumerate(trials.mask) if mask.any()):
        whole, acted = trials.obs[b].tobytes(), trials.action[b].tobytes()
        groups[0].setdefault(hashlib.sha256(whole + acted).digest(), []).append(b)
        if not trials.actions and mask.sum() >= 10 and np.ptp(trials.action[b][mask], 0).any():
            groups[1].setdefault(hashlib.sha256(acted).digest(), []).append(b)
        for e in np.flatnonzero(mask.any(1)):
            bits = trials.obs[b, e].tobytes() + trials.action[b, e].tobytes()
            groups[2].setdefault(hashlib.sha256(bits).digest(), []).append(b)
    return tuple([numbers for numbers in by_hash.values() if len(numbers) > 1] for by_hash in groups)


def distinct(trials: Trials) -> Trials:
    """One of each trial with steps: a copy would be on both sides of a split, or the "other" trial of itself."""
    left_out = [b for same in copies(trials)[0] for b in same[1:]] + np.flatnonzero(~trials.mask.any((1, 2))).tolist()
    return select(trials, np.delete(np.arange(len(trials)), left_out)) if left_out else trials


def select(trials: Trials, index: Numbers) -> Trials:
    """Those trials, by number; those of a log with their names."""
    parts = trials.obs[index], trials.action[index], trials.mask[index], trials.actions
    if not isinstance(trials, Log):
        return Trials(*parts)
    return Log(*parts, trials.units, tuple(trials.names[i] for i in index), trials.notes)


def standardised(x: Array) -> Array:
    """Columns [N, F] with mean 0 and standard deviation 1; 0 where a column hardly varies."""
    std, rounding = x.std(0), 1e-9 * np.abs(x).max(0, initial=0)  # of a column that hardly varies
    return (x - x.mean(0)) / np.where(std > rounding, std, np.inf)


def clipped(x: Array) -> Array:
    """Columns [N, F] standardised, without extremes."""
    return standardised(x).clip(-CLIP, CLIP)


def usual_size(left: Array, change: Array) -> Array:
    """The usual size [O] of what a fit leaves of the change [N, O]; inf where next to nothing is left."""
    unit = 1.48 * np.median(np.abs(left), 0)
    return np.where(unit > 1e-4 * np.maximum(change.std(0), 1e-9), unit, np.inf)


def features(x: Array) -> Array:
    """Standardised columns [N, F], and their products where columns are few."""
    x = standardised(x)
    pairs = combinations_with_replacement(range(x.shape[1]), 2) if x.shape[1] <= FEW else ()
    return np.stack([*x.T, *(x[:, i] * x[:, j] for i, j in pairs)], 1)


def one_hot(action: Array, n_actions: int) -> Array:
    """Actions [..., A]; those of n_actions discrete ones as zeros and a one [..., n_actions - 1]."""
    return np.eye(n_actions)[action[..., 0].astype(int)][..., 1:] if n_actions else action


def residual(y: Array, x: Array, trial: Numbers) -> tuple[Array, bool]:
    """What linear fits of y [N, A] by x [N, F] leave, and whether they are of each trial alone, as of long ones."""
    count = int(trial.max()) + 1
    own = float(np.median(np.bincount(trial, minlength=count))) >= ENOUGH * (x.shape[1] + 1)
    centred = [np.stack([c - by_trial(c, trial, count)[trial] for c in part.T], 1) for part in (y, x)]
    if not own:
        return centred[0] - centred[1] @ ridge(centred[1], centred[0]), False
    left = centred[0].copy()
    for rows in _by_trial(trial):
        if len(rows) > x.shape[1] + 1:
            left[rows] -= centred[1][rows] @ ridge(centred[1][rows], centred[0][rows])
            left[rows] *= np.sqrt(len(rows) / (len(rows) - x.shape[1] - 1))
    return left, True


def unexplained(y: Array, x: Array, trial: Numbers) -> float:
    """The share of the variance of y, within trials, that is left."""
    count = int(trial.max()) + 1
    total = sum(float(((c - by_trial(c, trial, count)[trial]) ** 2).sum()) for c in y.T)
    return float((residual(y, standardised(x), trial)[0] ** 2).sum()) / max(total, 1e-12)


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
        return Window(obs, one_hot(trials.action[b, e, t].astype(float), trials.actions), b)

    def __len__(self) -> int:
        return len(self.action)

    def unexplained(self, lags: Sequence[int]) -> float:
        """The share of the variance of actions that observations at these lags leave."""
        return unexplained(self.action, np.concatenate([features(self.obs[lag]) for lag in lags], 1), self.trial)


def lasting(trials: Trials, steps: Steps) -> tuple[float, float, float] | None:
    """What a trial's own fit by observations leaves of its actions: correlation from step to step, share of variance.

    The third is the correlation with what is left at the most alike observation of another time: of a poor fit it is
    high, of noise low. None where trials are too short for fits of their own, which take a latent out.
    """
    action = one_hot(steps.action, trials.actions)
    inputs = standardised(steps.obs)
    rest = action - smooth(inputs.clip(-CLIP, CLIP), action)
    for x in (features(steps.obs), inputs):
        left, own = residual(rest, x, steps.trial)
        if own:
            break
    else:
        return None
    grid = np.zeros((*trials.mask.shape, left.shape[1]))
    grid[trials.mask] = left
    both = trials.mask[:, :, 1:] & trials.mask[:, :, :-1]
    pairs: tuple[list[Array], list[Array]] = [], []
    for rows in _by_trial(steps.trial)[:ALIKE]:
        rows = rows[:LONGEST]  # the time grows with its square
        distance = np.square(inputs[rows][:, None] - inputs[rows]).sum(-1)
        near = np.abs(np.subtract.outer(np.arange(len(rows)), np.arange(len(rows)))) < APART
        nearest = np.where(near, np.inf, distance).argmin(1)
        pairs[0].append(left[rows])
        pairs[1].append(left[rows[nearest]])
    share = float((left**2).sum() / max(action.var(0).sum(), 1e-12) / len(left))
    alike = _correlation(np.concatenate(pairs[0]), np.concatenate(pairs[1]))
    return _correlation(grid[:, :, :-1][both], grid[:, :, 1:][both]), share, alike


def _correlation(x: Array, y: Array) -> float:
    return float((x * y).sum()) / max(float((x**2).sum() * (y**2).sum()) ** 0.5, 1e-12)


def smooth(x: Array, y: Array) -> Array:
    """A smooth function of standardised x [N, F], fitted to y [N, K] in all trials: ridge on random features."""
    basis = random_features(x, HIDDEN)
    return basis @ fitted(basis, y)


def random_features(x: Array, count: int) -> Array:
    """Standardised x [N, F], their squares, and `count` random features."""
    rng = np.random.default_rng(0)
    weight = rng.standard_normal((x.shape[1], count)) * rng.choice([0.3, 1.0], count) / x.shape[1] ** 0.25
    hidden = np.tanh(x @ weight + rng.uniform(-2, 2, count))
    return np.concatenate([np.ones((len(x), 1)), x, x**2, hidden], 1)


def fitted(basis: Array, y: Array) -> Array:
    """Coefficients of a fit to some of the steps."""
    part = np.random.default_rng(0).permutation(len(y))[:FITTED]
    return ridge(basis[part], y[part], RIDGE)


def ridge(x: Array, y: Array, penalty: float = 1e-9) -> Array:
    """Coefficients [F, K] of a linear fit of y [N, K] by x [N, F]."""
    return np.asarray(np.linalg.solve(x.T @ x + penalty * len(x) * np.eye(x.shape[1]), x.T @ y), float)


def _by_trial(trial: Numbers) -> list[Numbers]:
    """Rows of each trial, in their order."""
    order = np.argsort(trial, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(trial[order])) + 1)
