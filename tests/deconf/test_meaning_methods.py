"""Methods by what they mean: which data each part of a method is trained on, and what is passed on."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
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
from deconfounded.deconf.core.adam import Adam
from deconfounded.deconf.core.beliefs import EvidenceBelief
from deconfounded.deconf.core.data import Batch, Draws, Signature
from deconfounded.deconf.core.drift import split_episodes
from deconfounded.deconf.core.latent_agent import DeconfoundedAgent
from deconfounded.deconf.core.models import VariationalModel
from deconfounded.deconf.core.monitor import Monitor
from deconfounded.deconf.core.nets import ActionHead, Scales
from deconfounded.deconf.core.online import OnlineBelief
from deconfounded.deconf.core.sizes import LARGE_OBSERVATION, WIDE
from deconfounded.deconf.diagnosis.exploration import SHARE, ExplorationPolicy
from deconfounded.deconf.equations import imitation_loss
from deconfounded.deconf.exact import ExactAgent
from deconfounded.deconf.given import Given
from deconfounded.deconf.method import Method
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
    memoryless_bc,
    naive_rnn,
    naive_transformer,
    palr,
    rma,
    sequence_bc,
)
from deconfounded.deconf.methods.dadp import DadpConfig
from deconfounded.deconf.methods.dagger import DaggerAgent, DaggerConfig
from deconfounded.deconf.methods.deconfounded import DeconfoundedConfig
from deconfounded.deconf.methods.deconfounded_mean import MeanAgent, MeanConfig
from deconfounded.deconf.methods.deconfounded_offline import OfflineConfig, Synthesis
from deconfounded.deconf.methods.dml_il import DmlConfig, History, MeanHead, Rollouts
from deconfounded.deconf.methods.dpt import DptAgent, DptConfig
from deconfounded.deconf.methods.flow_bc import ChunkFlow, FlowAgent, FlowConfig, FlowTrainer
from deconfounded.deconf.methods.gail import Discriminator, GailConfig
from deconfounded.deconf.methods.memoryless_bc import MemorylessConfig
from deconfounded.deconf.methods.naive_dropout import ActionDropoutAgent, DropoutConfig
from deconfounded.deconf.methods.naive_transformer import TransformerConfig
from deconfounded.deconf.methods.palr import PalrAgent, PalrConfig
from deconfounded.deconf.methods.rma import RmaAgent, RmaConfig
from deconfounded.deconf.methods.sequence_bc import RecurrentAgent, RecurrentConfig, RecurrentTrainer
from deconfounded.experts.agent import Agent, RandomAgent
from deconfounded.experts.trials import Trials
from tests import toys
from tests.deconf.ball import streams
from tests.deconf.test_baselines import gail_env
from tests.tools import FEW, OFFLINE, tiny_preset

FLAT = Signature(obs=2, action=1, actions=0, binary=False)
N, EPISODES, STEPS = 8, 2, 6


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


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

    @pytest.fixture
    def sizes(self, monkeypatch: pytest.MonkeyPatch) -> list[int]:
        """How many trials there are at each update."""
        counts, beginnings = list[int](), Batch.beginnings

        def spy(self: Batch, *rest: Any) -> Batch:
            counts.append(len(self))
            return beginnings(self, *rest)

        monkeypatch.setattr(Batch, "beginnings", spy)
        return counts

    def test_of_dagger(self, sizes: list[int]) -> None:
        behaviours = list[Agent | None]()

        def query(behaviour: Agent | None) -> tuple[Trials, np.ndarray]:
            behaviours.append(behaviour)
            return trials(), trials().action

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

    def test_of_rma_are_as_many_as_roll_outs_have_chunks(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Else the learning rate is 0 before the last rounds, where roll-outs are longer than the expert's trials."""
        steps, step, twice = list[int](), Adam.step, np.concatenate([trials().mask] * 2, 1)
        long = Trials(np.concatenate([trials().obs] * 2, 1), np.concatenate([trials().action] * 2, 1), twice)
        config = RmaConfig(width=8, chunk=STEPS, updates=6, rounds=2, batch=4, teacher_updates=1, teacher_batch=8)
        monkeypatch.setattr(Adam, "step", lambda self, loss: (steps.append(self._updates or 0), step(self, loss))[1])
        theta = np.zeros((N, EPISODES, 1))
        rma.train(trials(), theta, lambda agent: (long, np.repeat(theta, 2, 1)), config, [rng()])
        _, *student = steps  # the first is the teacher's
        assert {*student} == {len(student)}

    def test_of_dpt(self, sizes: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
        """Each label stays with its trial: here it is the trial's number."""
        behaviours = list[Agent | None]()
        query_loss = DptAgent.query_loss

        def query(behaviour: Agent | None) -> tuple[Trials, np.ndarray]:
            behaviours.append(behaviour)
            rolled = trials()
            return rolled, rolled.obs[:, :, :-1, :1] / 10

        def loss_spy(self: DptAgent, own: Batch, label: Tensor, context: Batch, *where: Tensor) -> Tensor:
            for number in (own.obs[..., 0], context.obs[..., 0]):
                torch.testing.assert_close(label[:, :, : number.shape[2], 0], number / 10)
            return query_loss(self, own, label, context, *where)

        monkeypatch.setattr(DptAgent, "query_loss", loss_spy)
        agent = dpt.train(query, DptConfig(16, 1, 2, rounds=3, updates=3, batch=4), [rng()])
        assert behaviours == [None, agent, agent]
        assert sorted({*sizes}) == [N, 2 * N, 3 * N]

    def test_of_deconfounded_mean(self, sizes: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
        """The policy is cloned given the beliefs of the model of its round, and at last of the last."""
        behaviours = list[Agent | None]()
        means, imitation = list[Tensor](), MeanAgent.imitation

        def explore(behaviour: Agent | None) -> Trials:
            behaviours.append(behaviour)
            return trials()

        def imitation_spy(self: MeanAgent, expert: Batch, mean: Tensor, *rest: Any) -> Tensor:
            means.append(mean)
            return imitation(self, expert, mean, *rest)

        monkeypatch.setattr(MeanAgent, "imitation", imitation_spy)
        config = MeanConfig(**{**FEW, "width": 8, "latent": 2, "inference_steps": 64})
        agent = deconfounded_mean.train(trials(), explore, config, [rng()])
        assert behaviours == [None, agent]
        assert sizes == [N, N, 2 * N, 2 * N]
        assert [torch.equal(*pair) for pair in pairwise(means)] == [True, False, True, True, True]
        torch.testing.assert_close(means[-1], deconfounded_mean.running_mean(agent.model, batch()))

    def test_how_much_is_kept_where_theta_drifts_is_of_the_last(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Its exploration is the nearest to what the agent does when it is deployed."""
        marks, chosen = iter((0.0, 100.0)), list[Batch]()
        monkeypatch.setattr(deconfounded, "choose_kept", lambda model, episodes, *rest: chosen.append(episodes))
        config = DeconfoundedConfig(**{**FEW, "width": 8, "latent": 2, "drifts": True})
        deconfounded.train(trials(), lambda behaviour: trials(next(marks)), config, [rng()])
        assert len(chosen[0]) == N * EPISODES
        assert (chosen[0].obs[..., 0] >= 100).all()


class TestRequests:
    """What a method asks for when it is given data: see deconf/given.py."""

    def given(self, fresh: bool = False) -> tuple[Given, list[tuple[Any, ...]]]:
        """And a list of what was asked for, with the agent that is to be rolled out."""
        asked = list[tuple[Any, ...]]()
        about = {"observations": 2, "action_space": toys.Push.action_space, "episodes": 2, "horizon": 6, "fresh": fresh}

        def ask(kind: str, *details: Any, agent: Agent | None = None) -> Any:
            asked.append((kind, *details, agent))

        return Given(ask, about, None, [rng()], Monitor()), asked

    def test_roll_outs_are_of_the_agent(self) -> None:
        """As many as asked for, and environments of the seed that was asked for."""
        (given, asked), agent = self.given(), RandomAgent(toys.Push.action_space)
        given.explore(agent, 3)
        given.explore_with_theta(agent)
        given.query(agent, 5)
        given.environments(1, 4)
        assert asked == [
            ("exploration", 3, agent),
            ("exploration with theta", None, agent),
            ("queries", 5, agent),
            ("environments", 1, 4, None),
        ]

    @pytest.mark.parametrize("fresh", [False, True])
    def test_demonstrations_are_fresh_where_the_preset_says_so(self, fresh: bool) -> None:
        """At each call."""
        given, asked = self.given(fresh)
        source = given.source
        if callable(source):
            source()
            source()
        assert asked == ([("fresh demonstrations", None)] * 2 if fresh else [("demonstrations", None)])

    @pytest.mark.parametrize(("share", "loss"), [(np.nan, 1.0), (0.5, np.inf)])
    def test_progress_is_of_finite_numbers(self, share: float, loss: float) -> None:
        with pytest.raises(envs.InputError, match="it must be finite numbers"):
            self.given()[0].progress(share, imitation=loss)

    @pytest.mark.parametrize("loss", [np.float32(2.0), np.array(2.0), torch.tensor(2.0)])
    def test_a_loss_is_any_number(self, loss: Any) -> None:
        """Kept as Python's, which goes through json and to other processes."""
        given, _ = self.given()
        kept = list[Any]()
        given.monitor.update = lambda *report: kept.append(report)  # type: ignore[method-assign]
        given.progress(np.float32(0.5), imitation=loss)  # type: ignore[arg-type]
        assert kept == [(500, 1000, {"imitation": 2.0})]
        assert type(kept[0][2]["imitation"]) is float


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
        agent = RecurrentAgent.new(8, Scales.of(FLAT, data), streams())
        trainer = RecurrentTrainer(agent, RecurrentConfig(width=8, updates=3, chunk=4), 3 * 4, Monitor())
        self.spied(agent, lambda: trainer.learn(data, data.action), monkeypatch)

    def test_of_the_adaptation_module(self, monkeypatch: pytest.MonkeyPatch) -> None:
        data = batch()
        agent = RmaAgent.blank({"width": 8, "theta": 1, "teacher": 8}, Scales.of(FLAT, data), streams())
        optimizer, theta = Adam([agent.adapter], 1e-3), torch.zeros(*data.mask.shape, 1)
        self.spied(agent, lambda: rma._pass(agent, optimizer, data, theta, 4) and None, monkeypatch)

    def test_the_last_chunk_is_as_long_as_what_is_left(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """All steps of a trial are learned, each in one update of a pass."""
        data, lengths = batch(), list[int]()
        agent = RecurrentAgent.new(8, Scales.of(FLAT, data), streams())
        trainer = RecurrentTrainer(agent, RecurrentConfig(width=8, updates=3, chunk=5), EPISODES * STEPS, Monitor())
        loss = agent.loss
        spy = lambda part, *rest: (lengths.append(part.mask.shape[2]), loss(part, *rest))[1]  # noqa: E731
        monkeypatch.setattr(agent, "loss", spy)
        trainer.learn(data, data.action)
        assert lengths == [5, 5, 2]
        assert trainer.done == trainer.total == 3

    @pytest.mark.parametrize("cooled", [False, True])
    def test_a_learning_rate_falls_if_it_is_to(self, cooled: bool) -> None:
        """To 0 at the end of training."""
        data, config = batch(), RecurrentConfig(width=8, updates=3, chunk=4, cooled=cooled)
        trainer = RecurrentTrainer(RecurrentAgent.new(8, Scales.of(FLAT, data), streams()), config, 12, Monitor())
        trainer.learn(data, data.action)
        assert trainer.optimizer.rate == pytest.approx(0 if cooled else config.learning_rate)

    def test_a_history_ends_with_its_episode(self) -> None:
        """flow_bc reads the latest steps of the episode alone."""
        shape = {"width": 8, "history": 3, "ahead": 2, "executed": 1, "integration": 1}
        agent, step = FlowAgent.blank(shape, Scales.plain(FLAT, 1), streams()), batch()[:, :, 0]
        agent.begin(N)
        agent.reset([rng()])
        agent.remember(step)
        assert agent.features().any()
        agent.reset([rng()])
        assert not agent.features().any()

    def test_a_chunk_ends_with_its_episode(self) -> None:
        """Actions that flow_bc has not executed by then are never executed."""
        shape, acted = {"width": 8, "history": 3, "ahead": 4, "executed": 4, "integration": 2}, []
        for seen in (0.0, 1.0):
            agent = FlowAgent.blank(shape, Scales.plain(FLAT, 1), streams())
            agent.begin(N)
            for obs in (0.0, seen):
                agent.reset([rng()])
                acted.append(agent.act(np.full((N, 2), obs, np.float32)))
        np.testing.assert_array_equal(acted[0], acted[2])
        assert (acted[1] != acted[3]).any()


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

    def test_the_first_steps_of_an_episode_are_taken_as_they_are(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Where noise lasts as long as episodes, all are: no model is fitted to them, and no roll-out is used."""
        fitted, residuals, moment_loss = list[Tensor](), list[Any](), dml_il.moment_loss
        spy = lambda log_prob, mask: (fitted.append(mask), imitation_loss(log_prob, mask))[1]  # noqa: E731
        monkeypatch.setattr(dml_il, "imitation_loss", spy)
        spy = lambda pair, mask: (residuals.append(pair), moment_loss(pair, mask))[1]  # noqa: E731
        monkeypatch.setattr(dml_il, "moment_loss", spy)
        dml_il.train(trials(), replace(self.config, lag=STEPS), [rng()])
        assert fitted
        assert residuals
        assert not any(mask.any() for mask in fitted)
        assert all(torch.equal(first, second) for first, second in residuals)

    def test_a_policy_reads_the_memory_of_its_own_trial(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Of either half; the action is the trial's number here."""
        marked, read, acted = trials(), list[Tensor](), list[Tensor]()
        marked = Trials(marked.obs, np.repeat(marked.obs[:, :, :1, :1] / 10, STEPS, 2), marked.mask)
        at, residual = History.at, MeanHead.residual

        def at_spy(self: History, data: Batch, origin: Tensor) -> Tensor:
            if not isinstance(self, Rollouts):
                read.append(data.steps(origin).obs[..., :1])
            return at(self, data, origin)

        monkeypatch.setattr(History, "at", at_spy)
        spy = lambda self, features, action: (acted.append(action), residual(self, features, action))[1]  # noqa: E731
        monkeypatch.setattr(MeanHead, "residual", spy)
        dml_il.train(marked, self.config, [rng()])
        assert read
        for number, action in zip(read, acted[::2], strict=True):
            torch.testing.assert_close(number / 10, action)

    def test_a_roll_out_model_has_the_density_of_its_mixture(self) -> None:
        draws = streams()
        model, memory, obs = Rollouts(2, 8, 3, Scales.of(FLAT, batch()), draws), batch(), draws.normal(2, N, 2)
        with torch.no_grad():
            memory, now, then = model.memory(batch())[:, :, 3], obs[:, 0], obs[:, 1]
            logits, mean, std = model(memory, now)
            parts = torch.distributions.Independent(torch.distributions.Normal(mean, std), 1)
            mixture = torch.distributions.MixtureSameFamily(torch.distributions.Categorical(logits=logits), parts)
            torch.testing.assert_close(model.log_prob(memory, now, then), mixture.log_prob(then))


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
    spy = lambda x, y, given, ridge: (samples.append((x, y, given)), hscic(x, y, given, ridge))[1]  # noqa: E731
    monkeypatch.setattr(palr, "hscic", spy)
    agent = PalrAgent.new(8, Scales.plain(FLAT, 1), streams())
    agent.configure(PalrConfig(samples=32))
    data = batch()
    numbers = torch.arange(data.mask.shape[2]).float().expand_as(data.mask)[..., None]
    agent.leakage(numbers + 200, replace(data, action=numbers), numbers + 100)
    memory, before, given = samples[0]
    assert torch.equal(given, before + 1 + 100)
    assert torch.equal(memory, before + 1 + 200)


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


def always_half(features: int) -> ActionHead:
    """A policy that always says .5."""
    policy = ActionHead(features, 8, Scales.plain(FLAT, 1), streams())
    policy.sample = lambda features, _: torch.full((*features.shape[:-1], 1), 0.5)  # type: ignore[method-assign]
    return policy


@pytest.mark.parametrize(("share", "std"), [(0.0, 0.0), (1.0, 3**-0.5)])
def test_synthetic_actions_are_random_as_often_as_asked(share: float, std: float) -> None:
    """deconfounded_offline: by a policy that always says .5, or uniform in [-1, 1]."""
    data = batch()
    scales = Scales.of(FLAT, data)
    model, policy = VariationalModel("evidence", 1, 8, scales, streams()), always_half(FLAT.obs + 1)
    starts = data.obs[:, :, 0]
    synthetic, _ = Synthesis(model, policy, torch.zeros(1, 2, 1), data, starts, STEPS, share, streams())(64)
    assert synthetic.action.std().item() == pytest.approx(std, abs=0.05)
    assert synthetic.action.mean().item() == pytest.approx(0.5 * (1 - share), abs=0.08)


def test_the_unit_of_an_online_belief_is_of_demonstrations(monkeypatch: pytest.MonkeyPatch) -> None:
    """deconfounded_offline: those that it infers on whole trials of the expert."""
    inferred, fitted, fit_online = list[Tensor](), list[Tensor](), OnlineBelief.fit
    fit_spy = lambda *given: (fitted.append(given[-1]), fit_online(*given))[1]  # noqa: E731
    monkeypatch.setattr(OnlineBelief, "fit", fit_spy)
    spy = lambda *parts: (inferred.append(parts[2]), Synthesis(*parts))[1]  # noqa: E731
    monkeypatch.setattr(deconfounded_offline, "Synthesis", spy)
    agent = deconfounded_offline.train(trials(), OfflineConfig(**{**OFFLINE, "width": 8, "online_steps": 64}), [rng()])
    torch.testing.assert_close(agent.model.latent_stds(), inferred[0].std(1, correction=0).clamp(min=0.05))
    assert inferred[0].shape[1] == N
    assert torch.isin(fitted[0], inferred[0]).all()  # synthetic trials have known latents


def test_an_exploration_policy_acts_at_random_now_and_then() -> None:
    """By a share of SHARE; in the other steps as the clone does, which always says .5 here."""
    agent = ExplorationPolicy(always_half(FLAT.obs), Scales.plain(FLAT, 1), None)
    agent.begin(1000)
    agent.reset([rng()])
    assert (agent.act(np.zeros((1000, 2), np.float32)) != 0.5).mean() == pytest.approx(SHARE, abs=0.05)


@pytest.mark.parametrize("head", [ActionHead, MeanHead])
def test_actions_are_within_their_range(head: type[ActionHead]) -> None:
    """Whatever a network says: [-1, 1], to the end."""
    policy = head(FLAT.obs, 8, Scales.plain(FLAT, 1), streams())
    for bias, end in ((50.0, 1), (-50.0, -1)):
        policy.net[-1].bias.data[..., 0] = bias  # type: ignore[operator, union-attr]
        assert (policy.sample(torch.zeros(1, 5, FLAT.obs), streams()) == end).all()


def test_a_policy_reads_in_training_what_it_reads_in_deployment() -> None:
    """dagger: at each step a memory of the steps before, and not of that step."""
    data = batch()
    agent: Any = DaggerAgent.new(8, 2, False, Scales.of(FLAT, data), streams())
    agent.memory.eval()
    trained, deployed = list[Tensor](), list[Tensor]()
    agent.policy.log_prob = lambda features, action: (trained.append(features), action[..., 0])[1]
    agent.policy.sample = lambda features, _: (deployed.append(features), features[..., :1])[1]
    agent.begin(N)
    with torch.no_grad():
        agent.loss(data, data.action, None, streams())
        for t in range(EPISODES * STEPS):
            agent.choose(data.obs[:, :, t])
            agent.remember(data[:, :, t])
    stepwise = torch.stack(deployed, 2)
    torch.testing.assert_close(trained[0].view_as(stepwise), stepwise, rtol=1e-4, atol=1e-4)


def test_an_estimate_is_trained_as_it_is_deployed() -> None:
    """rma: that of a step is of the steps before it."""
    data = batch()
    agent = RmaAgent.blank({"width": 8, "theta": 1, "teacher": 8}, Scales.of(FLAT, data), streams())
    agent.begin(N)
    estimates = []
    for t in range(EPISODES * STEPS):
        estimates.append(torch.tensor(agent.features())[None])
        agent.remember(data[:, :, t])
    assert agent.loss(data, torch.stack(estimates, 2), agent.adapter.start(N))[0].item() < 1e-10


def test_actions_of_a_chunk_are_within_their_range() -> None:
    flow = ChunkFlow(4, 8, 2, Scales.plain(FLAT, 1), streams())
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


def test_each_batch_of_a_function_is_fresh_trials(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first are for scales alone."""
    marks, learned = iter((0.0, 100.0, 200.0)), list[float]()
    learn = RecurrentTrainer.learn

    def spy(self: RecurrentTrainer, data: Batch, label: Tensor) -> None:
        learned.append(data.obs[0, 0, 0, 0].item())
        learn(self, data, label)

    monkeypatch.setattr(RecurrentTrainer, "learn", spy)
    naive_rnn.train(lambda: trials(next(marks)), RecurrentConfig(width=8, updates=2), [rng()])
    assert learned == [100, 200]


@pytest.mark.parametrize("fresh", [False, True])
def test_histories_of_flow_bc_are_of_an_episode(fresh: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """It learns single episodes, of trials that stay and of fresh ones."""
    lengths, learn = list[int](), FlowTrainer.learn
    spy = lambda self, data, label: (lengths.append(data.mask.shape[2]), learn(self, data, label))[1]  # noqa: E731
    monkeypatch.setattr(FlowTrainer, "learn", spy)
    config = FlowConfig(width=8, history=2, ahead=2, updates=1, batch=4, steps=8)
    flow_bc.train(trials if fresh else trials(), config, rng())
    assert lengths == [STEPS]


def test_ppo_has_the_settings_of_gail() -> None:
    from deconfounded.deconf.methods.gail_ppo import new_ppo

    config = GailConfig(width=8, envs=3, steps=8, epochs=2, minibatch=12, gamma=0.5, policy_rate=0.25)
    ppo = new_ppo(gail_env()[0], config, 0)
    assert (ppo.n_steps, ppo.n_epochs, ppo.batch_size, ppo.gamma, ppo.learning_rate) == (8, 2, 12, 0.5, 0.25)
    assert ppo.policy.log_std.exp().tolist() == pytest.approx([0.6], abs=0.01)  # type: ignore[operator, union-attr]


def test_each_seed_of_gail_is_rewarded_by_its_own_discriminator(monkeypatch: pytest.MonkeyPatch) -> None:
    """In the environments of its own, before the first round and in each; it takes demonstrations for the expert's."""
    rewarded, of_seed = list[int](), Discriminator.of_seed
    spy = lambda self, i: (rewarded.append(i), of_seed(self, i))[1]  # noqa: E731
    monkeypatch.setattr(Discriminator, "of_seed", spy)
    given, train, loss = list[Trials](), gail.train, Discriminator.loss

    def loss_spy(self: Discriminator, expert: Batch, own: Batch) -> Tensor:
        demonstrated = torch.tensor(given[0].action).unique()
        assert torch.isin(expert.action, demonstrated).all()
        assert not torch.isin(own.action, demonstrated).all()
        return loss(self, expert, own)

    monkeypatch.setattr(gail, "train", lambda *rest: (given.append(rest[0]), train(*rest))[1])
    monkeypatch.setattr(Discriminator, "loss", loss_spy)
    fit(Context(envs.get("tilted_cartpole"), tiny_preset().configured("gail", rounds=1), [0, 1], Monitor()), "gail")
    assert rewarded == [0, 1, 0, 1]


@pytest.mark.parametrize(
    ("name", "setting", "value"),
    [
        ("deconfounded_gru", "model", "gru"),
        ("deconfounded_forgetting", "model", "forgetting"),
        ("deconfounded_discrete", "model", "discrete"),
        ("deconfounded_large", "latent", 16),
        ("deconfounded_large", "width", WIDE),
    ],
)
@pytest.mark.parametrize(
    ("preset", "task"), [("default", "tilted_cartpole"), ("default", "bandit"), ("paper", "bandit")]
)
def test_what_a_variant_is_named_for(name: str, setting: str, value: object, preset: str, task: str) -> None:
    """On control and on the bandit, in each preset."""
    assert METHODS[name].amounts(preset, envs.get(task), "cpu")[setting] == value


def test_the_large_variant_begins_anew_on_control() -> None:
    tasks = ("tilted_cartpole", "bandit")
    restarts = [METHODS["deconfounded_large"].amounts("default", envs.get(name), "cpu")["restart"] for name in tasks]
    assert restarts == [True, False]


def test_a_clone_is_trained_with_its_own_settings() -> None:
    """The dropout and the penalty of those of naive_rnn's family that have one."""
    dropping, penalised = DropoutConfig(width=8, updates=1, dropout=0.3), PalrConfig(width=8, updates=1, penalty=3.0)
    assert sequence_bc.train_recurrent(ActionDropoutAgent, trials(), dropping, [rng()]).dropout == 0.3
    assert sequence_bc.train_recurrent(PalrAgent, trials(), penalised, [rng()]).config is penalised


def test_a_transformer_reads_as_many_tokens_as_a_trial_of_training_has() -> None:
    config = TransformerConfig(width=16, layers=1, heads=2, updates=1, batch=4)
    assert naive_transformer.train(trials(), config, [rng()]).net.window == EPISODES * STEPS


@pytest.mark.parametrize("method", ["dagger", "dpt"])
def test_labels_are_in_units_of_their_own(method: str) -> None:
    """And not of the actions of roll-outs, which are the imitator's."""
    label = 0.3 + 5 * trials().action
    agents: dict[str, Callable[..., Any]] = {
        "dagger": lambda query: dagger.train(query, DaggerConfig(16, 3, rounds=1, updates=1, batch=4), [rng()]),
        "dpt": lambda query: dpt.train(query, DptConfig(16, 1, 2, rounds=1, updates=1, batch=4), [rng()]),
    }
    scaler = agents[method](lambda behaviour: (trials(), label)).policy.scaler
    assert scaler.mean.item() == pytest.approx(label.mean(), abs=1e-5)
    assert scaler.std.item() == pytest.approx(label.std(), abs=1e-5)


def test_a_loaded_agent_is_not_in_training() -> None:
    """Else a loss of it, on other trials, would move the moments by which it reads its evidence."""
    draws = Draws([rng()], "cpu")
    made = DeconfoundedAgent.new(
        "evidence", 2, 8, Scales.plain(Signature(obs=2, action=1, actions=0, binary=False), 1), draws
    )
    loaded = DeconfoundedAgent.from_state(*made.state())
    batch = Batch(torch.ones(1, 3, 4, 2), torch.ones(1, 3, 4, 1), torch.zeros(1, 3, 4, 2), torch.ones(1, 3, 4))
    before = {key: x.copy() for key, x in loaded.state()[1].items()}
    loaded.model.loss(batch, None, 1.0, draws)
    after = loaded.state()[1]
    assert all(np.array_equal(after[key], x) for key, x in before.items())


@pytest.mark.parametrize("drifts", [False, True])
def test_a_saved_transformer_forgets_as_it_did(drifts: bool) -> None:
    """dpt: where theta drifts between episodes, what the last one showed is forgotten."""
    config = DptConfig(16, 1, 2, rounds=1, updates=1, batch=4, drifts=drifts)
    agent = dpt.train(lambda behaviour: (trials(), trials().action), config, [rng()])
    assert DptAgent.from_state(*agent.state()).forgets is agent.forgets is drifts


def test_contexts_are_read_by_the_encoder_that_was_trained(monkeypatch: pytest.MonkeyPatch) -> None:
    """dadp: its policy is cloned on them, and they are as long as all episodes but one."""
    read, contexts = list[Tensor](), dadp.contexts
    spy = lambda memories, of: (read.append(memories), contexts(memories, of))[1]  # noqa: E731
    monkeypatch.setattr(dadp, "contexts", spy)
    config = DadpConfig(width=8, inference_updates=2, inference_batch=4, inference_steps=16, imitation_updates=1)
    numbers, forward = list[Tensor](), EvidenceBelief.forward
    forward_spy = lambda self, data: (numbers.append(data.obs[0, :, 0, 0]), forward(self, data))[1]  # noqa: E731
    monkeypatch.setattr(EvidenceBelief, "forward", forward_spy)
    agent = dadp.train(trials(), config, rng())
    assert len(read) == 3  # in each update of encoder and policy
    assert not any(number.unflatten(0, (-1, EPISODES)).diff().any() for number in numbers)  # of trials that are whole
    with torch.no_grad():
        memories = agent.encoder(Batch.of(split_episodes(trials()), 1))[:, :, -1]
    torch.testing.assert_close(read[-1], memories.unflatten(1, (N, EPISODES)))
    assert agent.encoder.longest == (EPISODES - 1) * STEPS


def test_a_teacher_has_settings_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """rma: its updates, batch and learning rate are not the student's."""
    taught, clone = list[MemorylessConfig](), memoryless_bc.train
    spy = lambda data, config, *rest: (taught.append(config), clone(data, config, *rest))[1]  # noqa: E731
    monkeypatch.setattr(memoryless_bc, "train", spy)
    config = RmaConfig(8, 2, 4, rounds=1, learning_rate=0.1, teacher_updates=3, teacher_batch=16, teacher_rate=0.2)
    theta = np.zeros((N, EPISODES, 1))
    rma.train(trials(), theta, lambda behaviour: (trials(), theta), config, [rng()])
    assert taught == [MemorylessConfig(8, 3, 16, 0.2)]
