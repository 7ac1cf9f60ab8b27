"""The core: equations against numbers by hand, beliefs, data types, and methods on little data."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from safetensors.numpy import save_file
from torch import Tensor

from deconfounded import envs
from deconfounded.benchmarks.engine import benchmark
from deconfounded.benchmarks.engine.catalogue import METHODS
from deconfounded.benchmarks.engine.context import Context
from deconfounded.benchmarks.engine.provider import fit
from deconfounded.deconf.core.agents import LearnedAgent
from deconfounded.deconf.core.beliefs import Belief, EvidenceBelief, ForgettingBelief, InnovationBelief
from deconfounded.deconf.core.data import Batch, Draws, Signature
from deconfounded.deconf.core.dynamics import CodedDynamicsHead
from deconfounded.deconf.core.gru import GruBelief, GruMemory
from deconfounded.deconf.core.latent_model import final_belief
from deconfounded.deconf.core.layers import Linear
from deconfounded.deconf.core.models import DiscreteModel, VariationalModel
from deconfounded.deconf.core.monitor import Monitor
from deconfounded.deconf.core.nets import ActionHead, Embedding, Scales
from deconfounded.deconf.equations import (
    belief_update,
    gaussian_kl,
    imitation_loss,
    imitation_objective,
    inference_loss,
    marginal_loss,
    offline_loss,
    posterior_policy,
    reparametrise,
)
from deconfounded.deconf.exact import PRUNE_BELOW, ExactAgent, Grid
from deconfounded.deconf.methods import deconfounded, deconfounded_offline, memoryless_bc, naive_rnn
from deconfounded.deconf.methods.deconfounded import DeconfoundedConfig
from deconfounded.deconf.methods.deconfounded_offline import OfflineConfig, Synthesis
from deconfounded.deconf.methods.sequence_bc import RecurrentConfig
from deconfounded.envs.streams import Array
from deconfounded.experts import policy
from deconfounded.experts.agent import Agent, ExpertAgent, RandomAgent
from deconfounded.experts.rollout import run_trials
from deconfounded.experts.trials import Trials
from tests.tools import FEW, tiny_preset


def demonstrations(name: str, n: int, episodes: int = 2) -> tuple[Trials, envs.BatchEnv]:
    env = envs.BatchEnv(envs.get(name), n)
    return run_trials(env, ExpertAgent(env, policy.load(env.task)), episodes, seed=1).trials, env


def explorer(name: str, n: int, rng: np.random.Generator, episodes: int = 2) -> deconfounded.Explore:
    def explore(agent: Agent | None) -> Trials:
        env = envs.BatchEnv(envs.get(name), n)
        behaviour = agent or RandomAgent(env.task.action_space)
        return run_trials(env, behaviour, episodes, int(rng.integers(2**31))).trials

    return explore


class TestEquations:
    def test_kl(self) -> None:
        """KL(N(1, 2^2) || N(0, 1)) = (1 + 4 - 1 - 2 log 2) / 2 = 2 - log 2; of equal Gaussians it is 0."""
        ones = torch.ones(1)
        assert gaussian_kl(ones, 2 * ones, 0 * ones, ones).item() == pytest.approx(2 - np.log(2))
        assert gaussian_kl(3 * ones, 2 * ones, 3 * ones, 2 * ones).item() == pytest.approx(0)

    def test_objective(self) -> None:
        """Eq. (1): -1 - 2, the third step came after the end."""
        taken = np.array([True, True, False])
        for after in (-4.0, -np.inf, np.nan):
            assert imitation_objective(np.array([-1.0, -2.0, after]), taken) == -3

    def test_posterior_policy(self) -> None:
        """Eq. (2): half of (.6, .4) and half of (.2, .8)."""
        policy_ = posterior_policy(np.log([[0.5, 0.5]]), np.array([[0.6, 0.4], [0.2, 0.8]]))
        np.testing.assert_allclose(policy_, [[0.4, 0.6]])

    @pytest.mark.parametrize("kind", [np.array, torch.tensor])
    def test_belief_update(self, kind: Callable[[Any], Any]) -> None:
        """Eq. (5): .25 * .5 and .75 * .2 over their sum; Eq. (3): times .1 and .4 of the action as well."""
        belief, dynamics, actions = (kind(np.log(p)) for p in ([0.25, 0.75], [0.5, 0.2], [0.1, 0.4]))
        p_int, p_cond = belief_update(belief, dynamics), belief_update(belief, dynamics, actions)
        np.testing.assert_allclose(np.exp(np.asarray(p_int)), [0.125 / 0.275, 0.15 / 0.275])
        np.testing.assert_allclose(np.exp(np.asarray(p_cond)), [0.0125 / 0.0725, 0.06 / 0.0725])

    def test_offline_loss(self) -> None:
        """Eq. (7): two trajectories of (-1 - 2) + (-3 - 4) and (-1 - 1), KL 5 and 7, beta .5: (12.5 + 5.5) / 2."""
        log_next, log_policy = torch.tensor([[-1.0, -3.0], [-1.0, -9.0]]), torch.tensor([[-2.0, -4.0], [-1.0, -9.0]])
        mask, kl = torch.tensor([[1.0, 1.0], [1.0, 0.0]]), torch.tensor([5.0, 7.0])
        assert offline_loss(log_next, log_policy, kl, 0.5, mask).item() == pytest.approx(9)

    def test_marginal_loss(self) -> None:
        """Footnote 4: .25 * .5 * .5 + .75 * .2 * .1 of one trajectory of two steps; the padding counts for nothing."""
        log_next = torch.tensor([[[0.5, 0.2], [0.5, 0.1], [0.3, 0.3]]]).log()
        loss = marginal_loss(torch.tensor([0.25, 0.75]).log(), log_next, torch.tensor([[1.0, 1.0, 0.0]]))
        assert loss.item() == pytest.approx(-np.log(0.25 * 0.25 + 0.75 * 0.02) / 2)

    def test_losses(self) -> None:
        """Eq. (6) of log p = -1, -3 and KL = 10, 20 with beta .1: -((-1 - 1) + (-3 - 2)) / 2 = 3.5."""
        loss = inference_loss(torch.tensor([-1.0, -3.0]), torch.tensor([10.0, 20.0]), 0.1, torch.ones(2))
        assert loss.item() == pytest.approx(3.5)
        half = inference_loss(torch.tensor([-1.0, -3.0]), torch.tensor([10.0, 20.0]), 0.1, torch.tensor([1.0, 0.0]))
        assert half.item() == pytest.approx(2)
        assert imitation_loss(torch.tensor([-1.0, -3.0]), torch.ones(2)).item() == pytest.approx(2)

    def test_reparametrise(self) -> None:
        """Mean and std within 4 standard errors of 40,000 draws, and gradients flow to both."""
        mean, std = torch.full((40_000,), 2.0, requires_grad=True), torch.full((40_000,), 3.0, requires_grad=True)
        drawn = reparametrise(mean, std, torch.randn(40_000, generator=torch.Generator().manual_seed(0)))
        assert abs(drawn.mean().item() - 2) < 4 * 3 / 200
        assert abs(drawn.std().item() - 3) < 4 * 3 / 200 / np.sqrt(2)
        drawn.sum().backward()
        assert mean.grad is not None
        assert std.grad is not None


@pytest.mark.parametrize("kind", [InnovationBelief, EvidenceBelief, ForgettingBelief, GruBelief])
@pytest.mark.parametrize("name", ["bandit", "slippery_cartpole"])
class TestBeliefs:
    def make(self, kind: type[Belief], name: str) -> tuple[Belief, Batch, Trials]:
        trials, _ = demonstrations(name, 6)
        data = Batch.of(trials, 2)
        draws = Draws([np.random.default_rng(i) for i in range(2)], "cpu")
        belief = kind(3, 32, Scales.of(Signature.of(trials), data), draws)  # type: ignore[call-arg, arg-type]
        belief(data)  # as in training, for running means that are not those of the start
        return belief.eval(), data, trials

    def test_one_step_at_a_time_equals_all_at_once(self, kind: type[Belief], name: str) -> None:
        belief, data, _ = self.make(kind, name)
        memory = belief.start(len(data))
        memories = [memory]
        for t in range(data.mask.shape[2]):
            memory = belief.update(memory, data[:, :, t])
            memories.append(memory)
        real = torch.cat([torch.ones_like(data.mask[..., :1]), data.mask], 2) == 1
        torch.testing.assert_close(torch.stack(memories, 2)[real], belief(data)[real], rtol=1e-4, atol=1e-4)

    def test_masked_steps_change_nothing(self, kind: type[Belief], name: str) -> None:
        belief, data, _ = self.make(kind, name)
        step = data[:, :, 0]
        step.mask = torch.zeros_like(step.mask)
        memory = belief(data)[:, :, 3]
        torch.testing.assert_close(belief.update(memory, step), memory)

    def test_order(self, kind: type[Belief], name: str) -> None:
        """The evidence belief does not depend on the order of transitions; the GRU's does (so the check can fail)."""
        belief, data, _ = self.make(kind, name)
        shortest = int(data.mask.sum(2).min())
        turned = data[:, :, torch.arange(shortest - 1, -1, -1)]
        mean, _ = belief.posterior(belief(data[:, :, :shortest])[:, :, -1])
        mean_turned, _ = belief.posterior(belief(turned)[:, :, -1])
        same = torch.allclose(mean, mean_turned, atol=1e-4)
        assert same == (kind in (InnovationBelief, EvidenceBelief))

    def test_hindsight(self, kind: type[Belief], name: str) -> None:
        """A memory of whole trials, each of whose steps counts the less the further it is from where theta is asked."""
        belief, data, _ = self.make(kind, name)
        memory, steps = belief.hindsight(data, belief(data)), data.mask.shape[2]
        if not isinstance(belief, ForgettingBelief):
            torch.testing.assert_close(memory, belief(data)[:, :, -1:])
            return
        terms = belief._terms(data)
        apart = (torch.arange(steps)[:, None] - torch.arange(steps)).abs()
        weights = [kept**apart for kept in (1.0, *belief.KEPT)]
        expected = torch.cat([torch.einsum("tu,sbuf->sbtf", weight, terms) for weight in weights], -1)
        torch.testing.assert_close(memory, expected, rtol=1e-3, atol=2e-3)


