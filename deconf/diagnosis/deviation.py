"""How strange one set of paths is to another: episodes in a few figures each, and how far these are from the usual."""

from __future__ import annotations

import torch
from torch import Tensor

from deconfounded.deconf.core.data import Batch

PARTS = 6  # of an episode
FAR = 9.0  # in squares of what is usual: further off is no stranger


def ways(episodes: Batch) -> Tensor:
    """Where episodes [1, N, T] went, [N, T, O]; one that is over stays where it ended."""
    path, mask = episodes.next_obs[0], episodes.mask[0]
    index = torch.minimum(torch.arange(path.shape[1]), (mask.sum(1).long()[:, None] - 1).clamp(min=0))
    return path.gather(1, index[..., None].expand_as(path))


def strange(paths: Tensor, usual: Tensor, again: Tensor) -> Tensor:
    """How far paths [N, T, O] are from usual ones [M, T, O], whichever: [F, O], 1 if no further than others of these.

    again: others of the usual kind. F figures of each coordinate: its mean over each of six parts of the episode, over
    all of it, and its mean square. From the median of the usual ones, in squares of their median distance from it (as
    of a normal distribution's std), of which more than 9 is 9.
    """
    known = _figures(usual)
    centre = known.median(0).values
    return _ratio(known, _figures(paths) - centre, _figures(again) - centre, known - centre)


def strayed(paths: Tensor, home: Tensor, again: Tensor) -> Tensor:
    """How far paths [N, T, O] are from home, each from its own, over how far those of a second visit are: [F, O]."""
    known = _figures(home)
    return _ratio(known, _figures(paths) - known, _figures(again) - known, _figures(again) - known)


def oddest(strangeness: Tensor, chance: Tensor) -> float:
    """In what shows it most, over the same by chance."""
    return float(strangeness.max() / chance.max().clamp(min=1))


def back(off: Tensor, mistaken: Tensor) -> float:
    """As a score, how far one strayed, beyond chance [F, O]: 1 is not, 0 as far as one who is mistaken; least squares.

    The chance of both is to be measured apart: of one, its noise would be in both, and look like straying.
    """
    known = mistaken.clamp(min=0)
    lost = (known * off).sum() / known.square().sum().clamp(min=1e-6)
    return float(1 - lost.clamp(0, 1))


def _ratio(known: Tensor, off: Tensor, by_chance: Tensor, usual: Tensor) -> Tensor:
    """Mean squares of two kinds of distances [N, F, O], in units of the usual ones; of what hardly varies, 1% of it."""
    least = (0.01 * (known.amax(0) - known.amin(0))).clamp(min=1e-6)
    unit = torch.maximum(1.48 * usual.abs().median(0).values, least)
    far, near = ((some / unit).square().clamp(max=FAR).mean(0) for some in (off, by_chance))
    return far / near.clamp(min=0.5)


def _figures(path: Tensor) -> Tensor:
    """[N, T, O] -> [N, F, O]."""
    whole = (path, path.square())
    return torch.stack([part.mean(1) for part in (*path.tensor_split(min(PARTS, path.shape[1]), 1), *whole)], 1)
