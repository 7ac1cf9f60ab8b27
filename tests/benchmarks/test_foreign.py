"""Foreign worlds: their cases, scores and filter, in those simulators that are ours too."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from deconfounded.benchmarks.studies import findings, validate
from deconfounded.benchmarks.studies.foreign import cases, measure, report, world
from deconfounded.benchmarks.studies.foreign.cases import CASES, Case
from deconfounded.benchmarks.studies.foreign.measure import scores
from deconfounded.deconf.diagnosis import exploration
from deconfounded.deconf.diagnosis.diagnose import VERSION
from deconfounded.experts.agent import Agent, RandomAgent
from deconfounded.experts.trials import Trials

OURS = [case for case in CASES if case.reference.split(":")[0] in ("arm", "classic", "mujoco")]
NAMES = [case.name for case in OURS]
HARMLESS = [
    "classic_reversedcart",
    "classic_mountainpower",
    "classic_polelength",
    "mujoco_pushedpole",
]  # though dynamics depend on theta


def test_both_halves_have_every_tier() -> None:
    for unseen, counts in ((False, (7, 7, 1)), (True, (5, 5, 1))):
        tiers = [case.tier for case in CASES if case.unseen is unseen]
        assert (tiers.count(1), tiers.count(2), tiers.count(3)) == counts
    assert len({case.reference.split(":")[0] for case in CASES}) >= 5


@pytest.mark.slow
@pytest.mark.parametrize("case", OURS, ids=NAMES)
def test_theta_is_hidden_at_first_and_seeds_repeat(case: Case) -> None:
    made = case.world
    theta = world.thetas(made, 6, 0)
    agent = RandomAgent(world.task(made).action_space)
    one, other = (world.roll_out(made, agent, x, 5).trials for x in (theta, np.roll(theta, 1, 0)))
    again = world.roll_out(made, agent, theta, 5).trials
    assert one.sha256 == again.sha256
    assert np.array_equal(one.obs[:, 0, 0], other.obs[:, 0, 0])
    moved = not np.array_equal(one.obs, other.obs)
    assert moved is (case.tier == 2 or case.name in HARMLESS)


def test_experts_have_their_habits() -> None:
    by_name = {case.name: case.world for case in OURS}
    pauses = world.demonstrations(by_name["classic_acrobotpauses"], 12, 0).trials
    waits = (pauses.action[:, 0, :, 0] == 1).cumprod(1).sum(1)
    assert waits.max() <= 25
    assert len(set(waits.tolist())) > 4
    trials = world.demonstrations(by_name["mujoco_armtrembles"], 4, 0).trials
    made = by_name["mujoco_armtrembles"]
    mean = world.task(made).expert_mean(trials.obs[:, 0, :-1].reshape(-1, 10), np.zeros((4 * made.steps, 2)))
    left = (trials.action[:, 0] - mean.reshape(4, made.steps, 2)).transpose(0, 2, 1).reshape(-1, made.steps)
    assert 0.7 < np.corrcoef(left[:, 1:].ravel(), left[:, :-1].ravel())[0, 1] < 0.97


def test_logs_of_exploration_are_half_at_random_and_half_by_the_clone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The clone is of the expert's trials that are kept beside them; logs that are there are not made again."""

    def trials(n: int, value: float) -> Trials:
        return Trials(np.full((n, 1, 2, 1), value), np.full((n, 1, 1, 1), value), np.ones((n, 1, 1), bool))

    def explorer(world: Any, n: int, rng: Any) -> Any:
        return lambda agent: trials(n, -1.0 if agent is None else agent)

    monkeypatch.setattr(cases, "demonstrations", lambda world, n, seed: type("Made", (), {"trials": trials(n, 0.5)}))
    monkeypatch.setattr(cases, "explorer", explorer)
    monkeypatch.setattr(exploration, "fit", lambda expert, config, rng: float(expert.action.max()))
    expert, explored = map(Trials.load, OURS[0].logs(tmp_path))
    assert (len(expert), expert.action.min(), expert.action.max()) == (cases.TRIALS, 0.5, 0.5)
    assert explored.action.ravel().tolist() == [-1.0] * cases.EXPLORED + [0.5] * cases.EXPLORED
    monkeypatch.setattr(cases, "explorer", None)
    OURS[0].logs(tmp_path)


@pytest.mark.slow
def test_a_filter_does_as_well_as_the_expert() -> None:
    made = next(case.world for case in CASES if case.name == "classic_pendulumwind")
    theta = world.thetas(made, 24, 0)
    lost = world.LinearFilter(made, 32, 1)
    lost.effect = 0 * lost.effect  # it takes no evidence in
    agents: dict[str, Agent] = {
        "random": RandomAgent(world.task(made).action_space),
        "expert": world.WorldExpert(made, theta),
        "wrong theta": world.WorldExpert(made, np.roll(theta, 1, 0)),
        "filter": world.LinearFilter(made, 32, 1),
        "lost": lost,
    }
    made_of = scores({name: world.roll_out(made, x, theta, 0).returns.mean(0).tolist() for name, x in agents.items()})
    assert made_of["filter"] == pytest.approx(1, abs=0.1)
    assert made_of["lost"] < 0.8


