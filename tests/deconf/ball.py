"""Trials of a ball with a hidden force, whose exact posterior is known."""

import numpy as np
import torch
from torch import Tensor

from deconfounded.deconf.core.data import Batch, Draws

STEPS = 24


def streams(seeds: int = 1) -> Draws:
    return Draws([np.random.default_rng(i) for i in range(seeds)], "cpu")


def pushed(n: int, rng: np.random.Generator) -> tuple[Batch, Tensor]:
    """A hidden force theta ~ N(0, 1) on a ball, noise of std 1, and a weak controller that takes it for another's.

    Where the ball is tells of theta: after some steps it lies at about twice theta less the force assumed.
    """
    theta, assumed, place = rng.normal(size=n), rng.normal(size=n), np.zeros(n)
    seen, actions = [place], []
    for _ in range(STEPS):
        actions.append(-0.5 * place - assumed + 0.1 * rng.normal(size=n))
        place = place + actions[-1] + theta + rng.normal(size=n)
        seen.append(place)
    obs, action = (torch.tensor(np.stack(x, 1)[..., None], dtype=torch.float32)[None] for x in (seen, actions))
    batch = Batch(obs[:, :, :-1], action, obs[:, :, 1:], torch.ones(1, n, STEPS))
    return batch, torch.tensor(theta, dtype=torch.float32)
