"""Theta does not leak, and protocols do not change: each test fails on a fault that others had not noticed."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch.distributions import Normal, kl_divergence

from deconfounded import envs
from deconfounded.benchmarks.engine.benchmark import evaluate
from deconfounded.benchmarks.engine.context import DEMOS, EVALUATION, EXPLORATION, Context, stream
from deconfounded.benchmarks.engine.provider import fit
from deconfounded.deconf.core.agents import LearnedAgent
from deconfounded.deconf.core.data import Batch, Draws, Signature
from deconfounded.deconf.core.deployment import deployments
from deconfounded.deconf.core.latent_agent import DeconfoundedAgent
from deconfounded.deconf.core.latent_model import LatentModel, final_belief
from deconfounded.deconf.core.models import VariationalModel, new_model
from deconfounded.deconf.core.nets import ActionHead, Scales
from deconfounded.deconf.methods import (
    dadp,
    dagger,
    deconfounded,
    deconfounded_mean,
    deconfounded_offline,
    dml_il,
    dpt,
    flow_bc,
    gail,
    naive_obs,
    naive_rnn,
    naive_transformer,
    palr,
)
from deconfounded.envs.contract.probe import actions, streams
from deconfounded.envs.streams import Array
from deconfounded.experts import policy
from deconfounded.experts.agent import ExpertAgent, RandomAgent
from deconfounded.experts.policy import NetworkExpert
from deconfounded.experts.rollout import run_trials
from deconfounded.experts.sb3 import Sb3VecEnv
from deconfounded.experts.trials import Trials
from tests.tools import tiny_preset

TASKS = envs.names()
CONTROL = "slippery_cartpole"


@pytest.mark.parametrize("name", TASKS)
class TestEnvironments:
    def test_vector_infos_are_empty(self, name: str) -> None:
        task = envs.get(name)
        vec = envs.make_vec(name, 3)
        assert vec.reset(seed=0)[1] == {}
        for action in actions(task, 3, task.horizon + 3):  # over autoresets
            assert vec.step(action[:, 0].astype(int) if task.n_actions else action)[4] == {}

    def test_observations_are_those_of_the_state(self, name: str) -> None:
        """Bit for bit, at every step: `observe` is given the state, and never theta."""
        task = envs.get(name)
        batch, space = envs.BatchEnv(task, 8), task.observation_space
        obs = batch.reset(0)
        for action in actions(task, 8, task.horizon):
            expected = np.clip(task.observe(batch.state).astype(np.float32), space.low, space.high)
            np.testing.assert_array_equal(obs, expected)
            obs = batch.step(action)[0]

    @pytest.mark.slow
    def test_every_trial_of_sb3_has_its_own_theta(self, name: str) -> None:
        """Episode number e of environment i has theta number e of that environment's own stream, until it switches."""
        task = envs.get(name)
        vec = Sb3VecEnv(task, 3, seed=4)
        vec.reset()
        drawn = [streams(np.random.SeedSequence(4 + i).spawn(3)[0]) for i in range(3)]  # type: ignore[arg-type]
        expected, compared, resets = np.concatenate([task.sample_theta(one) for one in drawn]), np.ones(3, bool), 0
        for action in actions(task, 3, 2 * task.horizon + 2):
            np.testing.assert_array_equal(vec.env.batch.theta[compared], expected[compared])
            vec.step_async(action)
            done = vec.step_wait()[2]
            for i in np.flatnonzero(done):
                expected[i] = task.sample_theta(drawn[i])[0]
                resets += 1
            compared = done if task.switches else compared
        assert resets >= 6

    @pytest.mark.slow
    def test_dead_environments_stand_still(self, name: str) -> None:
        """What has ended is not stepped, earns nothing, and is as it was."""
        task = envs.get(name)
        batch = envs.BatchEnv(task, 32)
        batch.reset(0)
        for action in actions(task, 32, task.horizon + 2):
            dead, state = ~batch.alive, batch.state
            _, reward, terminated, truncated = batch.step(action)
            np.testing.assert_array_equal(batch.state[dead], state[dead])
            assert not np.any([reward[dead], terminated[dead], truncated[dead]])
            assert not batch.alive[dead].any()


