"""From a method to a paper: several tasks, what a failing method shows, one rule for scores, and `deconf compare`."""

import json
import queue
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deconfounded import envs
from deconfounded.__main__ import main as deconf
from deconfounded.benchmarks import compare
from deconfounded.benchmarks.engine import catalogue, job_files, presets, progress, published, scheduler, sources
from deconfounded.benchmarks.engine.benchmark import BenchmarkJob, evaluate
from deconfounded.benchmarks.engine.context import Context
from deconfounded.benchmarks.engine.guest_host import Guest, fit_guest
from deconfounded.benchmarks.output import aggregation, comparison, pictures, records, scoring, statistics
from deconfounded.envs.support.errors import InputError, error_line, users_line
from tests.tools import bars, dots, tiny_preset

TEXT = """
from dataclasses import dataclass
import numpy as np
import torch
from torch.utils.data import DataLoader, TensorDataset
from deconfounded.deconf.method import uses
from deconfounded.experts.agent import Agent

@dataclass(frozen=True)
class Config:
    updates: int = 7

class Noisy(Agent):
    def __init__(self, gain): self.gain = gain
    def begin(self, n): self.n = n
    def reset(self, rngs): self.rng = rngs[0]
    def act(self, obs): return self.gain * self.rng.uniform(-1, 1, (len(obs), 1))

@uses("demonstrations", "exploration", on_control=Config())
def fit(given):
    for batch in DataLoader(TensorDataset(torch.arange(8)), 4, num_workers=1):
        pass
    explored = given.explore(Noisy(.5))
    return Noisy(float(np.abs(explored.action).mean()) + given.config.updates / 100)

@uses("demonstrations")
def bad(given):
    return torch.zeros(3) @ torch.zeros(4)
"""


@pytest.fixture
def mine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(catalogue.METHODS, "outside", {})
    (tmp_path / "mine.py").write_text(TEXT)
    return tmp_path / "mine.py"


def record(method: str, seed: int, score: float, task: str = "curling") -> records.Record:
    """Of a method from outside on a task of the suite, with that score in each episode."""
    like = records.of_task(published.RECORDS, task)[0]
    zero, one = aggregation.references(like)
    returns = [zero + score * (one - zero)] * len(like["returns"])
    return {**like, "method": method, "method_version": 0, "deployment": "", "seed": seed, "returns": returns}


class TestSeveralTasks:
    def test_certified(self) -> None:
        names = [task.name for task in published.tasks(["certified", "hidden_goal", "bandit"])]
        assert names[-1] == "hidden_goal"
        assert set(envs.SUITE) - set(names) == {"forked_path"}
        assert [task.name for task in published.tasks(["suite"])] == list(envs.SUITE)
        with pytest.raises(
            InputError, match=r"^task 'certifed' is unknown; did you mean 'certified'\? there are bandit"
        ):
            published.tasks(["bandit", "certifed"])

    @pytest.mark.slow
    @pytest.mark.usefixtures("no_pictures")
    def test_a_run_goes_on_behind_a_failure(self, mine: Path, monkeypatch: pytest.MonkeyPatch, capfd: Any) -> None:
        """Both tasks are tried, and have reports of the rest; the line is of the user's file; the traceback is kept."""
        monkeypatch.chdir(mine.parent)
        small = ["--preset", "smoke", "--set", "eval_trials=4", "expert_trials=4"]
        command = ["deconf", "run", "--tasks", "bandit", "weak_thruster", "--methods", "mine.py:bad", *small]
        monkeypatch.setattr(sys, "argv", list(command))
        with pytest.raises(SystemExit) as ended:
            deconf()
        assert ended.value.code == 2
        said = capfd.readouterr()
        assert re.match(
            r"error: 2 of 2 tasks failed; bandit: mine_bad, seed 0: method mine_bad: .*\(RuntimeError, mine.py:28\)",
            said.err,
        )
        for task in ("bandit", "weak_thruster"):
            assert (mine.parent / "results" / f"{task}-smoke" / "report.html").is_file()
            trace = (mine.parent / "results" / f"{task}-smoke" / "errors" / "mine_bad-0.txt").read_text()
            assert trace.startswith("Traceback")
            assert "torch.zeros(3) @ torch.zeros(4)" in trace
        monkeypatch.setattr(sys, "argv", command)
        with pytest.raises(SystemExit):
            deconf()
        assert "give --resume to go on" in capfd.readouterr().err


