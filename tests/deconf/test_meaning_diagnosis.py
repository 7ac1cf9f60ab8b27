"""Parts of a diagnosis by what they mean: what a figure is of, and which of two explanations is believed."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from deconfounded.deconf.core.data import Batch, Draws, Signature
from deconfounded.deconf.core.monitor import Monitor
from deconfounded.deconf.diagnosis import advice, fits, latent, measures, trait
from deconfounded.deconf.diagnosis.judgement import judge
from deconfounded.deconf.diagnosis.latent import Explanation
from deconfounded.deconf.diagnosis.measures import Amounts, split
from deconfounded.deconf.diagnosis.thresholds import MISFIT
from deconfounded.deconf.methods.memoryless_bc import MemorylessConfig
from deconfounded.experts.trials import Trials
from tests.deconf.test_diagnose import CLEAR
from tests.deconf.test_latent import CLONING, EXPLORING, world


def draws() -> Draws:
    return Draws([np.random.default_rng(0)], "cpu")


def test_a_memory_that_did_not_fit_in_a_single_split_stops_the_verdict() -> None:
    """Though it fitted in the mean of all."""
    diagnosis = judge([CLEAR, CLEAR, CLEAR._replace(memory_gain=-1.5 * MISFIT)])
    assert diagnosis.figures["memory_gain"].value > 0
    assert "did not fit" in diagnosis.conclusion
    assert (diagnosis.verdict, diagnosis.next) == ("cannot tell", advice.MORE_TRIALS)


def test_half_of_the_splits_are_enough() -> None:
    """A verdict falls where fewer than half of them give it alone."""
    diagnosis = judge([CLEAR, CLEAR._replace(latent_gain=2.0)])
    assert (diagnosis.verdict, diagnosis.agreeing, diagnosis.refits) == ("confounded", 1, 2)


@pytest.mark.parametrize(
    ("gain", "evidence", "single"), [(1.0, 1.0, True), (1.0, 0.0, False), (0.0, 1.0, False), (0.0, 0.0, False)]
)
def test_latents_of_episodes_explain_dynamics_and_actions(
    gain: float, evidence: float, single: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """More of one alone is no reason to believe that something hidden changes between episodes."""
    of_trials, of_episodes = (
        Explanation(None, None, torch.zeros(1, 1, 1), latent_gain=1 + by[0], expert_evidence=1 + by[1])  # type: ignore[arg-type]
        for by in ((0.0, 0.0), (gain, evidence))
    )
    explanations = iter((of_trials, of_episodes))
    monkeypatch.setattr(measures, "_differ", lambda explored: (0.0, 1.0))
    monkeypatch.setattr(latent, "from_dynamics", lambda *_: next(explanations))
    data = world(0.2, False, 8, 0, 2), world(0.2, False, 8, 1, 2)
    amounts = Amounts(exploring=EXPLORING, cloning=CLONING)
    explanation = measures._explain(data, data, amounts, draws(), lambda share: None)
    assert explanation is (of_episodes if single else of_trials)


def test_what_a_fit_of_each_trial_leaves_of_noise_is_its_variance() -> None:
    """Though a fit of four coefficients to 40 steps leaves a tenth less of each trial: 20,000 numbers."""
    rng, trials, steps = np.random.default_rng(0), 500, 40
    x, y = rng.normal(size=(trials * steps, 3)), rng.normal(size=(trials * steps, 1))
    left, own = fits.residual(y, x, np.repeat(np.arange(trials), steps))
    assert own
    assert left.var() == pytest.approx(1, abs=0.03)


def test_the_noise_of_dynamics_is_that_of_the_expert_s_trials() -> None:
    """Explorers meet more of it: beyond |s| = 1.5 it is twenty times as large."""
    rng = np.random.default_rng(0)
    expert, explored = (split(world(0.2, kind, 64, seed), 0.25, rng) for seed, kind in enumerate((True, False)))
    few = replace(EXPLORING, inference_updates=20)
    explanation = latent.from_dynamics(expert, explored, 1, few, replace(CLONING, updates=2), draws(), Monitor())
    data, head = Batch.of(expert[0], 1), explanation.dynamics
    with torch.no_grad():
        own = latent.each_step(data, explanation.latents)
        expected = head(data.obs, data.action, own)[..., 0, :]
        left = head.change(data.next_obs - data.obs) - expected
    torch.testing.assert_close(head.log_std.exp().flatten(), left.square().mean().sqrt().reshape(1))


@pytest.mark.slow
def test_a_trait_is_of_the_half_before() -> None:
    """Where nothing of it shows there, in trials that are held out, there is no gain in the second half."""
    rng = np.random.default_rng(0)
    side, obs = rng.choice([-1, 1], (48, 1, 1, 1)), rng.uniform(-1, 1, (48, 1, 41, 1))
    action = 0.4 * side + 0.05 * rng.standard_normal((48, 1, 40, 1))
    action[36:, :, :20] -= 0.4 * side[36:]
    train, held_out = (
        Trials(obs[i], action[i], np.ones((len(obs[i]), 1, 40), bool)) for i in (slice(0, 36), slice(36, None))
    )
    config = MemorylessConfig(updates=100, batch=256, width=32, learning_rate=6e-3)
    fitted = trait.fit(Batch.of(train, 1), Batch.of(held_out, 1), Signature.of(train), config, draws())
    assert fitted.gain < 0.1
