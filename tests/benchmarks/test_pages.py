"""Figures over seeds and tasks, and the pages that show them, in a real browser where there is one."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, get_args
from unittest.mock import Mock

import imageio.v3 as imageio
import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from deconfounded import envs
from deconfounded.benchmarks.engine.catalogue import METHODS
from deconfounded.benchmarks.engine.presets import preset
from deconfounded.benchmarks.output import aggregation, film, index, records, run_report, scoring, statistics
from deconfounded.benchmarks.output.index import answers
from deconfounded.benchmarks.output.pictures import mark, mark_of, panels, save_figure, still
from deconfounded.benchmarks.studies import (
    cards,
    findings,
    gap,
    hard,
    headroom,
    protocol_scores,
    publish,
    results,
    tune,
)
from deconfounded.deconf.core.deployment import Way
from tests.tools import bars, dots
from tests.toys import Push

if TYPE_CHECKING:
    from playwright.sync_api import Page

DOCS = Path(__file__).resolve().parents[2] / "docs"


def test_tuning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The preset's amount so many times is tried; of settings that score nearly alike, the cheaper is chosen."""
    for method, changes in tune.TRIED.items():
        for task in map(envs.get, tune.TASKS):
            began = tune.other(preset("default", task, "cpu", [method]), method, tune.BEFORE.get(method, {}))
            tried = [began, *(tune.other(began, method, change) for change in changes)]
            assert len({str(each.configs[method]) for each in tried}) == 4, (
                f"{method} on {task.name}: the same number of settings each"
            )
    amounts = preset("default", envs.get("bandit"), "cpu", ["deconfounded_mean"])
    changed = tune.other(amounts, "deconfounded_mean", {"latent": 0.34, "beta": 2, "model": "evidence"})
    config = changed.configs["deconfounded_mean"]
    assert (config["latent"], config["beta"], config["model"]) == (2, 0.02, "evidence")
    assert tune.title({"beta": 2, "model": "evidence"}) == "beta x 2, model evidence"
    about = {"machine": "m", "versions": {"torch": "2"}, "commit": None}
    for method, setting, scores, cpu in (
        *(("gail", "a", [0.9, 0.9], 5.0), ("gail", "b", [0.5, 0.7], 9.0), ("gail", "c", [0.59, 0.6], 4.0)),
        *(("gail", "d", [0.2, 0.2], 1.0), ("palr", "a", [0.2, 0.2], 5.0), ("gail", "a", [0.1, 0.3], 5.0)),
        *(("naive_rnn", "the preset", [0.1, 0.1], 5.0), ("naive_rnn", "b", [0.9, 0.9], 5.0)),
        *(("naive_rnn", "c", [0.2, 0.1], 5.0), ("naive_rnn", "d", [0.3, 0.1], 5.0)),
    ):
        row = {"method": method, "setting": setting, "scores": {"bandit": scores}, "cpu_s": {"bandit": cpu}, **about}
        tune.keep(row, tmp_path / "tuning.json")
    monkeypatch.setattr(cards, "DOCS", tmp_path)
    lines = findings.tuning().splitlines()
    words = [line.split(" | ")[-1].strip(" |") for line in lines[2:11]]
    assert words == ["kept", "", "", "", "", "", "", "chosen", ""], "palr is not through"
    assert lines[6:8] == ["| palr | a | 0.20 | 5 |  |", "| gail | a | 0.20 | 5 |  |"]


