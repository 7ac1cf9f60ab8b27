"""A belief linear in innovations, effects linear in the latent, and the belief in the course of a trial, on a ball."""

import numpy as np
import pytest
import torch
from torch import Tensor

from deconfounded.deconf.core import online
from deconfounded.deconf.core.adam import Adam
from deconfounded.deconf.core.beliefs import EvidenceBelief, InnovationBelief
from deconfounded.deconf.core.data import Batch, Draws, Signature
from deconfounded.deconf.core.latent_model import final_belief
from deconfounded.deconf.core.models import VariationalModel
from deconfounded.deconf.core.nets import Scales
from deconfounded.deconf.core.online import OnlineBelief
from deconfounded.deconf.methods import deconfounded
from deconfounded.deconf.methods.deconfounded import DeconfoundedConfig
from deconfounded.experts.trials import Trials
from tests.deconf.ball import STEPS, pushed, streams
from tests.tools import tiny_preset


@pytest.fixture(scope="module")
def model() -> tuple[VariationalModel, Batch]:
    """A model with InnovationBelief, and the trials of a wrong controller on which it was trained."""
    data, _ = pushed(256, np.random.default_rng(0))
    draws, signature = streams(), Signature(1, 1, 0, False)
    made = VariationalModel("innovations", 2, 32, Scales.of(signature, data), draws)
    optimizer = Adam([made], 5e-3, 400)
    for update in range(400):
        batch = data.beginnings(update, 0.1).draw_trials(16, draws)
        made.learn(optimizer, batch, 256, 1e-3 * min(1, update / 200), draws)
    made.set_prior(final_belief(made, data), draws)
    return made.eval(), data


