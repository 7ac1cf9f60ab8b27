"""Evidence of a latent in the dynamics, and the size of their noise, in a small world where both are known."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from deconfounded.deconf.core.data import Batch, Draws, Signature
from deconfounded.deconf.core.drift import episodes_of
from deconfounded.deconf.core.dynamics import DynamicsHead
from deconfounded.deconf.core.monitor import Monitor
from deconfounded.deconf.core.nets import Inputs, Scales
from deconfounded.deconf.diagnosis import latent, measures, trait
from deconfounded.deconf.diagnosis.measures import Amounts, split
from deconfounded.deconf.diagnosis.thresholds import NO_EVIDENCE
from deconfounded.deconf.methods.deconfounded import DeconfoundedConfig
from deconfounded.deconf.methods.memoryless_bc import MemorylessConfig
from deconfounded.experts.trials import Trials

NOISE, FALL = 0.1, 1.5
EXPLORING = DeconfoundedConfig(inference_updates=800, inference_rate=1e-2)
CLONING = MemorylessConfig(updates=200)


def world(push: float, expert: bool, n: int, seed: int, episodes: int = 1, drifts: bool = False) -> Trials:
    """s' = s + a / 2 + push theta + noise, larger beyond |s| = 1.5; the expert holds s at 0, others act at random."""
    rng = np.random.default_rng(seed)
    theta = np.repeat(rng.choice([-1.0, 1.0], (n, 1)), episodes, 1)
    if drifts:
        theta = rng.choice([-1.0, 1.0], (n, episodes))
    obs, actions = [rng.normal(0, 0.1 if expert else 3.0, (n, episodes))], []
    for _ in range(40):
        s = obs[-1]
        act = -2 * s - 0.4 * theta + rng.normal(0, 0.05, s.shape) if expert else rng.uniform(-1, 1, s.shape) - s
        act = act.clip(-1, 1)
        noise = np.where(abs(s) > FALL, 20 * NOISE, NOISE) * rng.normal(size=s.shape)
        obs.append(s + act / 2 + push * theta + noise)
        actions.append(act)
    return Trials(np.stack(obs, -1)[..., None], np.stack(actions, -1)[..., None], np.ones((n, episodes, 40), bool))


def explain(push: float) -> latent.Explanation:
    rng = np.random.default_rng(0)
    expert, explored = (split(world(push, kind, 128, seed), 0.25, rng) for seed, kind in enumerate((True, False)))
    return latent.from_dynamics(expert, explored, 1, EXPLORING, CLONING, Draws([rng], "cpu"), Monitor())


@pytest.mark.slow
def test_dynamics_with_evidence() -> None:
    """theta moves s by .2 either way, in noise of .1: 8 nats a step between opposite ones, as half of all pairs are.

    In exploration, where noise is large beyond |s| = 1.5, so few updates leave an error of half its size.
    """
    explanation = explain(0.2)
    assert explanation.exploration_evidence == pytest.approx(4, rel=0.35)
    assert explanation.expert_evidence == pytest.approx(4, rel=0.2)
    head = explanation.dynamics
    assert (torch.exp(head.log_std) * head.change.std).item() == pytest.approx(NOISE, rel=0.3)


@pytest.mark.slow
def test_dynamics_without_evidence() -> None:
    explanation = explain(0.0)
    assert explanation.exploration_evidence == pytest.approx(0, abs=NO_EVIDENCE)
    assert explanation.expert_evidence == pytest.approx(0, abs=NO_EVIDENCE)