def test_settings_of_one_s_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of any type that json has, and of any size; its width stays its author's, on large observations too."""
    monkeypatch.setattr(catalogue.METHODS, "outside", {})
    fields = "sizes: tuple[int, ...] = (64, 64)\n    offset: int = 0\n    bias: float = -1.0\n    width: int = 32"
    config = f"@dataclass(frozen=True)\nclass Config:\n    {fields}\n"
    head = "from dataclasses import dataclass\nfrom deconfounded.deconf.method import uses\n"
    fit = "@uses('demonstrations', on_control=Config())\ndef fit(given):\n    pass\n"
    (tmp_path / "clone.v2.py").write_text(f"{head}{config}{fit}")
    name = catalogue.add(f"{tmp_path}/clone.v2.py:fit")
    assert name == "clone_v2"
    for task in ("slippery_cartpole", "ant_goal"):
        settings = presets.preset("default", envs.get(task), "cpu")
        assert settings.configs[name]["width"] == 32
        for change, field, value in (
            ("sizes=[32, 8]", "sizes", (32, 8)),
            ("offset=0", "offset", 0),
            ("bias=-2", "bias", -2),
        ):
            assert presets.changed(settings, [f"{name}.{change}"]).configs[name][field] == value
        with pytest.raises(InputError, match=r"sizes was '32'; it must be like \[64, 64\]"):
            presets.changed(settings, [f"{name}.sizes=32"])


def test_methods_have_helpers_of_their_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Modules of one name in two folders: a method's process finds the one beside it."""
    monkeypatch.setattr(catalogue.METHODS, "outside", {})
    monkeypatch.setattr(sys, "path", [*sys.path])
    head = "import helper\nfrom deconfounded.deconf.method import uses\n"
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "helper.py").write_text(f"NAME = '{folder}'")
        fit = "@uses('demonstrations')\ndef fit(given):\n    raise ValueError(f'helper of {helper.NAME}')\n"
        (tmp_path / folder / f"m_{folder}.py").write_text(f"{head}{fit}")
    names = [catalogue.add(f"{tmp_path}/{folder}/m_{folder}.py:fit") for folder in ("a", "b")]
    context = Context(envs.get("bandit"), tiny_preset(), [0])
    for name, folder in zip(names, ("a", "b"), strict=True):
        method = catalogue.METHODS[name]
        with pytest.raises(InputError, match=f"helper of {folder}"):
            Guest(context, name, method.reference, method.uses)


def test_a_helper_that_does_not_parse(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The line names its file, not the method's."""
    monkeypatch.setattr(catalogue.METHODS, "outside", {})
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "broken_helper.py").write_text("print 'no'")
    head = "from deconfounded.deconf.method import uses\n@uses('demonstrations')\n"
    (tmp_path / "late.py").write_text(f"{head}def fit(given):\n    import broken_helper\n")
    with pytest.raises(SyntaxError) as caught:
        sources.of_reference(f"{tmp_path}/late.py:fit")
    assert caught.value.filename == str(tmp_path / "broken_helper.py")


@pytest.mark.parametrize("key", ["task_version", "expert", "eval_trials", "method_version"])
def test_records_of_two_kinds_are_not_compared(key: str) -> None:
    one, other = record("mine", 0, 0.5), record("mine", 1, 0.6)
    other = {**other, key: "0" * 64 if key == "expert" else other[key] + 1}
    with pytest.raises(InputError, match=f"have {key} .*; such are not to be compared"):
        comparison.gathered([one, other], [])


def test_records_of_two_texts_of_a_method_are_not_compared() -> None:
    """On two tasks; they would be averaged over."""
    of_texts = [record("mine", 0, 0.5, task) | {"outside": {"method": task}} for task in ("curling", "bandit")]
    with pytest.raises(InputError, match="records of mine are from two versions of its file; make them again with one"):
        comparison.gathered(of_texts, [])
    assert comparison.gathered([made | {"outside": {"method": "a"}} for made in of_texts], [])


