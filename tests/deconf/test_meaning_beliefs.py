"""Beliefs by what they mean: what they wait out, what they read, and what they say of a theta."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from deconfounded import envs
from deconfounded.deconf import learned_reference
from deconfounded.deconf.core.data import Batch, Signature
from deconfounded.deconf.core.drift import choose_kept
from deconfounded.deconf.core.dynamics import DynamicsHead
from deconfounded.deconf.core.gru import GruBelief
from deconfounded.deconf.core.latent_agent import DeconfoundedAgent, Explorer
from deconfounded.deconf.core.linear_model import LinearModel
from deconfounded.deconf.core.models import VariationalModel, new_model
from deconfounded.deconf.core.nets import Inputs, Scales
from deconfounded.deconf.diagnosis.learned_env import LearnedEnv, PosteriorSampler
from deconfounded.deconf.exact import ExactAgent, Grid
from deconfounded.deconf.learned_reference import LearnedDynamics
from deconfounded.deconf.methods.deconfounded_offline import exact
from deconfounded.deconf.particles import Particles
from deconfounded.envs.latent import Latent
from deconfounded.envs.streams import Array, Streams
from deconfounded.experts import policy
from deconfounded.experts.rollout import Rollout, run_trials
from deconfounded.experts.trials import Trials
from tests import toys
from tests.deconf.ball import streams
from tests.deconf.test_particles import expert
from tests.envs.test_drift import Average

FLAT = Signature(obs=1, action=1, actions=0, binary=False)


class TwoKinds(toys.Push):
    """Push, with a second latent of two kinds and a third one, which do nothing."""

    name = "two_kinds"
    latents = (*toys.Push.latents, Latent("kind", "", 0, 1, "categorical"), Latent("rest", "", 0.0, 1.0))


def numbered(trials: int = 6, steps: int = 10) -> Batch:
    """Trials whose observations are all different."""
    obs = torch.arange(trials * (steps + 1)).float().reshape(1, trials, steps + 1, 1)
    return Batch(obs[:, :, :-1], streams().normal(trials, steps, 1), obs[:, :, 1:], torch.ones(1, trials, steps))


class TestExact:
    def test_a_belief_waits_for_the_steps_that_an_episode_lacked(self) -> None:
        """Of its own episode alone, not of all before it."""
        env, waits = envs.BatchEnv(toys.Switch(), 1), list[int]()
        agent = ExactAgent(env, expert(env.task), False, 5)
        predict_steps = agent.grid.predict_steps

        def spy(log_belief: Array, *steps: int) -> Array:
            waits.extend(steps)
            return predict_steps(log_belief, *steps)

        agent.grid.predict_steps = spy  # type: ignore[method-assign]
        lengths = run_trials(env, agent, 6, 0).trials.mask[0].sum(-1)
        assert waits == [env.task.horizon - length for length in lengths[:-1]]
        assert len({*waits}) > 1

    def test_a_true_theta_has_the_likelihood_of_its_grid_value(self) -> None:
        """Also where one latent alone has changed since the step before."""
        task = envs.get("gusty_drone")
        env = envs.BatchEnv(task, 1)
        grid = Grid(env, policy.load(task), 2)
        env.reset(0)
        state, action = env.state.copy(), np.full((1, task.action_width), 0.3)
        env.step(action)
        log_prob = grid.log_dynamics(state, action, env.state)
        for k, theta in enumerate(grid.theta):
            assert grid.log_true(state, action, env.state, theta[None]) == pytest.approx(log_prob[:, k])
        assert len(np.unique(log_prob)) == len(grid.theta)

    def test_a_theta_of_an_episode_is_drawn_anew_in_the_next(self) -> None:
        env = envs.BatchEnv(toys.Push(), 64)
        agent, drawn = ExactAgent(env, expert(env.task), False, 21), []
        agent.way = "episode"
        obs = env.reset(0)
        agent.begin(64)
        for episode in range(2):
            agent.reset([np.random.default_rng(episode)])
            for _ in range(2):
                agent.act(obs)
                drawn.append(agent._theta)
        np.testing.assert_array_equal(drawn[0], drawn[1])
        assert (np.array(drawn[1]) != drawn[2]).any()


class TestParticles:
    def belief(self, task: envs.Task, static: bool = False) -> Particles:
        env = envs.BatchEnv(task, 3)
        belief = Particles(env, expert(task), False, static=static)
        belief.begin(3)
        belief.reset(Streams([np.random.default_rng(0)]))
        return belief

    def test_a_category_has_no_mean(self) -> None:
        """Its likeliest value stands in its place."""
        belief = self.belief(TwoKinds())
        mean = belief.mean(belief.log_weight)
        assert {*mean[:, 1]} <= {0, 1}
        assert mean[:, 2] == pytest.approx(0.5, abs=0.1)

    @pytest.mark.parametrize("static", [True, False])
    def test_a_static_belief_does_not_drift(self, static: bool) -> None:
        belief = self.belief(toys.Drift(), static)
        before = belief.theta.copy()
        belief.reset(Streams([np.random.default_rng(1)]))
        assert np.array_equal(belief.theta, before) == static


def test_an_exponent_is_of_whole_beginnings_of_trials() -> None:
    """An error that all steps of a trial share adds up, though it is small in each of them."""
    rng, n, length = np.random.default_rng(0), 24, 40
    obs, mask = rng.uniform(-1, 1, (n, 1, length + 1, 2)), np.ones((n, 1, length), bool)

    class Biased:
        task = toys.Push()

        def log_prob(self, obs: Array, *_: Array) -> Array:
            return np.zeros(len(obs))

        def log_grid(self, obs: Array, action: Array, next_obs: Array, decoys: Array) -> Array:
            return np.repeat(rng.normal(-0.3, 0.5, (1, len(decoys))), len(obs), 0)

    rollout = Rollout(Trials(obs, np.zeros((n, 1, length, 1)), mask), np.zeros((n, 1)), np.zeros((n, 1, 1)))
    dynamics: Any = Biased()
    assert learned_reference.calibrated(dynamics, [rollout], np.ones(n, bool)) < 0.2


@pytest.mark.parametrize("effect", [0.2, 0.5])
def test_an_exact_likelihood_of_a_category_keeps_its_exponent(effect: float) -> None:
    """The true category is among all values of the grid, and counts once; a world of one effect a category."""
    rng, n, length = np.random.default_rng(0), 400, 20
    theta = rng.integers(3, size=(n, 1, 1)).astype(float)
    obs = effect * theta[..., None] + rng.standard_normal((n, 1, length + 1, 1))

    class Exact:
        task = toys.Arms()

        def log_prob(self, obs: Array, action: Array, next_obs: Array, theta: Array) -> Array:
            return -0.5 * (next_obs[:, 0] - effect * theta[:, 0]) ** 2

        def log_grid(self, obs: Array, action: Array, next_obs: Array, decoys: Array) -> Array:
            return -0.5 * (next_obs - effect * decoys[:, 0]) ** 2

    actions, mask = np.zeros((n, 1, length, 1)), np.ones((n, 1, length), bool)
    rollout = Rollout(Trials(obs, actions, mask), np.zeros((n, 1)), theta)
    dynamics: Any = Exact()
    assert learned_reference.calibrated(dynamics, [rollout], np.ones(n, bool)) == 1


def test_padding_is_no_reason_to_forget() -> None:
    """Steps that did not take place do not count in the choice of what is kept between episodes."""
    generator, trials, episodes, steps, kept = torch.Generator().manual_seed(0), 200, 4, 5, []
    theta = torch.randn(trials, 1, 1, generator=generator).expand(trials, episodes, 1)
    theta = theta.reshape(1, -1, 1, 1).expand(1, trials * episodes, steps, 1)
    readings = theta + torch.randn(theta.shape, generator=generator)
    for padding in (0, 3):
        x = torch.cat([readings, 30 * torch.randn(1, trials * episodes, padding, 1, generator=generator)], 2)
        mask = (torch.arange(steps + padding) < steps).float().expand(x.shape[:-1])
        model = Average(streams())
        choose_kept(model, Batch(x, x, x, mask), episodes, streams())
        kept.append(model.kept.item())
    assert kept[0] == kept[1] > 0


class TestSets:
    """A belief of some steps of a trial predicts its other steps, and none that it has read."""

    def test_of_a_network(self, monkeypatch: pytest.MonkeyPatch) -> None:
        data = numbered()
        model = new_model("evidence", 2, 8, Scales.of(FLAT, data), streams())
        assert isinstance(model, VariationalModel)
        final_memory, negative_elbo, read, predicted = model.final_memory, model.negative_elbo, [], []

        def memory_spy(batch: Batch) -> Tensor:
            read.append(batch.obs[batch.mask > 0])
            return final_memory(batch)

        def elbo_spy(steps: Batch, *rest: Any) -> Tensor:
            predicted.append(steps.obs[steps.mask > 0])
            return negative_elbo(steps, *rest)

        monkeypatch.setattr(model, "final_memory", memory_spy)
        monkeypatch.setattr(model, "negative_elbo", elbo_spy)
        model.loss_on_sets(data, 50, 0.0, streams())
        assert len(read[0]) + len(predicted[0].unique()) > 0.9 * data.mask.sum()
        assert not torch.isin(predicted[0], read[0]).any()

    def test_of_sums(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """The steps before and after are all of a trial's: counts, the last numbers of memories, add up."""
        data = numbered()
        model = new_model("linear", 2, 8, Scales.of(FLAT, data), streams())
        assert isinstance(model, LinearModel)
        prediction_loss, counts = model.prediction_loss, []

        def spy(before: Tensor, after: Tensor) -> Tensor:
            counts.append(before[..., -1] + after[..., -1])
            return prediction_loss(before, after)

        monkeypatch.setattr(model, "prediction_loss", spy)
        model.loss_on_sets(data, 50, 0.0, streams())
        assert (counts[0] == data.mask.shape[2]).all()


