"""Diagnosis: bad input is refused in one line, figures lead to their verdicts, and the commands run."""

import html
import json
import re
from functools import partialmethod
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from deconfounded import envs
from deconfounded.benchmarks import diagnose as command
from deconfounded.benchmarks.console import run_command
from deconfounded.deconf.core.data import Batch
from deconfounded.deconf.diagnosis import advice, diagnose, fits, learned_env, measures
from deconfounded.deconf.diagnosis.diagnose import DiagnoseConfig
from deconfounded.deconf.diagnosis.judgement import judge
from deconfounded.deconf.diagnosis.measures import Amounts, Findings
from deconfounded.deconf.methods.deconfounded import DeconfoundedConfig
from deconfounded.deconf.methods.deconfounded_offline import OfflineConfig
from deconfounded.deconf.methods.memoryless_bc import MemorylessConfig
from deconfounded.deconf.methods.sequence_bc import RecurrentConfig
from deconfounded.envs.support.errors import InputError
from deconfounded.experts import policy
from deconfounded.experts.agent import ExpertAgent, RandomAgent
from deconfounded.experts.rollout import run_trials
from deconfounded.experts.trials import Trials

ROOT = Path(__file__).parents[2]
TINY = Amounts(
    candidates=2,
    rollouts=4,
    cloning=MemorylessConfig(updates=5, batch=64),
    naive=RecurrentConfig(updates=6, batch=4),
    offline=OfflineConfig(offline_updates=5, online_updates=0, offline_batch=4, offline_steps=16),
    exploring=DeconfoundedConfig(inference_updates=5, inference_batch=4, inference_steps=32),
)


def trials(n: int = 24, episodes: int = 2, steps: int = 3, seed: int = 0) -> Trials:
    rng = np.random.default_rng(seed)
    shape = (n, episodes, steps)
    return Trials(rng.normal(size=(n, episodes, steps + 1, 2)), rng.uniform(-1, 1, (*shape, 1)), np.ones(shape, bool))


def repeated(data: Trials, index: list[int]) -> Trials:
    return Trials(data.obs[index], data.action[index], data.mask[index])


class TestSplit:
    """Trials for training and held-out ones."""

    def test_a_trial_is_there_once(self) -> None:
        """In a split with copies, one held out would be known, and "another trial" the same."""
        data = trials(12)
        whole = fits.distinct(repeated(data, [*range(12), *range(12), 3, 3]))
        np.testing.assert_array_equal(whole.obs, data.obs)
        assert fits.distinct(data) is data
        mask = data.mask.copy()
        mask[4:6] = False
        assert len(fits.distinct(Trials(data.obs, data.action, mask))) == 10

    def test_figures_do_not_depend_on_copies(self) -> None:
        data, other = trials(24), trials(24, seed=1)
        twice = [repeated(of, [*range(24), *range(12)]) for of in (data, other)]
        figures = [
            measures.measure(*of, TINY, np.random.default_rng(0)) for of in ((data, other), (twice[0], twice[1]))
        ]
        assert figures[0] == figures[1]

    @pytest.mark.parametrize("unit", [1.0, 1e6, 1e-9])
    def test_dynamics_are_valid_near_the_data_in_any_unit(self, unit: float) -> None:
        data = trials(24)
        low, high = learned_env.valid_range(Batch.of(Trials(unit * data.obs, data.action, data.mask), 1))
        least, most = learned_env.observed_range(Batch.of(data, 1))
        torch.testing.assert_close((high - low) / unit, 2 * (most - least))

    def test_without_copies_the_share_is_exact(self) -> None:
        data = trials(24)
        train, held_out = measures.split(data, 0.25, np.random.default_rng(0))
        order = np.random.default_rng(0).permutation(24)
        assert np.array_equal(np.concatenate([held_out.obs, train.obs]), data.obs[order])
        assert len(held_out) == 6


