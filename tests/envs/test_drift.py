"""Latents that drift from episode to episode: their distribution, the exact filter, and how learned beliefs forget."""

import numpy as np
import pytest
import torch
from torch import Tensor

from deconfounded import envs
from deconfounded.deconf.core import models
from deconfounded.deconf.core.data import Batch, Draws, Signature
from deconfounded.deconf.core.drift import SHARES, choose_kept
from deconfounded.deconf.core.latent_agent import DeconfoundedAgent
from deconfounded.deconf.core.latent_model import LatentModel
from deconfounded.deconf.core.nets import Scales
from deconfounded.deconf.exact import ExactAgent, Grid
from deconfounded.envs.contract.probe import streams
from deconfounded.envs.streams import Array
from deconfounded.envs.tasks.tilted_cartpole import TiltedCartpole
from deconfounded.experts import policy
from deconfounded.experts.agent import ExpertAgent
from deconfounded.experts.rollout import run_trials, thetas
from tests.toys import Push


class Walking(TiltedCartpole):
    """tilted_cartpole with a drifting tilt."""

    latents = (envs.Latent("tilt", "rad", -0.3, 0.3, drift=0.15),)


def drifting(*drifts: float) -> envs.Task:
    """Push with a latent of each drift."""
    return Push().changed(latents=tuple(envs.Latent(f"x{i}", "", -1.0, 1.0, drift=d) for i, d in enumerate(drifts)))


@pytest.mark.parametrize(("distribution", "drift"), [("uniform", 0.3), ("loguniform", 0.3), ("uniform", 1.0)])
def test_transition_is_that_of_the_walk(distribution: str, drift: float) -> None:
    """Of 200,000 walks from each bin's middle, as many end in each bin: within 5 standard errors and .002."""
    latent, k, n = envs.Latent("x", "m", 1.0, 4.0, distribution, drift), 7, 200_000  # type: ignore[arg-type]
    matrix, rng = latent.transition(k), np.random.default_rng(0)
    np.testing.assert_allclose(matrix.sum(0), 1, atol=1e-9)
    np.testing.assert_allclose(matrix.sum(1), 1, atol=1e-9)
    for i, value in enumerate(latent.grid(k)):
        ends = latent.cdf(latent.drifted(np.full(n, value), rng.standard_normal(n)))
        share = np.bincount(np.minimum((ends * k).astype(int), k - 1), minlength=k) / n
        np.testing.assert_allclose(share, matrix[i], atol=5 * np.sqrt(0.25 / n) + 0.002)


@pytest.mark.parametrize("drifts", [(0.3, 0.0), (0.0, 0.3)])
def test_the_matrix_of_two_latents_moves_the_drifting_one(drifts: tuple[float, float]) -> None:
    """To each of its values; the value of the other stays."""
    task, still = drifting(*drifts), drifts.index(0)
    grid = task.theta_grid(21)
    stays = grid[:, None, still] == grid[:, still]
    assert not stays.all()
    np.testing.assert_array_equal(task.transition(21) > 0, stays)


@pytest.mark.parametrize("kind", ["drift", "switch"])
def test_an_environment_goes_on_from_its_own_theta(kind: str) -> None:
    """Also if it alone begins another episode of its trial: within .005 of a theta of its own, that others have not."""
    task = Push().changed(latents=(envs.Latent("x", "", -1.0, 1.0, **{kind: 1e-3}),))  # type: ignore[arg-type]
    env = envs.BatchEnv(task, 3)
    env.reset(0)
    before = env.theta.copy()
    assert np.abs(before - before.T)[np.triu_indices(3, 1)].min() > 0.01
    for i in range(3):
        env.reset(options={"keep_theta": True}, where=np.arange(3) == i)
        np.testing.assert_allclose(env.theta, before, atol=0.005)


def test_latents_drift_independently() -> None:
    """The correlation of 2,000 steps of two latents is 0, within 5 standard errors."""
    theta = drifting(0.1, 0.1).drifted(np.zeros((2000, 2)), streams(*range(2000)))
    assert abs(np.corrcoef(theta.T)[0, 1]) < 5 / np.sqrt(2000)