@pytest.mark.slow
def test_a_method_in_this_process_is_as_in_its_own(mine: Path) -> None:
    """Same data, same random numbers; it may start processes of its own, and its amounts can be set."""
    name = catalogue.add(f"{mine}:fit")
    settings = presets.changed(presets.preset("smoke", envs.get("weak_thruster"), "cpu"), [f"{name}.updates=3"])
    settings = presets.changed(settings, ["eval_trials=4", "expert_trials=4", "explore_trials=4"])
    assert settings.configs[name]["updates"] == 3
    returns = []
    for walled in (True, False):
        context = Context(envs.get("weak_thruster"), settings, [0])
        method = catalogue.METHODS[name]
        make: Callable[[], Any] = lambda c=context, m=method: Guest(c, name, m.reference, m.uses)  # noqa: E731
        agent = make() if walled else fit_guest(context, name, method)
        try:
            returns.append(evaluate(context, agent, True)[0]["returns"])
        finally:
            if isinstance(agent, Guest):
                agent.close()
    assert (returns[0] == returns[1]).all()


def test_tracebacks_are_kept_until_it_works(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "_ticks", queue.Queue(), raising=False)
    job = BenchmarkJob("bandit", tiny_preset(), "random", (0,), tmp_path / "jobs")
    failure = InputError("no")
    failure.add_note("Traceback ...")
    run: Callable[..., None] = lambda jobs, tick, say: say(jobs[0], failure)  # noqa: E731
    (error,) = scheduler.run_jobs([job], "one", run, tmp_path / "errors")
    assert str(error) == "random, seed 0: no"
    assert error.__cause__ is failure
    assert (tmp_path / "errors" / "random-0.txt").read_text() == "Traceback ..."
    scheduler.run_jobs([job], "one", lambda jobs, tick, say: say(jobs[0], "well"), tmp_path / "errors")
    assert not list((tmp_path / "errors").iterdir())


def test_an_error_s_line_is_of_the_user_s_file(tmp_path: Path) -> None:
    """And a long one is cut."""
    (tmp_path / "own.py").write_text(
        "import json\ndef f():\n    json.loads('{')\nimport deconfounded\ndef g():\n    deconfounded.load('nowhere')\n"
    )
    sys.path.insert(0, str(tmp_path))
    try:
        import own  # type: ignore[import-not-found]

        with pytest.raises(ValueError, match="Expecting") as caught:
            own.f()
        assert error_line(caught.value).endswith("(JSONDecodeError, own.py:3)")
        with pytest.raises(InputError) as of_ours:  # in deconfounded/__init__.py, called by the user's line
            own.g()
        assert users_line(of_ours.value) == "own.py:6"
    finally:
        sys.path.remove(str(tmp_path))
    assert len(str(InputError("x" * 22_000))) < 1100
    with pytest.raises(InputError, match=r"was 0\.5, and 5 others were as wrong; each must be a whole number 0\.\.4"):
        envs.get("bandit").check_action(np.full((6, 1), 0.5), 6)


def test_what_differs_is_said() -> None:
    before, now = {"torch": "2.13.0", "numpy": "2.4"}, {"torch": "2.14.0", "numpy": "2.4"}
    assert job_files.differing("versions", before, now) == "versions (torch was 2.13.0, is 2.14.0)"
    assert job_files.differing("salt", "", "x") == "salt (was empty, is x)"
    before, now = dict.fromkeys("abcde", "1"), dict.fromkeys("abcde", "2")
    assert job_files.differing("set", before, now) == "set (a was 1, is 2; b was 1, is 2; c was 1, is 2, and 2 more)"


