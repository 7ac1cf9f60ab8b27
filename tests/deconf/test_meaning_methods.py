"""Methods by what they mean: which data each part of a method is trained on, and what is passed on."""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from deconfounded import envs
from deconfounded.benchmarks.engine.catalogue import METHODS
from deconfounded.benchmarks.engine.context import Context
from deconfounded.benchmarks.engine.provider import fit
from deconfounded.deconf.core.data import Batch, Draws, Signature
from deconfounded.deconf.core.models import VariationalModel
from deconfounded.deconf.core.monitor import Monitor
from deconfounded.deconf.core.nets import ActionHead, Scales
from deconfounded.deconf.core.sizes import LARGE_OBSERVATION, WIDE
from deconfounded.deconf.diagnosis.exploration import SHARE, ExplorationPolicy
from deconfounded.deconf.exact import ExactAgent
from deconfounded.deconf.method import Method
from deconfounded.deconf.methods import dadp, dagger, deconfounded, dml_il, palr, rma, sequence_bc
from deconfounded.deconf.methods.dadp import DadpConfig
from deconfounded.deconf.methods.dagger import DaggerAgent, DaggerConfig
from deconfounded.deconf.methods.deconfounded import DeconfoundedConfig
from deconfounded.deconf.methods.deconfounded_offline import Synthesis
from deconfounded.deconf.methods.dml_il import DmlConfig, MeanHead, Rollouts
from deconfounded.deconf.methods.flow_bc import ChunkFlow, FlowAgent
from deconfounded.deconf.methods.palr import PalrAgent, PalrConfig
from deconfounded.deconf.methods.rma import RmaAgent, RmaConfig
from deconfounded.deconf.methods.sequence_bc import RecurrentAgent, RecurrentConfig, RecurrentTrainer
from deconfounded.experts.agent import Agent
from deconfounded.experts.trials import Trials
from tests.deconf.test_baselines import gail_env
from tests.tools import FEW, tiny_preset

FLAT = Signature(obs=2, action=1, actions=0, binary=False)
N, EPISODES, STEPS = 8, 2, 6


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def draws() -> Draws:
    return Draws([rng()], "cpu")


def trials(mark: float = 0.0) -> Trials:
    """Random trials; the first column of an observation is `mark` and the trial's number, from 0 up."""
    random = rng()
    obs = random.normal(size=(N, EPISODES, STEPS + 1, 2))
    obs[..., 0] = mark + np.arange(N)[:, None, None]
    return Trials(obs, random.uniform(-0.1, 0.1, (N, EPISODES, STEPS, 1)), np.ones((N, EPISODES, STEPS), bool))


def batch() -> Batch:
    return Batch.of(trials(), 1)