def test_a_drift_is_from_0_to_1() -> None:
    """Anything else is refused."""
    for wrong in (-0.1, 1.1, np.nan):
        with pytest.raises(envs.InputError, match="drift of x was"):
            envs.Latent("x", "", 0, 1, drift=wrong)


def test_what_does_not_drift_stays() -> None:
    """Its matrix is the identity; a categorical latent cannot drift."""
    np.testing.assert_array_equal(envs.Latent("x", "m", 1.0, 4.0).transition(5), np.eye(5))
    with pytest.raises(envs.InputError, match=r"drift of x was 0\.1"):
        envs.Latent("x", "", 0, 3, "categorical", 0.1)


def test_what_does_not_drift_stays_beside_what_does() -> None:
    """To the bit, and whatever category it is of."""
    latents = (
        *(envs.Latent("gain", "", 0, 48, "categorical"), envs.Latent("mass", "kg", 0.3, 7.0, "loguniform")),
        *(envs.Latent("wind", "m/s", -0.7, 0.4), envs.Latent("walk", "", 0, 1, drift=0.3)),
    )
    task = type("Mixed", (Push,), {"latents": latents})()
    theta = task.sample_theta(streams(*range(500)))
    later = task.drifted(theta, streams(*range(500)))
    np.testing.assert_array_equal(later[:, :3], theta[:, :3])
    assert (later[:, 3] != theta[:, 3]).all()


def test_thetas_are_those_of_the_trials() -> None:
    """Drawn once more from their seeds, episode by episode; they move, and stay where they may be."""
    task, seen = Walking(), list[Array]()

    class Noting(ExpertAgent):
        def reset(self, rngs: object) -> None:
            super().reset(rngs)  # type: ignore[arg-type]
            seen.append(self.env.theta.copy())

    env = envs.BatchEnv(task, 4)
    run_trials(env, Noting(env, policy.load(envs.get("tilted_cartpole"))), 3, [5, 9])
    np.testing.assert_array_equal(thetas(task, 4, 3, [5, 9]), np.stack(seen, 1))
    assert (np.diff(np.stack(seen, 1), axis=1) != 0).all()
    assert np.abs(seen).max() <= 0.3


def test_the_exact_filter_spreads_between_episodes() -> None:
    """After an episode the belief is sharp; in the next it is the transition's; taken as static, it stays as it was."""
    task = Walking()
    expert = policy.load(envs.get("tilted_cartpole"))
    env = envs.BatchEnv(task, 3)
    env.reset(0)
    for static in (False, True):
        agent = ExactAgent(env, expert, False, 11, static)
        agent.begin(3)
        agent.reset([np.random.default_rng(0)])
        np.testing.assert_allclose(np.exp(agent.log_belief), 1 / 11)
        agent.log_belief = np.log(np.eye(11)[[0, 5, 10]] + 1e-300)
        agent.reset([np.random.default_rng(0)])
        expected = np.eye(11) if static else Grid(env, expert, 11).env.task.transition(11)
        np.testing.assert_allclose(np.exp(agent.log_belief), expected[[0, 5, 10]], atol=1e-12)


class Average(LatentModel):
    """Exact beliefs about theta ~ N(0, 1) from readings theta + N(0, 1), whose sum and number are the memory."""

    def __init__(self, draws: Draws) -> None:
        super().__init__(draws)

    def start(self, n: int) -> Tensor:
        return torch.zeros(len(self.kept), n, 2)

    def update(self, memory: Tensor, step: Batch) -> Tensor:
        return memory + torch.cat([step.next_obs, torch.ones_like(step.next_obs)], -1) * step.mask[..., None]

    def log_next(self, memory: Tensor, step: Batch, draws: Draws) -> Tensor:
        variance = 1 / (1 + memory[..., 1])
        return torch.distributions.Normal(memory[..., 0] * variance, (1 + variance).sqrt()).log_prob(
            step.next_obs[..., 0]
        )

    final_memory = belief = sample = mode = mean = loss = None  # type: ignore[assignment]