def test_what_a_second_network_reads_has_the_mean_of_the_belief() -> None:
    """Also once the network of the belief says something."""
    data = numbered()
    model = exact(VariationalModel("innovations", 2, 8, Scales.of(FLAT, data), streams()), streams())
    for parameter in model.reader.parameters():
        torch.nn.init.normal_(parameter, generator=torch.Generator().manual_seed(0))
    memory = model.final_memory(data)
    torch.testing.assert_close(model.read(memory)[1], model.mean(model.belief(memory)))
    assert not torch.allclose(model.read(memory)[1], model.read(memory)[0][..., :2])


class TestLatentOfAnEpisode:
    def agent(self) -> DeconfoundedAgent:
        return DeconfoundedAgent.new("evidence", 3, 16, Scales.plain(FLAT, 1), streams())

    def test_it_is_drawn_at_the_start_of_each(self) -> None:
        agent, latents = self.agent(), []
        agent.way = "episode"
        agent.begin(4)
        for episode in range(2):
            agent.reset([np.random.default_rng(episode)])
            latents += [agent.latent(), agent.latent()]
        assert torch.equal(latents[0], latents[1])
        assert (latents[1] != latents[2]).all()

    def test_of_blind_explorers_too(self) -> None:
        """Every other trial acts by one latent of an expert trial, as long as the episode lasts."""
        explorer = Explorer(self.agent(), torch.arange(300.0).reshape(1, 100, 3), 0.1)
        latents = []
        explorer.begin(8)
        for episode in range(2):
            explorer.reset([np.random.default_rng(episode)])
            latents += [explorer.latent()[:, ::2], explorer.latent()[:, ::2]]
        assert torch.equal(latents[0], latents[1])
        assert (latents[1] != latents[2]).any()


