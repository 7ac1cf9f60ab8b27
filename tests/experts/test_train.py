"""Training of experts: its learning rate, its reports, and its seed."""

import numpy as np
import pytest
from stable_baselines3 import PPO

from deconfounded.experts import train
from tests.toys import Push

STEPS = 128  # of two updates


@pytest.fixture(autouse=True)
def _small_updates(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 64 steps, in four environments."""
    monkeypatch.setitem(train.PPO_SETTINGS, "n_steps", 16)
    monkeypatch.setitem(train.PPO_SETTINGS, "batch_size", 64)


def test_the_learning_rate_falls_to_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    """Linearly, with the steps that are left."""
    rates = list[float]()

    class Noting(PPO):
        def train(self) -> None:
            super().train()
            rates.append(self.policy.optimizer.param_groups[0]["lr"])

    monkeypatch.setattr(train, "PPO", Noting)
    train.train(Push(), STEPS, 0, lambda *_: None, n=4)
    assert rates == [pytest.approx(5e-4), 0]


def test_reports_add_up_to_the_training() -> None:
    """Each has the steps since the one before, and a text about returns."""
    reports = list[tuple[int, str]]()
    train.train(Push(), STEPS, 0, lambda *report: reports.append(report), n=4)
    assert [steps for steps, _ in reports] == [STEPS / 2, STEPS / 2]
    assert all(text.startswith("return ") for _, text in reports)


def test_a_training_is_that_of_its_seed() -> None:
    """Its weights are the same, to the bit; those of another seed differ in every layer."""
    first, again, other = (train.train(Push(), STEPS, seed, lambda *_: None, n=4) for seed in (3, 3, 4))
    for name, values in first.items():
        np.testing.assert_array_equal(values, again[name])
        assert (values != other[name]).any(), name
