"""Deviation of trajectories: 1 by chance, more with distance, and of the coordinate that deviates alone."""

import numpy as np
import pytest
import torch

from deconfounded.deconf.core.data import Batch, Draws
from deconfounded.deconf.diagnosis.deviation import deviation, excess_score, max_ratio, paired_deviation, trajectories
from deconfounded.deconf.diagnosis.measures import draw_distant
from deconfounded.experts.rollout import Trials


def walks(n: int, seed: int) -> torch.Tensor:
    """Random walks [n, 24, 2] about 0."""
    return torch.tensor(np.random.default_rng(seed).normal(size=(n, 24, 2)).cumsum(1), dtype=torch.float32)


def test_same_distribution() -> None:
    """1 on average, to .15; the maximum of 16 features is that by chance, to .35: of 400 trajectories a side."""
    deviations = deviation(walks(400, 0), walks(400, 1), walks(400, 2))
    assert float(deviations.mean()) == pytest.approx(1, abs=0.15)
    chance = deviation(walks(400, 3), walks(400, 1), walks(400, 2))
    assert max_ratio(deviations, chance) == pytest.approx(1, abs=0.35)


def test_one_coordinate_deviates() -> None:
    shifted = walks(400, 0) + torch.tensor([0.0, 20.0])
    first, second = deviation(shifted, walks(400, 1), walks(400, 2)).T
    assert float(first.max()) < 1.5
    assert float(second.min()) > 3


def test_pairs() -> None:
    """Trajectories to the same goals in another order do not deviate as a set, but each from its own reference."""
    goals = torch.linspace(-1, 1, 200)[:, None, None] * torch.linspace(0, 1, 24)[:, None]
    reference, repeat, mixed = (goals + 0.01 * walks(200, seed)[..., :1] for seed in range(3))
    mixed = mixed[torch.randperm(200, generator=torch.Generator().manual_seed(0))]
    assert float(deviation(mixed, reference, repeat).max()) == pytest.approx(1, abs=0.1)
    assert float(paired_deviation(mixed, reference, repeat).max()) > 5
    assert float(paired_deviation(repeat, reference, repeat).max()) == pytest.approx(1)


def test_score() -> None:
    """Under the wrong latent two of three features deviate, the first three times as much: it weighs nine times."""
    wrong = torch.tensor([3.0, 1.0, -1.0])
    for excess, score in (([0, 0, 9], 1), ([3, 1, 0], 0), ([1.5, 0.5, 0], 0.5), ([3, 0, 0], 0.1), ([0, 1, 0], 0.9)):
        assert excess_score(torch.tensor(excess), wrong) == pytest.approx(score)
    assert excess_score(torch.tensor([9.0, 9.0, 0.0]), wrong) == 0
    assert excess_score(torch.tensor([-0.5, -0.5, 0.0]), wrong) == 1


def test_chance_scores_one() -> None:
    """Deviation by chance scores 1, though the wrong latent's is hardly larger: to .1, of 400 trajectories."""
    reference, repeat, first, second, paths, wrong = (walks(400, seed) for seed in range(6))
    excess = paired_deviation(paths, reference, repeat) - paired_deviation(first, reference, repeat)
    mistake = paired_deviation(1.1 * wrong, reference, repeat) - paired_deviation(second, reference, repeat)
    assert excess_score(excess, mistake) > 0.9


def test_distant_latents() -> None:
    """Of two clusters of two latents, the two of the other cluster are drawn."""
    latents = torch.tensor([[0.0], [5.0], [0.1], [5.1]])[None]
    draws = Draws([np.random.default_rng(0)], "cpu")
    index = torch.arange(4).repeat(20)[None]
    distant = draw_distant(latents, index, draws)
    assert set(zip(index[0].tolist(), distant[0].tolist(), strict=True)) == {
        (i, j) for i in range(4) for j in range(4) if (i + j) % 2
    }


def test_trajectories() -> None:
    """After an episode's end its last observation is repeated."""
    obs = np.arange(2 * 5, dtype=np.float32).reshape(2, 1, 5, 1)
    mask = np.ones((2, 1, 4), bool)
    mask[1, 0, 2:] = False
    paths = trajectories(Batch.of(Trials(obs, np.zeros((2, 1, 4, 1)), mask), 1))
    assert paths[..., 0].tolist() == [[1, 2, 3, 4], [6, 7, 7, 7]]
