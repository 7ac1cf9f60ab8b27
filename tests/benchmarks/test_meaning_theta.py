"""Theta by what it means: imitators see it through the world alone, and scoring has the true one."""

import queue
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deconfounded import envs
from deconfounded.benchmarks.engine import catalogue, guest_host, progress, provider
from deconfounded.benchmarks.engine.benchmark import BenchmarkJob
from deconfounded.benchmarks.engine.context import EVALUATION, Context, stream
from deconfounded.benchmarks.engine.provider import Provider
from deconfounded.deconf.given import Given
from deconfounded.deconf.method import USES, uses
from deconfounded.deconf.methods import memoryless_bc
from deconfounded.envs.contract.probe import far_thetas
from deconfounded.experts import datasets
from deconfounded.experts.agent import ExpertAgent, RandomAgent
from deconfounded.experts.policy import CallableExpert
from deconfounded.experts.rollout import Rollout, run_trials, thetas
from deconfounded.experts.trials import Trials
from tests import toys
from tests.tools import tiny_preset


@pytest.mark.parametrize("name", envs.names())
def test_later_episodes_start_alike_under_any_theta(name: str) -> None:
    """Bit for bit, in the state too: the second and third start of a trial, of the same seed."""
    task = envs.get(name)
    starts = []
    for theta in far_thetas(task):
        env = envs.BatchEnv(task, 2)
        env.reset([3, 4], {"theta": theta})
        for _ in range(2):
            env.step(np.zeros((2, task.action_width)))
            seen = env.reset(options={"keep_theta": True})
        starts.append((env.state.copy(), seen))
    for state, seen in starts[1:]:
        np.testing.assert_array_equal(state, starts[0][0])
        np.testing.assert_array_equal(seen, starts[0][1])


def test_padding_of_trials_tells_nothing() -> None:
    """After the end of an episode: no action, and the last observation again and again, whatever was there before."""
    env = envs.BatchEnv(toys.Push(), 32)
    trials, _, theta = run_trials(env, RandomAgent(env.task.action_space), 2, 0)
    assert 0.2 < trials.mask.mean() < 0.9
    over = np.arange(trials.obs.shape[2]) >= 1 + trials.mask.sum(-1)[..., None]
    obs = np.where(over[..., None], theta[:, :, None], trials.obs)
    action = np.where(trials.mask[..., None], trials.action, theta[:, :, None])
    for some in (trials, Trials(obs, action, trials.mask)):
        assert not some.action[~some.mask].any()
        last = np.take_along_axis(trials.obs, trials.mask.sum(-1)[..., None, None], 2)
        np.testing.assert_array_equal(some.obs[over], np.broadcast_to(last, trials.obs.shape)[over])


def test_episodes_of_a_data_set_hold_no_theta(tmp_path: Path) -> None:
    """Infos are empty; theta is in the metadata, for scoring, and nowhere else."""
    minari = pytest.importorskip("minari")
    task = envs.get("rolling_deck")
    collected = datasets.collect(task, 2, lambda env: RandomAgent(task.action_space), 5)
    place = datasets.write(tmp_path, task, "random", collected, "random", (0.0, 1.0))
    trials, theta, _ = collected
    for i, episode in enumerate(minari.MinariDataset(place / "data").iterate_episodes()):
        b, e = divmod(i, task.episodes)
        assert not episode.infos
        n = len(episode.rewards)
        np.testing.assert_array_equal(episode.observations, trials.obs[b, e, : n + 1])
        np.testing.assert_array_equal(episode.actions, trials.action[b, e, :n])
    np.testing.assert_array_equal(datasets.read_theta(place), theta)


def test_who_explores_gets_nothing_else() -> None:
    """What each use opens, all of it, by name: nothing is opened beside what is written here."""
    opened = {
        "demonstrations": {"demonstrations", "fresh demonstrations"},
        "exploration": {"exploration", "environments", "reset", "step"},
        "queries": {"queries"},
        "theta": {"theta", "acting theta"},
    }
    assert set(opened) == set(USES)
    context = Context(toys.Push(), tiny_preset(), [0], expert="tests.toys:control")
    for use, kinds in opened.items():
        assert Provider(context, [use], context.rngs).open == kinds


