"""Deviation of trajectories from a reference set, by a few features of each episode, relative to chance."""

import torch
from torch import Tensor

from deconfounded.deconf.core.data import Batch

SEGMENTS = 6  # of an episode
CLIP = 9.0  # of squared deviations, in squares of the unit
MEANS, SQUARES = slice(-1), slice(-1, None)  # of features


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


def paired_score(paths: Tensor, wrong: Tensor, right: Tensor, repeats: tuple[Tensor, Tensor]) -> float:
    """The score of trajectories: 1 if they deviate from those under right latents by chance, 0 if as those under wrong.

    All are [N, T, O], and the i-th of each have latent and start in common; repeats are two more draws under the right
    latents. A deviation is the mean over trajectories of the squared differences of a feature, less that by chance, of
    one repeat for the wrong latents and of the other for the trajectories, so that their errors are independent. The
    score is 1 - c, where c times the deviations under wrong latents fits those of the trajectories by least squares.

    The unit, in which squares are clipped at 9, is what chance does to a coordinate, in any segment of the episode. In
    a unit for each segment, a small deviation at the start, where chance has had no time to add up, would count as much
    as a large one later.
    """
    features = _features(right)
    off, away, *by_chance = (_features(x) - features for x in (paths, wrong, *repeats))
    unit = torch.cat([_pooled_unit(features[:, part], torch.cat(by_chance)[:, part]) for part in (MEANS, SQUARES)])
    deviation, mistake, chance, second = ((x / unit).square().clamp(max=CLIP).mean(0) for x in (off, away, *by_chance))
    weight = (mistake - chance).clamp(min=0)
    share = (weight * (deviation - second)).sum() / weight.square().sum().clamp(min=1e-6)
    return float(1 - share.clamp(0, 1))


def _pooled_unit(features: Tensor, by_chance: Tensor) -> Tensor:
    """The unit of differences by chance [M, F, O], of all features [N, F, O] together: [F, O], the same for each."""
    return _unit(features.flatten(0, 1), by_chance.flatten(0, 1)).expand(features.shape[1], -1)


def _ratio(reference: Tensor, deviations: Tensor, by_chance: Tensor, usual: Tensor) -> Tensor:
    """The ratio of mean squares of two deviations [N, F, O], in units of the usual one, or of 1% of the range."""
    unit = _unit(reference, usual)
    numerator, denominator = ((x / unit).square().clamp(max=CLIP).mean(0) for x in (deviations, by_chance))
    return numerator / denominator.clamp(min=0.5)


def _unit(values: Tensor, usual: Tensor) -> Tensor:
    """The scaled median of usual deviations [M, ...], or 1% of the range of values [N, ...] if that is more."""
    rounding = (1e-7 * values.abs().amax(0)).clamp(min=1e-30)
    least = torch.maximum(0.01 * (values.amax(0) - values.amin(0)), rounding)
    return torch.maximum(1.48 * usual.abs().median(0).values, least)


def _features(paths: Tensor) -> Tensor:
    """[N, T, O] -> [N, F, O]: MEANS, over segments and over all of the episode, and SQUARES, the mean square."""
    segments = paths.tensor_split(min(SEGMENTS, paths.shape[1]), 1)
    return torch.stack([part.mean(1) for part in (*segments, paths, paths.square())], 1)