@pytest.mark.parametrize("power", [1, 3])
def test_kept_share_is_chosen_without_theta(power: int) -> None:
    """Nearly 1 for constant thetas, 0 for thetas drawn anew at each episode; a share for each seed.

    For thetas of which .2 of the variance is new in each episode, it is a power of what the model says.
    """
    generator, b, e, t = torch.Generator().manual_seed(0), 400, 6, 5
    constant = torch.randn(b, 1, 1, generator=generator).expand(b, e, 1)
    anew = torch.randn(b, e, 1, generator=generator)
    steps = torch.cat([constant[:, :1], 0.45 * torch.randn(b, e - 1, 1, generator=generator)], 1)
    theta = torch.stack([constant, anew, steps.cumsum(1)]).reshape(3, b * e, 1, 1).expand(3, b * e, t, 1)
    readings = theta + torch.randn(theta.shape, generator=generator)
    episodes = Batch(readings, readings, readings, torch.ones(3, b * e, t))
    model = Average(Draws([np.random.default_rng(i) for i in range(3)], "cpu"))
    model.share_power = power
    choose_kept(model, episodes, e, Draws([np.random.default_rng(i) for i in range(3)], "cpu"))
    assert model.kept[0] >= 0.9**power - 1e-6  # .9 is a nat or so from 1
    assert model.kept[1] == 0
    assert 0 < model.kept[2] < 1
    assert torch.isclose(model.kept[2], torch.linspace(0, 1, SHARES) ** power).any()
    before = model.kept.clone()
    choose_kept(model, episodes, 1, Draws([np.random.default_rng(i) for i in range(3)], "cpu"))
    assert torch.equal(model.kept, before)  # trials of one episode do not tell


@pytest.mark.parametrize("kind", ["evidence", "discrete"])
def test_forgetting(kind: str) -> None:
    """A share of 1 leaves the memory as it was, a share of 0 gives the initial one; .5 is in between."""
    draws = Draws([np.random.default_rng(0)], "cpu")
    model = models.new_model(kind, 3, 16, Scales.plain(Signature(2, 1, 0, False), 1), draws).eval()
    step = Batch(draws.normal(4, 2), draws.normal(4, 1), draws.normal(4, 2), torch.ones(1, 4))
    memory = model.update(model.start(4), step)
    assert torch.equal(model.forget(memory), memory) or kind == "discrete"
    torch.testing.assert_close(model.forget(memory), memory)
    model.kept.fill_(0)
    torch.testing.assert_close(model.forget(memory), model.start(4))
    model.kept.fill_(0.5)
    half = model.belief(model.forget(memory))
    if kind == "discrete":
        torch.testing.assert_close(half.sum(-1), torch.ones(1, 4))
        torch.testing.assert_close(half, (whole := model.belief(memory).sqrt()) / whole.sum(-1, keepdim=True))
    assert not torch.allclose(half, model.belief(memory))


def test_agents_forget_between_episodes() -> None:
    """The share that the model says, once an episode has ended and not before."""
    agent = DeconfoundedAgent.new(
        "linear", 3, 16, Scales.plain(Signature(2, 1, 0, False), 1), Draws([np.random.default_rng(0)], "cpu")
    )
    agent.model.kept.fill_(0.5)
    agent.begin(4)
    agent.reset([rng := np.random.default_rng(0)])
    agent.observe(*(rng.uniform(-1, 1, (4, n)).astype(np.float32) for n in (2, 1, 2)), np.ones(4, bool))
    memory = agent._memory.clone()
    agent.reset([rng])
    torch.testing.assert_close(agent.belief()[1], agent.model.belief(agent.model.forget(memory)))
    assert not torch.allclose(agent.belief()[1], agent.model.belief(memory))


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in envs.SUITE if envs.get(name).drifts])
def test_the_static_filter_loses(name: str) -> None:
    """A belief that only ever grows surer: in the last episode of 96 trials it scores .05 less, or lower still."""
    task = envs.get(name)
    expert, env = policy.load(task), envs.BatchEnv(task, 96)
    last = {
        static: run_trials(env, ExactAgent(env, expert, False, 17, static), task.episodes, [0]).returns[:, -1].mean()
        for static in (False, True)
    }
    best = run_trials(env, ExpertAgent(env, expert), task.episodes, [0]).returns[:, -1].mean()
    assert last[True] < last[False] - 0.05 * best
    assert last[False] > 0.9 * best