def _bandit_batch(n: int) -> tuple[Batch, Scales, Draws]:
    trials, _ = demonstrations("bandit", n, episodes=1)
    batch, draws = Batch.of(trials, 1), Draws([np.random.default_rng(0)], "cpu")
    return batch, Scales.of(Signature.of(trials), batch), draws


def test_products_keep_float32() -> None:
    """However torch was told to multiply: bfloat16's error would be near .1."""
    generator = torch.Generator().manual_seed(0)
    a, b = torch.randn(2, 100, 256, generator=generator), torch.randn(2, 256, 768, generator=generator)
    assert (torch.bmm(a, b) - torch.bmm(a.double(), b.double())).abs().max() < 3e-4


def test_one_bit_is_embedded_as_any_observation() -> None:
    """The two embeddings of a binary observation are those that the network gives row by row."""
    batch, scales, draws = _bandit_batch(8)
    embedding = Embedding(16, scales, draws)
    torch.testing.assert_close(
        embedding.obs(batch.obs), embedding.embed_obs(scales.obs(batch.obs)), rtol=1e-5, atol=1e-6
    )


def test_gru_remembers_before_training() -> None:
    """Memories of histories that differ in the first 10 steps differ after 30 more; with torch's gates they do not."""
    batch, scales, draws = _bandit_batch(8)
    other = Batch(*(x.clone() for x in batch.tensors))
    other.action[:, :, :10] = (other.action[:, :, :10] + 1) % 5
    remaining = {}
    ours, torchs = (GruMemory(64, scales, draws) for _ in range(2))
    for layer in (module for module in torchs.modules() if isinstance(module, Linear)):
        bound = layer.weight.shape[1] ** -0.5
        for parameter in layer.parameters():
            parameter.data = (2 * draws.uniform(*parameter.shape[1:]) - 1) * bound
    for name, memory in (("ours", ours), ("torch", torchs)):
        runs = [memory(x, memory.start(8)) for x in (batch, other)]
        gap = (runs[0] - runs[1]).norm(dim=-1).mean((0, 1))
        remaining[name] = (gap[40] / gap[10]).item()
    assert remaining["ours"] > 0.2
    assert remaining["torch"] < 0.02