class TestRounds:
    """Methods that act in rounds: at first at random, then by what they have learned so far, and nothing is lost."""

    def test_of_dagger(self, monkeypatch: pytest.MonkeyPatch) -> None:
        behaviours, sizes, beginnings = list[Agent | None](), list[int](), Batch.beginnings

        def query(behaviour: Agent | None) -> tuple[Trials, np.ndarray]:
            behaviours.append(behaviour)
            return trials(), trials().action

        def spy(self: Batch, *rest: Any) -> Batch:
            sizes.append(len(self))
            return beginnings(self, *rest)

        monkeypatch.setattr(Batch, "beginnings", spy)
        agent = dagger.train(query, DaggerConfig(16, 3, rounds=3, updates=3, batch=4), [rng()])
        assert behaviours == [None, agent, agent]
        assert sorted({*sizes}) == [N, 2 * N, 3 * N]
        assert isinstance(agent, DaggerAgent)

    def test_of_rma(self) -> None:
        behaviours = list[Agent | None]()

        def explore(behaviour: Agent | None) -> tuple[Trials, np.ndarray]:
            behaviours.append(behaviour)
            return trials(), np.zeros((N, EPISODES, 1))

        config = RmaConfig(width=8, updates=2, rounds=2, batch=4, teacher_updates=1, teacher_batch=8)
        agent = rma.train(trials(), np.zeros((N, EPISODES, 1)), explore, config, [rng()])
        assert behaviours == [None, agent]

    def test_how_much_is_kept_where_theta_drifts_is_of_the_last(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Its exploration is the nearest to what the agent does when it is deployed."""
        marks, chosen = iter((0.0, 100.0)), list[Batch]()
        monkeypatch.setattr(deconfounded, "choose_kept", lambda model, episodes, *rest: chosen.append(episodes))
        config = DeconfoundedConfig(**{**FEW, "width": 8, "latent": 2, "drifts": True})
        deconfounded.train(trials(), lambda behaviour: trials(next(marks)), config, [rng()])
        assert len(chosen[0]) == N * EPISODES
        assert (chosen[0].obs[..., 0] >= 100).all()


class TestMemories:
    """A chunk of trials begins with the memory with which the one before it ended."""

    def spied(self, agent: Any, learn: Callable[[], None], monkeypatch: pytest.MonkeyPatch) -> None:
        begun, ended, loss = list[Tensor](), list[Tensor](), agent.loss

        def spy(part: Batch, label: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
            begun.append(state)
            value, after = loss(part, label, state)
            ended.append(after)
            return value, after

        monkeypatch.setattr(agent, "loss", spy)
        learn()
        assert len(begun) == 3
        assert all(torch.equal(*pair) for pair in zip(begun[1:], ended[:-1], strict=True))
        assert not torch.equal(begun[0], begun[1])

    def test_of_recurrent_clones(self, monkeypatch: pytest.MonkeyPatch) -> None:
        data = batch()
        agent = RecurrentAgent.new(8, Scales.of(FLAT, data), draws())
        trainer = RecurrentTrainer(agent, RecurrentConfig(width=8, updates=3, chunk=4), 3 * 4, Monitor())
        self.spied(agent, lambda: trainer.learn(data, data.action), monkeypatch)

    def test_of_the_adaptation_module(self, monkeypatch: pytest.MonkeyPatch) -> None:
        data = batch()
        agent = RmaAgent.blank({"width": 8, "theta": 1, "teacher": 8}, Scales.of(FLAT, data), draws())
        optimizer, theta = sequence_bc.Adam([agent.adapter], 1e-3), torch.zeros(*data.mask.shape, 1)
        self.spied(agent, lambda: rma._pass(agent, optimizer, data, theta, 4) and None, monkeypatch)

    def test_a_history_ends_with_its_episode(self) -> None:
        """flow_bc reads the latest steps of the episode alone."""
        shape = {"width": 8, "history": 3, "ahead": 2, "executed": 1, "integration": 1}
        agent, step = FlowAgent.blank(shape, Scales.plain(FLAT, 1), draws()), batch()[:, :, 0]
        agent.begin(N)
        agent.reset([rng()])
        agent.remember(step)
        assert agent.features().any()
        agent.reset([rng()])
        assert not agent.features().any()


class TestInstruments:
    """dml_il: each roll-out model acts on trials that it was not trained on, in two independent roll-outs."""

    config = DmlConfig(latent=2, width=8, components=2, lag=2, updates=8, batch=8, steps=64, shortest=1.0)

    def test_cross_fitting(self, monkeypatch: pytest.MonkeyPatch) -> None:
        fitted, used = dict[int, set[float]](), dict[int, set[float]]()
        for name, seen in (("log_prob", fitted), ("sample", used)):

            def spy(self: Rollouts, memory: Tensor, obs: Tensor, *rest: Any, of: Any, seen: Any) -> Tensor:
                seen.setdefault(id(self), set()).update(obs[..., 0].flatten().tolist())
                return of(self, memory, obs, *rest)

            of = getattr(Rollouts, name)
            spied = lambda self, *given, of=of, seen=seen: spy(self, *given, of=of, seen=seen)  # noqa: E731
            monkeypatch.setattr(Rollouts, name, spied)
        dml_il.train(trials(), self.config, [rng()])
        assert fitted.keys() == used.keys()
        assert len(fitted) == 2
        for model, seen in fitted.items():
            assert not seen & used[model]
            assert len(seen) == len(used[model]) == N / 2

    def test_two_roll_outs(self, monkeypatch: pytest.MonkeyPatch) -> None:
        residuals, moment_loss = list[Any](), dml_il.moment_loss
        spy = lambda pair, mask: (residuals.append(pair), moment_loss(pair, mask))[1]  # noqa: E731
        monkeypatch.setattr(dml_il, "moment_loss", spy)
        dml_il.train(trials(), self.config, [rng()])
        assert all((first != second).any() for first, second in residuals)
        assert residuals


def test_the_inverse_model_counts_as_much_as_it_is_set_to() -> None:
    """dadp's encoder learns other weights with it and without."""
    states = []
    for inverse in (0.0, 1.0):
        config = DadpConfig(
            **{"width": 8, "inference_updates": 2, "inference_batch": 4, "inference_steps": 16},
            **{"imitation_updates": 1, "inverse": inverse},
        )
        states.append(dadp.train(trials(), config, rng()).encoder.state_dict())
    assert any(not torch.equal(states[0][name], states[1][name]) for name in states[0] if "evidence" in name)


def test_what_leaks_is_given_the_next_action(monkeypatch: pytest.MonkeyPatch) -> None:
    """palr: a memory before a step must hold no more of the action before than the expert's action there tells."""
    samples, hscic = list[tuple[Tensor, ...]](), palr.hscic
    spy = lambda x, y, given, ridge: (samples.append((y, given)), hscic(x, y, given, ridge))[1]  # noqa: E731
    monkeypatch.setattr(palr, "hscic", spy)
    agent = PalrAgent.new(8, Scales.plain(FLAT, 1), draws())
    agent.configure(PalrConfig(samples=32))
    data = batch()
    numbers = torch.arange(data.mask.shape[2]).float().expand_as(data.mask)[..., None]
    agent.loss(replace(data, action=numbers), numbers + 100, agent.memory.start(N))
    before, given = samples[0]
    assert torch.equal(given, before + 1 + 100)


def test_transitions_of_gail_end_where_their_episode_did() -> None:
    """And not at the first observation of the next one."""
    vec, environments = gail_env()
    vec.reset()
    step, outcomes = vec._environments.step, []
    vec._environments.step = lambda action: (outcomes.append(step(action)), outcomes[-1])[1]
    for action in rng().uniform(-1, 1, (60, 3, 1)):
        vec.step(action)
    assert any(over.any() for _, _, over, _ in outcomes)
    for (*_, next_obs), (expected, *_) in zip(vec.transitions, outcomes, strict=True):
        np.testing.assert_array_equal(next_obs, expected)
    assert len(outcomes) == 60
    assert environments is not None


@pytest.mark.parametrize(("share", "std"), [(0.0, 0.0), (1.0, 3**-0.5)])
def test_synthetic_actions_are_random_as_often_as_asked(share: float, std: float) -> None:
    """deconfounded_offline: by a policy that always says .5, or uniform in [-1, 1]."""
    data = batch()
    scales = Scales.of(FLAT, data)
    model, policy = VariationalModel("evidence", 1, 8, scales, draws()), ActionHead(FLAT.obs + 1, 8, scales, draws())
    policy.sample = lambda features, _: torch.full((*features.shape[:-1], 1), 0.5)  # type: ignore[method-assign]
    starts = data.obs[:, :, 0]
    synthetic, _ = Synthesis(model, policy, torch.zeros(1, 2, 1), data, starts, STEPS, share, draws())(64)
    assert synthetic.action.std().item() == pytest.approx(std, abs=0.05)
    assert synthetic.action.mean().item() == pytest.approx(0.5 * (1 - share), abs=0.08)


def test_an_exploration_policy_acts_at_random_now_and_then() -> None:
    """By a share of SHARE; in the other steps as the clone does, which always says .5 here."""
    policy = ActionHead(FLAT.obs, 8, Scales.plain(FLAT, 1), draws())
    policy.sample = lambda features, _: torch.full((*features.shape[:-1], 1), 0.5)  # type: ignore[method-assign]
    agent = ExplorationPolicy(policy, Scales.plain(FLAT, 1), None)
    agent.begin(1000)
    agent.reset([rng()])
    assert (agent.act(np.zeros((1000, 2), np.float32)) != 0.5).mean() == pytest.approx(SHARE, abs=0.05)


@pytest.mark.parametrize("head", [ActionHead, MeanHead])
def test_actions_are_within_their_range(head: type[ActionHead]) -> None:
    """Whatever a network says: [-1, 1], to the end."""
    policy = head(FLAT.obs, 8, Scales.plain(FLAT, 1), draws())
    for bias, end in ((50.0, 1), (-50.0, -1)):
        policy.net[-1].bias.data[..., 0] = bias  # type: ignore[operator, union-attr]
        assert (policy.sample(torch.zeros(1, 5, FLAT.obs), draws()) == end).all()


def test_actions_of_a_chunk_are_within_their_range() -> None:
    flow = ChunkFlow(4, 8, 2, Scales.plain(FLAT, 1), draws())
    assert flow.decode(torch.tensor([[[[50.0], [-50.0]]]])).flatten().tolist() == [1, -1]


def test_an_exact_policy_has_the_grid_that_it_is_set_to() -> None:
    settings = tiny_preset().configured("conditional", grid=5)
    agent = fit(Context(envs.get("tilted_cartpole"), settings, [0], Monitor()), "conditional")
    assert isinstance(agent, ExactAgent)
    assert len(agent.grid.theta) == 5


@pytest.mark.parametrize(("on_bandit", "updates"), [(None, 3), (RecurrentConfig(updates=9), 9)])
def test_a_method_of_one_configuration_has_one_smoke(on_bandit: RecurrentConfig | None, updates: int) -> None:
    """Its changes hold on the bandit too, unless that has a configuration of its own."""
    method = Method(("demonstrations",), on_control=RecurrentConfig(), on_bandit=on_bandit, smoke={"updates": 3})
    assert method.amounts("smoke", envs.get("bandit"), "cpu")["updates"] == updates


@pytest.mark.parametrize(("columns", "width"), [(LARGE_OBSERVATION - 1, 64), (LARGE_OBSERVATION, WIDE)])
def test_large_observations_have_wide_networks(columns: int, width: int) -> None:
    """From 16 numbers on."""
    task: Any = SimpleNamespace(is_bandit=False, latents=(None,), observation=dict.fromkeys(range(columns)))
    task.drifts = False
    assert METHODS["naive_rnn"].amounts("default", task, "cpu")["width"] == width
    assert (LARGE_OBSERVATION, WIDE) == (16, 128)
