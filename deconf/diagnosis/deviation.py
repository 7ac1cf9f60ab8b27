"""Deviation of trajectories from a reference set, by a few features of each episode, relative to chance."""

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


def excess_score(excess: Tensor, wrong: Tensor) -> float:
    """A score of deviations beyond chance [F, O]: 1 for none, 0 for those under a wrong latent; by least squares.

    Chance has to be estimated for each separately: noise of a common estimate would correlate the two.
    """
    weight = wrong.clamp(min=0)
    share = (weight * excess).sum() / weight.square().sum().clamp(min=1e-6)
    return float(1 - share.clamp(0, 1))


def _ratio(reference: Tensor, deviations: Tensor, by_chance: Tensor, usual: Tensor) -> Tensor:
    """The ratio of mean squares of two deviations [N, F, O], in units of the usual one, or of 1% of the range."""
    least = (0.01 * (reference.amax(0) - reference.amin(0))).clamp(min=1e-6)
    unit = torch.maximum(1.48 * usual.abs().median(0).values, least)
    numerator, denominator = ((x / unit).square().clamp(max=CLIP).mean(0) for x in (deviations, by_chance))
    return numerator / denominator.clamp(min=0.5)


def _features(paths: Tensor) -> Tensor:
    """[N, T, O] -> [N, F, O]."""
    segments = paths.tensor_split(min(SEGMENTS, paths.shape[1]), 1)
    return torch.stack([part.mean(1) for part in (*segments, paths, paths.square())], 1)