@pytest.mark.parametrize("name", ["bandit", "slippery_cartpole"])
def test_discrete_belief_one_step_at_a_time(name: str) -> None:
    """Bayes' rule step by step gives the posterior of the whole trial, which is not the prior."""
    trials, _ = demonstrations(name, 6)
    data = Batch.of(trials, 2)
    scales = Scales.of(Signature.of(trials), data)
    model = DiscreteModel(4, 16, scales, Draws([np.random.default_rng(i) for i in range(2)], "cpu"))
    with torch.no_grad():
        memory = model.start(len(data))
        for t in range(data.mask.shape[2]):
            memory = model.update(memory, data[:, :, t])
        torch.testing.assert_close(memory, model.final_memory(data), rtol=1e-3, atol=1e-3)
        assert (memory - model.start(len(data))).abs().max() > 0.1


def test_discrete_models_differ_by_their_codes_alone() -> None:
    """Of model k the mean is f + G e_k: of an empty code it is f, and of two codes the mean is in the middle."""
    trials, _ = demonstrations("slippery_cartpole", 4)
    data = Batch.of(trials, 2)
    draws = Draws([np.random.default_rng(i) for i in range(2)], "cpu")
    head = DiscreteModel(4, 16, Scales.of(Signature.of(trials), data), draws).dynamics
    assert isinstance(head, CodedDynamicsHead)
    with torch.no_grad():
        head.codes[..., 0] = 0
        head.codes[..., 1] = (head.codes[..., 2] + head.codes[..., 3]) / 2
        mean, (common, _) = head(data.obs, data.action), head.parts(data.obs, data.action)
    torch.testing.assert_close(mean[..., 0, :], common)
    torch.testing.assert_close(mean[..., 1, :], (mean[..., 2, :] + mean[..., 3, :]) / 2)
    assert (mean[..., 2, :] - mean[..., 3, :]).abs().max() > 0.1