def test_evidence_is_linear_in_innovations() -> None:
    """Changes that are as expected are no evidence, whatever the states; twice the innovation is twice the evidence."""
    data, _ = pushed(8, np.random.default_rng(0))
    belief = InnovationBelief(2, 16, Scales.of(Signature(1, 1, 0, False), data), streams()).eval()
    other = EvidenceBelief(2, 16, belief.inputs.scales, streams()).eval()

    def evidence(of: EvidenceBelief, times: float) -> torch.Tensor:
        inputs = torch.cat([of.inputs.obs(data.obs), of.inputs.action(data.action)], -1)
        change = of.change.inverse(of.expected(inputs) + times)
        return of(Batch(data.obs, data.action, data.obs + change, data.mask))[..., : of.width // 4]

    with torch.no_grad():
        assert evidence(belief, 0).abs().max() < 1e-4
        torch.testing.assert_close(evidence(belief, 2), 2 * evidence(belief, 1), rtol=1e-3, atol=1e-4)
        assert evidence(belief, 1).abs().max() > 0.1
        assert evidence(other, 0).abs().max() > 0.1, "that of EvidenceBelief is not"


@pytest.mark.slow
def test_effects_are_linear_in_the_latent(model: tuple[VariationalModel, Batch]) -> None:
    """Means of next observations lie on the line between those of two latents, but not with EvidenceBelief."""
    made, data = model
    other = VariationalModel("evidence", 2, 32, made.inputs.scales, streams()).eval()

    def apart(of: VariationalModel) -> tuple[float, float]:
        """The largest distance from the line, and the largest effect."""
        one, two = (torch.tensor(x).expand(*data.mask.shape, 2) for x in ([3.0, -2.0], [-1.0, 4.0]))
        with torch.no_grad():
            ends = [of.dynamics.mean(data.obs, data.action, x) for x in (one, two, 0.25 * one + 0.75 * two)]
        return (ends[2] - 0.25 * ends[0] - 0.75 * ends[1]).abs().max().item(), (ends[0] - ends[1]).abs().max().item()

    off, effect = apart(made)
    assert effect > 0.3
    assert off < 1e-4
    assert apart(other)[0] > 0.01


@pytest.mark.slow
def test_untrained_it_is_the_model_s_mean(model: tuple[VariationalModel, Batch]) -> None:
    made, data = model
    belief = OnlineBelief(made, 16, streams())
    memory = made.encoder(data)
    torch.testing.assert_close(belief.mean(belief(made, memory)), made.encoder.posterior(memory)[0])


def test_samples_are_of_the_density() -> None:
    """Of latents that depend on each other: mean, covariance and entropy as of the Gaussian that is given."""
    data, _ = pushed(2, np.random.default_rng(0))
    made = VariationalModel("innovations", 3, 16, Scales.of(Signature(1, 1, 0, False), data), streams())
    belief = OnlineBelief(made, 16, streams())
    belief.unit.copy_(torch.tensor([[1.0, 2.0, 0.5]]))
    mean, std, lower = [0.3, -1.0, 2.0], [0.5, 0.1, 0.02], [-0.9, 2.0, -3.0]
    given = torch.tensor([*mean, *std, *lower])[None, None].expand(1, 20_000, -1)
    drawn = belief.sample(given, streams())[0].double()
    triangle = torch.tensor([[1, 0, 0], [-0.9, 1, 0], [2, -3, 1]]).double().inverse()
    factor = belief.unit[0, :, None].double() * triangle @ torch.diag(torch.tensor(std).double())
    torch.testing.assert_close(drawn.mean(0), torch.tensor(mean).double(), atol=0.02, rtol=0)
    torch.testing.assert_close(drawn.T.cov(), factor @ factor.T, atol=5e-3, rtol=0.05)
    entropy = sum(0.5 * np.log(2 * np.pi * np.e) + np.log(x) for x in std)
    apart = (drawn[None].float() - given[..., :3]) / belief.unit
    log_prob = belief.gaussian.log_prob(torch.cat([torch.zeros(1, 20_000, 3), given[..., 3:]], -1), apart)
    assert abs(log_prob.mean().item() + entropy) < 0.03


@pytest.mark.slow
def test_it_says_how_far_it_is_from_the_latent_of_the_whole_trial(model: tuple[VariationalModel, Batch]) -> None:
    """On trials that it has not seen: squared errors are 1 to 2 of its variance, and hundreds of the model's own.

    The two dimensions of the latent depend on each other, since theta has one, and so do samples.
    """
    made, data = model
    belief = OnlineBelief(made, 32, streams())
    belief.fit(made, data, 400, streams())
    fresh, _ = pushed(400, np.random.default_rng(1))
    with torch.no_grad():
        memory = made.encoder(fresh)
        final = made.encoder.posterior(memory[:, :, -1])[0]
        for t in (0, 2, 6, 12):
            given = belief(made, memory[:, :, t])
            mean, drawn = belief.mean(given), belief.sample(given, streams())
            own_mean, own_std = made.encoder.posterior(memory[:, :, t])
            own_apart = ((own_mean - final) / own_std).square().mean()
            _, std, lower = belief.gaussian.split(given)
            apart = belief.gaussian.triangle(lower) @ ((final - mean) / belief.unit[:, None])[..., None]
            assert 0.5 < (apart[..., 0] / std).square().mean() < 4
            assert t == 0 or own_apart > 50
            assert (mean - final).square().mean() < 1.05 * (own_mean - final).square().mean()
            assert abs(_correlation(drawn) - _correlation(final)) < 0.1, "samples lie where latents lie"


def _correlation(latents: Tensor) -> float:
    return float(np.corrcoef(latents[0].T.numpy())[0, 1])


def test_memories_go_with_the_latents_of_their_trials(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of steps that took place, more of the first ones."""
    data, _ = pushed(70, np.random.default_rng(0))
    data.mask[:, ::2, 10:] = 0
    made = VariationalModel("innovations", 2, 8, Scales.of(Signature(1, 1, 0, False), data), streams()).eval()
    number, step = torch.arange(70.0)[None, :, None].expand(-1, -1, STEPS), torch.arange(float(STEPS)).expand(1, 70, -1)
    data = Batch(torch.stack([number, step], -1), data.action, data.next_obs, data.mask)
    monkeypatch.setattr(made.encoder, "forward", lambda batch: torch.cat([batch.obs, batch.obs[:, :, -1:]], 2))
    monkeypatch.setattr(made, "belief", lambda memory: torch.cat([memory, memory], -1))
    memory, latent = online.memories(made, data, streams())
    given, of_given = online.memories(made, data, streams(), 10 * number[..., :1].expand(-1, -1, 2))
    assert torch.equal(given, memory)
    assert torch.equal(of_given, 10 * latent[..., :1].expand(-1, -1, 2))
    assert (latent[..., 1] == STEPS - 1).all(), "a latent is of the whole trial"
    assert memory.shape == (1, 70 * online.PER_TRIAL, 2)
    assert torch.equal(memory[..., 0], latent[..., 0])
    short, whole = (memory[0, memory[0, :, 0] % 2 == rest, 1] for rest in (0, 1))
    assert short.max() == 9
    assert whole.max() > 20
    assert abs((whole < STEPS / 4).float().mean() - 0.5) < 0.1
    monkeypatch.setattr(made.encoder, "hindsight", lambda batch, memories: batch.obs)  # a latent for every step
    memory, latent = online.memories(made, data, streams())
    assert torch.equal(memory, latent)


def test_a_step_is_predicted_by_the_belief_before_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where a step led to is no evidence for its own prediction, and is for that of the step after it."""
    data, _ = pushed(6, np.random.default_rng(0))
    made = VariationalModel("innovations", 2, 8, Scales.of(Signature(1, 1, 0, False), data), streams()).eval()
    means: list[Tensor] = []
    bound = made.negative_elbo
    monkeypatch.setattr(made, "negative_elbo", lambda *given: (means.append(given[1].detach()), bound(*given))[1])
    led = data.next_obs.clone()
    led[:, :, 5] += 1
    for next_obs in (data.next_obs, led):
        made.loss(Batch(data.obs, data.action, next_obs, data.mask), None, 1.0, streams())
    before, after = (mean.unflatten(1, (6, STEPS)) for mean in means)
    moved = (before != after).any(-1)[0]
    assert not moved[:, :6].any()
    assert moved[:, 6:].all()


def test_no_latent_of_padding_enters_the_prior(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where each step has a latent, p(theta_hat) is fitted to those of steps that took place."""
    rng, mask, checked = np.random.default_rng(0), np.arange(12) < np.array([3, 12, 5, 2])[:, None], []
    trials = Trials(rng.random((4, 1, 13, 2)), rng.uniform(-1, 1, (4, 1, 12, 1)), mask[:, None])
    data = Batch.of(trials, 1)

    def check(model: VariationalModel, belief: Tensor, draws: Draws) -> None:
        real, padding = (final_belief(model, data)[data.mask.flatten(1) == taken] for taken in (1, 0))
        checked.append(len(belief[0]))
        assert (belief[0][:, None] == real).all(-1).any(1).all()
        assert not (belief[0][:, None] == padding).all(-1).any()

    monkeypatch.setattr(VariationalModel, "set_prior", check)
    config = DeconfoundedConfig(**tiny_preset().configs["deconfounded_forgetting"])
    deconfounded.train(trials, lambda agent: trials, config, rng)
    assert checked == [48, 48]