def test_scores() -> None:
    returns = {"random": [0.0, 0.0], "expert": [9.0, 10.0], "wrong theta": [9.0, 6.0], "naive_rnn": [9.0, 8.0]}
    assert scores(returns) == {"random": -1.5, "expert": 1, "wrong theta": 0, "naive_rnn": 0.5}
    assert scores(returns | {"wrong theta": [9.0, 9.9]})["naive_rnn"] == 0.8  # nothing is at stake: 0 is random


def test_returns_are_kept_until_a_method_has_another_version(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of expert and random actions have none, and stay."""
    monkeypatch.setattr(measure, "roll_out", lambda *_: SimpleNamespace(returns=np.full((4, 5), next(returns))))
    monkeypatch.setattr(measure.Bench, "theta", None)
    agents = dict.fromkeys(("naive_rnn", "random"), lambda bench: RandomAgent(np.zeros(1)))  # type: ignore[arg-type]
    monkeypatch.setattr(measure, "AGENTS", agents)
    returns, said = iter(range(9)), []
    for version in (2, 2, 3):
        monkeypatch.setattr(measure, "METHODS", {"naive_rnn": SimpleNamespace(version=version)})
        bench = measure.Bench(OURS[0], tmp_path)
        said += [[bench.measure(name) for name in agents]]
    assert said == [["0", "1"], ["0", "1"], ["2", "1"]]
    assert bench.made["method_versions"] == {"naive_rnn": 3}


def test_report() -> None:
    row = {
        "case": "arm_arm",
        "world": "arm:Arm",
        "tier": 2,
        "unseen": False,
        "scores": {"naive_rnn": 0.2, "deconfounded": 0.9},
    }
    wrong = {"verdict": "confounded", "diagnosed_tier": 3, "right": False, "predicted": 0.5, "splits": 3}
    unsure = {"verdict": "cannot tell", "diagnosed_tier": None, "right": None, "predicted": 0.0}
    rows = [row | wrong | {"agreeing": 2}, row | wrong | {"agreeing": 3}, row | unsure | {"unseen": True}, row]
    assert report.summary(rows) == (
        "Of the half by which thresholds are set, 0 of 2 verdicts are right, 2 wrong (1 of these with all splits"
        " agreeing). Of the half by which they are judged, 0 of 1 verdicts are right, 0 wrong."
    )
    lines = report.table(rows).splitlines()
    assert lines[2].endswith("| confounded, Tier 3 | 2 of 3 | wrong |")
    assert lines[4].endswith("| cannot tell |  | cannot tell |")
    assert lines[5].endswith("|  |  |  |")


def test_how_often_verdicts_are_right(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of all cases, and of those by which no threshold was set; what was not diagnosed does not count."""
    own = [{"case": "bandit", "right": True}, {"case": "IcyRoadProcess2", "right": False}]
    judged = [{"verdict": "", "unseen": True, "right": right} for right in (True, None, True)]
    worlds = [*judged, {"verdict": "", "unseen": False, "right": False}, {"unseen": True, "right": None}]
    monkeypatch.setattr(findings, "kept", {validate.KEPT: own, report.KEPT: worlds}.__getitem__)
    said = findings.right()
    assert said.startswith("Verdicts are right in 1 of 2 cases on tasks of this suite (0 of the 1 by which no")
    assert "and in 2 of 4 worlds on simulators of others (2 of the 3 by which no" in said


def test_verdicts_of_earlier_versions_of_the_diagnosis_are_named() -> None:
    """Those that name no version too; what was not diagnosed has no verdict."""
    old = [{"case": "old", "verdict": "", "diagnosis": VERSION - 1}, {"case": "first", "verdict": ""}, {"case": "none"}]
    new = {"case": "new", "verdict": "", "diagnosis": VERSION}
    said = f" Verdicts of earlier versions of the diagnosis (unknown, {VERSION - 1}; today's is {VERSION}): "
    assert findings._outdated([new, *old]) == f"{said}old, first."
    assert findings._outdated(old) == f"{said}all."
    assert findings._outdated([new, old[-1]]) == ""


def test_report_says_of_which_version_scores_are() -> None:
    def row(case: str, version: int | None, **more: float) -> dict[str, object]:
        return {"case": case, "scores": more, "method_versions": {} if version is None else {"deconfounded": version}}

    rows = [row("old", 5, deconfounded=0.9), row("unknown", None, deconfounded=0.8), row("not_there", None)]
    assert report.scored(rows[1:]) == ""
    assert report.scored([*rows, row("new", 6, deconfounded=1)]) == (
        "Scores of deconfounded are of its version 6; of an earlier one: old, unknown."
    )
    assert report.scored([row("new", 6, deconfounded=1)]) == "Scores of deconfounded are of its version 6."


def test_report_correlates_gaps_that_are_predicted() -> None:
    """Where the diagnosis cannot tell it predicts none; the figure with what its rollouts have there is in brackets."""

    def row(predicted: float, gap: float, right: bool | None) -> dict[str, object]:
        scores = {"naive_rnn": 0.0, "deconfounded": gap}
        verdict = {"verdict": "confounded", "right": right, "predicted": predicted, "splits": 3}
        return {"case": "", "unseen": True, "scores": scores} | verdict

    rows = [row(0.1, 0.2, True), row(0.2, 0.3, True), row(0.3, 0.4, False), row(0.9, 0.0, None)]
    assert "measured gaps is 1.00 (-0.20 with those of which it cannot tell" in report.summary(rows)
    assert "correlation" not in report.summary(rows[2:])