def test_discrete_loss_splits_trials_into_histories() -> None:
    """Six steps, of which the second trial has four: histories of 1, 2, 4 and 8 steps, every so many steps apart."""
    draws = Draws([np.random.default_rng(0)], "cpu")
    trials, _ = demonstrations("slippery_cartpole", 2)
    data, signature = Batch.of(trials, 1)[:, :, :6], Signature.of(trials)
    data.mask[0, 1, 4:] = 0
    model = DiscreteModel(3, 16, Scales.of(signature, data), draws)
    with torch.no_grad():
        log_next = model.dynamics.log_prob(data.obs, data.action, data.next_obs)[0].double().numpy()
        loss = model.loss(data, None, 0.0, draws).item()
    splits = [[[0], [1], [2], [3], [4], [5]], [[0, 4], [1, 5], [2], [3]], [[0, 2, 4], [1, 3, 5]], [[0, 1, 2, 3, 4, 5]]]
    totals = []
    for histories in splits:
        real = [(trial, [t for t in steps if t < (6, 4)[trial]]) for trial in (0, 1) for steps in histories]
        totals.append(sum(np.log(np.exp(log_next[trial, steps].sum(0)).mean()) for trial, steps in real))
    assert loss == pytest.approx(-np.mean(totals) / 10, rel=1e-5)


def test_synthetic_actions_are_blind_to_the_latent_of_the_dynamics() -> None:
    """Tier 1: two latents with the same dynamics, a policy that pulls its latent's arm: no correlation of the two."""
    trials, _ = demonstrations("bandit", 6, 1)
    data = Batch.of(trials, 1)
    scales = Scales.of(Signature.of(trials), data)
    draws = Draws([np.random.default_rng(0)], "cpu")
    model = VariationalModel("evidence", 1, 8, scales, draws)
    policy_ = ActionHead(2, 8, scales, draws)
    with torch.no_grad():
        for layer in (policy_.net[0], policy_.net[2]):
            layer.weight.zero_()
            layer.bias.zero_()
        policy_.net[0].weight[0, 1, :2] = torch.tensor([1.0, -1.0])  # reads the latent's sign
        policy_.net[2].weight[0, :2, :2] = torch.eye(2)
        policy_.net[4].weight.zero_()
        policy_.net[4].bias.zero_()
        policy_.net[4].weight[0, :2, :2] = 50 * torch.eye(2)
        model.dynamics.net[4].weight.zero_()
        model.dynamics.net[0].weight[0, -1] = 1.0
    latents = torch.tensor([[[-1.0], [1.0]]])
    taken: list[Tensor] = []
    sample = model.dynamics.sample

    def spy(obs: Tensor, action: Tensor, theta_hat: Tensor, draws: Draws) -> Tensor:
        taken.append(torch.stack([action[0, :, 0], (theta_hat[0, :, 0] < 0).float()]))
        return sample(obs, action, theta_hat, draws)

    model.dynamics.sample = spy  # type: ignore[method-assign]
    Synthesis(model, policy_, latents, data, data.obs[:, :, 0], 2, 0.0, draws)(400)
    action, wanted = taken[0]
    assert set(action.tolist()) == {0.0, 1.0}  # the policy does read its latent
    assert abs(np.corrcoef(action, wanted)[0, 1]) < 4 / np.sqrt(400)


