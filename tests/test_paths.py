"""How strange paths are: 1 among their like, more the further off, and of the coordinate that is off alone."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from deconfounded.deconf.data import Batch
from deconfounded.deconf.paths import FAR, familiar, strange, ways
from deconfounded.experts.demos import Trials


def walks(n: int, seed: int) -> torch.Tensor:
    """Random walks [n, 24, 2] about 0."""
    return torch.tensor(np.random.default_rng(seed).normal(size=(n, 24, 2)).cumsum(1), dtype=torch.float32)


def test_like_among_like() -> None:
    """The mean over figures is 1, to .15: of 400 paths a side."""
    assert float(strange(walks(400, 0), walks(400, 1)).mean()) == pytest.approx(1, abs=0.15)


def test_what_is_off_shows() -> None:
    off = walks(400, 0) + torch.tensor([0.0, 20.0])
    here, there = strange(off, walks(400, 1)).T
    assert float(here.max()) < 1.5
    assert float(there.min()) > 3


def test_never_stranger_than_can_be() -> None:
    assert float(strange(walks(50, 0) + 1e9, walks(50, 1)).max()) <= 2 * FAR


def test_as_score() -> None:
    assert [familiar(s) for s in (0.5, 1.0, FAR**0.5, FAR, 2 * FAR)] == pytest.approx([1, 1, 0.5, 0, 0])


def test_ways() -> None:
    """Of an episode that is over, what it came to last."""
    obs = np.arange(2 * 5, dtype=np.float32).reshape(2, 1, 5, 1)
    mask = np.ones((2, 1, 4), bool)
    mask[1, 0, 2:] = False
    path = ways(Batch.of(Trials(obs, np.zeros((2, 1, 4, 1)), mask), 1))
    assert path[..., 0].tolist() == [[1, 2, 3, 4], [6, 7, 7, 7]]
