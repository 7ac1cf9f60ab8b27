"""Deviation of trajectories from a reference set, by a few features of each episode, relative to chance."""

from collections.abc import Sequence

import torch
from torch import Tensor

from deconfounded.deconf.core.data import Batch

SEGMENTS = 6  # of an episode
CLIP = 9.0  # of squared deviations, in squares of the unit


def trajectories(episodes: Batch) -> Tensor:
    """Observations [N, T, O] after each step of episodes [1, N, T]; after an episode's end, its last one."""
    obs, mask = episodes.next_obs[0], episodes.mask[0]
    index = torch.minimum(torch.arange(obs.shape[1]), (mask.sum(1).long()[:, None] - 1).clamp(min=0))
    return obs.gather(1, index[..., None].expand_as(obs))


def deviation(paths: Tensor, reference: Tensor, repeat: Tensor) -> Tensor:
    """Deviation [F, O] of trajectories [N, T, O] from a reference set [M, T, O], over that of a repeat: 1 is chance.

    F features of each coordinate: its mean over each of six segments and over all of the episode, and
    its mean square. Squared deviations from the reference's median are in squares of its scaled median absolute
    deviation (a normal distribution's std), and clipped at 9.
    """
    features = _features(reference)
    centre = features.median(0).values
    return _ratio(features, _features(paths) - centre, _features(repeat) - centre, features - centre)


def paired_deviation(paths: Tensor, reference: Tensor, repeat: Tensor) -> Tensor:
    """Deviation [F, O] of each trajectory [N, T, O] from its own reference, over that of its repeat."""
    features = _features(reference)
    by_chance = _features(repeat) - features
    return _ratio(features, _features(paths) - features, by_chance, by_chance)


def max_ratio(deviations: Tensor, chance: Tensor) -> float:
    """The maximum of deviations [F, O], over the maximum by chance."""
    return float(deviations.max() / chance.max().clamp(min=1))


def paired_score(paths: Tensor, wrong: Tensor, right: Tensor, repeats: Sequence[Tensor]) -> float:
    """The score of trajectories [N, T, O]: 1 if they are those under the right latents, 0 if those under wrong ones.

    Squared deviations of the means over segments are compared, each trajectory's from the one under the right latent
    that starts as it does, by least squares: where the wrong latent's deviation is large counts most. The unit is what
    a coordinate deviates by chance, over the whole episode: in units of a segment, a small deviation at the start,
    where chance has had no time to add up, would count as much as a large one at the end. repeats: three more draws
    under the right latents. Chance is subtracted, by a repeat of its own on either side: noise of a common estimate
    would correlate the two.
    """
    of_right = _means(right)
    errors, mistakes, *by_chance = (_means(x) - of_right for x in (paths, wrong, *repeats))
    usual = torch.cat(by_chance).abs().flatten(0, 1).median(0).values
    unit = torch.maximum(1.48 * usual, _least(of_right.flatten(0, 1)))
    error, mistake, _, first, second = (
        (x / unit).square().clamp(max=CLIP).mean(0) for x in (errors, mistakes, *by_chance)
    )
    weight = (mistake - first).clamp(min=0)
    share = (weight * (error - second)).sum() / weight.square().sum().clamp(min=1e-6)
    return float(1 - share.clamp(0, 1))


def _ratio(reference: Tensor, deviations: Tensor, by_chance: Tensor, usual: Tensor) -> Tensor:
    """The ratio of mean squares of two deviations [N, F, O], in units of the usual one, or of 1% of the range."""
    unit = torch.maximum(1.48 * usual.abs().median(0).values, _least(reference))
    numerator, denominator = ((x / unit).square().clamp(max=CLIP).mean(0) for x in (deviations, by_chance))
    return numerator / denominator.clamp(min=0.5)


def _least(values: Tensor) -> Tensor:
    """The least unit of values [N, ...]: 1% of their range."""
    return (0.01 * (values.amax(0) - values.amin(0))).clamp(min=1e-6)


def _features(paths: Tensor) -> Tensor:
    """[N, T, O] -> [N, F, O]."""
    return torch.cat([_means(paths), paths.mean(1, keepdim=True), paths.square().mean(1, keepdim=True)], 1)


def _means(paths: Tensor) -> Tensor:
    """Means over segments: [N, T, O] -> [N, segments, O]."""
    return torch.stack([part.mean(1) for part in paths.tensor_split(min(SEGMENTS, paths.shape[1]), 1)], 1)
