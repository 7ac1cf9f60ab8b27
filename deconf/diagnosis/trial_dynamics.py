"""Whether trials differ in their dynamics: what a fit of all trials leaves of the motion, in halves of each trial."""

import numpy as np
from numpy.typing import NDArray

from deconfounded.deconf.diagnosis.fits import (
    CLIP,
    FINE,
    FITTED,
    RIDGE,
    Array,
    Numbers,
    Steps,
    by_trial,
    clipped,
    deviations,
    fitted,
    halves,
    in_both,
    one_hot,
    random_features,
    usual_size,
)
from deconfounded.experts.trials import Trials

RATIOS, LASTING = (0.0, 0.01, 0.1, 1.0, 10.0), (0.0, 0.3, 0.6, 0.9)  # of variances; correlations from step to step


def own_dynamics(trials: Trials, steps: Steps, least: float = 1.0) -> tuple[float, int] | None:
    """How alike two halves of a trial are in what a fit of all trials leaves of the motion, and the column of it.

    Half the episodes each, or half the steps of a trial's only one. What is left, and its products with observations
    and actions, has a mean in each half; alike is the rank correlation of the halves over trials, where it is largest,
    or 0 if that is chance. Where nothing is alike by least squares, fits with `trial_means` are tried. None for too
    little data, also where chance exceeds `least`. Columns that observation and action decide are left out.
    """
    from scipy.stats import rankdata  # a second

    count = len(trials)
    if count < 16 or np.median(np.bincount(steps.trial, minlength=count)) < 8:
        return None
    action = one_hot(steps.action, trials.actions)
    change, inputs = steps.then - steps.obs, clipped(np.concatenate([steps.obs, action], 1))
    inputs = inputs[:, inputs.any(0)]  # a constant column is alike in all halves
    basis = random_features(inputs, FINE)
    left = change - basis @ fitted(basis, change)
    unit = usual_size(left, change)
    kept = np.flatnonzero(np.isfinite(unit))
    _, episode, step = np.nonzero(trials.mask)
    group = 2 * steps.trial + halves(trials, steps)
    both = in_both(group, count)
    if not len(kept) or both.sum() < 16:
        return None
    tests = len(kept) * (1 + inputs.shape[1])
    limit = deviations(tests)
    chance, rest = limit / float(both.sum()) ** 0.5, (left[:, kept] / unit[kept]).clip(-CLIP, CLIP)

    def alike(columns: Numbers, rest: Array, slopes: Array) -> tuple[float, int]:
        best = (0.0, 0)
        for k, y in zip(columns, rest.T, strict=True):
            for x in slopes.T:
                power = np.maximum(by_trial(x**2, group, 2 * count), 1e-9)
                halves = (by_trial(x * y, group, 2 * count) / power).reshape(count, 2)[both]
                if not np.ptp(halves, 0).all():
                    continue
                ranks = rankdata(halves, axis=0).T
                best = max(best, (float(np.corrcoef(*ranks).min()), int(k)), key=lambda pair: pair[0])
        return best if best[0] > chance else (0.0, 0)

    constant = np.ones((len(rest), 1))
    best = alike(kept, rest, np.concatenate([constant, inputs], 1))
    if not best[0]:
        succeeds = (np.diff(steps.trial) == 0) & (np.diff(episode) == 0) & (np.diff(step) == 1)
        follows = np.concatenate([[False], succeeds])
        rest, likelier = trial_means(basis, rest, steps.trial, follows)
        own = likelier > limit**2 / 2
        best = alike(kept[own], rest[:, own], constant)
    return best if best[0] or chance <= least else None


def trial_means(basis: Array, y: Array, trial: Numbers, follows: NDArray[np.bool_]) -> tuple[Array, Array]:
    """What fits of y [N, C] by the basis [N, K] leave, [N, C], where trials have means, and their log-likelihood ratio.

    y = basis beta + u + e is a panel with random intercepts: each trial has its own u ~ N(0, ratio s^2), integrated
    out, and errors e of variance s^2 are AR(1), as misfits are, and gusts that last. Least squares, where u is 0, takes
    for an effect of observations what they tell of u, if u moved them; this likelihood does not, as long as u is
    independent of where trials start, and of actions given the past. follows [N]: the row before.
    """
    count = int(trial[-1]) + 1
    chosen = np.random.default_rng(0).permutation(count)[: max(16, int(count * FITTED / len(trial)))]
    part = np.isin(trial, chosen)
    begins = np.concatenate([[0], np.flatnonzero(np.diff(trial[part])) + 1])
    without, best = np.full((2, y.shape[1]), -np.inf)
    beta = np.zeros((basis.shape[1], y.shape[1]))
    for correlation in LASTING:
        first = np.where(follows[part], 1, (1 - correlation**2) ** 0.5)[:, None]
        b, z, constant = (
            first * (x - correlation * follows[part, None] * np.roll(x, 1, 0))
            for x in (basis[part], y[part], np.ones((part.sum(), 1)))
        )
        gram, moment = b.T @ b + RIDGE * len(b) * np.eye(b.shape[1]), b.T @ z
        p, q, size = (np.add.reduceat(x * constant, begins) for x in (b, z, constant))
        for ratio in RATIOS:
            weight = ratio / (1 + ratio * size)  # [B, 1]
            of_basis, of_y = gram - (weight * p).T @ p, moment - (weight * p).T @ q
            solved = np.linalg.solve(of_basis, of_y)
            rest = (z**2).sum(0) - (weight * q**2).sum(0) - (of_y * solved).sum(0)
            likely = np.log(first).sum() - 0.5 * (len(b) * np.log(rest) + np.log1p(ratio * size).sum())
            if not ratio:
                without = np.maximum(without, likely)
            beta, best = np.where(likely > best, solved, beta), np.maximum(likely, best)
    return y - basis @ beta, best - without