def test_even_steps_predict_odd_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beliefs read as many steps as in training: the even ones; likelihoods are of the odd ones."""
    read: list[torch.Tensor] = []
    final = latent.final_belief
    monkeypatch.setattr(latent, "final_belief", lambda model, batch: read.append(batch.mask) or final(model, batch))
    monkeypatch.setattr(latent, "shared_with", lambda *_: 1.0)  # which is of halves
    rng = np.random.default_rng(0)
    expert, explored = (split(world(0.2, kind, 32, seed), 0.25, rng) for seed, kind in enumerate((True, False)))
    few = replace(EXPLORING, inference_updates=5)
    latent.from_dynamics(expert, explored, 1, few, replace(CLONING, updates=5), Draws([rng], "cpu"), Monitor())
    assert read
    for mask in read:
        assert mask[..., ::2].any()
        assert not mask[..., 1::2].any()
    batch = Batch.of(expert[0], 1)
    odd = latent.odd_steps(batch).mask
    assert odd[..., 1::2].eq(batch.mask[..., 1::2]).all()
    assert not odd[..., ::2].any()


def evidence_of(latents: Any, batch: Batch, per_theta: int) -> float:
    """Of trials with these latents, 0 or 1, of which a wrong one costs a nat a step."""
    own = torch.tensor(latents, dtype=torch.float)[None, :, None]
    return latent._evidence(lambda _, given: -(given - own[:, :, None]).square()[..., 0], batch, own, per_theta)


@pytest.mark.parametrize(("n", "per_theta", "nats"), [(4, 2, 1.0), (4, 1, 2 / 3), (16, 2, 4 / 7), (16, 1, 8 / 15)])
def test_evidence_is_against_trials_under_other_thetas(n: int, per_theta: int, nats: float) -> None:
    """Pairs of trials share a latent, 0 or 1, in turn; a wrong one costs a nat a step. No trial is held against itself.

    Of four trials, two trials away is a wrong one; of sixteen, four of the seven that are a multiple of two away.
    """
    batch = Batch.of(world(0.2, False, n, 0), 1)
    assert evidence_of([0.0, 0, 1, 1] * (n // 4), batch, per_theta) == pytest.approx(nats)


def test_evidence_hardly_depends_on_which_trials_are_neighbours() -> None:
    """Of a latent of two values, in any order of the trials; one neighbour each would tell .2 to .8 of them apart."""
    batch, rng = Batch.of(world(0.2, False, 40, 0), 1), np.random.default_rng(0)
    for _ in range(20):
        assert evidence_of(rng.permutation(np.arange(40) % 2), batch, 1) == pytest.approx(0.5, abs=0.08)


@pytest.mark.slow
def test_how_much_trials_and_episodes_differ() -> None:
    """theta lasts for a trial, for an episode, or is in no dynamics; and of a few trials nobody knows."""
    lasting, passing, none = (
        measures._differ(world(push, False, 96, 0, 4, drifts)) for push, drifts in ((0.2, 0), (0.2, 1), (0, 0))
    )
    assert lasting[0] is not None
    assert lasting[0] >= lasting[1] > 0.5
    assert passing[0] == 0
    assert passing[1] > 0.5
    assert none == (0, 0)
    assert measures._differ(world(0, False, 24, 0, 1)) == (None, 0)


@pytest.mark.slow
def test_theta_that_drifts() -> None:
    """Each episode of the 48 training trials has a latent of its own; in whole trials there is no evidence of one."""
    few = replace(EXPLORING, inference_updates=500)
    rng, amounts = np.random.default_rng(0), Amounts(exploring=few, cloning=replace(CLONING, updates=20))
    expert, explored = (
        split(world(0.2, kind, 64, seed, 4, drifts=True), 0.25, rng) for seed, kind in enumerate((True, False))
    )
    explanation = measures._explain(expert, explored, amounts, Draws([rng], "cpu"), lambda share: None)
    assert explanation.latents.shape[1] == 4 * 48
    assert explanation.exploration_evidence == pytest.approx(4, rel=0.35)


@pytest.mark.slow
@pytest.mark.parametrize(("size", "least", "most"), [(0.4, 0.2, 1.0), (0.0, -0.1, 0.1)])
def test_a_trait_s_gain_is_over_a_policy_that_fits_as_well(size: float, least: float, most: float) -> None:
    """Actions of a rough function of the state, which no clone fits in so few updates, and of a side of each trial."""
    rng = np.random.default_rng(0)
    side, obs = rng.choice([-1, 1], (48, 1, 1, 1)), rng.uniform(-1, 1, (48, 1, 41, 1))
    action = size * side + 0.5 * np.sin(9 * obs[:, :, :-1]) + 0.05 * rng.standard_normal((48, 1, 40, 1))
    train, held_out = (
        Trials(obs[i], action[i].clip(-1, 1), np.ones((len(obs[i]), 1, 40), bool))
        for i in (slice(0, 36), slice(36, None))
    )
    config = MemorylessConfig(updates=100, batch=256, width=32, learning_rate=6e-3)
    data = Batch.of(train, 1), Batch.of(held_out, 1)
    made = trait.fit(*data, Signature.of(train), config, Draws([rng], "cpu"))
    assert least < made.gain < most


@pytest.mark.slow
def test_a_trait_of_trials_whose_halves_differ() -> None:
    """In the first half all experts push the other way, so that a trait of the whole trial is of neither half."""
    rng = np.random.default_rng(0)
    side, turn = rng.uniform(-0.5, 0.5, (96, 1, 1, 1)), np.where(np.arange(40) < 20, -0.4, 0.4)[:, None]
    obs = np.stack([np.broadcast_to(np.arange(41) / 40, (96, 1, 41)), rng.normal(size=(96, 1, 41))], -1)
    action = (side + turn + 0.05 * rng.standard_normal((96, 1, 40, 1))).clip(-1, 1)
    parts = (Trials(obs[i], action[i], np.ones((len(obs[i]), 1, 40), bool)) for i in (slice(0, 72), slice(72, None)))
    train, held_out = (Batch.of(part, 1) for part in parts)
    config = MemorylessConfig(updates=150, batch=256, width=32, learning_rate=6e-3)
    signature = Signature.of(Trials(obs, action, np.ones((96, 1, 40), bool)))
    made = trait.fit(train, held_out, signature, config, Draws([rng], "cpu"))
    assert made.gain > 0.2


def test_a_trait_s_policy_acts_by_the_scales_of_its_training() -> None:
    """Those of the expert, whatever the dynamics were learned from."""
    rng = np.random.default_rng(0)
    obs = rng.normal(0, 1, (24, 1, 21, 1))
    trials = Trials(obs, 0.3 * np.tanh(obs[:, :, :-1]), np.ones((24, 1, 20), bool))
    data, signature = Batch.of(trials, 1), Signature.of(trials)
    draws = Draws([rng], "cpu")
    of_trial = trait.fit(data, data, signature, MemorylessConfig(updates=2, width=8), draws)
    wide = Scales(signature, replace(data, obs=3 * data.obs), data.action, data.mask)
    dynamics = DynamicsHead(2, 8, Inputs(wide), draws)
    latents, traits = torch.zeros(1, 24, 2), of_trial.traits
    made = trait.TraitPolicy(dynamics, of_trial, latents, traits)
    seen = made.features(data.obs[:, :, 0], torch.cat([latents, traits], -1))
    torch.testing.assert_close(seen[..., :1], Scales.of(signature, data).obs(data.obs[:, :, 0]))


def test_episodes_that_did_not_take_place() -> None:
    """Some trials have fewer episodes than others; nothing is of those that they lack."""
    trials = world(0.2, True, 6, 0, 4)
    mask = trials.mask.copy()
    mask[1:, 2:] = False
    episodes = episodes_of(Trials(trials.obs, trials.action, mask))
    assert len(episodes) == 4 + 5 * 2
    assert episodes.mask.any((1, 2)).all()
    np.testing.assert_array_equal(episodes.action[:4, 0], trials.action[0])
    np.testing.assert_array_equal(episodes.action[4:6, 0], trials.action[1, :2])


def test_halves_of_a_trial_are_of_the_steps_that_it_has() -> None:
    """Of 6 steps of room: 2 and 2 of four, 1 and 1 of two; half of an odd number is rounded down, then up."""
    taken = np.arange(6) < np.array([[4], [2], [5]])
    batch = Batch.of(Trials(np.zeros((3, 1, 7, 1)), np.zeros((3, 1, 6, 1)), taken[:, None]), 1)
    early, late = latent.halves(batch)
    assert early.mask[0].sum(-1).tolist() == [2, 1, 2]
    assert late.mask[0].sum(-1).tolist() == [2, 1, 3]
    assert not (early.mask * late.mask).any()


@pytest.mark.parametrize(("of", "share"), [("change", (0.9, 1.0)), ("place", (0.0, 0.3))])
def test_a_latent_in_the_system_lasts_through_exploration_too(
    of: str, share: tuple[float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not so a latent that is where a trial went: the expert goes there again in its next episode, others do not."""
    rng, n, steps = np.random.default_rng(0), 96, 40

    def moved(starts: Any) -> Batch:
        theta, obs = rng.choice([-1.0, 1.0], (n, 1)), np.zeros((n, 2, steps + 1, 1))
        obs[:, :, 0, 0] = starts
        for t in range(steps):
            obs[:, :, t + 1, 0] = obs[:, :, t, 0] + 0.1 * theta + 0.02 * rng.standard_normal((n, 2))
        return Batch.of(Trials(obs, np.zeros((n, 2, steps, 1)), np.ones((n, 2, steps), bool)), 1)

    def belief(model: Any, batch: Batch) -> Tensor:
        """The mean of the change, or of the place, over the steps of a trial."""
        seen, weight = (batch.next_obs - batch.obs if of == "change" else batch.obs), batch.mask[..., None]
        return (seen * weight).sum(2) / weight.sum(2)

    monkeypatch.setattr(latent, "final_belief", belief)
    model, policy = (SimpleNamespace(for_cloning=lambda x, draws: x), SimpleNamespace(point=lambda obs, x: x))
    expert, explored = (moved(rng.choice([-30.0, 30.0], (n, episodes))) for episodes in (1, 2))
    shared = latent.shared_with(explored, expert, model, policy)  # type: ignore[arg-type]
    assert share[0] <= shared <= share[1]
    monkeypatch.setattr(latent, "final_belief", lambda _, batch: belief(_, batch) * (batch.obs is not expert.obs))
    assert latent.shared_with(explored, expert, model, policy) == 0  # type: ignore[arg-type]  # nothing lasts there