class TestScores:
    def test_one_rule_for_0_and_1(self) -> None:
        """The same records have the same score, whichever seeds of random and expert are beside them."""
        kept = records.of_task(published.RECORDS, "curling")
        seeds = [[0, 1, 2], [0, 1, 2, 7, 8, 9]]
        both = [[r for r in kept if r["seed"] in (s if r["method"] in catalogue.REFERENCES else s[:3])] for s in seeds]
        few, many = (aggregation.gather(of)["methods"] for of in both)
        assert few["naive_rnn"]["score"] == many["naive_rnn"]["score"]
        for of in ({"expert": "0" * 64}, {"expert_version": 99}):  # another expert: its run's own references
            foreign = [{**r, **of} for r in both[0]]
            assert aggregation.references(foreign[0], foreign) != aggregation.references(both[0][0], both[0])

    @pytest.mark.slow
    def test_episodes_beyond_the_trial_s_do_not_count(self) -> None:
        """A record may hold the returns of more episodes than a trial of its task has."""
        made = record("mine", 0, 0.5)
        episodes = made["episodes"]
        random, expert = aggregation.references(made)
        longer = {**made, "returns": [*made["returns"][:episodes], expert, expert]}
        scores = comparison.gathered([longer], [])["mine"]["curling"][0]
        np.testing.assert_allclose(scores, [0.5] * episodes)
        assert random != expert

    @pytest.mark.slow
    def test_coverage(self) -> None:
        """Of the interval that tables show, by an independent simulation."""
        rng = np.random.default_rng(1)
        for n, right in ((3, 0.75), (5, 0.84), (10, 0.90)):
            ends = [scoring.bootstrap(x) for x in rng.standard_normal((300, n))]
            held = np.mean([e is not None and e[0] <= 0 <= e[1] for e in ends])
            assert held == pytest.approx(scoring.coverage(n), abs=0.06)
            assert scoring.coverage(n) == pytest.approx(right, abs=0.015)
        assert scoring.interval([0.311, 0.422], 3) == "0.31 to 0.42 (75%)"
        assert scoring.interval(None, 1) == "-"

    def test_intervals_of_many_values(self) -> None:
        """Of a normal: 1.96 standard errors to each side, to a tenth; in memory that does not grow with them."""
        values = np.random.default_rng(0).standard_normal(scoring.MANY * 3)
        ends = scoring.bootstrap(values)
        assert ends is not None
        assert np.ptp(ends) == pytest.approx(2 * 1.96 * values.std() / len(values) ** 0.5, rel=0.1)
        assert scoring.coverage(len(values)) == pytest.approx(0.95)

    def test_a_table_fits_into_the_terminal(self, monkeypatch: pytest.MonkeyPatch) -> None:
        head, rows = ("method", "data", "last"), [("one", "d" * 70, "0.10"), ("two", "d", "0.20")]
        monkeypatch.setenv("COLUMNS", "80")
        lines = scoring.plain_table(head, rows, ["interval", "data"]).splitlines()  # it has no intervals
        assert lines[0] == "method  last"
        assert lines[-1] == "(too wide for this terminal: data)"
        monkeypatch.setenv("COLUMNS", "200")
        assert "data" in scoring.plain_table(head, rows, ["data"]).splitlines()[0]

    def test_colours_are_of_one_method_each(self) -> None:
        names = [*catalogue.METHODS, *(f"mine_{i}" for i in range(40))]
        assert len(set(pictures.colours(names).values())) == len(names)


