"""What studies and commands hand on and keep: splits, thetas, amounts and verdicts, by what they mean."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from deconfounded import envs
from deconfounded.benchmarks import certify, diagnose, verify
from deconfounded.benchmarks import score as score_command
from deconfounded.benchmarks.engine import identity, protocols, scheduler
from deconfounded.benchmarks.engine.benchmark import BenchmarkJob, evaluate
from deconfounded.benchmarks.engine.catalogue import DEFAULT, METHODS
from deconfounded.benchmarks.engine.context import EVALUATION, Context, stream
from deconfounded.benchmarks.engine.presets import preset
from deconfounded.benchmarks.engine.published import RECORDS
from deconfounded.benchmarks.output import records
from deconfounded.benchmarks.studies import exploration, spectrum, validate
from deconfounded.benchmarks.studies.foreign import measure as foreign
from deconfounded.deconf.core.monitor import Monitor
from deconfounded.deconf.diagnosis import exploration as explorers
from deconfounded.deconf.diagnosis import measures
from deconfounded.deconf.diagnosis.advice import EXPLORE, VARY_LATENT, Next
from deconfounded.deconf.diagnosis.measures import Amounts
from deconfounded.deconf.diagnosis.verdict import Diagnosis, Figure
from deconfounded.deconf.exact import Grid
from deconfounded.deconf.particles import exact_agent
from deconfounded.envs.latent import Latent
from deconfounded.envs.streams import Array
from deconfounded.experts import policy
from deconfounded.experts.agent import RandomAgent
from deconfounded.experts.policy import CallableExpert
from deconfounded.experts.rollout import run_trials
from deconfounded.experts.trials import Trials, of_steps
from tests import toys
from tests.tools import deconf, tiny_preset

PUSH = toys.Push()
EXPERT = CallableExpert(PUSH, toys.control, "control")


class Stopped(Exception):  # noqa: N818 (nothing is wrong)
    """Raised where a test has seen enough."""


def test_each_split_has_a_generator_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """That of `diagnose` in Python, in the same order."""
    trials = run_trials(envs.BatchEnv(PUSH, 4), RandomAgent(PUSH.action_space), 2, 0).trials
    trials.save(tmp_path / "trials.npz")
    (tmp_path / "jobs").mkdir()
    findings = SimpleNamespace(_asdict=lambda: {"draw": drawn[-1]})
    drawn: list[float] = []
    monkeypatch.setattr(measures, "measure", lambda *given: (drawn.append(given[3].random()), findings)[1])
    for i in range(3):
        diagnose.Refit(tmp_path / "trials.npz", None, Amounts(), i, 5, 3, tmp_path).run()
    assert drawn == [rng.random() for rng in np.random.default_rng(5).spawn(3)]
    assert json.loads((tmp_path / "jobs" / "refit-1.json").read_text()) == {"draw": drawn[1]}


def test_a_split_whose_learning_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is not kept, and its error says what may help."""
    trials = run_trials(envs.BatchEnv(PUSH, 4), RandomAgent(PUSH.action_space), 2, 0).trials
    trials.save(tmp_path / "trials.npz")
    figures = measures.Findings(**dict.fromkeys(measures.Findings._fields, 1.0))._replace(naive=float("nan"))
    monkeypatch.setattr(measures, "measure", lambda *_: figures)
    with pytest.raises(envs.InputError, match="learning failed: naive is nan; are there outliers, or scales"):
        diagnose.Refit(tmp_path / "trials.npz", None, Amounts(), 0, 5, 3, tmp_path).run()
    assert not (tmp_path / "jobs").exists()