@pytest.mark.parametrize("salt", ["", "salt"])
def test_a_job_s_file_has_its_own_seed_s_thetas(salt: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those that evaluation drew for that seed and salt, episode by episode; they are other ones for another salt."""
    monkeypatch.setattr(progress, "_ticks", queue.Queue(), raising=False)
    job = BenchmarkJob("rolling_deck", replace(tiny_preset(), eval_trials=3), "random", (0, 1), tmp_path, salt=salt)
    job.run()
    for seed in (0, 1):
        data = job.load(seed)
        assert data is not None
        task = envs.get("rolling_deck")
        expected = thetas(task, 3, task.episodes, stream(EVALUATION, seed, salt))
        np.testing.assert_array_equal(data["random/theta"], expected)
        assert (expected != thetas(task, 3, task.episodes, stream(EVALUATION, seed, f"{salt}x"))).all()


def test_a_salt_draws_other_explorations() -> None:
    """What is explored in training is nobody's guess either, nor what the expert is asked about."""
    contexts = [Context(toys.Push(), tiny_preset(), [0], expert="tests.toys:control", salt=salt) for salt in ("", "x")]
    for explored, salted in (
        [context.explore(None, context.rngs) for context in contexts],
        [context.query(None, context.rngs)[0] for context in contexts],
    ):
        assert not np.isin(salted.obs[:, 0, 0], explored.obs[:, 0, 0]).any()


class TestDrift:
    """Where theta walks from episode to episode, each episode's labels and features are of its own theta."""

    @pytest.fixture
    def context(self) -> Context:
        preset = replace(tiny_preset(), expert_trials=64, explore_trials=64, query_trials=64)
        return Context(toys.Drift(), preset, [0], expert="tests.toys:control")

    @staticmethod
    def off(trials: Trials, action: Any, theta: Any) -> Any:
        """Root mean square of actions less what the expert would do on average under theta [B, E, L], by episode."""
        b, e, t = trials.mask.shape
        mean = toys.control(
            trials.obs[:, :, :-1].reshape(b * e * t, -1), np.repeat(theta.reshape(b * e, -1), t, 0)
        ).reshape(b, e, t, 1)
        inside = trials.mask[..., None] & (np.abs(mean) < 0.7)  # not clipped
        return [np.sqrt(np.mean((action - mean)[:, i][inside[:, i]] ** 2)) for i in range(e)]

    def test_labels_of_queries(self, context: Context, monkeypatch: pytest.MonkeyPatch) -> None:
        kept: list[Rollout] = []
        roll_out = context._roll_out

        def keep(*given: Any) -> Rollout:
            kept.append(roll_out(*given))
            return kept[0]

        monkeypatch.setattr(context, "_roll_out", keep)
        trials, labels = context.query(None, context.rngs)
        assert self.off(trials, labels, kept[0].theta) == pytest.approx([0.1, 0.1], abs=0.02)
        assert self.off(trials, labels, kept[0].theta[:, ::-1])[1] > 0.15

    @pytest.mark.parametrize("salt", ["", "salt"])
    def test_thetas_of_demonstrations(self, salt: str, context: Context) -> None:
        """Those of a guest too, whose data is salted."""
        context.salt = salt
        trials, theta = context.demonstrations, context.demonstrated_theta
        assert self.off(trials, trials.action, theta) == pytest.approx([0.1, 0.1], abs=0.02)
        assert self.off(trials, trials.action, theta[:, ::-1])[1] > 0.15

    def test_thetas_of_explorations(self, context: Context) -> None:
        """The force that the motion shows, whose noise is .125 a step, is the theta that is handed out."""
        trials, theta = context.explore_with_theta(None, context.rngs)
        velocity = trials.obs[..., 1]
        force = (velocity[..., 1:] - 0.8 * velocity[..., :-1]) / 0.4 - trials.action[..., 0]
        offsets = [(force[:, e] - theta[:, e])[trials.mask[:, e]] for e in range(2)]
        assert [np.sqrt(np.mean(x**2)) for x in offsets] == pytest.approx([0.125, 0.125], abs=0.02)

    def test_an_oracle_reads_the_theta_of_the_episode(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Trials whose action is their episode's theta: so is the feature beside every step that it clones."""
        theta = np.random.default_rng(0).uniform(-1, 1, (6, 3, 1))
        action = np.repeat(theta[:, :, None], 4, 2)
        trials = Trials(np.random.default_rng(1).random((6, 3, 5, 2)), action, np.ones((6, 3, 4), bool))
        seen: list[Any] = []
        log_prob = memoryless_bc.ActionHead.log_prob

        def spy(self: Any, features: Any, actions: Any) -> Any:
            seen.append((features[..., -1], actions[..., 0]))
            return log_prob(self, features, actions)

        monkeypatch.setattr(memoryless_bc.ActionHead, "log_prob", spy)
        memoryless_bc.train(trials, memoryless_bc.MemorylessConfig(8, 1, 256), np.random.default_rng(0), theta)
        assert seen[0][0].unique().numel() == 18
        np.testing.assert_array_equal(*seen[0])


def test_a_later_episode_s_expert_acts_on_its_own_theta() -> None:
    """As evaluation deploys it: what the expert does is of the theta that the roll-out reports."""
    env = envs.BatchEnv(toys.Drift(), 64)
    made = run_trials(env, ExpertAgent(env, CallableExpert(env.task, toys.control, "control")), 3, 1)
    assert TestDrift.off(made.trials, made.trials.action, made.theta) == pytest.approx([0.1] * 3, abs=0.02)


def test_data_is_for_training_and_an_oracle_s_theta_for_acting(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a method of ours may ask for when it has been trained: the theta that it acts under, and no more data."""
    handed: list[Given] = []

    @uses("demonstrations", "exploration", "queries", "theta")
    def greedy(given: Given) -> RandomAgent:
        handed.append(given)
        assert len(given.demonstrations) == len(given.explore()) == len(given.theta) == 4
        return RandomAgent(given.action_space)

    context = Context(toys.Push(), tiny_preset(), [0], expert="tests.toys:control")
    monkeypatch.setattr(provider.methods, "load", lambda name: greedy)
    provider.fit(context, "greedy")
    context.env.reset(0)
    np.testing.assert_array_equal(handed[0].acting_theta(), context.env.theta)  # which is encoded as it is, in [-1, 1]
    for ask in (handed[0].explore, handed[0].query, lambda: handed[0].demonstrations, lambda: handed[0].theta):
        with pytest.raises(envs.InputError, match="after training"):
            ask()


def test_a_guest_does_not_act_on_theta(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever it declares, the theta that it acts under is not to be had; that of demonstrations is, if declared."""

    monkeypatch.setattr(guest_host.sys, "executable", "true")
    monkeypatch.setattr(guest_host.Guest, "_fit", lambda self: None)
    context = Context(toys.Push(), tiny_preset(), [0], expert="tests.toys:control")
    made = guest_host.Guest(context, "mine", "mine.py:fit", ["demonstrations", "theta"])
    made.close()
    assert len(made.provider("theta")) == 4
    with pytest.raises(envs.InputError, match="it asked for acting theta"):
        made.provider("acting theta")


def test_nor_does_one_in_this_process(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Which is how a method is debugged: it gets what it would get as a guest."""
    monkeypatch.setattr(catalogue.METHODS, "outside", {})
    (tmp_path / "curious.py").write_text(
        "from deconfounded.deconf.method import uses\n"
        "@uses('demonstrations', 'theta')\n"
        "def fit(given):\n    assert len(given.theta) == 4\n    return given._ask('acting theta')\n"
    )
    method = catalogue.METHODS[catalogue.add(f"{tmp_path}/curious.py:fit")]
    context = Context(toys.Push(), tiny_preset(), [0], expert="tests.toys:control")
    with pytest.raises(envs.InputError, match="it asked for acting theta"):
        guest_host.fit_guest(context, "curious", method)
