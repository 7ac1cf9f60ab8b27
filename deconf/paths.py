"""How strange one set of paths is to another: episodes in a few figures each, and how far these are from the usual."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from deconfounded.deconf.data import Batch

PARTS = 6  # of an episode
FAR = 9.0  # in squares of what is usual: as strange as it gets


def ways(episodes: Batch) -> Tensor:
    """Where episodes [1, N, T] went, [N, T, O]; one that is over stays where it ended."""
    path, mask = episodes.next_obs[0], episodes.mask[0]
    index = torch.minimum(torch.arange(path.shape[1]), (mask.sum(1).long()[:, None] - 1).clamp(min=0))
    return path.gather(1, index[..., None].expand_as(path))


def strange(paths: Tensor, usual: Tensor) -> Tensor:
    """How far paths [N, T, O] are from usual ones [M, T, O]: [F, O], 1 if they are alike.

    F figures of each coordinate: its mean over each of six parts of the episode, over all of it, and its mean square.
    From the median of the usual ones, in squares of their median distance from it (as of a normal distribution's std),
    of which more than 9 is 9; over the same for the other half of the usual ones.
    """
    known, rest = _figures(usual[::2]), _figures(usual[1::2])
    centre = known.median(0).values
    least = (0.01 * (known.amax(0) - known.amin(0))).clamp(min=1e-6)
    unit = torch.maximum(1.48 * (known - centre).abs().median(0).values, least)
    far, near = (((some - centre) / unit).square().clamp(max=FAR).mean(0) for some in (_figures(paths), rest))
    return far / near.clamp(min=0.5)


def familiar(strangeness: float) -> float:
    """As a score: 1 if alike, falling with the logarithm, to 0 where nothing is as usual."""
    return float(min(1, max(0, 1 - math.log(strangeness) / math.log(FAR))))


def _figures(path: Tensor) -> Tensor:
    """[N, T, O] -> [N, F, O]."""
    whole = (path, path.square())
    return torch.stack([part.mean(1) for part in (*path.tensor_split(min(PARTS, path.shape[1]), 1), *whole)], 1)