def test_the_two_explorations_of_a_case_are_under_other_thetas(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """That by a clone is more than the same trials once more."""
    drawn: list[Any] = []
    roll_out = Context._roll_out

    def spy(self: Context, *given: Any) -> Any:
        made = roll_out(self, *given)
        drawn.append(made.theta[:, 0, 0].tolist())
        return made

    monkeypatch.setattr(Context, "_roll_out", spy)
    monkeypatch.setattr(validate, "TRIALS", {"tilted_cartpole": 8})
    monkeypatch.setattr(explorers, "fit", lambda *_: None)
    validate.data(envs.get("tilted_cartpole"), None, tmp_path)
    assert [len(thetas) for thetas in drawn] == [2, 2]
    assert len({*drawn[0], *drawn[1]}) == 4


def diagnosis(verdict: Any, tier: int | None, advice: Next = EXPLORE) -> Diagnosis:
    return Diagnosis(verdict, {"gap": Figure.of([0.4])}, (), tier, advice)


@pytest.mark.parametrize(
    ("name", "certified", "verdict", "tier", "right"),
    [
        ("curling", True, "confounded", 2, True),
        ("curling", True, "confounded", 3, False),
        ("curling", True, "cannot tell", None, False),
        ("curling", True, "not confounded", 1, False),
        ("hidden_goal", False, "confounded", 3, True),
        ("hidden_goal", False, "confounded", 2, False),
        ("bandit", False, "nothing at stake", 1, True),
        ("bandit", False, "cannot tell", None, False),
    ],
)
def test_which_verdicts_are_right(name: str, certified: bool, verdict: Any, tier: int | None, right: bool) -> None:
    assert validate.right(envs.get(name), certified, diagnosis(verdict, tier)) is right


def test_a_gap_is_predicted_where_tier_2_could_close_it() -> None:
    assert validate.predicted(diagnosis("confounded", 2)) == 0.4
    assert validate.predicted(diagnosis("cannot tell", None)) == 0.4
    for verdict, tier in (("confounded", 3), ("not confounded", 1), ("nothing at stake", 1)):
        assert validate.predicted(diagnosis(verdict, tier)) == 0
    assert validate.predicted(diagnosis("cannot tell", None, VARY_LATENT)) == 0


def test_exploration_of_a_validation_is_half_at_random(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And half by a clone of the demonstrations that tries things; what is there is not made again."""
    trials = run_trials(envs.BatchEnv(PUSH, 4), RandomAgent(PUSH.action_space), 2, 0).trials
    explored: list[Any] = []
    monkeypatch.setattr(Context, "demonstrations", trials)
    monkeypatch.setattr(
        Context, "explore", lambda self, *given: (explored.append((given[0], self.preset.explore_trials)), trials)[1]
    )
    monkeypatch.setattr(explorers, "fit", lambda *given: given[0])
    for _ in range(2):
        file = validate.data(envs.get("curling"), None, tmp_path)[1]
        assert explored == [(None, 64), (trials, 64)]
    assert len(Trials.load(file)) == 8
    monkeypatch.setattr(
        Context, "demonstrations", run_trials(envs.BatchEnv(PUSH, 4), RandomAgent(PUSH.action_space), 2, 1).trials
    )
    validate.data(envs.get("curling"), None, tmp_path)
    assert len(explored) == 4  # of other demonstrations: its clone is another


def test_a_row_of_a_validation_is_of_its_case(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The predicted gap, and by how much deconfounded is ahead of naive_rnn; of a certified task Tier 2 is right."""
    rows: list[dict[str, Any]] = []
    monkeypatch.setattr(validate, "data", lambda *_: (tmp_path, tmp_path))
    monkeypatch.setattr(diagnose, "run", lambda *_: (diagnosis("confounded", 2), ""))
    monkeypatch.setattr(validate, "certificate", lambda *_: True)
    monkeypatch.setattr(validate, "measured", lambda *_: {"deconfounded": 0.75, "naive_rnn": 0.5})
    monkeypatch.setattr(validate, "keep", lambda row, order: rows.append(row))
    monkeypatch.setattr(validate, "kept", lambda name: [])
    monkeypatch.setattr(validate, "picture", lambda *_: None)
    monkeypatch.setattr("sys.argv", ["validate", "--tasks", "curling", "--out", str(tmp_path)])
    validate.main()
    (row,) = rows
    assert (row["case"], row["predicted"], row["measured"], row["right"]) == ("curling", 0.4, 0.25, True)


@pytest.mark.parametrize(
    ("study", "task"), [(validate, "NothingHidden"), (spectrum, "tilted_cartpole")], ids=["validate", "spectrum"]
)
def test_runs_of_a_study_begin_beside_what_else_it_makes(
    study: Any, task: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Data, a diagnosis and a certificate of the same task lie in its folder."""

    def data(task: envs.Task, source: str | None, folder: Path) -> tuple[Path, Path]:
        made = folder / "expert.npz", folder / "explored.npz"
        for file in made:
            file.touch()
        return made

    def stop(*_: Any) -> None:
        raise Stopped

    monkeypatch.setattr(validate, "data", data)
    monkeypatch.setattr(diagnose, "run", lambda *given: (given[4].mkdir(), (diagnosis("cannot tell", None), ""))[1])
    monkeypatch.setattr(certify, "certify", lambda *_: {"verdict": "failed"})
    monkeypatch.setattr(scheduler, "run_all", stop)
    monkeypatch.setattr("sys.argv", ["study", "--tasks", task, "--out", str(tmp_path / "out")])
    with pytest.raises(Stopped):
        study.main()


@pytest.mark.parametrize(
    ("verdict", "tier", "right"), [("confounded", 2, True), ("not confounded", 1, False), ("cannot tell", None, None)]
)
def test_a_wrong_verdict_on_a_foreign_world_is_kept_as_wrong(
    verdict: Any, tier: int | None, right: bool | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept: dict[str, Any] = {}
    monkeypatch.setattr(diagnose, "run", lambda *_: (diagnosis(verdict, tier), ""))
    monkeypatch.setattr(foreign, "write", lambda case, **measured: kept.update(measured))
    case: Any = SimpleNamespace(name="mine", tier=2, truth=("confounded", 2), logs=lambda folder: (folder, folder))
    foreign.diagnosed(case, tmp_path)
    assert kept["right"] is right


class TestCertificates:
    """Their curves are those of the policies that they name."""

    def curve(self, task: envs.Task, expert: CallableExpert, conditional: bool, static: bool = False) -> Array:
        env = envs.BatchEnv(task, 12)
        agent = exact_agent(env, expert, conditional, 5, static=static)
        return run_trials(env, agent, certify.EPISODES, certify.SEED).returns.mean(0)

    @pytest.mark.slow
    def test_curves(self) -> None:
        drift = toys.Drift()
        expert = CallableExpert(drift, toys.control, "control")
        made = certify.certify(drift, expert, trials=12, grid=5)
        curves = {
            "interventional": self.curve(drift, expert, False),
            "conditional": self.curve(drift, expert, True),
            "static": self.curve(drift, expert, False, static=True),
        }
        for name, curve in curves.items():
            assert made[name]["return"] == pytest.approx(curve, abs=1e-6), name
        assert len({tuple(curve.round(6)) for curve in curves.values()}) == 3
        evidence = made["evidence_nats_per_step"]
        assert evidence["dynamics"] > 0.05
        assert evidence["delusion_ratio"] == pytest.approx(evidence["actions"] / evidence["dynamics"], rel=1e-3)

    def test_belief_about_a_theta_that_drifts(self) -> None:
        """Between episodes it spreads, as theta moves on meanwhile."""
        drift = toys.Drift()
        env, expert = envs.BatchEnv(drift, 12), CallableExpert(drift, toys.control, "control")
        recorder = certify.EvidenceRecorder(env, expert, Grid(env, expert, 5))
        run_trials(env, recorder, 1, 0)
        learned = recorder.log_belief
        recorder.reset([np.random.default_rng(i) for i in range(12)])
        np.testing.assert_allclose(recorder.log_belief, recorder.grid.predict(learned))
        assert (recorder.log_belief.max(-1) < learned.max(-1)).all()

    def test_estimates_are_of_the_theta_of_the_last_step_that_took_place(self) -> None:
        """Where theta switches on, and the belief with it, while other trials' episodes last longer."""
        env = envs.BatchEnv(toys.Switch(), 256)
        expert = CallableExpert(env.task, toys.control, "control")
        recorder = certify.EvidenceRecorder(env, expert, Grid(env, expert, 9))
        rollout = run_trials(env, recorder, 2, 0)
        recorder.note()
        steps = rollout.trials.mask.sum(2)
        assert (steps < steps.max()).mean() > 0.5
        theta = of_steps(rollout.theta, env.task.horizon)
        for episode, (estimate, truth) in enumerate(zip(recorder.estimates, recorder.truths, strict=True)):
            last = theta[np.arange(256), episode, steps[:, episode] - 1]
            np.testing.assert_array_equal(truth, last)
            assert np.square(estimate - last).mean() < 0.03 * last.var()

    def test_evidence_of_dynamics(self) -> None:
        """The mean log-likelihood ratio of theta against a grid: of Gaussians, half the squared difference of means."""
        env = envs.BatchEnv(PUSH, 256)
        grid = Grid(env, EXPERT, 5)
        recorder = certify.EvidenceRecorder(env, EXPERT, grid)
        theta = run_trials(env, recorder, 1, 0).theta[:, 0, :1]
        apart = (theta - PUSH.theta_grid(5).ravel()) * 0.4  # of the velocity; half of that of the position
        ratio = 0.5 * ((apart / PUSH.std[1]) ** 2 + (0.5 * apart / PUSH.std[0]) ** 2).mean()
        assert np.concatenate(recorder.dynamics).mean() == pytest.approx(ratio, rel=0.2)

    def test_evidence_is_over_the_other_categories(self) -> None:
        """The true one, which has no evidence over itself, is not among them."""
        env = envs.BatchEnv(toys.Arms(), 32)
        expert = policy.load(env.task)
        recorder = certify.EvidenceRecorder(env, expert, Grid(env, expert, 9))
        trials, _, theta = run_trials(env, recorder, 1, 0)
        arms, obs, action = int(env.task.latents[0].high) + 1, trials.obs[:, 0, 0], trials.action[:, 0, 0].astype(float)
        true, *others = (
            expert.log_prob(obs, action, (theta[:, 0, :1] + i) % arms).reshape(len(obs)) for i in range(arms)
        )
        np.testing.assert_allclose(recorder.actions[0], true - np.mean(others, 0), atol=1e-6)

    def test_evidence_is_of_the_steps_that_took_place(self) -> None:
        """That of actions: the mean over them of what the expert's log-likelihood is above that under the grid."""
        env = envs.BatchEnv(PUSH, 64)
        grid = Grid(env, EXPERT, 5)
        recorder = certify.EvidenceRecorder(env, EXPERT, grid)
        trials, _, theta = run_trials(env, recorder, 1, 0)
        mask = trials.mask
        obs, action = trials.obs[:, :, :-1][mask], trials.action[mask].astype(float)
        expert = EXPERT.log_prob(obs, action, of_steps(theta, mask.shape[2])[mask])
        assert mask.mean() < 0.9
        evidence = (expert[:, None] - grid.log_policy(obs, action)).mean()
        assert np.concatenate(recorder.actions).mean() == pytest.approx(evidence, rel=1e-3)
        assert len(np.concatenate(recorder.dynamics)) == mask.sum()


class TestCommands:
    """Settings of the command line reach what they are of."""

    def test_amounts_of_a_protocol(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        jobs: list[BenchmarkJob] = []

        def seen(every: list[BenchmarkJob], *_: Any) -> None:
            jobs.extend(every)
            raise envs.InputError("enough")

        monkeypatch.setattr(scheduler, "run_all", seen)
        deconf(tmp_path, "run", "--task", "curling", "--protocol", "scarce", "--methods", "blind_bc")
        amounts = protocols.amounts("scarce", preset("default", envs.get("curling"), "cpu"))
        assert jobs
        for job in jobs:
            assert job.folder == Path("results/curling-default-scarce/jobs")
            for name in (*protocols.AMOUNTS, "fresh"):
                assert getattr(job.preset, name) == getattr(amounts, name)

    def test_amounts_of_a_record_that_is_verified(self, monkeypatch: pytest.MonkeyPatch) -> None:
        (record, *_) = [r for r in records.of_task(RECORDS, "curling", protocol="scarce") if r["method"] == "naive_rnn"]

        def seen(every: list[BenchmarkJob], *_: Any) -> None:
            amounts = protocols.amounts("scarce", preset("default", envs.get("curling"), "cpu"))
            assert every[0].preset.expert_trials == amounts.expert_trials
            raise Stopped

        monkeypatch.setattr(scheduler, "run_all", seen)
        with pytest.raises(Stopped):
            verify.rerun(record, envs.get("curling"), "naive_rnn", None, "cpu")

    def test_changes_of_a_record_that_is_verified(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Those of all methods and of its own, on the device that was asked for; another method's do not matter."""
        (record, *_) = [r for r in records.of_task(RECORDS, "curling") if r["method"] == "naive_rnn"]
        record = {**record, "set": ["query_trials=7", "naive_rnn.updates=9", "dagger.updates=3"]}

        def seen(every: list[BenchmarkJob], *_: Any) -> None:
            made = every[0].preset
            assert (made.query_trials, made.configs["naive_rnn"]["updates"], made.device) == (7, 9, "cuda")
            raise Stopped

        monkeypatch.setattr(scheduler, "run_all", seen)
        with pytest.raises(Stopped):
            verify.rerun(record, envs.get("curling"), "naive_rnn", None, "cuda")

    def test_a_deployment_is_verified_by_its_own_record(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Of the deployments of an agent, which are all made again."""
        (record, *_) = [r for r in records.of_task(RECORDS, "curling") if r["deployment"] == "mode"]
        made = [{**record, "deployment": way} for way in ("", "episode", "mode")]
        monkeypatch.setattr(scheduler, "run_all", lambda *_: ([], 0, []))
        monkeypatch.setattr(records, "of_run", lambda *_: made)
        assert verify.rerun(record, envs.get("curling"), record["method"], None, "cpu") == record
        made.pop()
        with pytest.raises(envs.InputError, match=f"left no {records.named(record)} to compare with"):
            verify.rerun(record, envs.get("curling"), record["method"], None, "cpu")

    @pytest.mark.parametrize("debug", [False, True])
    def test_a_run_for_a_debugger(self, debug: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """It is in this process, methods from outside too, and in a folder that goes away."""
        jobs: list[BenchmarkJob] = []

        def seen(every: list[BenchmarkJob], *_: Any) -> None:
            jobs.extend(every)
            raise envs.InputError("enough")

        monkeypatch.setattr(scheduler, "run_all", seen)
        deconf(tmp_path, "run", "--task", "bandit", "--methods", "blind_bc", *["--debug"] * debug)
        assert {(job.walled, job.folder.is_relative_to("results")) for job in jobs} == {(not debug, not debug)}
        assert (tmp_path / "results").exists() is not debug

    def test_exact_policies_need_a_likelihood(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """Without one, a run is of the other methods, and names what was asked for in vain."""
        ran: list[list[str]] = []

        def seen(tasks: Any, args: Any, methods: list[str], folders: Any) -> None:
            ran.append(methods)

        monkeypatch.setattr("deconfounded.benchmarks.run.run_tasks", seen)
        monkeypatch.setattr(envs, "check_task", lambda task: None)
        for opaque in (False, True):
            monkeypatch.setattr(type(envs.get("curling")), "has_likelihood", not opaque)
            assert deconf(tmp_path, "run", "--task", "curling").returncode == 0
        assert [name for name in ran[0] if name not in ran[1]] == ["conditional", "interventional"]
        assert {*ran[0]} == {*DEFAULT}
        refused = deconf(tmp_path, "run", "--task", "curling", "--methods", "conditional")
        assert (refused.returncode, len(ran)) == (2, 2)
        assert "--methods had conditional, and curling has no likelihood for it" in refused.stderr

    def test_another_range_is_scored(self) -> None:
        """All three agents are in it; the expert has less force there to act against than in the whole range."""
        agent = RandomAgent(PUSH.action_space)
        where = score_command.with_ranges(PUSH, ["force=.9:1"])
        scored = score_command.rescore(agent, PUSH, EXPERT, 16, 7, where)
        own = run_trials(envs.BatchEnv(where, 16), agent, 2, 7).returns.mean(0)
        assert scored["return"]["random"] == pytest.approx(own, abs=1e-4)
        assert scored["return"] != score_command.rescore(agent, PUSH, EXPERT, 16, 7, PUSH)["return"]

    def test_a_range_that_ends_before_it_begins(self) -> None:
        with pytest.raises(envs.InputError, match=r"--range was 'best_arm=3:1'; 3 must be less than 1"):
            score_command.with_ranges(envs.get("bandit"), ["best_arm=3:1"])
        with pytest.raises(envs.InputError, match=r"--range was 'force=\.5:\.5'; 0\.5 must be less than 0\.5"):
            score_command.with_ranges(PUSH, ["force=.5:.5"])

    def test_a_latent_has_one_range(self) -> None:
        with pytest.raises(envs.InputError, match="--range had force twice"):
            score_command.with_ranges(PUSH, ["force=0:.1", "force=.9:1"])

    def test_salt_of_a_score(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        seeds: list[int] = []
        scored = {"score": [0.0], "ci95_last": None}
        monkeypatch.setattr(score_command, "ready", lambda folder, task: RandomAgent(task.action_space))
        monkeypatch.setattr(score_command, "rescore", lambda *given: (seeds.append(given[4]), scored)[1])
        own = ("--agent", ".", "--task", "curling", "--seed", "3")
        for salt in ((), ("--salt", "x")):
            assert deconf(tmp_path, "score", *own, *salt).returncode == 0
        assert seeds == [stream(EVALUATION, 3), stream(EVALUATION, 3, "x")]


@pytest.mark.parametrize(
    ("amount", "use"),
    [
        ("expert_trials", "demonstrations"),
        ("fresh", "demonstrations"),
        ("explore_trials", "exploration"),
        ("query_trials", "queries"),
    ],
)
def test_results_depend_on_the_data_that_a_method_uses(amount: str, use: str) -> None:
    few = tiny_preset()
    more = replace(few, **{amount: getattr(few, amount) + 1})
    differ = set()
    for name in METHODS:
        made = [identity.identity(BenchmarkJob("bandit", each, name, (0,), Path())) for each in (few, more)]
        differ |= {name} if made[0] != made[1] else set()
    assert differ == {name for name in METHODS if use in METHODS[name].uses}
    assert differ


class Switching(toys.Push):
    """Push, whose force is drawn anew in a third of the steps; its episodes end with their time."""

    name = "switching"
    latents = (Latent("force", "N", -1.0, 1.0, switch=0.3),)
    observation = {"x": (-9.0, 9.0), "velocity": (-9.0, 9.0)}

    def terminated(self, state: Array) -> NDArray[np.bool_]:
        return np.zeros(len(state), bool)


class Knows(RandomAgent):
    """It acts at random, and its features are the theta that it acted under last."""

    env: envs.BatchEnv

    def act(self, obs: NDArray[np.float32]) -> Array:
        self.last = self.env.theta.astype(np.float32)
        return super().act(obs)

    def features(self) -> NDArray[np.float32]:
        return self.last


def test_r2_of_a_theta_that_switches_is_of_the_last_step() -> None:
    task = Switching()
    context = Context(task, replace(tiny_preset(), eval_trials=256), [0], expert="tests.toys:control")
    agent = Knows(task.action_space)
    agent.env = context.env
    assert (evaluate(context, agent, False)[1] > 0.95).all()


def test_fresh_demonstrations() -> None:
    """Of other thetas and starts each time, and paid for."""
    amounts = replace(tiny_preset(), fresh=3)
    context = Context(PUSH, amounts, [0, 1], monitor := Monitor(), expert="tests.toys:control")
    rngs = context.rngs
    made = [context.demonstrations, context.demonstrate(rngs), context.demonstrate(rngs)]
    assert [len(trials) for trials in made] == [8, 6, 6]
    starts = np.concatenate([trials.obs[:, 0, 0, 0] for trials in made])
    assert len(np.unique(starts)) == len(starts)
    assert monitor.budget["expert_trials"] == [4 + 3 + 3] * 2


def test_points_of_exploration_are_of_both_ends() -> None:
    of_task = records.of_task(RECORDS, "curling")
    made = [r for r in of_task if r["method"] in ("deconfounded", "random", "expert") and r["seed"] < 3]
    point = exploration.measured(made, "deconfounded", 1)
    random_return, expert_return = (
        np.mean([r["returns"][:5] for r in of_task if r["method"] == name and r["seed"] < 10])
        for name in ("random", "expert")
    )
    own = np.array([r["returns"][:5] for r in made if r["method"] == "deconfounded" and not r["deployment"]])
    for end, episode in (("first", 0), ("last", -1)):
        assert point[end] == pytest.approx(
            (own[:, episode] - random_return) / (expert_return - random_return), abs=1e-3
        )