@pytest.mark.parametrize("older", [{"method_version": -1}, {"task_versions": {}}, {"amounts": {}}])
def test_tuning_goes_on_with_what_is_not_of_today(
    older: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A setting's scores are done if they are of today's versions and amounts."""
    today = {task: tune.began(preset("default", envs.get(task), "cpu")).configs["gail"] for task in tune.TASKS}
    row = {"method": "gail", "setting": "the preset", "amounts": today, "method_version": METHODS["gail"].version}
    row["task_versions"] = {task: envs.get(task).version for task in tune.TASKS}
    monkeypatch.setattr(tune, "DOCS", tmp_path)
    monkeypatch.setattr(tune, "TRIED", {"gail": ()})
    monkeypatch.setattr(tune.runs, "run", Mock(side_effect=InterruptedError))
    monkeypatch.setattr("sys.argv", ["tune", "--methods", "gail", "--out", str(tmp_path / "tuning")])
    tune.keep(row, tmp_path / "tuning.json")
    tune.main()
    assert "gail, the preset: it is in tuning.json" in capsys.readouterr().out
    tune.keep({**row, **older}, tmp_path / "tuning.json")
    with pytest.raises(InterruptedError):
        tune.main()


def test_presets_are_what_tuning_chose() -> None:
    """Today's preset is the setting that docs/tuning.json says, which can be tried again."""
    rows = json.loads((DOCS / "tuning.json").read_text())["rows"]
    for method in dict.fromkeys(row["method"] for row in rows):
        tried, of = ({}, *tune.TRIED[method]), [row for row in rows if row["method"] == method]
        assert len(tried) == findings.BUDGET
        if len(of) < len(tried):  # tuning has begun
            continue
        assert [row["setting"] for row in of] == [tune.title(change) for change in tried]
        for task in map(envs.get, tune.TASKS):
            today = preset("default", task, "cpu", [method])
            assert today.configs[method] == findings.chosen(of)["amounts"][task.name], f"{method} on {task.name}"
            began = tune.other(today, method, tune.BEFORE.get(method, {}))
            for row, change in zip(of, tried, strict=True):
                changed = tune.other(began, method, change).configs[method]
                assert changed == pytest.approx(row["amounts"][task.name])


@pytest.mark.parametrize(
    ("score", "naive", "spread", "word"),
    [
        *((0.95, 0.4, 1, "Yes"), (0.7, 0.4, 1, "It helps, but it is not enough"), (0.4, 0.4, 1, "No")),
        *((0.7, 0.4, 20, "It cannot be decided yet"), (0.95, 0.95, 1, "It cannot be decided yet")),
        *((0.93, 0.4, 1, "Yes"), (0.91, 0.4, 1, "It helps, but it is not enough")),  # .03 behind, with the same noise
        (0.93, 0.4, 2, "It helps; whether it is enough cannot be decided yet"),
        (0.8, 0.4, 5, "It helps; whether it is enough cannot be decided yet"),  # its interval reaches that far
    ],
)
def test_answers(score: float, naive: float, spread: float, word: str) -> None:
    """By whether the baseline comes up to the one, or is no better than the other, on the tasks where all were run."""
    seeds = {0: -0.06, 1: -0.02, 2: 0.0, 3: 0.02, 4: 0.06}
    runs = {"naive_rnn": (naive, 1), "deconfounded": (0.95, 1), "naive_transformer": (score, spread)}
    of = {name: {seed: mean + by * noise for seed, noise in seeds.items()} for name, (mean, by) in runs.items()}
    scores = {"a": of, "b": of, "lacking": {name: of[name] for name in ("naive_rnn", "deconfounded")}}
    (sentence,) = answers(scores)
    assert sentence.startswith(f"Does scale cure the delusion? {word}: naive_transformer {score:.2f} (")
    assert f"naive_rnn {naive:.2f} (" in sentence
    assert "deconfounded 0.95 (" in sentence
    assert "over 2 tasks" in sentence
    assert answers({"lacking": scores["lacking"]}) == []
    assert answers({"a": {name: {0: 0.5} for name in runs}}) == [], "a seed alone has no interval"


class TestStatistics:
    """Against numbers worked out by hand from the formulas of Agarwal et al. 2021."""

    def test_paired(self) -> None:
        """Differences .5, 1 and 0: mean .5, sd .5, and Student's t of two degrees is 4.302653."""
        difference = statistics.paired({0: 1.0, 1: 2.0, 2: 3.0, 7: 9.0}, {2: 3.0, 1: 1.0, 0: 0.5, 8: 0.0})
        assert difference is not None
        assert (difference.value, difference.n) == (0.5, 3)
        assert difference.interval == pytest.approx((0.5 - 1.242069, 0.5 + 1.242069), abs=1e-6)
        assert statistics.paired({0: 1.0}, {0: 0.25}) == statistics.Figure(np.float64(0.75), None, 1)
        assert statistics.paired({0: 1.0}, {1: 1.0}) is None
        alike = statistics.paired({0: 1.5, 1: 1.5}, {0: 1.0, 1: 1.0})  # without a warning
        assert alike == statistics.Figure(np.float64(0.5), (0.5, 0.5), 2)

    @pytest.mark.parametrize("seeds", [2, 5])
    def test_intervals_are_as_wide_as_the_mean_varies(self, seeds: int) -> None:
        """Of the mean over 200 tasks: 1.96 standard errors a side. Draws of all S have (S - 1) / S of the variance."""
        runs = {str(i): x for i, x in enumerate(np.random.default_rng(0).standard_normal((200, seeds)))}
        figure = statistics.over_tasks(lambda of: np.mean([x.mean(-1) for x in of], 0), runs)
        assert figure is not None
        assert figure.interval is not None
        error = np.sqrt(np.mean([x.var(ddof=1) / seeds for x in runs.values()]) / 200)
        assert np.ptp(figure.interval) == pytest.approx(2 * 1.96 * error, rel=0.08)

    def test_seeds_of_several_methods_are_drawn_together(self) -> None:
        """What is the same of both cancels."""
        ours = {task: np.random.default_rng(i).standard_normal(4) for i, task in enumerate("ab")}
        theirs = {task: x - 0.5 for task, x in ours.items()}
        figure = statistics.over_tasks(lambda x, y: statistics.iqm(x) - statistics.iqm(y), ours, theirs)
        assert figure is not None
        assert figure.interval == pytest.approx((0.5, 0.5))

    def test_matched(self) -> None:
        """Seeds that all have, in one order; tasks without are left out."""
        ours = {"a": {3: 0.3, 1: 0.1, 2: 0.2}, "b": {0: 0.5}, "c": {0: 0.7}}
        theirs = {"a": {1: 1.1, 3: 1.3, 4: 1.4}, "b": {1: 1.5}, "d": {0: 1.7}}
        runs = [{task: x.tolist() for task, x in of.items()} for of in statistics.matched(ours, theirs)]
        assert runs == [{"a": [0.1, 0.3]}, {"a": [1.1, 1.3]}]

    def test_iqm(self) -> None:
        """Of all tasks as one, the lowest and the highest quarter are left out; of eight runs, two and two."""
        assert statistics.iqm([np.array([7.0, 0, 90, 3]), np.array([4.0, 2, 5, 1])]) == pytest.approx(3.5)
        assert statistics.iqm([np.array([0.0, 1]), np.array([2.0, 3])]) == 1.5

    def test_more_seeds_of_a_task_give_it_no_more_weight(self) -> None:
        """By hand: of runs of a sixth and of a tenth, half of the weight, 1 has a sixtieth, and 7 a twelfth."""
        unequal = [np.array([7.0, 0, 90]), np.array([3.0, 4, 2, 5, 1])]
        assert statistics.iqm(unequal) == pytest.approx(2 * (1 / 60 + (2 + 3 + 4 + 5) / 10 + 7 / 12))
        one, other = np.array([0.1, 0.7, 0.3, 0.2]), np.array([[0.9, 0.5, 0.6, 0.8], [0.0, 0.2, 0.2, 0.1]])
        again = statistics.iqm([np.tile(one, (2, 3)), other])
        np.testing.assert_allclose(again, statistics.iqm([np.tile(one, (2, 1)), other]))

    def test_profile(self) -> None:
        """Tasks weigh alike, however many seeds they have; a run at the threshold is not above it."""
        runs = [np.array([0.1, 0.5]), np.array([0.9])]
        assert statistics.profile(runs, np.array([0.0, 0.3, 0.5, 0.9])).tolist() == [1, 0.75, 0.5, 0]

    def test_improvement(self) -> None:
        """By seed: one tie and one loss; the other task is won whole."""
        first, second = [np.array([1.0, 2]), np.array([5.0])], [np.array([1.0, 3]), np.array([4.0])]
        assert statistics.improvement(first[:1], second[:1]) == 0.25
        assert statistics.improvement(first, second) == (0.25 + 1) / 2

    def test_over_tasks(self) -> None:
        """Seeds are drawn anew within a task, one fewer than there are; a task without seeds is left out."""
        scores = {"a": np.zeros(4), "b": np.ones(4)}
        estimate = statistics.over_tasks(statistics.iqm, scores)
        assert estimate is not None
        assert (estimate.value, estimate.interval, estimate.n) == (0.5, pytest.approx((0.5, 0.5)), 8)
        spread = statistics.over_tasks(statistics.iqm, {"a": np.array([0.0, 1.0])})  # 0 or 1
        assert spread is not None
        assert (spread.value, spread.interval) == (0.5, (0, 1))
        of_few = statistics.over_tasks(statistics.iqm, {"a": np.array([0.5]), "b": np.array([0.8, 0.9])})
        assert of_few is not None
        assert of_few.interval is None, "of a task with one seed nothing can be drawn anew"
        lone = statistics.over_tasks(statistics.iqm, {"b": np.array([2.0]), "a": np.array([])})
        assert lone is not None
        assert (lone.value, lone.n) == (2, 1)
        single = statistics.over_tasks(statistics.iqm, {"a": np.array([0.3])})
        assert single is not None
        assert (single.value, single.interval, single.n) == (pytest.approx(0.3), None, 1)
        assert (
            statistics.over_tasks(statistics.improvement, *statistics.matched({"a": {0: 1.0}}, {"b": {0: 1.0}})) is None
        )

    def test_against_evaluma(self) -> None:
        """Another package's interquartile mean, and its stratified bootstrap but for the draws.

        It brings pandas and statsmodels, 150 MB, so that it is none of our extras: `pip install evaluma==0.3.0` to run
        this. For seed 0 below: .470968 and .658239 on both sides, intervals .4224 to .5247 and .5818 to .7299 of its,
        .4192 to .5255 and .5829 to .7234 of ours.
        """
        evaluma = pytest.importorskip("evaluma", reason="evaluma is not installed")
        import pandas as pd

        rng = np.random.default_rng(0)
        runs = {m: {f"t{i}": rng.normal(0.5 + 0.1 * k, 0.2, 6) for i in range(5)} for k, m in enumerate("ab")}
        cells = [(m, t, s, x) for m, by in runs.items() for t, xs in by.items() for s, x in enumerate(xs)]
        frame = pd.DataFrame(cells, columns=["model", "dataset", "seed", "score"]).assign(metric="score")
        bounds = {f"norm_ref_{end}": {f"t{i}": value for i in range(5)} for end, value in (("low", 0.0), ("high", 1.0))}
        theirs = evaluma.load_df(frame, seed="seed", **bounds).iqm_ranking(2000, 0).table.set_index("model")
        for name, by_task in runs.items():
            ours = statistics.over_tasks(statistics.iqm, by_task)
            assert ours is not None
            assert ours.value == pytest.approx(theirs.loc[name, "IQM"], abs=1e-12)
            assert ours.interval == pytest.approx(tuple(theirs.loc[name, ["CI_low", "CI_high"]]), abs=0.02)


class TestCurves:
    def test_thinned(self) -> None:
        """50 points at least where there are as many, and no NaN, which json does not have."""
        made = records.thinned({"a": [(i, i / 3) for i in range(1, 401)], "b": [(1, float("nan")), (2, 1e9 / 3)]})
        assert made["a"]["update"] == list(range(1, 401, 8))
        assert made["a"]["loss"][:2] == [0.3333, 3.0]
        assert made["b"] == {"update": [2], "loss": [3.333e8]}
        for count in (49, 50, 99, 140):
            (kept,) = records.thinned({"a": [(i, 0.5) for i in range(count)]}).values()
            assert len(kept["update"]) >= min(count, 50)

    def test_rounds_are_not_bridged(self) -> None:
        """Where a curve goes without for longer than it is used to, there is a gap; seeds are averaged."""
        seed_0 = {"a": {"update": [10, 20, 30, 90, 100], "loss": [1.0, 2.0, 3.0, 4.0, 5.0]}}
        seed_1 = {"a": {"update": [10, 20, 30, 90, 100], "loss": [3.0, 2.0, 1.0, 4.0, 5.0]}}
        mean = {"update": [10, 20, 30, 31, 90, 100], "loss": [2, 2, 2, None, 4, 5], "seeds": 2}
        assert scoring.mean_curve([seed_0, seed_1]) == {"a": mean}
        lone = {"update": [5], "loss": [1.0]}
        assert scoring.mean_curve([{"b": lone}]) == {"b": {**lone, "seeds": 1}}

    def test_losses_of_other_updates_are_not_averaged(self) -> None:
        """Of seeds whose losses were noted at other updates, the curve is that of the first and those like it."""
        seed_0, seed_1 = ({"a": {"update": [10, 20], "loss": loss}} for loss in ([1.0, 2.0], [3.0, 6.0]))
        fewer, apart = ({"a": {"update": update, "loss": [9.0] * len(update)}} for update in ([10], [11, 21]))
        of_two = {"update": [10, 20], "loss": [2, 4], "seeds": 2}
        assert scoring.mean_curve([seed_0, fewer, apart, seed_1]) == {"a": of_two}

    def test_records(self) -> None:
        """A record has a curve of its training, and needs none."""
        record = next(one for one in records.of_task(DOCS / "records", "bandit") if one["method"] == "naive_rnn")
        assert record["curve"]["imitation"]["update"]
        records.check({key: value for key, value in record.items() if key != "curve"}, "it")
        for curve in ({"a": {"update": [1], "loss": []}}, {"a": {"update": [1], "loss": ["<b>"]}}, [1]):
            with pytest.raises(envs.InputError, match="it is no record: "):
                records.check({**record, "curve": curve}, "it")


def entry(last: float, interval: float | None = 0.01, tier: str = "1", probed: bool = True) -> dict[str, Any]:
    """What `outcome` reads of a method."""
    seeds = [0] if interval is None else [0, 1, 2]
    band = None if interval is None else [last - interval, last + interval]
    about = {"tier": tier, "theta_r2": [0.5] if probed else [], "seeds": seeds, "deployment": ""}
    return {"score_last": last, "ci95": band, **about}


class TestOutcome:
    EXACT = {"interventional": entry(1, tier="reference"), "conditional": entry(0.6, tier="reference")}

    def test_sides(self) -> None:
        outcome = scoring.outcome(
            {
                **self.EXACT,
                **{"good": entry(0.9), "unsure": entry(0.81, 0.05), "bad": entry(0.5)},
                **{"mute": entry(0.4, probed=False)},
                **{"good_episode": {**entry(0.1), "deployment": "episode"}, "oracle": entry(1, tier="sees theta")},
            }
        )
        assert outcome == (
            "good (0.90) inferred theta, like the exact policy interventional (1.00); unsure (0.81) may be"
            " on either side of the middle between the exact policies, 0.80; bad (0.50) scored like the deluded exact"
            " policy, conditional (0.60); mute (0.40) scored below the middle between the exact policies, 0.80, and has"
            " no features to read theta from. Scores of the last episode, means of 3 seeds."
        )

    def test_what_cannot_be_told(self) -> None:
        near = {**self.EXACT, "conditional": entry(0.95, tier="reference"), "one": entry(0.9), "two": entry(0.8)}
        assert scoring.outcome(near).startswith(
            "Nothing can be concluded: the exact policies, interventional (1.00) and"
        )
        assert "no pair of exact policies was run" in scoring.outcome({"one": entry(0.9, None)})
        assert scoring.outcome({"one": entry(0.9, None)}).endswith("of one seed.")
        assert scoring.outcome({"expert": entry(1, tier="reference")}).startswith("No method that learns without theta")
        lone = {name: entry(one["score_last"], None, one["tier"]) for name, one in self.EXACT.items()}
        assert "one (0.90) inferred" in scoring.outcome({**lone, "one": entry(0.9, None)})


def scored(method: str, first: float, last: float, tier: str = "2", deployment: str = "") -> dict[str, Any]:
    """What `headroom` reads of an agent with two seeds and two episodes, where a return is a score."""
    about = {
        "method": method,
        "deployment": deployment,
        "tier": tier,
        "seeds": [0, 1],
        "reference": int(method == "expert"),
    }
    around = {name: [score - 0.1, score + 0.1] for name, score in (("ci95_first", first), ("ci95", last))}
    return {**about, **around, "version": 1, "score_first": first, "score_last": last, "return": [[first, last]] * 2}


class TestHeadroom:
    METHODS = {
        **{"random": scored("random", 0, 0, "reference"), "expert": scored("expert", 1, 1, "reference")},
        **{"interventional": scored("interventional", 0.8, 0.98, "reference")},
        **{"interventional_mode": scored("interventional", 0.85, 0.9, "reference", "mode")},
        **{"a": scored("a", 0.6, 0.9), "a_mode": scored("a", 0.7, 0.8, deployment="mode")},
        **{"b": scored("b", 0.1, 0.95, "3"), "c": scored("c", 0.99, 0.99, "sees theta")},
    }

    def test_of_a_task(self) -> None:
        """Each method once, in the better deployment of the episode; who sees theta is no competitor."""
        first, last, without = (headroom.headroom(self.METHODS, *of) for of in (("first",), ("last",), ("last", "12")))
        assert first is not None
        assert last is not None
        assert without is not None
        assert first[:2] == (("interventional_mode", 0.85), [("a_mode", 0.7), ("b", 0.1)])
        assert last[:2] == (("interventional", 0.98), [("b", 0.95), ("a", 0.9)])
        assert (first.left, last.solved, without.solved) == (pytest.approx(0.15), True, False)
        assert headroom.headroom({"a": self.METHODS["a"]}, "last") is None

    @pytest.mark.parametrize(
        ("returns", "left", "solved", "sure"),
        [
            ({0: 0.9, 1: 0.8}, 0.02, True, False),  # .00 and .04
            ({0: 0.89, 1: 0.83}, 0.01, True, True),
            ({0: 0.8, 1: 0.74}, 0.1, False, True),
            ({0: 0.8, 1: 0.8}, 0.07, False, False),  # .1 and .04
            ({1: 0.8}, 0.04, False, False),
        ],
    )
    def test_what_is_left_is_paired_by_seed(
        self, returns: dict[int, float], left: float, solved: bool, sure: bool
    ) -> None:
        """Of the seeds that both have, however many more the exact policy has; and is it sure?"""
        exact = {"seeds": [0, 1, 2], "return": [[0.9], [0.84], [0.3]]}
        own = {"seeds": [*returns], "return": [[x] for x in returns.values()]}
        methods = {**self.METHODS, "interventional": {**self.METHODS["interventional"], **exact}}
        methods["b"] = {**self.METHODS["b"], **own}
        methods["a"] = methods["a_mode"] = scored("a", 0.1, 0.2)
        made = headroom.headroom(methods, "last")
        assert made is not None
        assert (round(made.left, 9), made.solved, made.sure) == (left, solved, sure)

    def test_best_is_by_the_same_seeds(self) -> None:
        """What a method of ten seeds loses by thetas of the last five does not put it behind one of five."""
        long, short = {"seeds": [*range(10)]}, {"seeds": [*range(5)]}
        returns = [[1.0]] * 5 + [[0.8]] * 5
        exact = {**self.METHODS["interventional"], **long, "return": returns, "score_last": 0.9}
        ours = {**scored("a", 0, 0.88), **long, "return": [[x - 0.02] for (x,) in returns]}
        theirs = {**scored("b", 0, 0.95), **short, "return": [[0.95]] * 5}
        ends = {name: self.METHODS[name] for name in ("random", "expert")}
        made = headroom.headroom({**ends, "interventional": exact, "a": ours, "b": theirs}, "last")
        assert made is not None
        assert made.best == [("a", pytest.approx(0.88)), ("b", pytest.approx(0.85))]
        assert made.left == pytest.approx(0.02)

    def test_page(self) -> None:
        """Certified tasks alone are counted; and it is time when enough are solved without queries."""
        better = {**self.METHODS, "a": scored("a", 0.6, 0.96)}
        tasks = [envs.get(name) for name in ("curling", "icy_road", "hidden_goal")]
        published = [
            (task, {"methods": methods, "task_version": task.version})
            for task, methods in zip(tasks, (self.METHODS, better, better), strict=True)
        ]
        certified = {name: {"verdict": "passed"} for name in ("curling", "icy_road")}
        text = headroom.page(published, certified, {})
        assert "- 1 of 2 tasks are solved (50%) in the last episode, of those without queries." in text
        assert "- 2 of 2 tasks are solved (100%) in the last episode, of all theta-blind methods." in text
        assert "**That is so now.** To compare strong methods, use" in text
        page = headroom.page(published[:1], certified, {"once": published[1:2]})
        assert "That is not so yet." in page
        own = page.partition("## Protocol once\n\nTrials of one episode.\n\n")[2]
        assert "- 1 of 1 tasks are solved (100%) in the last episode, of those without queries." in own
        assert "| curling |" not in own
        assert "| curling | 0.85, mode | 0.70 a_mode (2) |  | 0.15 | 0.98 | 0.95 b (3) |  | solved |" in text
        more = {f"m{i}": scored(f"m{i}", 0.05, 0.1 * i) for i in range(3)}
        results = {**published[0][1], "methods": {**self.METHODS, **more}}
        of_five = headroom.page([(tasks[0], results)], certified, {})
        assert "| 0.98 | 0.95 b (3) | 0.00 m0 | solved |" in of_five
        assert "hidden_goal" not in text
        assert "| a | 2 | 0.60 (0.60 to 0.60) | 0.93 (0.93 to 0.93) | 0.47 (0.47 to 0.47) |" in text

    def test_tasks_of_which_it_is_open(self) -> None:
        """Whether they are solved or seem not to be."""
        left = ((0.0, (0.0, 0.01)), (0.0, (-0.1, 0.1)), (0.1, (0.0, 0.2)), (0.1, (0.02, 0.2)))
        gaps = (statistics.Figure(np.array(value), interval, 5) for value, interval in left)  # type: ignore[arg-type]
        tasks = {str(i): headroom.Headroom(("x", 1.0), [], gap) for i, gap in enumerate(gaps)}
        assert headroom._solved(tasks) == "2 of 4 tasks are solved (50%; of 3 that is open)"

    def test_hard_in(self) -> None:
        """A task is hard where the best learner has .8 at most, and nobody counts who sees theta."""
        assert hard.hard_in({"first": 0.7, "last": 0.8}) == "first, last"
        assert hard.hard_in({"first": 0.81, "last": 0.79}) == "last"
        assert hard.hard_in({"first": 0.81, "last": 0.9}) == "no"
        text = hard.page([], {"gusty_drone": {"verdict": "passed", "interventional": {"score": [0.5, 0.97]}}})
        assert "| wind, load | passed | 0.50 | 0.97 |  |  |  |  |  |  |" in text
        row = hard._row(envs.get("gusty_drone"), None, self.METHODS)
        assert row[5:] == ["0.70 a_mode (2)", "0.90 a (2)", "first", "0.70 a_mode (2)", "0.95 b (3)", "first"]

    def test_best_learner(self) -> None:
        """Who sees theta and the exact policies are no learners."""
        assert headroom.best_of(self.METHODS, "first")[0] == ("a_mode", 0.7)
        assert headroom.best_of(self.METHODS, "last")[0] == ("b", 0.95)

    def test_picture(self, tmp_path: Path) -> None:
        published = [(envs.get("curling"), {"methods": self.METHODS})]
        made = headroom.points(published, {"curling": {"verdict": "passed"}})
        assert made == [("curling", {"first": (0.85, [0.7, 0.1]), "last": (0.98, [0.95, 0.9])})]
        headroom.picture(made, tmp_path / "headroom.png")
        assert (tmp_path / "headroom.png").stat().st_size > 5000

    def test_each_episode_has_its_panel(self, figures: list[Any], tmp_path: Path) -> None:
        """The others of the five best, then the best; a line at the ceiling."""
        headroom.picture([("curling", {"first": (0.85, [0.7, 0.1]), "last": (0.98, [0.95, 0.9])})], tmp_path / "x.png")
        first, last = figures[0].axes
        for panel, end, ceiling, best in ((first, "first", 0.85, [0.1, 0.7]), (last, "last", 0.98, [0.9, 0.95])):
            assert panel.get_title() == f"score in {headroom.ENDS[end]}"
            assert [x for x, _ in dots(panel)] == best
            assert bars(panel)[0] == pytest.approx((ceiling, -0.4, ceiling, 0.4))


class TestProtocols:
    ALL = {
        **{"random": scored("random", 0, 0, "reference"), "expert": scored("expert", 1, 1, "reference")},
        **{name: scored(name.removesuffix("_mode"), 0.5, 0.75) for name in protocol_scores.SHOWN},
    }

    def test_page(self) -> None:
        """The scores of both episodes, each with its own interval; what is missing, and what cannot be."""
        mine = {**self.ALL, "dagger": {**scored("dagger", 0.25, 0.5), "version": 7}}
        dagger_alone = {name: mine[name] for name in ("random", "expert", "dagger")}
        standard = [(envs.get(name), {"methods": self.ALL}) for name in ("curling", "icy_road")]
        under = [(envs.get("curling"), {"methods": mine}), (envs.get("icy_road"), {"methods": dagger_alone})]
        page = protocol_scores.page(standard, {"unseen": under, "once": under[:1]})
        unseen = page.partition("## unseen")[2].partition("## once")[0]
        first, last = unseen.split("| first episode |")[1].split("| last episode |")
        dagger = 1 + protocol_scores.SHOWN.index("dagger")

        def cells(table: str, row: str) -> list[str]:
            [line] = (line for line in table.splitlines() if line.startswith(f"| {row} |"))
            return [cell.strip() for cell in line.strip("| ").split(" | ")]

        assert cells(first, "curling")[dagger] == "0.25 (0.15 to 0.35)"
        assert cells(last, "curling")[dagger] == "0.50 (0.40 to 0.60)"
        assert cells(last, "curling")[1] == "0.75 (0.65 to 0.85)"
        assert "| icy_road |  |  |  | 0.50 (0.40 to 0.60) |" in last
        means = [cells(last, row)[dagger] for row in ("interquartile mean, tasks: 1", "the same, standard")]
        assert means == ["0.50", ""]  # over curling alone, where both have all; records of another version of dagger
        assert [cells(last, "the same, standard")[1], cells(last, "version")[dagger]] == ["0.75", "v7 (now v2)"]
        missing = last.partition("Not yet made: ")[2].partition(".")[0].split(", ")
        assert "weak_thruster" in missing
        assert not {"curling", "icy_road", "bandit"} & {*missing}
        assert "- Not for bandit: best_arm is categorical" in last
        assert "Not for" not in page.partition("## once")[2]

    def test_once(self) -> None:
        """A trial of one episode has one table; beside it is the first episode of longer trials."""
        curling = [(envs.get("curling"), {"methods": self.ALL})]
        once = protocol_scores.page([], {"once": curling}).partition("## once")[2]
        assert once.count("| curling |") == 1
        assert "interquartile mean" not in once
        both = protocol_scores.page(curling, {"once": curling}).partition("## once")[2]
        assert "| interquartile mean, tasks: 1 | 0.75 |" in both
        assert "| the same, standard, first episode | 0.50 |" in both

    def test_means_are_over_shared_seeds(self) -> None:
        """An agent with more seeds under one protocol is compared on those that it has under both."""
        more = {"seeds": [0, 1, 2], "return": [[0.5, 0.75], [0.5, 0.75], [0.5, 0.0]]}
        curling, wider = (
            [(envs.get("curling"), {"methods": {**self.ALL, "dagger": {**self.ALL["dagger"], **of}}})]
            for of in ({}, more)
        )
        expected = protocol_scores.Mean("dagger", 1, 0.75, (0.75, 0.75), 0.75)
        dagger = protocol_scores.SHOWN.index("dagger")
        assert protocol_scores.means("unseen", "last", wider, curling)[dagger] == expected
        assert protocol_scores.means("unseen", "last", curling, wider)[dagger] == expected

    def test_picture(self, tmp_path: Path) -> None:
        """A row for each protocol with means; what it shows are those of the tables."""
        curling = [(envs.get("curling"), {"methods": self.ALL})]
        made = protocol_scores.points(curling, {"unseen": curling, "once": curling})
        assert [(name, [said for said, _ in by_end]) for name, by_end in made] == [
            ("unseen", ["the first episode", "the last episode"]),
            ("once", ["the only episode"]),
        ]
        only = [(mean.agent, mean.value, mean.standard) for mean in made[1][1][0][1]]
        assert only == [(name, 0.75, 0.5) for name in protocol_scores.SHOWN]
        protocol_scores.picture(made, tmp_path / "protocols.png")
        assert (tmp_path / "protocols.png").stat().st_size > 10000
        assert protocol_scores.points([], {"unseen": curling}) == []

    def test_each_agent_has_its_line(self, figures: list[Any], tmp_path: Path) -> None:
        """A hollow dot under the standard protocol, if there is one, and one under this protocol, with its interval."""
        both = protocol_scores.Mean("a", 3, 0.5, (0.4, 0.7), 0.8), protocol_scores.Mean("b", 3, 0.2, (0.1, 0.3), None)
        protocol_scores.picture(
            [("scarce", [("the first episode", both), ("the last episode", both[::-1])])], tmp_path / "x.png"
        )
        first = figures[0].axes[0]
        assert first.get_title() == "scarce: the first episode, 3 tasks"
        drawn = [[*zip(*line.get_data(), strict=True)] for line in first.lines]
        of_a = [[(0.8, 0), (0.5, 0)], [(0.8, 0)], [(0.4, 0), (0.7, 0)], [(0.5, 0)]]
        assert drawn == [*of_a, [(0.1, 1), (0.3, 1)], [(0.2, 1)]]
        assert [line.get_markerfacecolor() for line in first.lines if len(line.get_xdata()) == 1][:2] == [
            "w",
            "tab:blue",
        ]

    def test_table_in_the_making(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """A task appears with its references, without which it has no scores; pages can be made before that."""
        for name in ("curling", "slippery_cartpole"):
            kept = records.of_task(publish.DOCS / "records", name, protocol="scarce")
            made = [record for record in kept if (name, record["method"]) != ("slippery_cartpole", "random")]
            records.write(tmp_path / "records", made)
        monkeypatch.setattr(results, "DOCS", tmp_path)
        tasks = {protocol: [task.name for task, _ in of] for protocol, of in results.other_protocols().items()}
        assert tasks == {"scarce": ["curling"]}


@pytest.fixture(scope="module")
def made() -> dict[str, Any]:
    """What docs/index.html shows."""
    text = (DOCS / "index.html").read_text()
    match = re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.S)
    assert match
    return json.loads(match[1])


class TestIndex:
    @pytest.mark.slow
    def test_rows_are_the_records(self, made: dict[str, Any]) -> None:
        """Each cell has as many seeds as records, and the last episode's score; differences are of these scores."""
        lines = {file.stem: records.of_task(DOCS / "records", file.stem) for file in (DOCS / "records").glob("*.jsonl")}
        for row in made["rows"]:
            returns = {
                name: [one["returns"] for one in lines[row["task"]] if records.named(one) == name]
                for name in (row["method"], "random", "expert")
            }
            assert row["n"] == len(returns[row["method"]])
            means = {name: np.array(seeds)[:, : row["trained"]] for name, seeds in returns.items()}
            zero, one = means["random"].mean(), means["expert"].mean()
            last = (means[row["method"]][:, -1].mean() - zero) / (one - zero)
            assert row["value"] == pytest.approx(last, abs=1e-4)
            scores = (means[row["method"]].mean(0) - zero) / (one - zero)
            assert row["first"]["value"] == pytest.approx(scores[0], abs=1e-4)
            assert row["regret"]["value"] == pytest.approx(len(scores) - scores.sum(), abs=1e-3)
            for measure in ("first", "regret"):
                low, high = row[measure]["interval"] or (row[measure]["value"],) * 2  # none of a single seed
                assert low - 1e-4 <= row[measure]["value"] <= high + 1e-4
            assert f"--task {row['task']}" in row["command"]
        values = {(row["task"], row["method"]): row for row in made["rows"]}
        for (task, _), row in values.items():
            for other, difference in row["minus"].items():
                beside = values[task, other]
                if row["n"] == beside["n"]:
                    assert difference["value"] == pytest.approx(row["value"] - beside["value"], abs=2e-4)

    def test_over_tasks_is_among_those_of_tasks(self, made: dict[str, Any]) -> None:
        """Each measure's own: random actions have a regret of 5, and a latent of the prior does badly at first."""
        for tier, over in made["over"].items():
            tasks = {task["name"] for task in made["tasks"] if tier in ("", task["tier"])}
            for name, method in over["methods"].items():
                rows = [row for row in made["rows"] if row["task"] in tasks and row["method"] == name]
                for measure in ("first", "regret"):
                    values = [row[measure]["value"] for row in rows]
                    assert min(values) - 0.15 <= method[measure]["value"] <= max(values) + 0.15, (tier, name, measure)

    def test_a_method_that_was_not_run(self) -> None:
        """It has figures of the tasks that it has, which say how many these are; one without any is not there."""
        scores = {"a": {"deconfounded": {0: 0.5, 1: 0.7}, "x": {0: 0.6}}, "b": {"deconfounded": {0: 0.9}}, "c": {}}
        aggregated = index.over_tasks(scores, ["a", "b", "c"])
        assert {name: method["tasks"] for name, method in aggregated["methods"].items()} == {"deconfounded": 2, "x": 1}
        assert aggregated["methods"]["x"]["iqm"] == {"value": 0.6, "interval": None, "n": 1}
        won = aggregated["methods"]["x"]["improvement"]
        assert (won["value"], won["n"], won["tasks"]) == (0, 1, 1), "of seed 0, which both have"

    def test_a_row_says_what_its_method_s_entry_does(self) -> None:
        """Each measure with its own interval; return and Eq. (1) of the last episode; differences by seed."""
        entry = {
            **{"seeds": [0, 1], "score": [0.1, 0.6], "score_beyond": [0.7], "budget": {}, "theta_r2": [0.2, 0.3]},
            **{"score_first": 0.1, "score_last": 0.6, "regret": 1.3, "objective": [-9.0, -5.0], "cpu_s": 7.0},
            **{"ci95": [0.5, 0.7], "ci95_first": [0.0, 0.2], "ci95_regret": [1.2, 1.4], "band": None},
            **{"return": [[1.0, 6.0], [1.0, 8.0]], "method": "gail", "version": 1},
        }
        last = {"x": {0: 0.5, 1: 0.7}, "deconfounded": {0: 0.9, 1: 0.9}, "naive_rnn": {0: 0.0, 1: 0.0}}
        row = index.row(envs.get("curling"), "x", entry, last)
        assert (row["n"], row["value"], row["interval"]) == (2, 0.6, [0.5, 0.7])
        assert row["first"] == {"value": 0.1, "interval": [0.0, 0.2]}
        assert row["regret"] == {"value": 1.3, "interval": [1.2, 1.4]}
        assert (row["scores"], row["trained"]) == ([0.1, 0.6, 0.7], 2)
        assert (row["return"], row["objective"], row["r2"], row["cpu"]) == (7.0, -5, [0.2, 0.3], 7.0)
        assert row["held"] == round(100 * scoring.coverage(2))
        assert row["version"] == f"v1 (now v{METHODS['gail'].version})"
        assert index.row(envs.get("curling"), "x", {**entry, "method": "mine"}, last)["version"] == ""
        assert {other: each["value"] for other, each in row["minus"].items()} == {"deconfounded": -0.3}

    def test_links_and_size(self) -> None:
        """All that the page links to is there, nothing comes from a network; a copy of it alone has every picture."""
        text = (DOCS / "index.html").read_text()
        body = text.partition('<script type="application/json"')[0]
        named = {name for name in re.findall(r'(?:href|src)="([^"#]+)"', body) if not name.startswith("data:")}
        assert [name for name in named if not (DOCS / name).exists()] == []
        assert "//" not in "".join(named)
        sources = re.findall(r'<img[^>]*\ssrc="([^"]+)"', body)
        assert len(set(sources)) >= len(index.stills(DOCS)) == len(named & set(index.stills(DOCS))) > 30
        assert all(source.startswith("data:image/webp;base64,") for source in sources)
        assert len(text) < 2e6


@pytest.fixture(scope="module", params=[(1280, False), (400, True)], ids=["desk", "phone, dark"])
def seen(request: pytest.FixtureRequest) -> "Iterator[Page]":
    """A page of two sizes."""
    if publish.chromium() is None:
        pytest.skip(f"no browser: none of {', '.join(publish.BROWSERS)} is installed")
    pytest.importorskip("playwright", reason="playwright is not installed")
    width, dark = request.param
    with publish.browser(width, 850, dark) as page:
        yield page


@pytest.fixture
def errors(seen: "Page") -> list[str]:
    """What the page complains of from now on."""
    heard = list[str]()
    seen.on("pageerror", lambda error: heard.append(str(error)))
    seen.on("console", lambda message: message.type in ("error", "assert") and heard.append(message.text))
    return heard


CELLS = "[...document.querySelectorAll('#matrix td[data-task={}]')].map(c => c.dataset.method)"


def choose(seen: "Page", **what: str) -> None:
    """Use the page's filter."""
    for name, value in what.items():
        change = f"form.{name}.value = {json.dumps(value)}; form.dispatchEvent(new Event('change'))"
        seen.evaluate(f"(form => {{ {change} }})(document.getElementById('filter'))")


class TestInABrowser:
    @pytest.fixture(autouse=True)
    def fresh(self, seen: "Page", errors: list[str]) -> None:
        seen.goto((DOCS / "index.html").as_uri())

    def test_it_fits_and_does_not_complain(self, seen: "Page", errors: list[str]) -> None:
        """No error, no request that leaves the disk, nothing wider than the screen, with all tasks open."""
        seen.evaluate("document.querySelectorAll('details').forEach(one => { one.open = true })")
        seen.evaluate("new Promise(done => setTimeout(done, 100))")
        assert errors == []
        assert seen.evaluate("document.documentElement.scrollWidth") <= seen.evaluate("innerWidth")
        loaded = seen.evaluate("performance.getEntriesByType('resource').map(one => one.name)")
        assert [name for name in loaded if not name.startswith(("file:", "data:"))] == []
        pale = seen.evaluate("getComputedStyle(document.body).backgroundColor.match(/[0-9]+/g).map(Number)")
        dark = seen.evaluate("matchMedia('(prefers-color-scheme: dark)').matches")
        assert max(pale) < 60 if dark else min(pale) > 200
        assert seen.evaluate(
            "[...document.querySelectorAll('.adaptation, .learning > figure')].every(one => one.querySelector('svg'))"
        )

    def test_sorting(self, seen: "Page", made: dict[str, Any]) -> None:
        task = made["tasks"][0]["name"]
        of_task = [row for row in made["rows"] if row["task"] == task]
        expected = [row["method"] for row in sorted(of_task, key=lambda row: -row["value"])]
        click = f"document.querySelector('#matrix button[data-key={task}]').click()"
        seen.evaluate(click)
        values = {row["method"]: row["value"] for row in of_task}
        names = seen.evaluate(CELLS.format(task))
        assert [values[name] for name in names] == [values[name] for name in expected]
        seen.evaluate(click)
        assert [values[name] for name in seen.evaluate(CELLS.format(task))] == [values[name] for name in expected[::-1]]
        seen.evaluate("document.querySelector('#all button[data-key=cpu]').click()")
        cells = "[...document.querySelectorAll('#all tbody tr')].map(row => row.cells[17].textContent)"
        texts = seen.evaluate(cells)
        cpu = [float(text) for text in texts if text != "by GPU"]
        assert cpu == sorted(cpu, reverse=True)
        assert "by GPU" not in texts[: len(cpu)]  # which have no CPU seconds, and come last
        assert len(texts) == len(made["rows"])

    def test_other_figures(self, seen: "Page", made: dict[str, Any], errors: list[str]) -> None:
        """The matrix shows them, with the best first: of regret the least."""
        task = made["tasks"][0]["name"]
        for measure in ("first", "regret"):
            choose(seen, measure=measure)
            values = {row["method"]: row[measure]["value"] for row in made["rows"] if row["task"] == task}
            seen.evaluate(f"document.querySelector('#matrix button[data-key={task}]').click()")
            ordered = [values[name] for name in seen.evaluate(CELLS.format(task))]
            assert sorted(ordered) in (ordered, ordered[::-1])
            assert (ordered[0] < ordered[-1]) == (measure == "regret")
            over = made["over"][""]["methods"]["deconfounded"][measure]["value"]
            assert f"{over:.2f}" in seen.evaluate("document.getElementById('matrix').textContent")
            seen.evaluate("document.querySelector('#matrix button[data-key=\"\"]').click()")
            seen.evaluate("document.querySelector('#matrix button[data-key=\"\"]').click()")
        assert errors == []

    def test_filters(self, seen: "Page", made: dict[str, Any], errors: list[str]) -> None:
        tiers = {task["name"]: task["tier"] for task in made["tasks"]}
        counted = "document.getElementById('count').textContent"
        total = len(made["rows"])
        for tier in set(tiers.values()):
            choose(seen, tier=tier)
            kept = [row for row in made["rows"] if tiers[row["task"]] == tier]
            assert seen.evaluate(counted) == f"{len(kept)} of {total} results"
            assert set(seen.evaluate("[...document.querySelectorAll('#matrix td.open')].map(c => c.dataset.task)")) == {
                row["task"] for row in kept
            }
        choose(seen, tier="", method="naive_rnn", task="hidden_goal")
        assert seen.evaluate(counted) == f"1 of {total} results"
        assert seen.evaluate(
            "[...document.querySelectorAll('details:not([hidden])')].map(d => d.dataset.task + d.open)"
        ) == ["hidden_goaltrue"]
        choose(seen, kind="3")  # naive_rnn is of another: nothing is left, and nothing breaks
        assert seen.evaluate(counted) == f"0 of {total} results"
        assert errors == []

    def test_the_card_of_a_number(self, seen: "Page", made: dict[str, Any]) -> None:
        """On hover, or on a tap: seeds, interval, curves and the command; it lies on the screen."""
        row = next(row for row in made["rows"] if row["method"] == "naive_rnn" and row["trained"] > 1)
        cell = f"#matrix td[data-task={row['task']}][data-method=naive_rnn]"
        if seen.evaluate("innerWidth") > 600:
            seen.hover(cell)
        else:
            seen.evaluate(f"document.querySelector({json.dumps(cell)}).click()")
        assert seen.evaluate("document.querySelectorAll('#card svg').length") == 1 + len(row["curve"])
        card = seen.evaluate("document.getElementById('card').innerText")
        assert row["command"] in card
        assert f"{row['n']} seeds" in card
        box = seen.evaluate(
            "(b => [b.left, b.top, b.right, b.bottom])(document.getElementById('card').getBoundingClientRect())"
        )
        assert min(box) >= 0
        assert box[2] <= seen.evaluate("innerWidth")
        assert box[3] <= seen.evaluate("innerHeight")
        seen.evaluate("document.body.click()")
        seen.evaluate("document.dispatchEvent(new KeyboardEvent('keydown', {key: 'Escape'}))")
        assert seen.evaluate("document.getElementById('card').hidden")

    def test_curves_tell_on_hover(self, seen: "Page") -> None:
        chart = "details[open] .adaptation"
        seen.hover(f"{chart} svg")
        readout = seen.evaluate(f"document.querySelector('{chart} .readout').textContent")
        assert re.fullmatch(r"\w+, episode \d+: \S+, \S+ to \S+, \d+ seeds", readout)
        assert seen.evaluate(f"document.querySelectorAll('{chart} .mark.on').length") == 1


def test_report_in_a_browser(seen: "Page", errors: list[str], tmp_path: Path) -> None:
    """A run's report fits as well; its table scrolls, and each method has its curves."""
    results = aggregation.gather(records.of_task(DOCS / "records", "slippery_cartpole"), list(METHODS))
    run_report.adaptation(results, tmp_path / "adaptation.png")
    run_report.learning(results, tmp_path / "learning.png")
    (tmp_path / "report.html").write_text(run_report.page(results, tmp_path))
    seen.goto((tmp_path / "report.html").as_uri())
    assert errors == []
    assert seen.evaluate("document.documentElement.scrollWidth") <= seen.evaluate("innerWidth")
    assert seen.evaluate("document.querySelectorAll('td svg').length") >= len(results["methods"])
    assert seen.evaluate("document.querySelector('.outcome').textContent") == scoring.outcome(results["methods"])
    wide = "box.scrollWidth > box.clientWidth && getComputedStyle(box).overflowX"
    assert seen.evaluate(f"(box => {wide})(document.querySelector('.scroll'))") == "auto"
    assert seen.evaluate("document.images.length") == 3  # adaptation, learning, certificate
    dark = seen.evaluate("matchMedia('(prefers-color-scheme: dark)').matches")
    filters = seen.evaluate("[...document.images].map(image => getComputedStyle(image).filter)")
    assert all(("invert" in each) == dark for each in filters)
    assert min(seen.evaluate("[...document.images].map(image => image.clientWidth)")) >= 400  # it scrolls on a phone


def test_certificate_of_a_report(tmp_path: Path) -> None:
    """Beside the run before that of docs/; of this version of the task, or none."""
    run, folder = tmp_path / "bandit-default", tmp_path / "certificates"
    assert run_report.certificate("bandit", 0, run) == DOCS / "certificates" / "bandit.png"
    assert run_report.certificate("bandit", 9, run) is None
    assert run_report.certificate("bandit", 0, run, "text of a file that was edited") is None
    assert run_report.certificate("loaded_arm", 0, run) == DOCS / "certificates" / "hard" / "loaded_arm.png"
    folder.mkdir()
    (folder / "bandit.json").write_text('{"task": "bandit", "task_version": 0}')
    (folder / "bandit.png").write_bytes(b"")
    assert run_report.certificate("bandit", 0, run) == folder / "bandit.png"


def test_beliefs_are_drawn(tmp_path: Path) -> None:
    """Of two latents; an agent without belief needs none, and no agents leave no picture."""
    task = envs.get("slippery_walker")
    theta, episode = task.theta_grid(2)[[0, 1, 2]], np.repeat([0, 1, 2], [4, 1, 3])
    run_report.beliefs(task, {}, tmp_path / "none.png")
    assert not (tmp_path / "none.png").exists()
    run_report.beliefs(
        task, {"naive_rnn": {"theta": theta, "episode": episode, "belief": theta[episode]}}, tmp_path / "some.png"
    )
    assert (tmp_path / "some.png").stat().st_size > 5000


def test_true_theta_is_of_the_trial_that_is_filmed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A run keeps the thetas of all trials, and the states of one."""
    task, drawn = envs.get("slippery_cartpole"), []
    monkeypatch.setattr(run_report, "beliefs", lambda _, clips, file: drawn.append(clips["naive_rnn"]["theta"]))
    for name in ("adaptation", "learning"):
        monkeypatch.setattr(run_report, name, lambda *_: None)
    monkeypatch.setattr(film, "write", lambda *_: None)
    monkeypatch.setattr(film, "decoded", lambda *_: None)
    theta, of_one = np.arange(15.0).reshape(3, 5, 1), np.zeros(3)
    kept = {"state": of_one, "action": of_one, "episode": of_one, "theta": theta, "trial": np.array(1), "read": of_one}
    finished = [("naive_rnn", 0, {f"naive_rnn/{key}": value for key, value in kept.items()})]
    run_report.pictures(task, {}, finished, tmp_path)  # type: ignore[arg-type]
    assert drawn[0].tolist() == theta[1].tolist()


def test_each_latent_has_its_panel(figures: list[Any], tmp_path: Path) -> None:
    """Of two latents and two episodes: the truth, and below it what was believed, each in its own unit."""
    task, episode = envs.get("slippery_walker"), np.array([0, 0, 1])
    theta, belief = np.array([[0.1, 5.0], [0.2, 6.0]]), np.array([[0.3, 7.0], [0.4, 8.0], [0.5, 9.0]])
    run_report.beliefs(task, {"naive_rnn": {"theta": theta, "episode": episode, "belief": belief}}, tmp_path / "x.png")
    for i, (panel, latent) in enumerate(zip(figures[0].axes, task.latents, strict=True)):
        assert panel.get_ylabel().startswith(latent.name)
        lines = {line.get_label(): line for line in panel.lines}
        assert [*lines["true"].get_ydata()] == [theta[0, i]] * 2
        assert lines["naive_rnn"].get_ydata().tolist() == belief[:2, i].tolist()
        assert lines["naive_rnn"].get_xdata() == pytest.approx([0, 1 / task.horizon])
        later = panel.lines[-1]
        assert later.get_xydata().tolist() == [[1, belief[2, i]]]


class Seen(Push):
    """Push, with pictures in which there is nothing."""

    def renderer(self, theta: Any) -> Any:
        return lambda state, action: np.zeros((240, 320, 3), np.uint8)


def clip_of_two_episodes() -> dict[str, Any]:
    """A start and three steps, then a start and one step; the force is at the least, then at the most."""
    x = np.array([0.5, 0.4, 0.3, 0.2, 1.0, 1.1])
    state, episode = np.stack([x, 0 * x], -1), np.array([0, 0, 0, 0, 1, 1])
    return {"state": state, "action": np.zeros((6, 1)), "episode": episode, "theta": np.array([[-1.0], [1.0]])}


def test_a_pane_shows_what_was_earned_in_its_episode() -> None:
    """Summed over its steps; when it is over, its last step goes on to be shown."""
    pane = film.Pane(Seen(), "expert", clip_of_two_episodes())
    rewards = np.exp(-np.square([0.4, 0.3, 0.2, 1.1]))
    np.testing.assert_allclose(pane.earned, [0, *rewards[:3].cumsum(), 0, rewards[3]])
    assert [pane.row(0, t) for t in (0, 3, 4)] == [(0, False), (3, False), (3, True)]
    assert [pane.row(1, t) for t in (0, 1, 2)] == [(4, False), (5, False), (5, True)]
    assert pane.row(1, Push.horizon) == (5, True)


def clip_of(*lengths: int) -> dict[str, Any]:
    """Episodes of so many steps, in which nothing moves."""
    episode = np.repeat(np.arange(len(lengths)), np.add(lengths, 1))
    still, theta = np.zeros((len(episode), 2)), np.zeros((len(lengths), 1))
    return {"state": still, "action": still[:, :1], "episode": episode, "theta": theta}


def test_a_film_is_of_the_first_and_the_last_episode(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each until all agents are done with it."""
    drawn, blank = list[tuple[str, int, int]](), Image.new("RGB", (film.WIDTH, 1))
    monkeypatch.setattr(film.Pane, "picture", lambda self, e, t: (drawn.append((self.name, e, t)), blank)[1])
    film.film(Seen(), {"a": clip_of(3, 1, 2), "b": clip_of(1, 4, 1)})
    assert drawn == [(name, e, t) for e, last in ((0, 3), (2, 2)) for t in range(last + 1) for name in "ab"]


@pytest.mark.parametrize(("step", "rate"), [(0.01, 25), (0.04, 25), (0.1, 10), (1.0, 5), (60.0, 5)])
def test_a_film_is_in_real_time(step: float, rate: int) -> None:
    """But for steps of less than 40 ms, and where they have no time of their own."""
    assert film.frame_rate(SimpleNamespace(control_dt=step)) == rate  # type: ignore[arg-type]


def test_a_strip_has_each_episode_s_theta() -> None:
    """The first lies at the lower end, the second at the upper end, each along its half of the strip."""
    pane, draw = film.Pane(Seen(), "expert", clip_of_two_episodes()), Mock()
    pane._strip(draw, 0, 100, 1, 0)
    truths = [call.args[0] for call in draw.line.call_args_list if call.kwargs["fill"] == film.TRUTH]
    low, high, left, right = 100 + film.STRIP - 8, 124, 8, film.WIDTH - 8
    middle = (left + right) / 2
    assert truths == [(left, low, middle, low), (middle, high, right, high)]


def test_a_video_is_as_fast_as_its_film(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Also where only every second step has a picture."""
    saved: list[Any] = []
    monkeypatch.setattr(film, "save", lambda pictures, rate, file: saved.append((len(pictures), rate)))
    monkeypatch.setattr(film, "film", lambda task, clips: film.Film([np.zeros(1)] * 3, 12.5))
    film.write(Seen(), {}, tmp_path / "video.mp4")
    assert saved == [(3, 12.5)]


def test_a_film_of_few_pictures_takes_as_long() -> None:
    """Two episodes of 3 and 1 steps in pictures 2 steps apart: half as many a second."""
    task = Seen()
    whole, short = (film.film(task, {"expert": clip_of_two_episodes()}, most) for most in (100, 2))
    assert (len(whole.pictures), whole.rate) == (4 + 2, film.frame_rate(task))
    assert (len(short.pictures), short.rate) == (2 + 1, film.frame_rate(task) / 2)


def test_thetas_that_a_probe_reads() -> None:
    """Of two kinds a share, of three the likeliest; of a log-uniform latent its middle is the geometric mean."""
    latents = (
        envs.Latent("two", "", 5, 6, "categorical"),
        envs.Latent("log", "", 1.0, 16.0, "loguniform"),
        envs.Latent("three", "", 0, 2, "categorical"),
    )
    task: Any = SimpleNamespace(latents=latents)
    features = np.array([[0.9, 0.1, 0.0, 0.1, 0.7, 0.2], [0.0, 1.0, 1.0, 0.6, 0.1, 0.3]])
    np.testing.assert_allclose(film.decoded(task, features), [[5.1, 4.0, 1.0], [6.0, 16.0, 0.0]])


def test_scores_by_episode(figures: list[Any], tmp_path: Path) -> None:
    """Of a way of deploying an agent another line in its method's colour; what is beyond training is shaded."""
    about = {"method": "naive_rnn", "score": [0.1, 0.2], "score_beyond": [0.3]}
    band = [[0.0, 0.2], [0.1, 0.3], [0.2, 0.4]]
    methods = {
        "naive_rnn": {**about, "deployment": "", "band": band},
        "naive_rnn_mode": {**about, "deployment": "mode", "band": None},
        "expert": {"method": "expert", "deployment": "", "score": [1.0, 1.0], "band": None},
    }
    run_report.adaptation({"task": "curling", "methods": methods}, tmp_path / "adaptation.png")
    axes = figures[0].axes[0]
    lines = {line.get_label(): line for line in axes.lines}
    assert lines["naive_rnn"].get_xydata().tolist() == [[1, 0.1], [2, 0.2], [3, 0.3]]
    assert [lines[name].get_linestyle() for name in methods] == ["-", "-.", "--"]
    assert {"step", *run_report.DEPLOYED} == {*get_args(Way)}
    assert lines["naive_rnn"].get_color() == lines["naive_rnn_mode"].get_color() != lines["expert"].get_color()
    shaded = {(round(y, 9), int(x)) for x, y in axes.collections[0].get_paths()[0].vertices}
    assert {(y, i + 1) for i, ends in enumerate(band) for y in ends} <= shaded
    (beyond,) = axes.patches
    assert (beyond.get_x(), beyond.get_width()) == (2.5, 1.0)


def test_each_kind_of_loss_has_its_panel(figures: list[Any], tmp_path: Path) -> None:
    """Other ways of deploying an agent have no training of their own, and so no line."""

    def entry(method: str, deployment: str = "", **curve: list[float]) -> dict[str, Any]:
        curves = {kind: {"update": [10, 20], "loss": losses} for kind, losses in curve.items()}
        return {"method": method, "deployment": deployment, "curve": curves}

    methods = {"a": entry("a", x=[1, 2], y=[3, 4]), "b": entry("b", y=[5, 6]), "a_mode": entry("a", "mode", y=[7, 8])}
    run_report.learning({"methods": methods}, tmp_path / "learning.png")
    panels = {
        panel.get_title(): {line.get_label(): [*line.get_ydata()] for line in panel.lines} for panel in figures[0].axes
    }
    assert panels == {"x loss": {"a": [1, 2]}, "y loss": {"a": [3, 4], "b": [5, 6]}}


def test_an_older_version_is_told_from_today_s() -> None:
    task, method = envs.get("curling"), METHODS["naive_rnn"]
    entry = {"method": "naive_rnn", "version": method.version - 1}
    made = results.outdated(task, {"task_version": task.version - 1, "methods": {"naive_rnn": entry}})
    assert made == [
        f"the task v{task.version - 1} (now v{task.version})",
        f"naive_rnn v{method.version - 1} (now v{method.version})",
    ]
    assert results.outdated(task, {"task_version": task.version, "methods": {}}) == []


def test_returns_beside_the_authors_are_of_the_last_episode() -> None:
    """A mean over seeds; a method that was not run here has an empty cell."""
    made = {"dagger": {"return": [[1.0, 10.0], [3.0, 20.0]], "score_last": 0.7}}
    rows = [
        line.strip("| ").split(" | ")
        for line in results.controls([(envs.get("ant_goal"), {"methods": made})]).splitlines()
    ]
    column, start = rows[0].index("dagger"), next(i for i, row in enumerate(rows) if row[0] == "ant_goal")
    assert [row[column - bool(i)] for i, row in enumerate(rows[start : start + 3])] == ["-500", "15.00", "0.70"]


@pytest.mark.parametrize(
    ("name", "moved"),
    [
        ("loaded_drone", ["wind", "wind", "`body_pos` of load", "`body_pos` of load", "of front_left"]),
        ("cheetah_speed", ["nothing"]),
        ("curling", ["`tendon_frictionloss` of ice"]),
    ],
)
def test_a_card_says_what_each_latent_moves(name: str, moved: list[str]) -> None:
    """Each by itself, in the model or in what surrounds it."""
    task = envs.get(name)
    assert isinstance(task, envs.MujocoTask)
    said = [cards._moved(task, i) for i in range(len(task.latents))]
    assert all(text.endswith(right) for text, right in zip(said, moved, strict=True)), said
    assert said[0] == moved[0]


@pytest.mark.parametrize(("name", "row"), [("slippery_cartpole", "slider"), ("ant_goal", "root")])
def test_a_card_has_the_noise_of_positions_and_of_velocities(name: str, row: str) -> None:
    """In that order; a free joint has two of each, of moves and of turns."""
    task = envs.get(name)
    assert isinstance(task, envs.MujocoTask)
    cells = cards.card(task).partition(f"| {row} | ")[2].partition("\n")[0].removesuffix(" |").split(" | ")
    assert len(cells) == 2
    assert [float(std) for std in ", ".join(cells).split(", ")] == [*task.process_noise[row]]


def test_no_browser(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(publish, "BROWSERS", ("no-such-browser",))
    says = r"^no browser was found; install one of no-such-browser$"
    with pytest.raises(envs.InputError, match=says), publish.browser(400, 400):
        pass


def test_equal_methods_stand_in_one_order(monkeypatch: pytest.MonkeyPatch) -> None:
    """Methods of the same interquartile mean stand in the registry's order, whatever Python's hash seed is."""
    equal = {name: {0: 0.5, 1: 0.5} for name in reversed(list(METHODS))}
    monkeypatch.setattr(index, "certified", lambda found, certified: {"bandit": equal})
    rows = [line.split(" | ") for line in results.fared([], {}).splitlines()[2:]]
    assert [row[0].removeprefix("| ") for row in rows] == list(METHODS)


def test_tasks_on_which_a_method_fared_worst_and_best(monkeypatch: pytest.MonkeyPatch) -> None:
    """The least first."""
    scores = {task: {"naive_rnn": {0: score, 1: score}} for task, score in (("bandit", 0.8), ("curling", 0.2))}
    monkeypatch.setattr(index, "certified", lambda found, certified: scores)
    head, _, row = results.fared([], {}).splitlines()
    ends = [[cell.strip() for cell in line.split("|")[-3:-1]] for line in (head, row)]
    assert ends == [["least on", "most on"], ["curling, 0.20", "bandit, 0.80"]]


def test_the_summary_has_the_first_and_the_last_episode() -> None:
    """Of the certified tasks where all of its methods were run, and the best of them first."""
    methods = {name: scored(name, 0.25, 0.75 + 0.1 * (name == "rma")) for name in results.SUMMARY}
    methods |= {"random": scored("random", 0, 0), "expert": scored("expert", 1, 1)}
    by_task = [(envs.get(name), {"methods": of}) for name, of in (("curling", methods), ("bandit", {**methods}))]
    by_task[1][1]["methods"].pop("gail")
    text = results.summary(by_task, {name: {"verdict": "passed"} for name in ("curling", "bandit")})
    assert text.startswith("Interquartile means over 1 tasks")
    rows = [[cell.strip() for cell in line.split("|")] for line in text.splitlines()[4:]]
    assert rows[0][1].startswith("[rma]")
    assert {tuple(cell.partition(" (")[0] for cell in row[4:6]) for row in rows[1:]} == {("0.25", "0.75")}


def test_methods_of_more_seeds_are_compared_by_the_same() -> None:
    """In the table of tasks: of ten seeds and of five, the five."""
    long = {**scored("deconfounded", 0, 0.5), "seeds": [*range(10)], "return": [[1.0]] * 5 + [[0.0]] * 5}
    short = {**scored("dagger", 0, 0.9), "seeds": [*range(5)], "return": [[0.9]] * 5}
    ends = {name: scored(name, of, of, "reference") for name, of in (("random", 0), ("expert", 1))}
    task = envs.get("curling")
    about = {"wall_s": 7.0, "task_version": task.version}
    text = results.by_task([(task, {**about, "methods": {**ends, "deconfounded": long, "dagger": short}})])
    head, _, row = ([cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines()[2:5])
    assert dict(zip(head, row, strict=True)) == {
        **dict.fromkeys(head, ""),
        **{"task": "[curling](#curling)", "tier needed": task.tier_name, "seeds": "5", "seconds": "7"},
        **{"deconfounded (2)": "1.00", "dagger (3)": "0.90"},
    }


def test_costs_stand_under_their_tasks() -> None:
    """Of the tasks in the table; a method that was not run on one has an empty cell there."""
    of = {"bandit": 7, "curling": 8, "tilted_cartpole": 9}
    by_task = [(envs.get(name), {"methods": {"dagger": {"cpu_s": seconds}}}) for name, seconds in of.items()]
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in results.costs(by_task).splitlines()]
    assert lines[0] == ["method", "bandit", "tilted_cartpole"]
    assert ["dagger", "7", "9"] in lines
    assert ["rma", "", ""] in lines


def test_commands_of_numbers() -> None:
    """Another way to deploy an agent is of its method's job; a method from outside is named by its file."""
    task = envs.get("bandit")
    ours = records.of_task(DOCS / "records", "bandit")
    outside = [{**record, "method": "mine"} for record in ours if record["method"] == "naive_rnn"][:2]
    gathered = aggregation.gather([*ours, *outside], list(METHODS))
    start = "python benchmarks/run.py --task bandit"
    episode = "deconfounded_discrete_episode"
    assert results.command(task, gathered, episode) == f"{start} --methods deconfounded_discrete"
    assert results.command(task, gathered, "mine") == f"{start} --seeds 2 --methods path/mine.py:fit"
    assert results.command(task, gathered, "expert") == results.command(task, gathered)


def test_a_prediction_that_is_the_wrong_way_round_is_told_by_its_sign() -> None:
    """Pearson's correlation, by hand: of the deviations (-1, 0, 1) and (1, 1, -2), -3 over the root of 2 x 6."""
    task = envs.get("curling")
    of = [gap.Gap(task, predicted, measured) for predicted, measured in ((0.1, 0.5), (0.2, 0.5), (0.3, 0.2))]
    assert f"Pearson's correlation\nis -{3 / 12**0.5:.2f} over 3 tasks" in gap.section(of)


@pytest.mark.slow
def test_pictures_are_drawn_when_their_data_change(tmp_path: Path) -> None:
    """And not otherwise, nor for another comment in the code that draws them."""
    file, drawn = tmp_path / "gap.png", list[int]()

    def draw(data: list[tuple[str, float, float]], file: Path, mark: str) -> None:
        drawn.append(len(data))
        gap.picture(data, file, mark=mark)

    for data in ([("a", 0.1, 0.2)], [("a", 0.1, 0.2)], [("a", 0.1, 0.3)], [("a", 0.1, 0.3)]):
        publish.redraw(file, draw, data)
    assert drawn == [1, 1]
    save_figure(Figure(), file, 50)
    assert mark_of(file) == mark_of(tmp_path / "nowhere.png") == ""
    publish.redraw(file, draw, data)
    assert drawn == [1, 1, 1]


def test_a_picture_leaves_the_backend_as_it_is(tmp_path: Path) -> None:
    """A notebook that draws with one of its own goes on doing so."""
    before = matplotlib.get_backend()
    matplotlib.use("svg")
    try:
        with panels(file := tmp_path / "empty.png", size=(1, 1), pdf=True):
            pass
        assert matplotlib.get_backend() == "svg"
        assert file.read_bytes().startswith(b"\x89PNG")
        assert file.with_suffix(".pdf").read_bytes().startswith(b"%PDF")
    finally:
        matplotlib.use(before)


def test_a_still_is_small_and_made_once(tmp_path: Path) -> None:
    """Of a film its middle frame; of a chart all of it. A page that anybody makes again has the same bytes."""
    frames = [Image.new("RGB", (1000, 40), (60 * i, 0, 0)) for i in range(5)]
    frames[0].save(tmp_path / "film.webp", save_all=True, append_images=frames[1:], lossless=True)
    frames[0].save(tmp_path / "chart.png")
    for name, size, red in (("film.webp", (640, 26), 120), ("chart.png", (1000, 40), 0)):
        file = tmp_path / "stills" / f"{name}.webp"
        still(tmp_path / name, file)
        with Image.open(file) as image:
            assert image.size == size
            assert abs(image.convert("RGB").getpixel((5, 5))[0] - red) < 4
        before = file.stat().st_mtime_ns
        still(tmp_path / name, file)
        assert file.stat().st_mtime_ns == before
        frames[1].save(tmp_path / name)
        still(tmp_path / name, file)
        assert file.stat().st_mtime_ns != before


def test_a_picture_is_drawn_again_when_it_would_be_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As its data have changed, or the code that draws it; and otherwise it is left alone."""
    drawn = []

    def draw(data: Any, file: Path, mark: str) -> None:
        drawn.append(data)
        save_figure(Figure(), file, 20, mark)

    for data, code in ((1, "a"), (1, "a"), (2, "a"), (2, "b"), (2, "b")):
        monkeypatch.setattr(publish.sources, "of_code", lambda _, code=code: code)
        publish.redraw(tmp_path / "x.png", draw, data)
    assert drawn == [1, 2, 2]


def test_a_clip_of_the_same_film_is_not_encoded_anew(tmp_path: Path) -> None:
    """Its mark says of which film it is; a copy is made only where that differs."""
    frames = np.repeat(np.uint8([0, 40, 80, 120, 160, 200]), 16 * 16 * 3).reshape(6, 16, 16, 3)
    imageio.imwrite(tmp_path / "video.mp4", frames)
    for name, made_of in (("one", "a"), ("two", "a"), ("three", "b")):
        publish.clip(tmp_path / "video.mp4", tmp_path / f"{name}.webp", mark(made_of))
    one, two, three = ((tmp_path / f"{name}.webp") for name in ("one", "two", "three"))
    assert mark_of(one) == mark_of(two) == mark("a") != mark_of(three)
    with Image.open(one) as image:
        assert getattr(image, "n_frames", 1) == 2  # every third of six
    before = one.stat().st_mtime_ns
    publish.copy(two, one)
    assert one.stat().st_mtime_ns == before
    publish.copy(three, one)
    assert mark_of(one) == mark("b")
