"""Jobs of a run: a checkpoint within one, and what it must not change."""

import json
import queue
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deconfounded import envs
from deconfounded.benchmarks.engine import benchmark, job_files, jobs, progress, scheduler
from deconfounded.benchmarks.engine.benchmark import BenchmarkJob, CurveMonitor
from deconfounded.benchmarks.engine.catalogue import METHODS
from deconfounded.benchmarks.engine.context import EVALUATION, stream
from deconfounded.benchmarks.engine.presets import preset
from deconfounded.benchmarks.studies import paper
from deconfounded.benchmarks.studies.paper import FigureJob
from deconfounded.deconf.core.data import Batch
from deconfounded.deconf.methods import naive_rnn, references
from deconfounded.deconf.methods.deconfounded import DeconfoundedConfig
from deconfounded.deconf.methods.sequence_bc import RecurrentConfig
from deconfounded.experts import policy
from deconfounded.experts.agent import Agent, ExpertAgent
from deconfounded.experts.rollout import run_trials


def settings(name: str, fresh: bool) -> Any:
    """Twenty-odd updates."""
    few = {"width": 16, "rounds": 5, "inference_updates": 2, "imitation_updates": 2, "inference_batch": 4}
    model, naive = DeconfoundedConfig(**few, final_updates=4, accumulate=not fresh), RecurrentConfig(16, 12, 4, 300)
    configs = {
        "deconfounded": asdict(model),
        "deconfounded_gru": asdict(replace(model, model="gru")),
        "naive_rnn": asdict(naive),
    }
    amounts = {"expert_trials": 8, "explore_trials": 4, "eval_trials": 8, "fresh": 8 if fresh else 0}
    return replace(preset("smoke", envs.get(name), "cpu"), **amounts, configs=configs)


TOYS = Path(__file__).parents[1] / "toys.py"
KINDS = (
    (BenchmarkJob, "Push", "deconfounded", False),
    (BenchmarkJob, "Push", "naive_rnn", False),
    (FigureJob, "Arms", "deconfounded_gru", True),
    (FigureJob, "Arms", "naive_rnn", True),
)