@pytest.mark.parametrize(("asked", "read"), [(4, 4), (50, 10)])
def test_eq_7_reads_drawn_steps(asked: int, read: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A random subset of each trial's steps, or all of them, weighted to the trial's length; another at each update."""
    seen: list[Tensor] = []
    weights: list[Tensor] = []
    betas: list[float] = []

    def final_memory(self: VariationalModel, batch: Batch) -> Tensor:
        seen.append(batch.obs[0, 0, :, 0])
        return self.encoder(batch)[:, :, -1]

    def loss(log_next: Tensor, log_policy: Tensor, kl: Tensor, beta: float, weight: Tensor) -> Tensor:
        weights.append(weight)
        betas.append(beta)
        return offline_loss(log_next, log_policy, kl, beta, weight)

    monkeypatch.setattr(VariationalModel, "final_memory", final_memory)
    monkeypatch.setattr(deconfounded_offline, "offline_loss", loss)
    step = np.tile(np.arange(11, dtype="f4"), (3, 1, 1))[..., None]
    trials = Trials(step, np.zeros((3, 1, 10, 1), "f4"), np.ones((3, 1, 10), bool))
    draws = Draws([np.random.default_rng(0)], "cpu")
    config = OfflineConfig(width=8, offline_beta=0.3, offline_updates=3, offline_batch=2, offline_steps=asked)
    deconfounded_offline.explain(Batch.of(trials, 1), Signature.of(trials), config, draws, Monitor())
    assert [len(set(steps.tolist())) for steps in seen] == [read] * 3
    assert betas == [0.3] * 3
    assert (len({tuple(sorted(steps.tolist())) for steps in seen}) > 1) == (read < 10)
    assert all(weight.sum(-1).tolist() == [[pytest.approx(10)] * 2] for weight in weights)


def test_synthetic_episodes_end_outside_the_expert_range() -> None:
    """Tier 1: an episode ends where it leaves the range of the expert's observations, of which padding is no part."""
    trials, _ = demonstrations("tilted_cartpole", 4)
    signature, draws = Signature.of(trials), Draws([np.random.default_rng(s) for s in (0, 1)], "cpu")
    obs = trials.obs.copy()
    mask = trials.mask.copy()
    mask[:, :, -2:], obs[:, :, -2:] = False, 1e3  # padding
    trials = Trials(obs, trials.action, mask)
    data, starts = Batch.of(trials, 2), torch.tensor(obs[:, :, 0]).reshape(2, -1, signature.obs)
    scales = Scales.of(signature, data)
    model = VariationalModel("evidence", 1, 8, scales, draws)
    policy_, latents = ActionHead(signature.obs + 1, 8, scales, draws), torch.zeros(2, 2, 1)
    synthetic, _ = Synthesis(model, policy_, latents, data, starts, mask.shape[2], 0.1, draws)(8)
    for s, own in enumerate(np.split(trials.obs[:, :, :-3], 2)):
        low, high = own.min((0, 1, 2)), own.max((0, 1, 2))
        acted, then = synthetic.obs[s].numpy(), synthetic.next_obs[s].numpy()
        left = ((then < low) | (then > high)).any(-1)[:, :-1]
        ended = (acted[:, 1:] != then[:, :-1]).any(-1)
        horizons = np.arange(1, acted.shape[1]) % mask.shape[2] == 0
        assert 0.01 < left.mean() < 0.9
        assert (ended == left | horizons).all()
        starts = {tuple(start) for start in own[:, :, 0].reshape(-1, signature.obs)}
        assert {tuple(start) for start in acted[:, 1:][ended]} <= starts


@pytest.mark.parametrize("values", [(3.0, 3.0), (0.0, 1.0)])
def test_synthetic_episodes_have_a_constant_column_and_a_flag(values: tuple[float, float]) -> None:
    """Both have the values that they had, and end no episode."""
    trials, _ = demonstrations("tilted_cartpole", 4)
    column = np.random.default_rng(0).choice(np.float32(values), trials.obs[..., :1].shape)
    column[:, :, 1:][~trials.mask] = 7  # padding
    obs = np.concatenate([trials.obs, column], -1)
    trials = Trials(obs, trials.action, trials.mask)
    signature, draws = Signature.of(trials), Draws([np.random.default_rng(0)], "cpu")
    data, starts = Batch.of(trials, 1), torch.tensor(obs[:, :, 0]).reshape(1, -1, signature.obs)
    scales = Scales.of(signature, data)
    model = VariationalModel("evidence", 1, 8, scales, draws)
    policy_, latents = ActionHead(signature.obs + 1, 8, scales, draws), torch.zeros(1, 2, 1)
    synthetic, _ = Synthesis(model, policy_, latents, data, starts, trials.mask.shape[2], 0.1, draws)(8)
    assert {*synthetic.next_obs[..., -1].flatten().tolist()} == {*values}
    ended = (synthetic.obs[0, :, 1:] != synthetic.next_obs[0, :, :-1]).any(-1)
    assert ended.float().mean() < 0.9


class TestTrials:
    def test_shapes_and_values_are_enforced(self) -> None:
        trials, _ = demonstrations("slippery_cartpole", 3)
        with pytest.raises(envs.InputError, match="must be"):
            Trials(trials.obs[:, :, :-1], trials.action, trials.mask)
        broken = trials.obs.copy()
        broken[0, 0, 0, 0] = np.nan
        with pytest.raises(envs.InputError, match="NaN"):
            Trials(broken, trials.action, trials.mask)
        with pytest.raises(ValueError, match="read-only"):
            trials.obs[0] = 0

    def test_save_and_load(self, tmp_path: Path) -> None:
        trials, _ = demonstrations("bandit", 3)
        trials.save(tmp_path / "trials.npz")
        again = Trials.load(tmp_path / "trials.npz")
        np.testing.assert_array_equal(again.obs, trials.obs)
        assert again.actions == trials.actions == 5
        (tmp_path / "trials.npz").write_bytes(b"no zip")
        with pytest.raises(envs.InputError, match="no trials"):
            Trials.load(tmp_path / "trials.npz")

    def test_ended_episodes_are_left_out(self) -> None:
        """Batch holds just the steps that took place, in order, each with its own successor."""
        env = envs.BatchEnv(envs.get("slippery_cartpole"), 8)
        trials, returns, _ = run_trials(env, RandomAgent(env.task.action_space), 3, seed=0)
        data = Batch.of(trials, 2)
        assert 0 < trials.mask.mean() < 0.5
        assert data.mask.sum() == trials.mask.sum()
        taken = data[1, 2].mask.bool()  # trial 2 of seed 1 is number 6
        assert (taken.float().diff() <= 0).all()
        np.testing.assert_array_equal(data.obs[1, 2][taken], trials.obs[6, :, :-1][trials.mask[6]])
        np.testing.assert_array_equal(data.next_obs[1, 2][taken], trials.obs[6, :, 1:][trials.mask[6]])
        drawn = data.draw_steps(500, Draws([np.random.default_rng(i) for i in range(2)], "cpu"))
        assert data.steps(drawn).mask.all()
        assert len(drawn[0].unique()) > 0.4 * data.mask[0].sum()
        assert (returns <= trials.mask.sum(-1)).all()  # at most one a step, none after the end


class TestExact:
    @pytest.mark.parametrize("name", ["tilted_cartpole", "slippery_cartpole"])
    def test_posterior_finds_theta(self, name: str) -> None:
        """After one episode the interventional posterior of 16 trials holds theta: 90% of its mass within a tenth."""
        env = envs.BatchEnv(envs.get(name), 16)
        agent = ExactAgent(env, policy.load(env.task), conditional=False, k=21)
        run_trials(env, agent, 2, seed=0)
        latent = env.task.latents[0]
        near = np.abs(latent.cdf(agent.grid.theta[:, 0])[None] - latent.cdf(env.theta)) < 0.1
        assert (np.exp(agent.log_belief) * near).sum(-1).mean() > 0.9

    def test_conditional_believes_its_first_guess(self) -> None:
        """The delusion: the conditional posterior is sure after ten steps, and far from theta more often than not."""
        env = envs.BatchEnv(envs.get("tilted_cartpole"), 32)
        agent = ExactAgent(env, policy.load(env.task), conditional=True, k=21)
        run_trials(env, agent, 1, seed=0)
        belief = np.exp(agent.log_belief)
        latent = env.task.latents[0]
        near = np.abs(latent.cdf(agent.grid.theta[:, 0])[None] - latent.cdf(env.theta)) < 0.1
        assert belief.max(-1).mean() > 0.8
        assert (belief * near).sum(-1).mean() < 0.6

    @pytest.mark.slow
    @pytest.mark.parametrize("conditional", [False, True])
    def test_pruned_values(self, conditional: bool) -> None:
        """In the agent's trials its belief is that of the full grid, to .01 in total variation on average.

        A small share of the grid is simulated. Where nothing is pruned, the bits are those of the full grid.
        """
        env = envs.BatchEnv(envs.get("tilted_cartpole"), 24)
        agent = ExactAgent(env, policy.load(env.task), conditional, k=21)
        grid, gaps, simulated = agent.grid, [], []
        log_dynamics, outcome = grid.log_dynamics, grid._simulator.outcome

        def spy(state: Array, action: Array, next_state: Array, log_belief: Array | None = None) -> Array:
            whole = log_dynamics(state, action, next_state)
            simulated.clear()
            pruned = log_dynamics(state, action, next_state, log_belief)
            assert log_belief is not None
            shares.append(simulated[0] / whole.size)
            if (log_belief == log_belief[:1, :1]).all():
                np.testing.assert_array_equal(pruned, whole)
            beliefs = [np.exp(belief_update(log_belief, x)) for x in (pruned, whole)]
            gaps.append(np.abs(beliefs[0] - beliefs[1]).sum(-1).mean() / 2)
            return pruned

        def count(state: Array, action: Array, rows: Any = None) -> Array:
            simulated.append(len(state))
            return outcome(state, action, rows)

        shares: list[float] = []
        grid.log_dynamics = spy  # type: ignore[method-assign]
        grid._simulator.outcome = count  # type: ignore[method-assign]
        run_trials(env, agent, 2, seed=0)
        assert np.mean(gaps) < 0.01
        assert shares[0] == 1
        assert np.mean(shares) < (0.15 if conditional else 0.4)

    def test_pruned_values_come_back(self) -> None:
        """Thirty steps under one theta, then many under another, which had been pruned: in the end it has the mass."""
        task = envs.get("tilted_cartpole")
        env = envs.BatchEnv(task, 16)
        grid = Grid(env, policy.load(task), 21)
        env.reset(0, {"theta": task.theta_grid(21)[4]})
        belief = grid.prior(16)
        agent = RandomAgent(task.action_space)
        agent.reset([np.random.default_rng(0)])
        for t in range(400):
            if t == 30:
                for i in range(16):
                    env.simulator.set_theta(i, task.theta_grid(21)[14])
            if not env.alive.all():
                env.reset(options={"keep_theta": True}, where=~env.alive)
            state, action = env.state.copy(), agent.act(env.observe())
            env.step(action)
            belief = belief_update(belief, grid.log_dynamics(state, action, env.state, belief))
            if t == 29:
                assert np.median(np.exp(belief)[:, 14]) < PRUNE_BELOW
        assert np.exp(belief)[:, 13:16].sum(-1).mean() > 0.9

    def test_probe_reads_the_posterior(self) -> None:
        """R^2 of theta in the exact interventional belief after an episode is near 1; in noise it is not."""
        env = envs.BatchEnv(envs.get("tilted_cartpole"), 64)
        agent = ExactAgent(env, policy.load(env.task), conditional=False, k=21)
        run_trials(env, agent, 1, seed=0)
        theta = env.task.encode_theta(env.theta)
        assert agent.features().shape == (64, 1)
        assert benchmark.probe(agent.features(), theta)[0] > 0.95
        assert benchmark.probe(np.random.default_rng(0).standard_normal((64, 1)), theta)[0] < 0.3

    def test_a_probe_is_judged_by_the_other_half(self) -> None:
        """Where features have the other sign R^2 is 1 - 4, though in the first half they are theta itself."""
        theta = np.random.default_rng(0).standard_normal((200, 1))
        features = np.where(np.arange(200)[:, None] < 100, theta, -theta)
        assert benchmark.probe(features, theta)[0] == pytest.approx(-3, abs=0.5)

    def test_probe_of_many_features(self) -> None:
        """With as many features as trials: R^2 is near 0 for noise, and near 1 for a few good features among noise."""
        rng = np.random.default_rng(0)
        theta, noise = rng.standard_normal((128, 1)), rng.standard_normal((128, 64))
        good = np.c_[noise[:, 16:], theta + 0.3 * rng.standard_normal((128, 16))]
        assert -0.2 < benchmark.probe(noise, theta)[0] < 0.2
        assert benchmark.probe(good, theta)[0] > 0.8
        rare = np.r_[1e-40 * rng.random((64, 1)), rng.random((64, 1)) < 0.1]  # such as p(k) of a rare k
        assert benchmark.probe(np.c_[good, rare], theta)[0] > 0.8


class TestMethods:
    """Methods learn from little data; margins are wide, seeds fixed."""

    @pytest.mark.slow
    def test_bandit_oracle_and_blind(self) -> None:
        trials, env = demonstrations("bandit", 500, 1)
        encode, config = env.task.encode_theta, memoryless_bc.MemorylessConfig(updates=300)
        score = envs.BatchEnv(env.task, 500)
        rng = np.random.default_rng
        oracle = memoryless_bc.train(trials, config, rng(0), encode(env.theta)[:, None], lambda: encode(score.theta))
        blind = memoryless_bc.train(trials, config, rng(0))
        assert run_trials(score, oracle, 1, 3).returns.mean() == pytest.approx(60, abs=2)
        assert run_trials(score, blind, 1, 3).returns.mean() == pytest.approx(20, abs=2)

    @pytest.mark.slow
    def test_naive_rnn_is_deluded(self) -> None:
        """Good on the expert's history, bad on its own: it beats blind cloning (20), and misses the exact 54."""
        trials, env = demonstrations("bandit", 1000, 1)
        config = RecurrentConfig(updates=250, batch=50, chunk=50, learning_rate=5e-3)
        agent = naive_rnn.train(trials, config, np.random.default_rng(0))
        assert 22 < run_trials(envs.BatchEnv(env.task, 500), agent, 1, 3).returns.mean() < 42

    @pytest.mark.slow
    @pytest.mark.parametrize("kind", ["linear", "innovations", "evidence", "forgetting", "gru", "discrete"])
    def test_deconfounded_runs_and_repeats(self, kind: str) -> None:
        """The same seed gives the same agent, and neither training nor acting touches torch's global generator."""
        trials, env = demonstrations("slippery_cartpole", 8)
        config = deconfounded.DeconfoundedConfig(
            model=kind,  # type: ignore[arg-type]
            rounds=2,
            inference_updates=3,
            inference_batch=4,
            imitation_updates=3,
            final_updates=3,
        )
        state = torch.get_rng_state()
        agents = [
            deconfounded.train(trials, explorer("slippery_cartpole", 4, rng), config, rng)
            for rng in (np.random.default_rng(0), np.random.default_rng(0))
        ]
        first, second = (run_trials(env, agent, 2, 5).trials.action for agent in agents)
        np.testing.assert_array_equal(first, second)
        assert torch.equal(torch.get_rng_state(), state)

    @pytest.mark.slow
    @pytest.mark.parametrize("name", ["bandit", "slippery_cartpole"])
    @pytest.mark.parametrize(
        "method",
        [name for name, about in METHODS.items() if about.learned and name != "deconfounded_gru"] + ["paper"],
    )
    def test_seeds_do_not_touch_each_other(self, name: str, method: str, monkeypatch: pytest.MonkeyPatch) -> None:
        """A seed's agent acts alike, bit for bit, trained alone and as the second of three."""
        monkeypatch.setattr(type(envs.get(name)), "horizon", 12)  # fewer steps than that hide products of a stack
        settings = tiny_preset()
        if method == "paper":  # deconfounded as in that preset: its belief, fresh trials each round
            method = "deconfounded"
            settings = replace(settings, fresh=4).configured("deconfounded", model="gru", accumulate=False)
        task, actions = envs.get(name), []
        for seeds in ((5,), (4, 5, 6)):
            context = Context(task, settings, seeds)
            agent = fit(context, method)
            trials = run_trials(context.env, agent, task.episodes, list(seeds)).trials
            actions.append(trials.action[4:8] if len(seeds) > 1 else trials.action)
        np.testing.assert_array_equal(*actions)

    def test_changes_are_scaled_by_all_data(self) -> None:
        """Expert trials may change a hundred times as much in a step as exploration: the model's targets stay small."""
        rng = np.random.default_rng(0)
        slow, fast = (
            Trials(step * rng.standard_normal((8, 1, 21, 2)), np.zeros((8, 1, 20, 1)), np.ones((8, 1, 20), bool))
            for step in (0.01, 1.0)
        )
        config = DeconfoundedConfig(rounds=1, inference_updates=1, imitation_updates=1, final_updates=1)
        model = deconfounded.train(fast, lambda agent: slow, config, rng).model
        data = Batch.of(fast, 1)
        assert 0.5 < model.dynamics.change(data.next_obs - data.obs).std() < 2

    def test_updates_of_a_restart(self) -> None:
        """Half of all inference updates are the last round's, the others' share is equal; a single round has all."""
        config = DeconfoundedConfig(rounds=5, inference_updates=20, restart=True)
        assert config.inference_by_round() == [12, 12, 12, 12, 50]
        assert replace(config, rounds=1).inference_by_round() == [20]
        assert replace(config, restart=False).inference_by_round() == [20] * 5

    def test_a_restart_warms_up_anew(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """beta rises over half of the updates of the first networks, and again over half of those of the new ones."""
        trials, _ = demonstrations("slippery_cartpole", 4)
        betas, learn = list[float](), VariationalModel.learn
        spy = lambda self, *given: (betas.append(given[3]), learn(self, *given))[1]  # noqa: E731
        monkeypatch.setattr(VariationalModel, "learn", spy)
        changed = {**FEW, "model": "evidence", "rounds": 2, "inference_updates": 4, "beta": 1.0, "warm_up": 0.5}
        deconfounded.train(
            trials, lambda agent: trials, DeconfoundedConfig(**changed, restart=True), np.random.default_rng(0)
        )
        assert betas == [0, 0.5, 1, 1] * 2

    @pytest.mark.parametrize("restart", [False, True])
    def test_a_restart_renews_networks(self, restart: bool) -> None:
        """Weights after the last round have as much to do with those before it as those of a network drawn anew."""
        trials, _ = demonstrations("slippery_cartpole", 4)
        config = DeconfoundedConfig(**FEW, restart=restart)
        before: list[dict[str, NDArray[Any]]] = []

        def explore(agent: Agent | None) -> Trials:
            if isinstance(agent, LearnedAgent):
                before.append(agent.state()[1])
            return trials

        after = deconfounded.train(trials, explore, config, np.random.default_rng(0)).state()[1]
        (early,) = before
        for network in ("model.dynamics.gains", "model.reader", "policy", "online.net"):
            key = max((key for key in after if key.startswith(network)), key=lambda key: after[key].size)
            alike = np.corrcoef(early[key].ravel(), after[key].ravel())[0, 1]
            assert abs(alike) < 0.2 if restart else alike > 0.9, key

    @pytest.mark.slow
    def test_deconfounded_learns_from_physics(self) -> None:
        """A minute's budget cut to seconds: after training, the belief tells thetas apart on expert trials."""
        trials, env = demonstrations("tilted_cartpole", 48)
        theta = env.theta[:, 0].copy()
        config = deconfounded.DeconfoundedConfig(
            **{"rounds": 2, "inference_updates": 150, "inference_batch": 8, "inference_rate": 3e-3, "latent": 2},
            **{"imitation_updates": 100, "final_updates": 100},
        )
        rng = np.random.default_rng(0)
        agent = deconfounded.train(trials, explorer("tilted_cartpole", 32, rng), config, rng)
        mean = agent.model.mean(final_belief(agent.model, Batch.of(trials, 1)))[0]
        inputs = np.c_[mean.numpy(), np.ones(len(mean))]
        residual = theta - inputs @ np.linalg.lstsq(inputs, theta, rcond=None)[0]
        assert 1 - (residual**2).mean() / theta.var() > 0.5


class TestWeights:
    def test_missing_damaged_and_wrong(self, tmp_path: Path) -> None:
        task = envs.get("slippery_cartpole")
        file = tmp_path / "none.safetensors"
        remedy = f"`deconf train --task slippery_cartpole --out {file}` makes such a file"
        with pytest.raises(envs.InputError, match=re.escape(f"no expert weights at {file}; {remedy}")):
            policy.load(task, file)
        (tmp_path / "bad.safetensors").write_bytes(b"\x80\x04not safetensors")
        with pytest.raises(envs.InputError, match="damaged"):
            policy.load(task, tmp_path / "bad.safetensors")
        layer = {"0.weight": np.zeros((4, 2), np.float32), "0.bias": np.zeros(4, np.float32)}
        save_file(layer, tmp_path / "narrow.safetensors")
        with pytest.raises(envs.InputError, match="takes 2 inputs, not 7"):
            policy.load(task, tmp_path / "narrow.safetensors")
        layer["0.weight"] = np.zeros((4, 7), np.float32)
        save_file(layer, tmp_path / "wide.safetensors")
        with pytest.raises(envs.InputError, match="give 4 actions, not 1"):
            policy.load(task, tmp_path / "wide.safetensors")
        layer["0.weight"][0, 0] = np.nan
        save_file(layer, tmp_path / "odd.safetensors")
        with pytest.raises(envs.InputError, match="holds NaN or infinity"):
            policy.load(task, tmp_path / "odd.safetensors")
        save_file({"0.weight": np.zeros((4, 2), np.float32)}, tmp_path / "small.safetensors")
        with pytest.raises(envs.InputError, match="lack a whole layer 0"):
            policy.load(task, tmp_path / "small.safetensors")