class TestComparison:
    @pytest.mark.slow
    def test_differences_are_paired_by_seed(self, tmp_path: Path) -> None:
        """Against the records of the package; intervals as of scipy, and over tasks as by hand."""
        every = [record("mine", seed, 0.5 + 0.1 * seed, task) for task in ("curling", "bandit") for seed in range(3)]
        scores = comparison.gathered(every, ["naive_rnn"])
        (row,) = [
            r for r in comparison.of_tasks(scores, ["mine"], ["naive_rnn"]) if (r.method, r.task) == ("mine", "curling")
        ]
        theirs = comparison.at(scores, "naive_rnn", "curling", "last")
        expected = np.array([0.5 + 0.1 * seed - theirs[seed] for seed in range(3)])
        assert row.minus["last"]["naive_rnn"].value == pytest.approx(expected.mean())
        assert row.minus["last"]["naive_rnn"].n == 3
        over = comparison.over_tasks(scores, ["mine"], ["naive_rnn"])[0]
        assert over.score["last"].value == pytest.approx(0.6)
        assert row.score["regret"].value == pytest.approx(5 * (1 - 0.6))  # curling's trials have five episodes
        theirs = comparison.at(scores, "naive_rnn", "curling", "regret")
        mean = np.mean([theirs[seed] for seed in range(3)])
        assert row.minus["regret"]["naive_rnn"].value == pytest.approx(2 - mean)
        said = comparison.write(scores, ["mine"], ["naive_rnn"], tmp_path)
        assert "last - naive_rnn" in said
        tex = (tmp_path / "tasks.tex").read_text()
        assert tex.count("\\toprule") == tex.count("\\bottomrule") == 1
        assert all(line.endswith(r"\\") for line in tex.splitlines() if "&" in line)
        assert r"naive\_rnn" in tex
        assert "naive_rnn" not in tex.replace(r"\_", "")
        for name in ("comparison.pdf", "comparison.png", "over_tasks.csv", "over_tasks.tex", "tasks.csv"):
            assert (tmp_path / name).stat().st_size > 0

    SCORES = {
        "a": {"t": {0: np.array([0.1, 0.5]), 1: np.array([0.1, 0.7])}, "u": {0: np.array([0.2, 0.3])}},
        "b": {"t": {0: np.array([0.4, 0.2]), 1: np.array([0.8, 0.5]), 2: np.array([0.0, 0.9])}},
        "c": {"t": {0: np.array([0.3, 0.1]), 1: np.array([0.2, 0.1])}},
    }

    def test_cells_stand_under_their_heads(self) -> None:
        """By hand, of two others: each difference, and the probability in the last episode alone."""
        rows = [
            comparison.of_tasks(self.SCORES, ["a"], ["b", "c"]),
            comparison.over_tasks(self.SCORES, ["a"], ["b", "c"]),
        ]
        tables = comparison.tables(*rows, ["b", "c"])
        of_t, over = (dict(zip(table[0], table[1], strict=True)) for table in tables.values())
        expected = {
            **{"first - b": "-0.50", "last - b": "+0.25", "regret - b": "+0.25"},
            **{"first - c": "-0.15", "last - c": "+0.50", "regret - c": "-0.35"},
        }
        assert (of_t["task"], of_t["method"], of_t["seeds"], of_t["last"]) == ("t", "a", "2", "0.60")
        assert tables["tasks"][2][:6] == ["t", "b", "3", "0.40", "0.53", "1.07"]
        for cells in (of_t, over):
            assert {head: cells[head].partition(" (")[0] for head in expected} == expected
        better = [over[f"P(better than {other})"].partition(" (")[0] for other in "bc"]
        assert better == ["1.00", "1.00"]  # a's .5 and .7 against .2 and .5, by seed; .5 and .5 would be a tie
        assert over["tasks"] == "2"

    def test_a_picture_is_of_the_last_episode(self, figures: list[Any], tmp_path: Path) -> None:
        """Differences with their intervals, a panel for each other; interquartile means."""
        rows = [
            comparison.of_tasks(self.SCORES, ["a"], ["b", "c"]),
            comparison.over_tasks(self.SCORES, ["a"], ["b", "c"]),
        ]
        comparison.picture(*rows, ["b", "c"], tmp_path / "comparison.png")
        first, second, last = figures[0].axes
        assert dots(first)[0] == pytest.approx((0.25, 0))
        assert dots(second)[0] == pytest.approx((0.5, 0))
        student = 12.7062 * 0.1  # of one degree of freedom, times the standard error
        assert bars(second)[0] == pytest.approx((0.5 - student, 0, 0.5 + student, 0), abs=1e-4)
        assert [x for x, _ in dots(last)] == pytest.approx([0.6 / 2 + 0.3 / 2, 1.6 / 3, 0.1])
        assert [label.get_text() for label in last.get_yticklabels()] == ["a", "b", "c"]

    def test_records_of_older_versions_are_named(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        kept = records.of_task(published.RECORDS, "curling")
        version, today = catalogue.METHODS["naive_rnn"].version, [r for r in kept if r["method"] == "naive_rnn"]
        line = f"naive_rnn is of version {version - 1} in the records of the package; today's is {version}"
        monkeypatch.setattr(comparison, "RECORDS", tmp_path)
        for back, lines in ((0, []), (1, [line])):
            records.write(tmp_path, [r | {"method_version": version - back, "bits": "0" * 64} for r in today])
            assert comparison.outdated([record("mine", 0, 0.5)], ["naive_rnn"]) == lines
            (tmp_path / "curling.jsonl").unlink()

    def test_records_of_several_versions_are_named(self) -> None:
        """In whatever order their tasks are given; methods from outside have no versions."""
        today = catalogue.METHODS["gail"].version
        made = [
            record("gail", 0, 0.5, task) | {"method_version": version}
            for task, version in (("curling", today), ("bandit", today - 1))
        ]
        line = f"gail is of version {today - 1} and {today} in the records given; today's is {today}"
        assert comparison.outdated(made, []) == comparison.outdated(made[::-1], []) == [line]
        assert comparison.outdated([*made[:1], record("mine", 0, 0.5)], []) == []

    def test_a_mean_over_tasks(self) -> None:
        """Welch's interval holds the mean as often as it says, of three seeds."""
        rng, held = np.random.default_rng(0), []
        for _ in range(600):
            figure = statistics.mean_difference({str(i): (1 + i) * rng.standard_normal(3) for i in range(4)})
            assert figure.interval is not None
            held.append(figure.interval[0] <= 0 <= figure.interval[1])
        assert np.mean(held) == pytest.approx(0.95, abs=0.025)

    def test_runs_unlike_the_package_s_are_named(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        """Their presets, settings and salts; a run that is given twice counts once."""
        read: list[records.Record] = []
        monkeypatch.setattr(comparison, "gathered", lambda every, against: (read.extend(every), {"mine": {}})[1])
        monkeypatch.setattr(comparison, "write", lambda *_: "written")
        monkeypatch.setattr(comparison, "outdated", lambda *_: [])
        changes = ({}, {"preset": "smoke"}, {"salt": "x"}, {"set": ["seeds=2"], "preset": "paper"}, {"eval_trials": 16})
        unpaired = "note: runs of salts none, x: a seed has other thetas in each, and nothing is paired"
        made = [record("mine", seed, 0.5) | change for seed, change in enumerate(changes)]
        for name, kept in (("plain", made[:1]), ("all", made)):
            records.write(tmp_path / name, kept)
            monkeypatch.setattr("sys.argv", ["compare", *[str(tmp_path / name)] * 2, "--out", str(tmp_path / "out")])
            compare.main()
        assert [each["seed"] for each in read] == [0, 0, 1, 2, 3, 4]
        kinds = ("preset paper, smoke", "set ['seeds=2']", "salt x")
        lines = capsys.readouterr().out.splitlines()
        noted = [f"note: runs of {kind}" for kind in kinds]
        fewer = "note: runs of 128 and 16 trials a seed, the package's of 128: a seed's are the same only in part"
        assert [line.partition(";")[0] for line in lines] == ["written"] * 2 + [*noted, fewer, unpaired]
        monkeypatch.setattr(comparison, "published", lambda *_: [])
        compare.main()  # of which the package has no part
        lines = capsys.readouterr().out.splitlines()
        unlike = ["preset default and paper and smoke", "set ['seeds=2'] and none"]
        assert lines == [
            "written",
            unpaired,
            *(f"note: runs of {kinds}: differences may come of that" for kinds in unlike),
        ]

    def test_bad_input(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        twice = [record("mine", 0, 0.5), record("mine", 0, 0.6)]
        with pytest.raises(InputError, match="two records of mine on curling with seed 0"):
            comparison.gathered(twice, [])
        with pytest.raises(InputError, match=r"--against nobody: no record is of it.*, rma$"):
            comparison.gathered(twice[:1], ["nobody"])
        own = [record("mine", 0, 0.5) | {"task": "own_task"}, record("random", 0, 0.1) | {"task": "own_task"}]
        own.append(record("expert", 0, 0.9) | {"task": "own_task"})
        says = (
            r"--against dagger: .* there are mine; `deconf run --task path/file.py:Class --methods dagger` makes them$"
        )
        with pytest.raises(InputError, match=says):
            comparison.gathered(own, ["dagger"])
        for wrong, near in (("naive_rn", "naive_rnn"), ("deconfounded_modes", "deconfounded_mode")):
            with pytest.raises(
                InputError, match=f"--against {wrong}: .*; did you mean {near}. there are mine, .*, rma"
            ):
                comparison.gathered(twice[:1], [wrong])
        for reference in ("random", "expert"):
            with pytest.raises(InputError, match=f"--against {reference}: scores are made by random, 0, and expert, 1"):
                comparison.gathered(twice[:1], [reference])
        with pytest.raises(InputError, match="holds no records"):
            compare.read(tmp_path)
        records.write(tmp_path, twice[:1])
        monkeypatch.setattr("sys.argv", ["compare", str(tmp_path / "curling.jsonl"), "--protocol", "scarce"])
        with pytest.raises(InputError, match="--protocol was scarce; the records given are of standard"):
            compare.main()


def test_records_name_the_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "_ticks", queue.Queue(), raising=False)
    job = BenchmarkJob("bandit", tiny_preset(), "blind_bc", (0,), tmp_path)
    job.run()
    data = job.load(0)
    assert data is not None
    (made,) = records.of_job(data, "smoke", [], 1)
    assert records.check(json.loads(json.dumps({**made, "sha256": "0" * 64})), "it")["package"] == "0.1.0"


def test_notes_say_whose_references() -> None:
    """Records of the package have no task of a user's own: 0 and 1 are then the runs' (aggregation.references)."""
    said = comparison.notes()
    assert "of the records that come with the package, or of the runs on a task that these do not have" in said
