"""Deviation of trajectories: 1 by chance, more with distance, and of the coordinate that deviates alone."""

import numpy as np
import pytest
import torch

from deconfounded.deconf.core.data import Batch, Draws
from deconfounded.deconf.diagnosis.deviation import deviation, max_ratio, paired_deviation, paired_score, trajectories
from deconfounded.deconf.diagnosis.measures import draw_distant, stakes_of
from deconfounded.experts.trials import Trials


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


def lines(n: int, seed: int) -> torch.Tensor:
    """Trajectories [n, 24, 2] at rest in noise of .5; the second coordinate is noise alone, a thousand times as large.

    Of two, the difference in a feature has a std of .5 / sqrt(4) sqrt(2) = .35, or by the mean of an episode .14.
    """
    noise = np.random.default_rng(seed).normal(size=(n, 24, 2)) * (0.5, 500)
    return torch.tensor(noise, dtype=torch.float32)


FIRST = torch.tensor([1.0, 0.0])  # the coordinate in which trajectories deviate


@pytest.mark.parametrize(("share", "score"), [(0, 1), (0.5, 0.75), (0.7, 0.51), (1, 0), (2, 0)])
def test_score(share: float, score: float) -> None:
    """By squared deviation, to .05: a trajectory half of the way to where a wrong latent leads scores 3 / 4."""
    right, *repeats, paths, wrong = (lines(2000, seed) for seed in range(5))
    assert paired_score(paths + share * 0.5 * FIRST, wrong + 0.5 * FIRST, right, tuple(repeats)) == pytest.approx(
        score, abs=0.05
    )


def test_a_score_is_of_the_way_from_each_right_trajectory() -> None:
    """Wherever these go, each elsewhere: half of the way to where wrong latents lead is 3 / 4, to .07, all of it 0."""
    courses = walks(2000, 9)
    right, *repeats, paths, wrong = (courses + lines(2000, seed) for seed in range(5))
    scores = [
        paired_score(x, wrong + 0.5 * FIRST, right, (repeats[0], repeats[1]))
        for x in (paths + 0.25 * FIRST, paths + 0.5 * FIRST)
    ]
    assert scores == pytest.approx([0.75, 0], abs=0.07)


@pytest.mark.parametrize("unit", [1e6, 1e-6, 1e-9])
def test_units_of_observations_do_not_matter(unit: float) -> None:
    """A course in kilometres or nanometres: the same score, and the same deviation of the mean square."""
    right, *repeats, paths, wrong = (lines(400, seed) for seed in range(5))
    walk, swing = walks(400, 0), walks(400, 0) * torch.tensor([1.0, 2.0])
    scores, deviations = [], []
    for scale in (1, unit):
        scaled = [scale * x for x in (paths + 0.25 * FIRST, wrong + 0.5 * FIRST, right)]
        scores.append(paired_score(*scaled, (scale * repeats[0], scale * repeats[1])))
        deviations.append(deviation(*[scale * x for x in (swing, walk, walks(400, 1))]))
    assert scores[1] == pytest.approx(scores[0], abs=1e-3)
    torch.testing.assert_close(deviations[1], deviations[0], rtol=1e-3, atol=1e-3)


def test_far_off_is_far_off() -> None:
    """What is further off than chance usually leads counts in full, however far wrong latents lead."""
    right, *repeats, paths, wrong = (lines(400, seed) for seed in range(5))
    assert paired_score(paths + 10 * FIRST, wrong + 30 * FIRST, right, tuple(repeats)) < 0.05


def test_a_single_trajectory_does_not_decide() -> None:
    right, *repeats, paths, wrong = (lines(400, seed) for seed in range(5))
    paths[0] += 1000
    assert paired_score(paths, wrong + 3 * FIRST, right, tuple(repeats)) > 0.97


def test_a_swing_about_the_right_course_deviates() -> None:
    """Its means are right, and its square is not."""
    right, *repeats, paths, wrong = (lines(400, seed) for seed in range(5))
    swing = 3 * FIRST * torch.tensor([-1.0, 1.0]).repeat(12)[:, None]
    assert paired_score(paths + swing, wrong + swing, right, tuple(repeats)) < 0.1


def test_a_deviation_at_the_start_counts_no_more_than_later() -> None:
    """Though chance is smaller there: half of the wrong latent's, in one of six segments, is a loss of some 1 / 24."""
    right, *repeats, paths, wrong = (0.4 * walks(400, seed)[..., :1] for seed in range(5))
    paths[:, :4] += 1.5
    assert paired_score(paths, wrong + 3, right, tuple(repeats)) > 0.9


def test_chance_scores_one() -> None:
    """Deviation by chance scores 1 if the wrong latent's is clearly larger: to .1, in each of ten draws."""
    for draw in range(10):
        right, *repeats, paths, wrong = (walks(400, 5 * draw + i) for i in range(5))
        assert paired_score(paths, 2 * wrong, right, tuple(repeats)) > 0.9


def test_chance_is_of_the_trials_that_deviate() -> None:
    """Of the second half, whose latents lead apart in one coordinate; wrong latents lead elsewhere in the other."""
    home, repeat, second, away = (walks(400, seed) for seed in range(4))
    for paths in (home, repeat, second, away):
        paths[200:, :, 0] *= 5
    away[..., 1] += 20
    assert stakes_of([away, home, repeat, second])[0] > 3


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
