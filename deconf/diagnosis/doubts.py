"""Doubts where trials of exploration do not differ in their mean motion: is it true that nothing there is hidden?

Signs that exploration was not blind, that it was under one condition alone, and that trials differ in another way.
"""

from collections.abc import Iterator

import numpy as np

from deconfounded.deconf.diagnosis.fits import (
    CLIP,
    FINE,
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
    sample,
    usual_size,
)
from deconfounded.experts.trials import Trials

LARGE = 0.5  # of what a fit leaves of a step, by which trials move differently


def doubts(trials: Trials, explore: Trials) -> tuple[str, ...]:
    """Sentences, the gravest first; empty if there is no doubt. Of long logs some trials alone are looked at."""
    trials, explore = sample(trials), sample(explore)
    steps, of_expert, made = Steps.of(explore), Steps.of(trials), list[str]()
    if _acts_on_it(explore, steps, trials, of_expert):
        made.append(
            "Trials of your exploration act as your expert does, each in its own way from its first step on: whoever"
            " explored seems to see what is hidden, which exploration must not."
        )
    if _expert_differs(explore, steps, trials, of_expert):
        made.append(
            "What your expert's trials do beyond a fit of your exploration differs from trial to trial, and in"
            " exploration it does not: perhaps that was under one condition alone. Explore under as many conditions as"
            " the expert met."
        )
    if _sizes_differ(explore, steps):
        made.append(
            "Trials of your exploration differ in how much a step varies, though not in where it leads on average. That"
            " tells what is hidden, but not to this diagnosis."
        )
    if _ends_differ(explore):
        made.append(
            "Trials of your exploration differ in where their episodes end. That tells what is hidden, but not to this"
            " diagnosis."
        )
    return tuple(made)


def _alike(one: Array, other: Array, tests: int) -> float:
    """The rank correlation of values [N] of trials; 0 if that is chance, of so many tests, or there are too few."""
    from scipy.stats import rankdata  # a second

    if len(one) < 16 or not np.ptp(one) or not np.ptp(other):
        return 0.0
    alike = float(np.corrcoef(rankdata(one), rankdata(other))[0, 1])
    return alike if alike > deviations(tests) / float(len(one)) ** 0.5 else 0.0


def _means(columns: Array, steps: Steps, half: Numbers, count: int) -> Iterator[tuple[Array, Array]]:
    """Of each column [N, C], the means of both halves of the trials that have three steps in each."""
    group = 2 * steps.trial + half
    both = in_both(group, count)
    for column in columns.T:
        first, second = by_trial(column, group, 2 * count).reshape(count, 2)[both].T
        yield first, second


def _rest(y: Array, x: Array) -> Array:
    """What a smooth function of x [N, F] leaves of y [N, C]."""
    basis = random_features(clipped(x), FINE)
    return y - basis @ fitted(basis, y)


def _acts_on_it(explore: Trials, steps: Steps, trials: Trials, of_expert: Steps) -> bool:
    """Whether trials of exploration act as the expert does, each in its own way, of which the first action tells.

    A blind policy's does not: it infers what is hidden later, or never. Trials count whose actions vary about a fit of
    the expert's by observations no more than the expert's do.
    """
    n, count = len(of_expert.trial), len(explore)
    obs = np.concatenate([of_expert.obs, steps.obs])
    action = np.concatenate([one_hot(each.action, trials.actions) for each in (of_expert, steps)])
    basis = random_features(clipped(obs), FINE)
    rest = action - basis @ fitted(basis[:n], action[:n])
    own, explored = rest[:n], rest[n:]
    (spread, noise), (_, noises) = _by_trial(own, of_expert.trial, len(trials)), _by_trial(explored, steps.trial, count)
    like = (noises <= 2 * np.median(noise)) & (np.bincount(steps.trial, minlength=count) > 0)
    if like.sum() < 16:
        return False
    begins, half = np.searchsorted(steps.trial, np.arange(count)), halves(explore, steps)
    later, _ = _by_trial(explored[half == 1], steps.trial[half == 1], count)
    return any(
        float(later[like, i].std()) > float(spread[:, i].std()) / 2
        and _alike(explored[begins[like], i], later[like, i], rest.shape[1]) > 0
        for i in range(rest.shape[1])
    )


def _by_trial(rest: Array, trial: Numbers, count: int) -> tuple[Array, Array]:
    """Means of rest [N, C] by trial [B, C], and the standard deviation about them, of all columns [B]."""
    mean = np.stack([by_trial(column, trial, count) for column in rest.T], 1)
    square = by_trial(np.square(rest - mean[trial]).sum(1), trial, count)
    return mean, np.sqrt(square)


def _expert_differs(explore: Trials, steps: Steps, trials: Trials, of_expert: Steps) -> bool:
    """Whether the expert's trials leave more of a fit of exploration than noise does, alike in both halves of each."""
    n = len(steps.trial)
    obs, then = (np.concatenate([getattr(each, name) for each in (steps, of_expert)]) for name in ("obs", "then"))
    action = np.concatenate([one_hot(each.action, explore.actions) for each in (steps, of_expert)])
    basis = random_features(clipped(np.concatenate([obs, action], 1)), FINE)
    change = then - obs
    left = change - basis @ fitted(basis[:n], change[:n])
    unit = usual_size(left[:n], change[:n])
    kept = np.isfinite(unit)
    if not kept.any():
        return False
    rest = (left[n:, kept] / unit[kept]).clip(-CLIP, CLIP)
    rest = _rest(rest, obs[n:])
    pairs = [*_means(rest, of_expert, halves(trials, of_expert), len(trials))]
    large = (min(float(x.std()) for x in pair) > LARGE for pair in pairs)
    return any(big and _alike(*pair, len(pairs)) > 0 for big, pair in zip(large, pairs, strict=True))


def _sizes_differ(explore: Trials, steps: Steps) -> bool:
    """Whether how much a fit leaves of the motion is alike in both halves of a trial."""
    inputs = np.concatenate([steps.obs, one_hot(steps.action, explore.actions)], 1)
    change = steps.then - steps.obs
    left = _rest(change, inputs)
    unit = usual_size(left, change)
    kept = np.isfinite(unit)
    if not kept.any():
        return False
    size = _rest(np.log(np.abs(left[:, kept] / unit[kept]).clip(0.01, CLIP)), inputs)
    pairs = [*_means(size, steps, halves(explore, steps), len(explore))]
    return any(_alike(*pair, len(pairs)) > 0 for pair in pairs)


def _ends_differ(explore: Trials) -> bool:
    """Whether episodes that end early end at like observations in a trial, more than they begin at such."""
    steps = explore.mask.sum(2)
    early = (steps > 0) & (steps < explore.mask.shape[2])
    which = np.flatnonzero(early.sum(1) > 1)
    if len(which) < 16:
        return False
    first, second = np.array([np.flatnonzero(early[b])[:2] for b in which]).T
    obs, width = explore.obs.astype(float), explore.obs.shape[-1]
    ends = obs[which, first, steps[which, first]], obs[which, second, steps[which, second]]
    starts = obs[which, first, 0], obs[which, second, 0]
    like_ends, like_starts = (
        [_alike(one[:, i], other[:, i], width) > 0 for i in range(width)] for one, other in (ends, starts)
    )
    return any(end and not start for end, start in zip(like_ends, like_starts, strict=True))
