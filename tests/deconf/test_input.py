"""What learned agents, configurations, roll-outs and exact policies refuse: one line says what would be right."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from deconfounded import envs
from deconfounded.benchmarks.engine import presets
from deconfounded.benchmarks.engine.context import Context
from deconfounded.benchmarks.engine.provider import fit
from deconfounded.deconf.core.data import Batch, Draws, Signature
from deconfounded.deconf.core.models import new_model
from deconfounded.deconf.core.nets import Scales
from deconfounded.deconf.diagnosis.diagnose import DiagnoseConfig
from deconfounded.deconf.diagnosis.measures import Amounts
from deconfounded.deconf.method import uses
from deconfounded.deconf.methods import (
    dagger,
    deconfounded,
    deconfounded_mean,
    deconfounded_offline,
    dml_il,
    dpt,
    memoryless_bc,
    rma,
)
from deconfounded.deconf.methods.dagger import DaggerConfig
from deconfounded.deconf.methods.deconfounded import DeconfoundedConfig
from deconfounded.deconf.methods.deconfounded_mean import MeanConfig
from deconfounded.deconf.methods.deconfounded_offline import OfflineConfig, starts_of
from deconfounded.deconf.methods.dml_il import DmlConfig
from deconfounded.deconf.methods.dpt import DptConfig
from deconfounded.deconf.methods.flow_bc import FlowConfig
from deconfounded.deconf.methods.memoryless_bc import MemorylessConfig
from deconfounded.deconf.methods.naive_dropout import DropoutConfig
from deconfounded.deconf.methods.palr import PalrConfig
from deconfounded.deconf.methods.rma import RmaConfig
from deconfounded.deconf.particles import Particles
from deconfounded.envs.streams import Streams
from deconfounded.experts.agent import Agent, AgentWrapper, ExpertAgent, RandomAgent
from deconfounded.experts.rollout import run_trials
from deconfounded.experts.trials import Trials
from tests.deconf.test_particles import Three, expert
from tests.tools import FEW, tiny_preset

CONTROL = "tilted_cartpole"


@pytest.fixture(scope="module")
def agents() -> dict[str, Agent]:
    """An agent of continuous actions, and one of three arms or more, two trials each."""
    made = {}
    for task in (CONTROL, "bandit"):
        agent = made[task] = fit(Context(envs.get(task), tiny_preset(), [0]), "naive_rnn")
        agent.begin(2)
        agent.reset([np.random.default_rng(0)])
    return made


def step(task: str, **changed: Any) -> list[Any]:
    obs = np.zeros((2, len(envs.get(task).observation)), np.float32)
    parts = {"obs": obs, "action": np.zeros((2, 1)), "next_obs": obs, "alive": np.ones(2, bool)}
    return list((parts | changed).values())


@pytest.mark.parametrize(
    ("task", "changed", "says"),
    [
        (CONTROL, {"next_obs": np.full((2, 5), np.nan, np.float32)}, "observations or actions held NaN or infinity"),
        (CONTROL, {"next_obs": np.full((2, 5), 2e15, np.float32)}, r"or more than 1e\+15"),
        (CONTROL, {"next_obs": np.zeros((2, 4), np.float32)}, r"had shape \(2, 4\); they must be \(2, 5\)"),
        (CONTROL, {"action": np.zeros(2)}, r"had shapes \(2,\) and \(2,\); they must be \(2, 1\) and \(2,\)"),
        (CONTROL, {"action": np.full((2, 1), np.inf)}, "observations or actions held NaN or infinity"),
        (CONTROL, {"alive": np.ones((2, 1), bool)}, r"and \(2, 1\); they must be"),
        ("bandit", {"action": np.array([[0], [5]])}, "an action was none of 0 to 4"),
        ("bandit", {"action": np.array([[np.nan], [0]])}, "observations or actions held NaN or infinity"),
    ],
)
def test_steps_that_an_agent_refuses(agents: dict[str, Agent], task: str, changed: Any, says: str) -> None:
    """Nothing of them enters its memory."""
    width = len(envs.get(task).observation)
    if width != 5 and task == CONTROL:  # the shapes above are of five numbers
        pytest.fail(f"{CONTROL} has {width} numbers")
    agent = agents[task]
    before = agent.features()
    with pytest.raises(envs.InputError, match=says):
        agent.observe(*step(task, **changed))
    np.testing.assert_array_equal(agent.features(), before)
    agent.observe(*step(task))
    assert (agent.features() != before).any()


@pytest.mark.parametrize(
    ("config", "values", "says"),
    [
        (FlowConfig, {"executed": 9}, "executed of FlowConfig was 9; it must be at most ahead, 8"),
        (DropoutConfig, {"dropout": 1.0}, "it must be float, from 0 up, below 1"),
        (DeconfoundedConfig, {"shortest": 3.0}, "it must be float, from 0 up, at most 1"),
        (PalrConfig, {"ridge": 0.0}, "ridge of PalrConfig was 0.0; it must be float, from 1e-09 up"),
        (DiagnoseConfig, {"refits": 0}, "refits of DiagnoseConfig was 0; it must be int, from 1 up"),
        (Amounts, {"held_out": 1.0}, "held_out of Amounts was 1.0; it must be float, from 0 up, below 1"),
    ],
)
def test_settings_that_do_not_fit(config: Any, values: Any, says: str) -> None:
    with pytest.raises(envs.InputError, match=says):
        config(**values)


@dataclass(frozen=True)
class Plain:
    updates: int = 3
    folder: Any = None


@dataclass(frozen=True)
class Nested:
    net: Plain = field(default_factory=Plain)


@pytest.mark.parametrize(
    ("declared", "says"),
    [
        ({"on_control": {"updates": 3}}, r"on_control={'updates': 3}; configurations must be an object of a dataclass"),
        ({"on_control": Nested()}, "on_control with the dataclass net; its values must be numbers, texts, lists and"),
        ({"on_control": Plain}, "on_control=<class .*; configurations must be an object"),
        ({"on_control": Plain(), "on_bandit": FlowConfig()}, "on_bandit=FlowConfig.*, and all of the same"),
        ({"on_bandit": Plain()}, "on_bandit=Plain.*, and all of the same"),
        ({"on_control": Plain(folder=Path())}, "on_control=Plain.*, as json has them .*PosixPath is not JSON"),
        ({"on_control": Plain(), "smoke": {"nope": 1}}, "smoke={'nope': 1}; .* of its configuration, updates, folder"),
        ({"on_control": Plain(), "smoke": {"folder": Path()}}, "smoke={.*, as json has them"),
        ({"on_control": Plain(), "smoke_bandit": 5}, "smoke_bandit=5; it must be a dictionary"),
        ({"smoke": {"updates": 1}}, "smoke={'updates': 1}; .* fields of its configuration, which has none"),
        ({"cost": "a"}, "cost='a'; it must be a whole number from 1 up"),
        ({"version": "x"}, "version='x'; it must be a whole number from 1 up"),
        ({"version": 0}, "version=0; it must be"),
        ({"cost": True}, "cost=True; it must be"),
    ],
)
def test_declarations_that_no_run_could_use(declared: dict[str, Any], says: str) -> None:
    with pytest.raises(envs.InputError, match=f"^a method declares {says}"):
        uses("demonstrations", **declared)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            "deconfounded.random_share=1.5",
            "random_share of DeconfoundedConfig was 1.5; it must be float, from 0 up, at",
        ),
        ("flow_bc.executed=99", "executed of FlowConfig was 99; it must be at most ahead, 8"),
        ("naive_transformer.width=20", "a transformer of 4 heads had width 20; it must be a multiple of 8"),
        ("dpt.width=20", "a transformer of 4 heads had width 20"),
    ],
)
def test_settings_that_a_command_refuses(change: str, says: str) -> None:
    """Before a run makes anything; two that fit each other alone may be given in any order."""
    settings = presets.preset("default", envs.get(CONTROL), "cpu")
    with pytest.raises(envs.InputError, match=says):
        presets.changed(settings, [change])
    presets.changed(settings, ["flow_bc.executed=99", "flow_bc.ahead=99"])


TRIALS = Trials(np.zeros((4, 2, 9, 2)), np.zeros((4, 2, 8, 1)), np.ones((4, 2, 8), bool))


@pytest.mark.parametrize(
    "train",
    [
        lambda given: memoryless_bc.train(given, MemorylessConfig(updates=1), np.random.default_rng(0)),
        lambda given: deconfounded_offline.train(given, OfflineConfig(), np.random.default_rng(0)),
        lambda given: dml_il.train(given, DmlConfig(), np.random.default_rng(0)),
    ],
)
def test_one_set_of_trials(train: Any) -> None:
    """A function gives other trials each time, so that sizes and data might be of two sets."""
    with pytest.raises(envs.InputError, match="training was given a function; it must be Trials"):
        train(lambda: TRIALS)


@pytest.mark.parametrize("answer", [None, TRIALS, (TRIALS,), (TRIALS.obs, TRIALS.action)])
def test_rollouts_and_what_is_beside_them(answer: Any) -> None:
    rng = np.random.default_rng(0)
    for train, config, what in ((dagger.train, DaggerConfig(), "labels"), (dpt.train, DptConfig(), "labels")):
        with pytest.raises(envs.InputError, match=f"roll-outs were .*; they must be Trials and {what}"):
            train(lambda behaviour: answer, config, rng)  # type: ignore[operator]
    tiny = RmaConfig(teacher_updates=1, rounds=1)
    with pytest.raises(envs.InputError, match=r"roll-outs were .*; they must be Trials and their theta"):
        rma.train(TRIALS, np.zeros((4, 2, 1)), lambda behaviour: answer, tiny, rng)


@pytest.mark.parametrize(
    ("theta", "says"),
    [
        (np.zeros((4, 1)), r"had shape \(4, 1\); it must be \(4, 2, F\) of episodes, or \(4, 2, 8, F\) of steps"),
        (np.zeros((3, 2, 1)), r"had shape \(3, 2, 1\)"),
        (np.zeros((4, 2, 9, 1)), r"had shape \(4, 2, 9, 1\)"),
        (np.full((4, 2, 1), np.nan), "held NaN or infinity; it must be finite"),
    ],
)
def test_theta_of_other_trials(theta: Any, says: str) -> None:
    with pytest.raises(envs.InputError, match=f"theta of trials {says}"):
        memoryless_bc.train(TRIALS, MemorylessConfig(updates=1), np.random.default_rng(0), theta)


def test_shares_of_one() -> None:
    assert DeconfoundedConfig(shortest=1.0, random_share=1).shortest == 1


@pytest.mark.parametrize("wrong_round", [0, 1])
@pytest.mark.parametrize("method", ["deconfounded", "deconfounded_mean"])
def test_exploration_of_another_kind(method: str, wrong_round: int) -> None:
    """In any of the rounds."""
    rng, rounds = np.random.default_rng(0), []
    trials, other = (Trials(rng.random((4, 1, 9, o)), rng.random((4, 1, 8, 1)), np.ones((4, 1, 8))) for o in (2, 3))

    def explore(agent: Agent | None) -> Trials:
        rounds.append(agent)
        return other if len(rounds) == wrong_round + 1 else trials

    tiny = tiny_preset().configs[method]
    module, config = {
        "deconfounded": (deconfounded, DeconfoundedConfig),
        "deconfounded_mean": (deconfounded_mean, MeanConfig),
    }[method]
    with pytest.raises(envs.InputError, match=r"exploration is Signature\(obs=3, .* they must agree"):
        module.train(trials, explore, config(**tiny), rng)  # type: ignore[operator]
    assert len(rounds) == wrong_round + 1


@pytest.mark.parametrize(
    ("train", "config"), [(deconfounded.train, DeconfoundedConfig), (deconfounded_mean.train, MeanConfig)]
)
def test_observations_that_are_0_or_1_in_demonstrations_alone(train: Any, config: Any) -> None:
    """As a count of errors, where the expert makes none: they are modelled as numbers, and not as coins."""
    task = envs.get("bandit")
    env = envs.BatchEnv(task, 4)
    coins = run_trials(env, RandomAgent(task.action_space), 1, 0).trials
    counts = Trials(coins.obs.cumsum(2), coins.action, coins.mask, coins.actions)
    agent = train(coins, lambda behaviour: counts, config(**FEW), [np.random.default_rng(0)])
    assert not agent.policy.signature.binary
    agent.begin(2)
    agent.reset([np.random.default_rng(0)])
    assert agent.act(np.full((2, 1), 7.0, np.float32)).shape == (2, 1)


def test_an_agent_takes_no_nan(agents: dict[str, Agent]) -> None:
    """No action follows of it."""
    agent = agents["bandit"]
    agent.begin(2)
    agent.reset([np.random.default_rng(0)])
    with pytest.raises(envs.InputError, match="observations held NaN or infinity"):
        agent.act(np.array([[0.0], [np.nan]], np.float32))
    with pytest.raises(envs.InputError, match="or more than 1e"):
        agent.act(np.array([[0.0], [1e16]], np.float32))


def test_an_agent_whose_memory_has_overflowed(agents: dict[str, Agent], monkeypatch: pytest.MonkeyPatch) -> None:
    """It says so, and gives no NaN to a robot."""
    agent = agents["bandit"]
    agent.begin(2)
    agent.reset([np.random.default_rng(0)])
    monkeypatch.setattr(agent, "choose", lambda obs: torch.tensor([[[0.0], [torch.nan]]]))
    with pytest.raises(envs.InputError, match=r"an action was NaN: .* begin again"):
        agent.act(np.zeros((2, 1), np.float32))


def test_the_expert_of_other_environments() -> None:
    task = envs.get(CONTROL)
    env, other = envs.BatchEnv(task, 2), envs.BatchEnv(task, 2)
    agent = ExpertAgent(other, expert(task))
    for given in (agent, AgentWrapper(AgentWrapper(agent))):
        with pytest.raises(envs.InputError, match="reads the state or theta of other environments"):
            run_trials(env, given, 1, 0)


class TestLikelihoods:
    def particles(self, monkeypatch: pytest.MonkeyPatch, likelihood: Any) -> Particles:
        """A belief that has taken in one step, whose log-likelihoods [N, K] are a function of its thetas' first."""
        task = Three()
        env = envs.BatchEnv(task, 3)
        env.reset(0)
        belief = Particles(env, expert(task), False)
        belief.begin(3)
        belief.reset(Streams([np.random.default_rng(0)]))
        monkeypatch.setattr(belief, "_log_prob", lambda *_: likelihood(belief.theta[..., 0]))
        belief.learn(env.state, env.state, np.zeros((3, 1)), env.state, np.ones(3, bool))
        return belief

    def test_a_bounded_sensor(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Thetas whose likelihood is 0 lose all weight; the others keep theirs, to a part in a million."""
        belief = self.particles(monkeypatch, lambda x: np.where(x > 0.5, 0.0, -np.inf))
        weight = np.exp(belief.log_weight)
        assert (weight * (belief.theta[..., 0] > 0.5)).sum(-1) == pytest.approx(1, abs=1e-6)
        assert (weight * belief.theta[..., 0]).sum(-1) == pytest.approx(0.75, abs=0.05)

    @pytest.mark.parametrize("value", [-np.inf, np.nan])
    def test_no_likelihood(self, monkeypatch: pytest.MonkeyPatch, value: float) -> None:
        with pytest.raises(envs.InputError, match="a step's likelihood was NaN, or 0 under every particle"):
            self.particles(monkeypatch, lambda x: np.full_like(x, value))

    def test_likelihoods_too_far_apart(self, monkeypatch: pytest.MonkeyPatch) -> None:
        with pytest.raises(envs.InputError, match="likelihoods of a step differ too much"):
            self.particles(monkeypatch, lambda x: -1e12 * x)


@pytest.mark.parametrize("kind", ["forgetting", "discrete"])
def test_models_without_beliefs_of_sets(kind: str) -> None:
    rng = np.random.default_rng(0)
    trials = Trials(rng.random((4, 1, 9, 2)), rng.random((4, 1, 8, 1)), np.ones((4, 1, 8)))
    data, draws = Batch.of(trials, 1), Draws([rng], "cpu")
    model = new_model(kind, 2, 8, Scales.of(Signature.of(trials), data), draws)
    with pytest.raises(envs.InputError, match=f"model {kind} has no belief of a set of steps"):
        model.loss_on_sets(data, None, 1.0, draws)


def test_starts_of_episodes_that_did_not_take_place() -> None:
    """They are those of an episode of the same trial that did."""
    obs = np.arange(2 * 3 * 3, dtype=np.float32).reshape(2, 3, 3, 1)
    mask = np.ones((2, 3, 2), bool)
    mask[0, 1:] = mask[1, 0] = False
    trials = Trials(obs, np.zeros((2, 3, 2, 1)), mask)
    assert starts_of(trials)[..., 0].tolist() == [[0, 0, 0], [12, 12, 15]]


def test_trials_can_be_compared_and_hashed() -> None:
    """By identity, as arrays have no single truth value."""
    trials = Trials(np.zeros((1, 1, 3, 1)), np.zeros((1, 1, 2, 1)), np.ones((1, 1, 2)))
    assert trials == trials
    assert trials != replace(trials)
    assert len({trials, replace(trials)}) == 2
