"""When episodes end early, learned: p(over | s'). A fall ends one, or a stone at rest; the horizon is no such end."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

from deconfounded.deconf.core.data import Draws, take
from deconfounded.deconf.core.nets import Adam, Scaler, mlp
from deconfounded.experts.rollout import Trials

UPDATES, ROWS, WIDTH, RATE = 600, 1024, 32, 3e-3


class Endings:
    """p(over | s'), of one seed."""

    def __init__(self, scaler: Scaler, draws: Draws) -> None:
        self.scaler = scaler
        self.net = mlp(len(scaler.mean[0]), WIDTH, 1, draws)

    def logit(self, obs: Tensor) -> Tensor:
        """Log-odds [1, ...] that it is over where [1, ..., O] was come to."""
        return self.net(self.scaler(obs))[..., 0]


def arrivals(trials: Trials) -> tuple[Tensor, Tensor]:
    """Observations [R, O] that steps came to, and whether the episode was over then, before its horizon [R]."""
    mask = torch.tensor(trials.mask)
    over = mask.clone()
    over[..., :-1] &= ~mask[..., 1:]
    over[..., -1] = False
    came = torch.tensor(trials.obs, dtype=torch.float32)[:, :, 1:]
    return came[mask], over[mask].float()


def fit(data: Sequence[Trials], scaler: Scaler, draws: Draws) -> Endings | None:
    """Of all trials that there are, whoever acted; None if no episode ended early."""
    obs, over = (torch.cat(rows)[None] for rows in zip(*map(arrivals, data), strict=True))
    if not over.any():
        return None
    ends = Endings(scaler, draws)
    optimizer = Adam([ends.net], RATE, UPDATES)
    for _ in range(UPDATES):
        index = draws.below(obs.shape[1], ROWS)
        optimizer.step(F.binary_cross_entropy_with_logits(ends.logit(take(obs, index)), take(over, index)))
    return ends