def test_a_sampler_in_learned_dynamics_takes_in_no_step_after_the_end() -> None:
    """Where the mask is 0 its belief about the candidates stays as it was."""
    sampler = PosteriorSampler.__new__(PosteriorSampler)
    sampler.theta_hat = torch.zeros(1, 2, 1)
    sampler.begin(1, [np.random.default_rng(0)])
    sampler.log_next = lambda step: torch.tensor([[[-9.0, 0.0]]])  # type: ignore[method-assign]
    before = sampler.log_belief
    for mask, same in ((0.0, True), (1.0, False)):
        sampler.remember(Batch(*torch.zeros(3, 1, 1, 1), torch.full((1, 1), mask)))
        assert torch.equal(sampler.log_belief, before) == same


def test_the_reference_s_likeliest_action_is_no_error() -> None:
    """Where actions are discrete: 0 for the likeliest, and for another as much as it is less likely."""
    log_probs = torch.tensor([[[0.6, 0.3, 0.1]]]).log()
    signature = SimpleNamespace(policy=SimpleNamespace(signature=SimpleNamespace(actions=3)), theta_hat=None)
    env: Any = SimpleNamespace(reference=SimpleNamespace(point=lambda obs, latent: log_probs, **vars(signature)))
    for action, error in ((0, 0), (1, 0.5)):
        measured = LearnedEnv._action_error(env, torch.zeros(1, 1, 1), torch.full((1, 1, 1), float(action)))
        assert measured.item() == pytest.approx(error)


def test_a_gru_says_a_variance() -> None:
    """Its numbers are a mean and a softplus variance, of which the std is the root."""
    data = numbered()
    belief = GruBelief(2, 8, Scales.of(FLAT, data), streams())
    memory = belief(data)
    mean, raw = belief.out(memory).chunk(2, -1)
    said = belief.posterior(memory)
    torch.testing.assert_close(said[0], mean)
    torch.testing.assert_close(said[1].square(), torch.nn.functional.softplus(raw), rtol=0, atol=1e-5)


def test_the_mean_change_of_a_bit() -> None:
    """Of one that is 1 with probability .5: down by .5 from 1, up by .5 from 0."""
    bits = Signature(obs=1, action=1, actions=0, binary=True)
    head = DynamicsHead(1, 8, Inputs(Scales.plain(bits, 1)), streams())
    head.forward = lambda obs, *rest: torch.zeros_like(obs)[..., None, :]  # type: ignore[method-assign]
    obs = torch.tensor([[[0.0], [1.0]]])
    mean = head.change.inverse(head.mean(obs, obs, obs))
    assert mean.flatten().tolist() == pytest.approx([0.5, -0.5])


def test_an_exponent_is_a_power_of_the_likelihood() -> None:
    residual = np.array([[1.0, 2.0], [0.0, 3.0]])
    missing: Any = None
    for exponent in (1.0, 0.1):
        dynamics = LearnedDynamics(toys.Push(), missing, missing, np.ones(2), np.eye(2), exponent)
        dynamics.residual = lambda *_: residual  # type: ignore[method-assign]
        log_prob = dynamics.log_prob(residual, residual, residual, residual)
        assert log_prob == pytest.approx([-0.5 * exponent * 5, -0.5 * exponent * 9])