@pytest.fixture(scope="module", params=KINDS, ids=lambda kind: f"{kind[0].__name__}-{kind[1]}-{kind[2]}")
def whole(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[jobs.Job]:
    """A job that ran from beginning to end; it and those that follow keep a checkpoint of each update."""
    kind, task, method, fresh = request.param
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paper, "POINTS", 8)
        patch.setattr(jobs, "SAVE_EVERY_S", 0.0)
        patch.setattr(progress, "_ticks", queue.Queue(), raising=False)
        named, folder = f"{TOYS}:{task}", tmp_path_factory.mktemp("whole")
        job: jobs.Job = kind(named, settings(named, fresh), method, (0, 1), folder, f"{TOYS}:control")
        job.run()
        yield job


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.45, 0.8, 0.9])
def test_interrupted_training_goes_on(
    whole: jobs.Job, share: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A job that was killed and begun again writes, bit for bit, what it would have written."""
    broken = replace(whole, folder=tmp_path / "broken")
    broken.folder.mkdir()

    def unplugged(
        self: jobs.JobMonitor, done: int, total: int, losses: dict[str, float], agent: Agent | None = None
    ) -> None:
        tell(self, done, total, losses, agent)
        seen.append(done / total)
        if max(seen[:-1], default=0) < share <= done / total:
            raise KeyboardInterrupt

    seen: list[float] = []
    tell = jobs.JobMonitor.update
    monkeypatch.setattr(jobs.JobMonitor, "update", unplugged)
    with pytest.raises(KeyboardInterrupt):
        broken.run()
    left = [file for file in broken.folder.iterdir() if not file.name.startswith("demonstrations-")]
    assert [file.suffix for file in left] == [".pt"]
    first = len(seen)
    broken.run()
    assert seen[0] < seen[first] <= seen[first - 1]  # it went on
    for seed in (0, 1):
        expected, resumed = whole.load(seed), broken.load(seed)
        assert expected is not None
        assert resumed is not None
        for key in expected.keys() - {"meta"}:
            np.testing.assert_array_equal(resumed[key], expected[key], err_msg=key)
        assert {k: v for k, v in resumed["meta"].items() if k not in ("spans", "train_s", "cpu_s")} == {
            k: v for k, v in expected["meta"].items() if k not in ("spans", "train_s", "cpu_s")
        }
        assert len(resumed["meta"]["spans"]) == 2
    assert not list(broken.folder.glob(".*.pt"))


def test_costs_are_those_before_an_interruption_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Seven CPU seconds until the checkpoint and two in the process that went on are nine; the data used count, too.

    And when each was at work is known.
    """
    monkeypatch.setattr(progress, "_ticks", queue.Queue(), raising=False)
    monkeypatch.setattr(jobs, "SAVE_EVERY_S", 0.0)
    monkeypatch.setattr(jobs.time, "process_time", iter([100.0, 107.0, 0.0, 2.0]).__next__)
    job = BenchmarkJob("bandit", settings("bandit", False), "naive_rnn", (0,), tmp_path)
    before = CurveMonitor(job, 0.8)
    before.budget["queries"] = [7]
    before.save(lambda: {"done": 3})
    resumed = CurveMonitor(job, 0.8)
    assert resumed.load() == {"done": 3}
    assert resumed.budget == before.budget
    assert resumed.cpu() == 9
    assert [start for start, _ in resumed.spans()] == [before.start, resumed.start]


def test_a_checkpoint_is_written_once_a_minute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A minute after the job began at the earliest, and then after the checkpoint before."""
    monkeypatch.setattr(progress, "_ticks", queue.Queue(), raising=False)
    monkeypatch.setattr(jobs, "SAVE_EVERY_S", 60.0)
    now, written = 0.0, []
    monkeypatch.setattr(jobs.time, "monotonic", lambda: now)
    monitor = CurveMonitor(BenchmarkJob("bandit", settings("bandit", False), "naive_rnn", (0,), tmp_path), 0.8)
    for now in (30.0, 61.0, 62.0, 90.0, 122.0):
        monitor.save(lambda: {"done": 3})
        if monitor.file.exists():
            monitor.file.unlink()
            written.append(now)
    assert written == [61, 122]


def test_a_resumed_curve_is_of_the_same_updates(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every tenth of 4000, wherever the job was interrupted."""
    monkeypatch.setattr(progress, "_ticks", queue.Queue(), raising=False)
    monkeypatch.setattr(jobs, "SAVE_EVERY_S", 0.0)
    job = BenchmarkJob("bandit", settings("bandit", False), "naive_rnn", (0,), tmp_path)
    begun, resumed = CurveMonitor(job, 0.8), CurveMonitor(job, 0.8)
    for done in range(1, 26):
        begun.update(done, 4000, {"imitation": 1 / done})
    begun.save(lambda: {"done": 25})
    assert resumed.load() == {"done": 25}
    for monitor in (begun, resumed):
        for done in range(26, 61):
            monitor.update(done, 4000, {"imitation": 1 / done})
        assert monitor.kept == {"imitation": [(done, 1 / done) for done in (10, 20, 30, 40, 50, 60)]}


def test_held_out_trials_are_no_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The loss of figure 3c is of expert trials that are neither imitated nor of those that agents are scored in."""
    watched: list[Any] = []

    def stop(self: paper.FigureMonitor, *given: Any) -> None:
        watched.extend(given)
        raise InterruptedError

    monkeypatch.setattr(progress, "_ticks", queue.Queue(), raising=False)
    monkeypatch.setattr(paper.FigureMonitor, "watch", stop)
    with pytest.raises(InterruptedError):
        FigureJob("bandit", settings("bandit", False), "naive_rnn", (0, 1), tmp_path).run()
    context, held_out, _ = watched
    seeds = [stream(EVALUATION, seed) for seed in context.seeds]
    scored = run_trials(context.env, ExpertAgent(context.env, context.expert), 1, seeds).trials
    every = [Batch.of(trials, 2).obs for trials in (context.demonstrations, scored)]
    payouts = [row.numpy().tobytes() for obs in (held_out.obs, *every) for row in obs.flatten(0, 1)]
    assert len(payouts) == len(set(payouts)) == 3 * 2 * 8


def test_an_onlooker_notes_what_it_would_have_done() -> None:
    """The expert acts, and the onlooker's memory is of that."""
    observed: list[Any] = []

    class Zero(Agent):
        def act(self, obs: Any) -> Any:
            return np.zeros((len(obs), 1))

        def observe(self, obs: Any, action: Any, *_: Any) -> None:
            observed.append(action)

    env = envs.BatchEnv(envs.get("bandit"), 4)
    onlooker = paper.Onlooker(Zero(), ExpertAgent(env, policy.load(env.task)))
    action = run_trials(env, onlooker, 1, 0).trials.action[:, 0]
    assert (np.stack(onlooker.would) == 0).all()
    assert len(np.unique(action)) == 5
    np.testing.assert_array_equal(np.stack(observed, 1), action)


@pytest.mark.slow
def test_paper_figures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From jobs to figures and table: exact curves by their closed forms, budgets by the settings."""
    monkeypatch.setattr(progress, "_ticks", queue.Queue(), raising=False)
    monkeypatch.setattr(paper, "POINTS", 4)
    task, methods = envs.get("bandit"), ("naive_rnn", "deconfounded")
    for method in methods:
        FigureJob("bandit", settings("bandit", False), method, (0, 1), tmp_path).run()
    like = FigureJob("bandit", settings("bandit", False), "random", (0,), tmp_path)
    finished = [(job.method, job.seeds[0], job.load(job.seeds[0])) for job in scheduler.written(like, tmp_path)]
    assert [(method, seed) for method, seed, _ in finished] == [
        ("deconfounded", 0), ("deconfounded", 1), ("naive_rnn", 0), ("naive_rnn", 1)
    ]  # fmt: skip
    references = paper.exact(task, 1000)  # test_bandit.py has more
    assert references["interventional"]["pulls"] == pytest.approx(54.1, abs=1.5)
    assert references["conditional"]["online"][[0, 9, 99]] == pytest.approx([0.2, 0.306, 0.333], abs=0.05)
    assert references["expert"]["loss"] == pytest.approx(-0.6 * np.log(0.6) - 0.4 * np.log(0.1))
    summary = paper.summarise(finished, references)
    assert summary["deconfounded"]["budget"] == {"expert_trials": 8, "exploration_trials": 20}
    assert summary["naive_rnn"]["target"] == "conditional"
    gap = np.abs(np.array(summary["naive_rnn"]["online"]) - references["conditional"]["online"]).max()
    assert summary["naive_rnn"]["max_gap_online"] == pytest.approx(gap, abs=2e-4)
    assert "20 exploration trials" in paper.write(task, {"set": []}, finished, references, tmp_path)
    results = json.loads((tmp_path / "results.json").read_text())
    assert results["methods"] == summary
    assert results["wall_s"] > 0
    assert len((tmp_path / "rows.csv").read_text().splitlines()) == 1 + len(finished)
    assert all((tmp_path / f"{name}.png").stat().st_size > 10_000 for name in ("figure2", "figure3", "tiers"))


def test_a_sliding_mean(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the last two steps, and at the start of the one that there is."""
    monkeypatch.setattr(paper, "WINDOW", 2)
    np.testing.assert_allclose(paper.smoothed(np.array([[1.0, 3.0, 7.0], [2.0, 0.0, 0.0]])), [[1, 2, 5], [2, 1, 0]])


def of_figures(pulls: float, level: float) -> dict[str, Any]:
    """What a job of the paper's figures keeps of a seed: constant curves at levels of their own."""
    steps = {key: np.full(100, times * level) for times, key in ((1, "on_expert"), (2, "online"))}
    curves = {"at": np.array([1, 2]), "loss_curve": np.full(2, 3 * level), "pulls_curve": np.full(2, 4 * level)}
    return {**steps, **curves, "pulls": np.array(pulls), "meta": {"budget": {}, "train_s": 1.0}}


def test_methods_are_held_against_the_policy_they_should_match() -> None:
    """Pulls of 50 and 53: the standard error of their mean is 1.5. A naive clone should be deluded, and others not."""
    exact = {name: of_figures(pulls, 0.1) for name, pulls in (("conditional", 33.0), ("interventional", 54.0))}
    references = {name: {**entry, "pulls": float(entry["pulls"])} for name, entry in exact.items()}
    finished = [(name, seed, of_figures(50.0 + 3 * seed, 0.2)) for name in ("naive_rnn", "dagger") for seed in (0, 1)]
    summary = paper.summarise(finished, references)
    assert (summary["dagger"]["pulls_mean"], summary["dagger"]["pulls_se"]) == (51.5, 1.5)
    assert (summary["naive_rnn"]["target"], summary["naive_rnn"]["target_pulls"]) == ("conditional", 33)
    assert (summary["dagger"]["target"], summary["dagger"]["target_pulls"]) == ("interventional", 54)
    assert summary["dagger"]["max_gap_online"] == pytest.approx(0.2)  # .4 and .2


def test_panels_of_figure_3(figures: list[Any], tmp_path: Path) -> None:
    """(a) on expert trajectories, (b) online, (c) the loss, (d) pulls: each has its own curve, and the exact one."""
    reference = {"on_expert": np.full(100, 0.5), "online": np.full(100, 0.6), "loss": 0.7, "pulls": 0.8}
    paper.figure_3([("naive_rnn", 0, of_figures(1.0, 0.1))], {"conditional": reference}, tmp_path / "figure3.png")
    for panel, letter, own, exact in zip(
        figures[0].axes, "abcd", (0.1, 0.2, 0.3, 0.4), (0.5, 0.6, 0.7, 0.8), strict=True
    ):
        assert panel.get_title().startswith(f"({letter})")
        learned, dashed = panel.lines
        assert np.nanmin(learned.get_ydata()) == pytest.approx(own) == np.nanmax(learned.get_ydata())
        assert np.ptp(dashed.get_ydata()) == pytest.approx(0)
        assert dashed.get_ydata()[0] == pytest.approx(exact)


@pytest.mark.parametrize("edited", ["method", "task", "amount", "layout"])
def test_a_checkpoint_of_other_code_is_refused(
    edited: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """One of another version of method, task or checkpoints, or of other amounts, is not gone on with."""
    monkeypatch.setattr(progress, "_ticks", queue.Queue(), raising=False)
    monkeypatch.setattr(jobs, "SAVE_EVERY_S", 0.0)
    job = BenchmarkJob("bandit", settings("bandit", False), "naive_rnn", (0,), tmp_path)
    begun = CurveMonitor(job, 0.8)
    begun.save(lambda: {"done": 3})
    assert CurveMonitor(job, 0.8).load() == {"done": 3}
    if edited == "method":
        monkeypatch.setattr(naive_rnn.fit, "method", replace(METHODS["naive_rnn"], version=9))
    elif edited == "task":
        monkeypatch.setattr(type(envs.get("bandit")), "version", 9)
    elif edited == "layout":
        monkeypatch.setattr(jobs, "LAYOUT", 9)
    else:
        job = replace(job, preset=job.preset.configured("naive_rnn", updates=13))
    assert CurveMonitor(job, 0.8).load() is None
    assert "was begun with other code or amounts; training begins again" in capsys.readouterr().out


def test_an_edit_during_a_run_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A result whose identity changed under it is not written; where only our files changed, its commit is marked."""
    monkeypatch.setattr(progress, "_ticks", queue.Queue(), raising=False)
    monkeypatch.setattr(jobs, "commit", lambda: "abc")
    job = BenchmarkJob("bandit", settings("bandit", False), "random", (0,), tmp_path)
    job.run()
    assert job_files.read(job.file(0))["meta"]["commit"] == "abc"  # type: ignore[index]
    stamps = iter((1, 2))
    monkeypatch.setattr(jobs, "last_edit", lambda: next(stamps))
    job.run()
    assert job_files.read(job.file(0))["meta"]["commit"] == "abc+"  # type: ignore[index]
    job.file(0).unlink()
    monkeypatch.undo()
    monkeypatch.setattr(progress, "_ticks", queue.Queue(), raising=False)
    evaluate = benchmark.evaluate

    def edit(*given: Any) -> Any:
        monkeypatch.setattr(references.random, "method", replace(METHODS["random"], version=9))
        return evaluate(*given)

    monkeypatch.setattr(benchmark, "evaluate", edit)
    with pytest.raises(envs.InputError, match=r"^random is made of files that changed while it ran .*; run it again$"):
        job.run()
    assert not job.file(0).exists()


def test_damaged_checkpoint_is_no_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "_ticks", queue.Queue(), raising=False)
    job = BenchmarkJob("bandit", settings("bandit", False), "naive_rnn", (0,), tmp_path)
    monitor = CurveMonitor(job, 0.8)
    assert monitor.load() is None
    for junk in (b"", b"junk", b"PK\x03\x04 half a zip"):
        monitor.file.write_bytes(junk)
        assert monitor.load() is None


def test_tensorboard(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What it shows is the learning curve that the job keeps."""
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    monkeypatch.setattr(progress, "_ticks", queue.Queue(), raising=False)
    (tmp_path / "jobs").mkdir()
    job = BenchmarkJob("bandit", settings("bandit", False), "naive_rnn", (0,), tmp_path / "jobs", track=True)
    job.run()
    kept = job.load(0)
    assert kept is not None
    events = EventAccumulator(str(tmp_path / "tensorboard" / "naive_rnn-0"))
    events.Reload()
    curve = [[event.step, event.value] for event in events.Scalars("loss/imitation")]
    np.testing.assert_allclose(curve, kept["meta"]["curve"]["imitation"], rtol=1e-6)