@pytest.mark.parametrize("name", [name for name in TASKS if isinstance(policy.load(envs.get(name)), NetworkExpert)])
def test_expert_density_is_one(name: str) -> None:
    """Density inside (-1, 1) and the mass on either bound add up, also where the mean is at the bound; to 1e-3."""
    task = envs.get(name)
    expert = policy.load(task)
    assert isinstance(expert, NetworkExpert)
    batch, width = envs.BatchEnv(task, 1), task.action_width
    obs, inside = batch.reset(0), np.linspace(-1, 1, 20_001)[1:-1]
    for centre in (-1.0, -0.99, 0.3, 1.0):
        expert.mean = lambda obs, theta, groups=1, c=centre: np.full((len(obs), width), c)  # type: ignore[method-assign]

        def density(action: Array) -> Array:
            rows = np.repeat(action[:, None], width, 1)
            n = len(rows)
            return np.exp(expert.log_prob(np.repeat(obs, n, 0), rows, np.repeat(batch.theta, n, 0)) / width)

        mass = density(inside).sum() * 1e-4 + density(np.array([-1.0, 1.0])).sum()
        assert mass == pytest.approx(1, abs=1e-3)


class TestData:
    """What methods are handed is what an environment without theta gives, from seeds that are nobody else's."""

    @pytest.mark.slow
    @pytest.mark.parametrize("name", ["bandit", CONTROL, "slippery_walker"])
    def test_demonstrations(self, name: str) -> None:
        """Bit for bit those of the expert in a plain environment with each seed's own stream; theta goes with them."""
        task, seeds = envs.get(name), [3, 5]
        context = Context(task, tiny_preset(), seeds)
        env = envs.BatchEnv(task, 8)
        made = run_trials(
            env, ExpertAgent(env, context.expert), task.episodes, [stream(DEMOS, s) for s in seeds]
        ).trials
        np.testing.assert_array_equal(context.demonstrations.obs, made.obs)
        np.testing.assert_array_equal(context.demonstrations.action, made.action)
        np.testing.assert_array_equal(context.demonstrated_theta, np.stack([env.theta] * task.episodes, 1))
        assert not np.array_equal(made.action[:4], made.action[4:])

    @pytest.mark.slow
    def test_kept_demonstrations_are_the_same(self, tmp_path: Any) -> None:
        task = envs.get(CONTROL)
        free, kept, again = (Context(task, tiny_preset(), [1, 2], folder=f) for f in (None, tmp_path, tmp_path))
        for context in (kept, again):
            np.testing.assert_array_equal(context.demonstrations.obs, free.demonstrations.obs)
            assert context.monitor.budget == free.monitor.budget
        assert len(list(tmp_path.iterdir())) == 2

    @pytest.mark.slow
    @pytest.mark.parametrize("name", ["bandit", CONTROL, "slippery_walker"])
    @pytest.mark.parametrize(
        "method",
        [
            *("deconfounded", "deconfounded_offline", "deconfounded_mean", "gail"),
            *("naive_rnn", "naive_obs", "naive_transformer", "palr", "dml_il", "dadp", "flow_bc", "dagger", "dpt"),
        ],
    )
    def test_methods_are_handed_no_theta(self, name: str, method: str, monkeypatch: pytest.MonkeyPatch) -> None:
        """Demonstrations are the context's, explorations a plain environment's: again from their seeds, bit for bit."""
        monkeypatch.setattr(type(envs.get(name)), "horizon", 8)
        monkeypatch.setattr(type(envs.get(name)), "episodes", 2)
        task = envs.get(name)
        modules = {
            "deconfounded": deconfounded,
            "deconfounded_offline": deconfounded_offline,
            "deconfounded_mean": deconfounded_mean,
            "gail": gail,
            "naive_rnn": naive_rnn,
            "naive_obs": naive_obs,
            "naive_transformer": naive_transformer,
            "palr": palr,
            "dml_il": dml_il,
            "dadp": dadp,
            "flow_bc": flow_bc,
            "dagger": dagger,
            "dpt": dpt,
        }
        handed: list[Any] = []

        def spy(given: Any, *rest: Any) -> Any:
            handed.extend((given, *rest))
            raise KeyboardInterrupt

        if method in ("naive_obs", "palr"):
            monkeypatch.setattr(modules[method], "train_recurrent", lambda kind, *given: spy(*given))
        else:
            monkeypatch.setattr(modules[method], "train", spy)
        context = Context(task, tiny_preset(), [0])
        with pytest.raises(KeyboardInterrupt):
            fit(context, method)
        if method not in ("dagger", "dpt"):
            np.testing.assert_array_equal(handed[0].obs, Context(task, tiny_preset(), [0]).demonstrations.obs)
            assert handed[0].obs.shape[-1] == len(task.observation)
        if method not in ("deconfounded", "deconfounded_mean", "dagger", "dpt"):
            return
        asks = method in ("dagger", "dpt")
        roll_out = handed[0] if asks else handed[1]
        given = roll_out(None)
        trials = given[0] if asks else given
        env = envs.BatchEnv(task, 4)
        seed = stream(EXPLORATION, int(context.rngs[0].integers(2**31)))
        plain = run_trials(env, RandomAgent(task.action_space), task.episodes, [seed]).trials
        np.testing.assert_array_equal(trials.obs, plain.obs)

    @pytest.mark.parametrize("name", [CONTROL, "tilted_cartpole"])
    def test_purposes_and_seeds_share_no_theta(self, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
        """Demonstrations, explorations and evaluations of two seeds: no theta twice."""
        task, context = envs.get(name), Context(envs.get(name), tiny_preset(), [0, 1])
        made: list[Array] = []
        begin = RandomAgent.begin

        def spy(self: RandomAgent, n: int) -> None:
            begin(self, n)
            made.append(latest[-1].theta.copy())

        latest: list[envs.BatchEnv] = []
        reset = envs.BatchEnv.reset

        def watch(self: envs.BatchEnv, *args: Any, **kwargs: Any) -> Any:
            latest.append(self)
            return reset(self, *args, **kwargs)

        monkeypatch.setattr(RandomAgent, "begin", spy)
        monkeypatch.setattr(envs.BatchEnv, "reset", watch)
        for _ in range(2):
            context.explore(None, [np.random.default_rng(seed) for seed in (0, 1)])
        evaluate(context, RandomAgent(task.action_space), False)
        thetas = np.concatenate([*made[:1], *made[2:], context.demonstrated_theta[:, 0]])[:, 0]
        np.testing.assert_array_equal(made[0], made[1])  # the same generators
        assert len(np.unique(thetas)) == len(thetas) == 3 * 8
        same = {stream(purpose, seed) for purpose in (DEMOS, EXPLORATION, EVALUATION) for seed in range(100)}
        assert len(same) == 300

    @pytest.mark.slow
    def test_the_oracle_is_given_theta(self) -> None:
        """On the bandit it pulls the best arm as often as the expert, 60 of 100, to four standard errors."""
        preset = replace(tiny_preset(), expert_trials=400, eval_trials=200)
        preset = preset.configured("oracle_bc", updates=300, batch=1024)
        context = Context(envs.get("bandit"), preset, [0])
        agent = fit(context, "oracle_bc")
        assert run_trials(context.env, agent, 1, [9]).returns.mean() == pytest.approx(60, abs=1.5)


def make(kind: str, name: str = CONTROL) -> tuple[LatentModel, Batch, Draws, DeconfoundedAgent]:
    """An untrained model of two seeds, expert trials, and the model's agent."""
    env = envs.BatchEnv(envs.get(name), 6)
    trials = run_trials(env, ExpertAgent(env, policy.load(env.task)), 2, 1).trials
    data, draws = Batch.of(trials, 2), Draws([np.random.default_rng(i) for i in range(2)], "cpu")
    scales = Scales.of(Signature.of(trials), data)
    model = new_model(kind, 3, 16, scales, draws)
    policy_ = ActionHead(model.inputs.obs_width + 3, 16, scales, draws)
    return model.eval(), data, draws, DeconfoundedAgent(model, policy_)


@pytest.mark.parametrize("kind", ["linear", "innovations", "evidence", "forgetting", "gru", "discrete"])
class TestLatents:
    def test_training_draws_theta_hat(self, kind: str) -> None:
        """The same update twice: only the noise of theta_hat differs, and so does the loss.

        Of the linear model the policy is cloned on means, and only what is predicted of trials is drawn.
        """
        model, data, draws, agent = make(kind)
        belief = final_belief(model, data)
        if kind == "discrete":
            belief = torch.full_like(belief, 1 / 3)
        first, second = (agent.loss(data, belief, None, draws) for _ in range(2))
        assert (first != second).all() == (kind != "linear")
        if kind != "discrete":  # which sums over its latents
            first, second = (model.loss(data, None, 0.0, draws) for _ in range(2))
            assert (first != second).all()

    def test_deployment_draws_theta_hat(self, kind: str) -> None:
        """Over 400 empty histories it has the prior's mean and std, and another value at the next step."""
        *_, agent = make(kind)
        agent.begin(800)
        agent.reset([np.random.default_rng(i) for i in range(2)])
        first, second = agent.latent(), agent.latent()
        assert (first != second).any()
        for way, deploy in deployments("episode", "mode", "mean").items():
            other = deploy(agent)
            other.begin(800)
            other.reset([np.random.default_rng(i) for i in range(2)])
            held = other.latent()
            assert torch.equal(held, other.latent())
            assert (held == held[:, :1]).all() == (way != "episode"), "it is drawn anew in each trial"
            assert (other.model, agent.way) == (agent.model, "step")
        mean, std = (1 / 3, (2 / 9) ** 0.5) if kind == "discrete" else (None, None)
        if kind in ("innovations", "evidence"):
            mean, std = 0.0, 1.0
        if mean is not None and std is not None:
            torch.testing.assert_close(first.mean(1), torch.full((2, 3), mean), rtol=0, atol=4 * std / 20)
            torch.testing.assert_close(first.std(1), torch.full((2, 3), std), rtol=0, atol=4 * std / 20)

    def test_memory_outlives_the_episode(self, kind: str) -> None:
        """The memory stays in a reset within a trial, and is empty when a trial begins."""
        *_, agent = make(kind)
        env = envs.BatchEnv(envs.get(CONTROL), 4)
        run_trials(env, agent, 1, [0, 1])
        memory = agent.features().copy()
        agent.reset([np.random.default_rng(i) for i in range(2)])
        np.testing.assert_array_equal(agent.features(), memory)
        agent.begin(4)
        assert (agent.features() != memory).any()


def test_naive_memory_outlives_the_episode() -> None:
    context = Context(envs.get(CONTROL), tiny_preset(), [0])
    agent = fit(context, "naive_rnn")
    assert isinstance(agent, LearnedAgent)
    run_trials(context.env, agent, 1, [0])
    memory = agent.features()
    assert memory is not None
    memory = memory.copy()
    agent.reset([np.random.default_rng(0)])
    np.testing.assert_array_equal(agent.features(), memory)
    agent.begin(4)
    assert not agent.features().any()


@pytest.mark.slow
def test_kl_is_of_the_posterior_from_the_prior() -> None:
    """Eq. (6): what beta adds to the loss is torch's own KL(q || p), with a prior that is not N(0, 1)."""
    model, data, draws, _ = make("evidence")
    assert isinstance(model, VariationalModel)
    model.encoder.prior_mean += 0.7
    model.encoder.prior_std *= 0.4
    state = draws.state_dict()
    without = model.loss(data, None, 0.0, draws)
    draws.load_state_dict(state)
    added = model.loss(data, None, 1.0, draws) - without
    mean, std = model.encoder.posterior(model.encoder(data)[:, :, :-1])
    prior_mean, prior_std = model.encoder.prior(mean)
    kl = kl_divergence(Normal(mean, std), Normal(prior_mean, prior_std)).sum(-1)
    expected = (kl * data.mask).sum((1, 2)) / data.mask.sum((1, 2))
    torch.testing.assert_close(added, expected, rtol=1e-3, atol=1e-4)


@pytest.mark.slow
def test_offline_kl_is_of_the_posterior_from_the_prior(monkeypatch: pytest.MonkeyPatch) -> None:
    """Eq. (7) hands posterior and prior over in that order: the prior is N(0, 1), the posterior is not."""
    seen: list[tuple[torch.Tensor, ...]] = []
    real = deconfounded_offline.gaussian_kl
    monkeypatch.setattr(deconfounded_offline, "gaussian_kl", lambda *given: (seen.append(given), real(*given))[1])
    fit(Context(envs.get(CONTROL), tiny_preset(), [0]), "deconfounded_offline")
    for mean, std, prior_mean, prior_std in seen:
        assert mean.std() > 0
        assert std.std() > 0
        assert (prior_mean == 0).all()
        assert (prior_std == 1).all()
    assert len(seen) == 2


def watch_betas(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """A list that records the beta of each update of a model."""
    betas: list[float] = []
    learn = LatentModel.learn

    def spy(self: Any, optimizer: Any, batch: Any, steps: Any, beta: float, draws: Any) -> float:
        betas.append(beta)
        return learn(self, optimizer, batch, steps, beta, draws)

    monkeypatch.setattr(LatentModel, "learn", spy)
    return betas


def fitted(monkeypatch: pytest.MonkeyPatch, **changes: Any) -> tuple[LatentModel, list[float]]:
    """A model after a few updates, and their betas."""
    betas = watch_betas(monkeypatch)
    agent = fit(Context(envs.get(CONTROL), tiny_preset().configured("deconfounded", **changes), [0]), "deconfounded")
    assert isinstance(agent, DeconfoundedAgent)
    return agent.model, betas


@pytest.mark.slow
@pytest.mark.parametrize("warm_up", [0.5, 0.0])
def test_beta_rises(warm_up: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Linearly from 0 over the warm-up's share of all updates; then it is constant."""
    _, betas = fitted(monkeypatch, inference_updates=4, warm_up=warm_up, beta=0.1)
    rising = [0, 0.025, 0.05, 0.075] if warm_up else [0.1] * 4
    assert betas == pytest.approx([*rising, 0.1, 0.1, 0.1, 0.1])


@pytest.mark.slow
def test_offline_beta_rises(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where observations are 0 or 1; elsewhere inference is exact."""
    betas = watch_betas(monkeypatch)
    preset = tiny_preset().configured("deconfounded_offline", offline_updates=1, online_updates=8, beta=0.1)
    fit(Context(envs.get("bandit"), preset, [0]), "deconfounded_offline")
    assert betas == pytest.approx([0, 0.025, 0.05, 0.075, 0.1, 0.1, 0.1, 0.1])


@pytest.mark.slow
@pytest.mark.parametrize("fit_prior", [True, False])
def test_prior_is_fitted_if_asked_for(fit_prior: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    model, _ = fitted(monkeypatch, fit_prior=fit_prior, model="evidence")
    assert isinstance(model, VariationalModel)
    same = bool((model.encoder.prior_mean == 0).all() and (model.encoder.prior_std == 1).all())
    assert same != fit_prior


@pytest.mark.slow
def test_gru_scan_has_the_gradient_of_autograd() -> None:
    """Double precision, two seeds, with steps that did not take place."""
    from deconfounded.deconf.core.gru import GruScan

    draw = Draws([np.random.default_rng(i) for i in range(2)], "cpu").normal
    shapes: Sequence[tuple[int, ...]] = ((3, 5, 12), (3, 4), (4, 12), (1, 12))
    inputs = [draw(*shape).double().requires_grad_() for shape in shapes]
    mask = torch.ones(2, 3, 5, dtype=torch.double)
    mask[0, 1, 3:] = mask[1, 0, 1] = 0
    scan: Callable[..., torch.Tensor] = lambda *given: GruScan.apply(*given, mask)  # noqa: E731
    assert torch.autograd.gradcheck(scan, inputs)


def test_beginnings() -> None:
    """Every length from the shortest share to the whole trial, about equally often on a logarithmic scale."""
    trials = Trials(np.zeros((2, 1, 161, 1)), np.zeros((2, 1, 160, 1)), np.ones((2, 1, 160), bool))
    data = Batch.of(trials, 1)
    lengths = np.array([data.beginnings(i, 1 / 16).mask.shape[2] for i in range(400)])
    assert lengths.min() == 10
    assert lengths.max() == 160
    assert np.mean(lengths < 40) == pytest.approx(0.5, abs=0.02)
    assert data.beginnings(7, 1.0).mask.shape[2] == 160