class TestBadInput:
    @pytest.mark.parametrize(
        ("given", "message"),
        [
            (lambda: trials(1, 1), "1 trial given; at least 24 are needed"),
            (lambda: trials(5), "5 trials given; at least 24 are needed"),
            (lambda: trials(steps=1), "every episode is of one step"),
        ],
    )
    def test_too_little(self, given, message: str) -> None:
        with pytest.raises(InputError, match=message):
            diagnose.check(given(), None, DiagnoseConfig())

    def test_copies_do_not_count(self) -> None:
        data = trials(26)
        with pytest.raises(InputError, match="26 trials given, of which 3 repeat another; at least 24 different ones"):
            diagnose.check(repeated(data, [0, 0, 0, 1, 1, *range(5, 26)]), None, DiagnoseConfig())

    def test_trials_without_a_step_do_not_count(self) -> None:
        data = trials(26)
        mask = data.mask.copy()
        mask[:3] = False
        with pytest.raises(InputError, match=r"^23 trials given; at least 24 are needed"):
            diagnose.check(Trials(data.obs, data.action, mask), None, DiagnoseConfig())

    def test_observations_that_never_change(self) -> None:
        data = trials()
        with pytest.raises(InputError, match=r"^no observation ever changes within an episode; there are no dynamics"):
            diagnose.check(Trials(0 * data.obs + 3, data.action, data.mask), None, DiagnoseConfig())

    def test_constant_actions(self) -> None:
        data = trials()
        with pytest.raises(InputError, match="every action is the same"):
            diagnose.check(Trials(data.obs, 0 * data.action + 0.5, data.mask), None, DiagnoseConfig())

    def test_steps_after_one_that_did_not_take_place(self) -> None:
        data = trials()
        mask = data.mask.copy()
        mask[3, 0, 0] = False
        with pytest.raises(InputError, match="a mask has steps after one that did not take place"):
            diagnose.check(Trials(data.obs, data.action, mask), None, DiagnoseConfig())

    def test_what_are_no_trials_and_no_generator(self) -> None:
        config, rng = DiagnoseConfig(), np.random.default_rng(0)
        with pytest.raises(InputError, match="diagnose was given a ndarray; it must be Trials"):
            diagnose.diagnose(trials().obs, None, config, rng)  # type: ignore[arg-type]
        with pytest.raises(InputError, match="diagnose was given a list; it must be Trials"):
            diagnose.diagnose(trials(), [], config, rng)  # type: ignore[arg-type]
        with pytest.raises(InputError, match="diagnose was given a NoneType; it must be Trials"):
            diagnose.diagnose(None, None, config, rng)  # type: ignore[arg-type]
        with pytest.raises(InputError, match="config was None; it must be a DiagnoseConfig"):
            diagnose.diagnose(trials(), None, None, rng)  # type: ignore[arg-type]
        with pytest.raises(InputError, match="rng was 0; it must be a generator"):
            diagnose.diagnose(trials(), None, config, 0)  # type: ignore[arg-type]

    def test_nan(self) -> None:
        data = trials()
        with pytest.raises(InputError, match="NaN"):
            Trials(data.obs * np.nan, data.action, data.mask)

    def test_other_observations(self) -> None:
        expert, other = trials(), trials(seed=1)
        wider = Trials(np.concatenate([other.obs] * 2, -1), other.action, other.mask)
        with pytest.raises(InputError, match="exploration has other observations"):
            diagnose.check(expert, wider, DiagnoseConfig())

    def test_exploration_is_checked_too(self) -> None:
        with pytest.raises(InputError, match="5 trials of exploration given"):
            diagnose.check(trials(), trials(5), DiagnoseConfig())

    def test_exploration_elsewhere(self) -> None:
        expert, other = trials(), trials(seed=1)
        for obs in (other.obs + 99, 999 * other.obs):  # elsewhere, and nearly everywhere
            with pytest.raises(InputError, match="where the expert goes for"):
                diagnose.check(expert, Trials(obs, other.action, other.mask), DiagnoseConfig())

    @pytest.mark.slow
    def test_command(self, tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
        """One line and exit code 2: no file, no trials in it, too few."""
        trials(5).save(tmp_path / "few.npz")
        (tmp_path / "junk.npz").write_bytes(b"junk")
        for name, line in (("none.npz", "there is no"), ("junk.npz", "no trials could"), ("few.npz", "5 trials given")):
            monkeypatch.setattr("sys.argv", ["diagnose", "--data", str(tmp_path / name), "--out", str(tmp_path)])
            with pytest.raises(SystemExit) as stopped:
                run_command(command.main)
            assert stopped.value.code == 2
            error = capsys.readouterr().err
            assert line in error
            assert error.count("\n") == 1


CLEAR = Findings(
    memory_gain=1.0,
    exploration_evidence=0.2,
    dynamics_differ=0.5,
    expert_evidence=0.2,
    action_evidence=50.0,
    latent_gain=0.5,
    over_memory=-0.5,
    stakes=3.0,
    paired_stakes=9.0,
    model_deviation=3.0,
    model_length=1.0,
    naive=0.2,
    latent=0.9,
    naive_by_actions=-0.1,
    latent_by_actions=0.8,
)

NO_FIGURES = ("latent_gain", "over_memory", "exploration_evidence", "expert_evidence", "action_evidence")
SMALL = {"naive_by_actions": 0.8}
ALONE = dict.fromkeys((*NO_FIGURES, "dynamics_differ"))
SILENT = {
    **{"exploration_evidence": 0.0, "dynamics_differ": 0.0},
    **{"expert_evidence": 0.05, "latent_gain": -0.1},
    **{"trait_gain": 0.6, "trait_stakes": 2.0, "paired_trait_stakes": 5.0},
}


class TestJudge:
    """Each way through `judge`, by figures that lead there."""

    @pytest.mark.parametrize(
        ("changes", "verdict", "tier", "then"),
        [
            ({}, "confounded", 2, advice.EXPLORE),
            (ALONE, "cannot tell", None, advice.EXPLORE_FIRST),
            (
                {**ALONE, "stakes": 1.0, "paired_stakes": 1.0, "model_deviation": 1.0},
                "cannot tell",
                None,
                advice.EXPLORE_FIRST,
            ),
            (SILENT, "confounded", 3, advice.QUERY),
            ({**SILENT, "latent_gain": 0.05}, "confounded", 3, advice.QUERY),
            ({**SILENT, "latent_gain": 0.4}, "confounded", 3, advice.QUERY),
            ({**SILENT, "dynamics_differ": 0.4}, "cannot tell", None, advice.EXPLORE_MORE),
            ({**SILENT, "dynamics_differ": None}, "cannot tell", None, advice.EXPLORE_MORE),
            ({**SILENT, "exploration_evidence": 0.8, "expert_evidence": 0.3}, "confounded", 3, advice.QUERY),
            ({**SILENT, "trait_gain": None}, "cannot tell", None, advice.MORE_TRIALS),
            ({**SILENT, "trait_gain": -0.5}, "cannot tell", None, advice.MORE_TRIALS),
            ({**SILENT, "trait_gain": 0.05}, "nothing at stake", 1, advice.CLONE_HABITS),
            ({**SILENT, "trait_gain": 0.09}, "nothing at stake", 1, advice.CLONE_HABITS),
            ({**SILENT, "paired_trait_stakes": 2.0}, "nothing at stake", 1, advice.CLONE_HABITS),
            ({"dynamics_differ": None}, "cannot tell", None, advice.EXPLORE_MORE),
            ({"shared": 0.6}, "confounded", 2, advice.EXPLORE),
            ({"shared": 0.4}, "cannot tell", None, advice.EXPLORE_MORE),
            ({"expert_evidence": 0.05}, "confounded", 2, advice.EXPLORE),
            ({"latent_gain": -0.1}, "cannot tell", None, advice.EXPLORE_MORE),
            ({"naive": 0.98, "latent": 1.0}, "nothing at stake", 1, advice.CLONE_HABITS),
            ({"over_memory": 0.4, "naive": 0.98, "latent": 1.0}, "cannot tell", None, advice.MORE_TRIALS),
            ({"over_memory": 0.3, "naive": 0.98, "latent": 1.0}, "nothing at stake", 1, advice.CLONE_HABITS),
            ({"over_memory": 0.4}, "cannot tell", None, advice.MORE_TRIALS),
            ({"latent_gain": 5.0}, "confounded", 2, advice.EXPLORE),  # over a policy that learned trials by heart
            ({"memory_gain": 0.0, "latent_gain": 0.05}, "cannot tell", None, advice.MORE_TRIALS),
            ({"memory_gain": 0.0, "over_memory": 0.3}, "cannot tell", None, advice.MORE_TRIALS),
            ({"memory_gain": 0.0, "latent_gain": 0.05, "model_deviation": 5.0}, "not confounded", 1, advice.CLONE),
            ({"memory_gain": 0.0, "latent_gain": -0.1}, "not confounded", 1, advice.CLONE),
            ({"memory_gain": 0.0, "over_memory": 0.3, "dynamics_differ": 0.0}, "cannot tell", None, advice.VARY_LATENT),
            (
                {"memory_gain": 0.0, "exploration_evidence": 0.0, "over_memory": 0.3},
                "cannot tell",
                None,
                advice.MORE_TRIALS,
            ),
            ({"expert_evidence": -0.5}, "cannot tell", None, advice.EXPLORE_MORE),
            ({"stakes": 1.1}, "confounded", 2, advice.EXPLORE),
            ({"paired_stakes": 1.1}, "confounded", 2, advice.EXPLORE),
            ({"stakes": 1.1, "paired_stakes": 1.4}, "not confounded", 1, advice.CLONE),
            ({"stakes": 1.1, "paired_stakes": 1.4, "model_deviation": 5.0}, "cannot tell", None, advice.EXPLORE_MORE),
            ({"stakes": 1.1, "paired_stakes": 1.4, "model_length": 0.4}, "cannot tell", None, advice.EXPLORE_MORE),
            ({"naive": 0.98, "latent": 1.0, "model_length": 0.4}, "cannot tell", None, advice.EXPLORE_MORE),
            ({"model_length": 0.4}, "confounded", 2, advice.EXPLORE),
            ({"stakes": 1.1, "paired_stakes": 1.4, "latent_gain": -0.1}, "nothing at stake", 1, advice.CLONE_HABITS),
            ({"expert_evidence": -5.0, "latent_gain": -5.0}, "cannot tell", None, advice.EXPLORE_MORE),
            ({"memory_gain": -1.0}, "cannot tell", None, advice.MORE_TRIALS),
            ({"naive": 0.7, "latent": 0.75, "naive_by_actions": 0.75}, "cannot tell", None, advice.MORE_TRIALS),
            ({"naive": 0.95, "latent": 1.0, "naive_by_actions": 0.75}, "not confounded", 1, advice.CLONE),
            ({"naive": 0.95, "latent": 1.0}, "confounded", 2, advice.EXPLORE),
            (
                {"memory_gain": 0.001, "latent_gain": 0.0, "expert_evidence": -0.002},
                "cannot tell",
                None,
                advice.VARY_LATENT,
            ),
            ({"memory_gain": 0.001, **ALONE}, "cannot tell", None, advice.MORE_TRIALS),
            ({**ALONE, "memory_gain": 0.001, "naive": 0.9, **SMALL}, "cannot tell", None, advice.VARY_LATENT),
            ({"latent": 0.1, "latent_by_actions": -0.2}, "cannot tell", None, advice.MORE_TRIALS),
        ],
    )
    def test_verdict(self, changes: dict, verdict: str, tier: int | None, then: advice.Next) -> None:
        diagnosis = judge([CLEAR._replace(**changes)] * 3)
        assert (diagnosis.verdict, diagnosis.tier, diagnosis.next) == (verdict, tier, then)

    def test_refits_that_disagree(self) -> None:
        """No confident verdict where refits lie on both sides of what decides."""
        assert judge([CLEAR, CLEAR._replace(memory_gain=0.0)]).verdict == "cannot tell"
        assert judge([CLEAR, CLEAR._replace(latent=0.1, latent_by_actions=-0.2)]).verdict == "cannot tell"
        assert judge([CLEAR._replace(naive=0.5), CLEAR._replace(latent=0.4)]).verdict == "confounded"
        assert judge([CLEAR, CLEAR._replace(expert_evidence=-0.002)]).verdict == "cannot tell"
        mixed = CLEAR._replace(**SILENT)
        assert judge([mixed, mixed]).tier == 3
        assert judge([mixed, mixed._replace(trait_gain=0.05)]).verdict == "cannot tell"
        assert judge([mixed, mixed, mixed._replace(paired_trait_stakes=2.9)]).verdict == "cannot tell"
        alike = CLEAR._replace(paired_stakes=1.4)
        assert judge([alike, alike._replace(stakes=0.9)]).verdict == "cannot tell"
        assert judge([alike._replace(stakes=1.8), alike._replace(stakes=1.1)]).verdict == "cannot tell"

    @pytest.mark.parametrize(
        ("both", "first", "second", "verdict"),
        [
            ({"stakes": 1.1, "paired_stakes": 1.4}, {"latent_gain": 0.5}, {"latent_gain": -0.1}, "cannot tell"),
            (SILENT, {"trait_gain": 0.05}, {"trait_gain": 0.12}, "cannot tell"),
            ({"over_memory": 0.4}, {"memory_gain": 0.6}, {"memory_gain": 1.4}, "confounded"),
            (
                {"naive_by_actions": 0.8},
                {"naive": 0.9, "latent": 0.95},
                {"naive": 0.78, "latent": 0.83},
                "cannot tell",
            ),
            ({"latent": 1.0}, {"naive": 1.0}, {"naive": 0.96}, "confounded"),
            ({"latent_gain": -0.1}, {"memory_gain": -0.05}, {"memory_gain": 0.12}, "cannot tell"),
        ],
    )
    def test_the_farther_split_decides(self, both: dict, first: dict, second: dict, verdict: str) -> None:
        """Though the mean of the two is on this side of a threshold."""
        splits = [CLEAR._replace(**{**both, **changes}) for changes in (first, second)]
        assert judge(splits).verdict == verdict

    def test_what_the_others_say(self) -> None:
        """A verdict that most splits give alone stands, and says how sure it is; that of fewer does not."""
        diagnosis = judge([CLEAR, CLEAR, CLEAR._replace(over_memory=1.0)])
        assert (diagnosis.verdict, diagnosis.agreeing, diagnosis.dissenting) == ("confounded", 2, ("cannot tell",))
        assert "Not very: 2 of 3 random splits" in diagnosis.sure
        assert "(the others: cannot tell)" in diagnosis.sure
        assert judge([CLEAR] * 2).dissenting == ()
        few = judge([CLEAR, CLEAR._replace(latent_gain=-0.1), CLEAR._replace(over_memory=1.0)])
        assert (few.verdict, few.tier, few.agreeing, few.next) == ("cannot tell", None, 2, advice.MORE_TRIALS)
        assert few.dissenting == ("confounded, Tier 2",)
        assert "lead to different verdicts" in few.conclusion

    def test_splits_that_agree_against_all_of_them(self) -> None:
        """Each alone says that the memory learned too little, and all together do not: then that is what is said."""
        splits = [CLEAR._replace(memory_gain=gain, over_memory=0.3 * gain + 0.3) for gain in (0.5, 1.0, 1.5)]
        diagnosis = judge(splits)
        assert {judge([split]).verdict for split in splits} == {"cannot tell"}
        assert (diagnosis.verdict, diagnosis.next, diagnosis.agreeing) == ("cannot tell", advice.MORE_TRIALS, 3)
        assert diagnosis.conclusion == judge(splits[:1]).conclusion
        assert "different verdicts" not in diagnosis.conclusion

    def test_harmless_verdicts_agree(self) -> None:
        """That nothing is at stake, and that a clone infers what is hidden by itself: either way it loses nothing."""
        at_rest, infers = (CLEAR._replace(naive=x, naive_by_actions=x, latent=x) for x in (1.0, 0.9))
        assert [judge([split]).verdict for split in (at_rest, infers)] == ["nothing at stake", "not confounded"]
        both = judge([at_rest, at_rest, infers])
        assert (both.verdict, both.tier, both.agreeing, both.dissenting) == ("not confounded", 1, 3, ())

    def test_nan(self) -> None:
        with pytest.raises(InputError, match="learning failed: model_deviation is"):
            judge([CLEAR, CLEAR._replace(model_deviation=float("nan"))])

    @pytest.mark.parametrize(("naive", "headline"), [(0.2, "Confounded"), (0.77, "Confounded, at a small cost")])
    def test_headline(self, naive: float, headline: str) -> None:
        """It says so if little is lost."""
        assert judge([CLEAR._replace(naive=naive, latent=1.0)]).headline == headline

    def test_cost(self) -> None:
        """What is lost is what the score lacks: its range is from the least loss to the most."""
        assert "by 70% (50% to 80%) of" in judge([CLEAR, CLEAR, CLEAR._replace(naive=0.5)]).cost

    def test_no_cost_is_promised_against_the_figures(self) -> None:
        """A clone that leaves the course in the learned model, where it matters, may lose by it."""
        memoryless = CLEAR._replace(memory_gain=0.0, latent_gain=-0.1)
        free = "Next to nothing, as far as the learned model of your system shows."
        assert judge([memoryless]).verdict == "not confounded"
        assert judge([memoryless]).cost == "Not known from these data."
        assert judge([memoryless._replace(naive=0.9, naive_by_actions=0.9)]).cost == free
        assert judge([CLEAR._replace(stakes=1.1, paired_stakes=1.4)]).cost == free

    def test_figures(self) -> None:
        """The mean over refits, the least, and the most of them."""
        figures = judge([CLEAR, CLEAR, CLEAR._replace(naive=0.5, expert_evidence=0.5)]).figures
        assert figures["naive"] == pytest.approx((0.3, 0.2, 0.5))
        assert figures["ratio"] == pytest.approx((200, 100, 250))
        assert str(figures["ratio"]) == "200 (100 to 250)"
        assert "exploration_evidence" not in judge([CLEAR._replace(**ALONE)]).figures


def _bandit(n: int = 24) -> tuple[Trials, Trials]:
    task = envs.get("bandit")
    env = envs.BatchEnv(task, n)
    expert = run_trials(env, ExpertAgent(env, policy.load(task)), task.episodes, 0).trials
    return expert, run_trials(env, RandomAgent(task.action_space), task.episodes, 1).trials


@pytest.mark.slow
@pytest.mark.parametrize("make", [_bandit, lambda: (trials(), trials(seed=1))], ids=["discrete", "continuous"])
def test_measures(make) -> None:
    """Figures come out finite, for both kinds of actions, and the same again from the same seed."""
    expert, explored = make()
    first, second = (measures.measure(expert, explored, TINY, np.random.default_rng(0)) for _ in range(2))
    assert first == second
    assert np.isfinite([value for value in first if value is not None]).all()
    alone = measures.measure(expert, None, TINY, np.random.default_rng(0))
    assert {getattr(alone, name) for name in ALONE} == {None}
    assert np.isfinite([alone.memory_gain, alone.stakes, alone.naive, alone.latent]).all()


def test_figures_of_rollouts() -> None:
    """A naive clone goes where a wrong latent leads, and errs by three quarters as much; the other imitator is right.

    Episodes of the expert itself end after 5 of 10 steps.
    """
    noise, made = np.random.default_rng(0), list[Any]()

    class Env:
        def __init__(self, right: Any) -> None:
            self.right = right

        def rollout(self, actor: Any, rngs: Any) -> learned_env.Rollout:
            made.append(actor)
            kind = type(actor).__name__
            wrong = kind == "AgentActor" or (kind == "LatentPolicy" and actor is not self.right)
            error = {"AgentActor": 0.75, "PosteriorSampler": 0.25}.get(kind, float(wrong))
            paths = torch.tensor(noise.normal(5 * wrong, 1, (1, 64, 10, 1)), dtype=torch.float32)
            return learned_env.Rollout(torch.tensor([error]), paths, torch.full((1, 64), 5.0))

    explanation: Any = SimpleNamespace(latents=torch.linspace(-1, 1, 8)[None, :, None], dynamics=None, policy=None)
    episodes = Batch.of(
        Trials(noise.normal(size=(64, 1, 11, 1)), np.zeros((64, 1, 10, 1)), np.ones((64, 1, 10), bool)), 1
    )
    make: Any = Env
    figures = measures._rollouts(explanation, make, Mock(), episodes, TINY, [np.random.default_rng(0)])
    stakes, paired_stakes, unlike, length, naive, inferring, *by_actions = figures
    assert min(stakes, paired_stakes) > 2
    assert unlike < 2
    assert length == 0.5
    assert (naive, inferring) == pytest.approx((0, 1), abs=0.1)
    assert by_actions == pytest.approx([0.25, 0.75])


@pytest.mark.slow
def test_gain_by_memory() -> None:
    """Actions that depend on a hidden sign: a memory gains log 2 nats a step, except for the first."""
    rng = np.random.default_rng(0)
    shape = (64, 1, 20)
    sign = rng.integers(2, size=(64, 1, 1, 1)) * np.ones((*shape, 1))
    obs, amounts = (
        rng.normal(size=(64, 1, 21, 1)),
        Amounts(
            **{**vars(TINY), "cloning": MemorylessConfig(updates=200), "naive": RecurrentConfig(updates=150, chunk=20)}
        ),
    )
    hidden = Trials(obs, sign, np.ones(shape, bool), 2)
    findings = measures.measure(hidden, None, amounts, np.random.default_rng(0))
    assert findings.memory_gain == pytest.approx(np.log(2) * 19 / 20, abs=0.06)
    chance = Trials(obs, rng.integers(2, size=(*shape, 1)), np.ones(shape, bool), 2)
    assert measures.measure(chance, None, amounts, np.random.default_rng(0)).memory_gain < 0.02


@pytest.mark.usefixtures("here")
def test_a_diagnosis_says_what_it_was_made_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both logs, each by its own name, contents and shape, and the seed."""
    logs = [tmp_path / "expert.npz", tmp_path / "explored.npz"]
    for n, file in enumerate(logs, 24):
        trials(n, seed=n).save(file)
    monkeypatch.setattr("deconfounded.benchmarks.engine.scheduler.run_jobs", lambda *_: [])
    monkeypatch.setattr(diagnose, "conclude", lambda *_: None)
    monkeypatch.setattr(command.look, "look", lambda *_: [])
    monkeypatch.setattr("deconfounded.benchmarks.output.diagnosis.write", lambda _, about, folder: about)
    about: Any = command.run(logs[:1], logs[1:], {}, 5, tmp_path / "out", "")[1]
    for key, n, file in zip(("trials", "explore"), (24, 25), logs, strict=True):
        assert about[key] == {"from": str(file), "sha256": trials(n, seed=n).sha256, "shape": (n, 2, 3)}
    assert about["seed"] == 5


@pytest.mark.slow
@pytest.mark.usefixtures("here")
def test_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    """A page that needs no other file, a json that says the same; a second time nothing is measured again.

    A diagnosis of other data, or with another seed, does not take the place of a finished one.
    """
    monkeypatch.setattr(diagnose.DiagnoseConfig, "__init__", _tiny_init)
    monkeypatch.setattr(type(envs.get("bandit")), "horizon", 20)
    for name, data in zip(("expert", "explored"), _bandit(), strict=True):
        data.save(tmp_path / f"{name}.npz")
    options = ["--data", str(tmp_path / "expert.npz"), "--explore", str(tmp_path / "explored.npz")]
    monkeypatch.setattr("sys.argv", ["diagnose", *options, "--out", str(tmp_path / "out")])
    command.main()
    first = capsys.readouterr().out
    written = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert advice.HEADLINES[written["verdict"]].upper() in first
    assert set(written["figures"]) >= {*Findings._fields[:14], "gap", "gap_by_actions", "ratio"} - {"dynamics_differ"}
    page = (tmp_path / "out" / "index.html").read_text()
    unfolded, _, folded = html.unescape(page).partition("<details>")
    for key in ("headline", "conclusion", "cost", "sure", "wrong"):
        assert written[key] in unfolded
    assert not re.search(r"nats|Tier|Eq\.", unfolded.partition("A look at the data")[0].partition("What to do")[0])
    assert written["reasons"][0] in folded
    assert not re.search(r"(src|href)=\"(?!data:)", page)
    assert first.count("measured in") == 2
    command.main()
    assert "measured in" not in capsys.readouterr().out
    assert json.loads((tmp_path / "out" / "diagnosis.json").read_text())["figures"] == written["figures"]
    for other, differs in ((options[:2], "explore"), ([*options, "--seed", "1"], "seed")):
        monkeypatch.setattr("sys.argv", ["diagnose", *other, "--out", str(tmp_path / "out")])
        with pytest.raises(InputError, match=rf"out holds a run that differs in its {differs} .*; give another --out"):
            command.main()
    assert json.loads((tmp_path / "out" / "diagnosis.json").read_text())["figures"] == written["figures"]
    monkeypatch.setattr("sys.argv", ["diagnose", *options[:2], "--out", str(tmp_path / "alone")])
    command.main()
    assert "exploration_evidence" not in json.loads((tmp_path / "alone" / "diagnosis.json").read_text())["figures"]


FEWER = {
    "EPISODES, STEPS = 3, 60": "EPISODES, STEPS = 2, 20",
    "range(192)": "range(24)",
    "range(96)": "range(24)",
    "range(32)": "range(4)",
    "trials=40": "trials=2",
    "RecurrentConfig()": "RecurrentConfig(updates=6)",
    "rounds=4, inference_rate=3e-3": "rounds=2, inference_updates=5, imitation_updates=5, final_updates=5",
}


@pytest.mark.slow
@pytest.mark.usefixtures("here")
def test_tutorial(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    """Every line of docs/diagnose.md, on less data and with less training."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(diagnose.DiagnoseConfig, "__init__", partialmethod(_tiny_init, refits=1))
    text = (ROOT / "docs" / "diagnose.md").read_text()
    for much, few in FEWER.items():
        assert much in text
        text = text.replace(much, few)
    exec("\n".join(re.findall(r"```python\n(.*?)```", text, re.S)), {})
    assert "naive clone" in capsys.readouterr().out
    assert (tmp_path / "agent" / "agent.json").is_file()


def _tiny_init(self: DiagnoseConfig, refits: int = 2) -> None:
    for key, value in {"refits": refits, "least": 24, "amounts": TINY}.items():
        object.__setattr__(self, key, value)
