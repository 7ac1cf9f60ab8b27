"""A termination model, p(terminated | s'), for rollouts in learned dynamics. The horizon is no termination."""

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

from deconfounded.deconf.core.adam import Adam
from deconfounded.deconf.core.data import Draws, take
from deconfounded.deconf.core.layers import Mlp
from deconfounded.deconf.core.nets import Scaler
from deconfounded.experts.trials import Trials

UPDATES, ROWS, WIDTH, RATE = 600, 1024, 32, 3e-3


class TerminationModel:
    """p(terminated | s'), of one seed."""

    def __init__(self, scaler: Scaler, draws: Draws) -> None:
        self.scaler = scaler
        self.net = Mlp(len(scaler.mean[0]), WIDTH, 1, draws)

    def logit(self, obs: Tensor) -> Tensor:
        """Log-odds [1, ...] that the episode ends with next observations [1, ..., O]."""
        return self.net(self.scaler(obs))[..., 0]


def labelled(trials: Trials) -> tuple[Tensor, Tensor]:
    """Next observations [R, O] of all steps, and 1 where the episode ended there, before its horizon [R]."""
    mask = torch.tensor(trials.mask)
    terminated = mask.clone()
    terminated[..., :-1] &= ~mask[..., 1:]
    terminated[..., -1] = False
    next_obs = torch.tensor(trials.obs, dtype=torch.float32)[:, :, 1:]
    return next_obs[mask], terminated[mask].float()


def fit(data: Sequence[Trials], scaler: Scaler, draws: Draws) -> TerminationModel | None:
    """A model fitted to trials of any behaviour; None if no episode ended early."""
    obs, terminated = (torch.cat(rows)[None] for rows in zip(*map(labelled, data), strict=True))
    if not terminated.any():
        return None
    model = TerminationModel(scaler, draws)
    optimizer = Adam([model.net], RATE, UPDATES)
    for _ in range(UPDATES):
        index = draws.integers(obs.shape[1], ROWS)
        optimizer.step(F.binary_cross_entropy_with_logits(model.logit(take(obs, index)), take(terminated, index)))
    return model
