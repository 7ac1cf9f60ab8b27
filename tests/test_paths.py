"""How strange paths are: 1 among their like, more the further off, and of the coordinate that is off alone."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from deconfounded.deconf.core.data import Batch, Draws
from deconfounded.deconf.diagnosis.deviation import back, oddest, strange, strayed, ways
from deconfounded.deconf.diagnosis.learned_env import farther
from deconfounded.experts.rollout import Trials


def walks(n: int, seed: int) -> torch.Tensor:
    """Random walks [n, 24, 2] about 0."""
    return torch.tensor(np.random.default_rng(seed).normal(size=(n, 24, 2)).cumsum(1), dtype=torch.float32)


def test_like_among_like() -> None:
    """1 on average, to .15; the oddest of 16 figures is no odder than chance, to .35: of 400 paths a side."""
    found = strange(walks(400, 0), walks(400, 1), walks(400, 2))
    assert float(found.mean()) == pytest.approx(1, abs=0.15)
    assert oddest(found, strange(walks(400, 3), walks(400, 1), walks(400, 2))) == pytest.approx(1, abs=0.35)


def test_what_is_off_shows() -> None:
    off = walks(400, 0) + torch.tensor([0.0, 20.0])
    here, there = strange(off, walks(400, 1), walks(400, 2)).T
    assert float(here.max()) < 1.5
    assert float(there.min()) > 3


def test_of_each_its_own() -> None:
    """Paths to as many places, mixed up, are no stranger than others; but each is far from its own."""
    goals = torch.linspace(-1, 1, 200)[:, None, None] * torch.linspace(0, 1, 24)[:, None]
    home, again, mixed = (goals + 0.01 * walks(200, seed)[..., :1] for seed in range(3))
    mixed = mixed[torch.randperm(200, generator=torch.Generator().manual_seed(0))]
    assert float(strange(mixed, home, again).max()) == pytest.approx(1, abs=0.1)
    assert float(strayed(mixed, home, again).max()) > 5
    assert float(strayed(again, home, again).max()) == pytest.approx(1)


def test_as_score() -> None:
    """Of three figures the mistaken one is off in two, three times as far in the first: it weighs nine times."""
    mistaken = torch.tensor([3.0, 1.0, -1.0])
    for off, score in (([0, 0, 9], 1), ([3, 1, 0], 0), ([1.5, 0.5, 0], 0.5), ([3, 0, 0], 0.1), ([0, 1, 0], 0.9)):
        assert back(torch.tensor(off), mistaken) == pytest.approx(score)
    assert back(torch.tensor([9.0, 9.0, 0.0]), mistaken) == 0
    assert back(torch.tensor([-0.5, -0.5, 0.0]), mistaken) == 1


def test_chance_is_no_straying() -> None:
    """Who goes as by chance scores 1, though others stray hardly further: to .1, of 400 paths."""
    home, again, one, other, away, mistaken = (walks(400, seed) for seed in range(6))
    off = strayed(away, home, again) - strayed(one, home, again)
    mistake = strayed(1.1 * mistaken, home, again) - strayed(other, home, again)
    assert back(off, mistake) > 0.9


def test_the_mistaken_mistake_it() -> None:
    """Where there are two latents, the other one; both of two far ones, of four in a row."""
    rivals = torch.tensor([[0.0], [5.0], [0.1], [5.1]])[None]
    draws = Draws([np.random.default_rng(0)], "cpu")
    known = torch.arange(4).repeat(20)[None]
    far = farther(rivals, known, draws)
    assert set(zip(known[0].tolist(), far[0].tolist(), strict=True)) == {
        (i, j) for i in range(4) for j in range(4) if (i + j) % 2
    }


def test_ways() -> None:
    """Of an episode that is over, what it came to last."""
    obs = np.arange(2 * 5, dtype=np.float32).reshape(2, 1, 5, 1)
    mask = np.ones((2, 1, 4), bool)
    mask[1, 0, 2:] = False
    path = ways(Batch.of(Trials(obs, np.zeros((2, 1, 4, 1)), mask), 1))
    assert path[..., 0].tolist() == [[1, 2, 3, 4], [6, 7, 7, 7]]
