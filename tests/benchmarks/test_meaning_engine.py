"""The engine and commands by what they claim: done is what is done, and an exit code of 0 says that all went well."""

import os
import queue
import shutil
import signal
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from deconfounded import envs
from deconfounded.benchmarks import certify
from deconfounded.benchmarks.console import run_command
from deconfounded.benchmarks.engine import jobs, progress, provider, published, scheduler
from deconfounded.benchmarks.engine.benchmark import BenchmarkJob, CurveMonitor
from deconfounded.benchmarks.engine.catalogue import METHODS
from deconfounded.benchmarks.engine.context import Context
from deconfounded.benchmarks.engine.local import Here, Local
from deconfounded.benchmarks.engine.presets import preset
from deconfounded.deconf.methods import references
from deconfounded.envs import registry
from tests import toys
from tests.tools import tiny_preset


class Killed(jobs.Job):
    """Its worker is killed, as by a system that is out of memory."""

    def run(self) -> str:
        os.kill(os.getpid(), signal.SIGKILL)
        return "not to be said"


@pytest.mark.slow
def test_a_killed_worker_is_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One line, and exit code 2; nothing is said of the job, and none of it counts as done."""
    job = Killed("bandit", tiny_preset(), "random", (0,), tmp_path)
    with pytest.raises(SystemExit) as ended, Local() as engine:
        run_command(lambda: scheduler.run_jobs([job], "killed", engine.run))
    assert ended.value.code == 2
    said = capsys.readouterr()
    assert said.err == "error: a worker process was killed (out of memory?); run it again\n"
    assert "random, seed 0" not in said.out


@pytest.mark.parametrize(("verdict", "code"), [("passed", 0), ("failed", 1)])
def test_a_certificate_s_exit_code(
    verdict: str, code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It is of as many trials as were asked for, and says how well theta is known in the last episode."""
    asked: list[Any] = []
    check = {"measured": 0.9, "required": "<= 0.7", "passed": verdict == "passed", "error": 0.12, "sure": code == 0}
    result = {
        **{"task": "bandit", "verdict": verdict, "inferability": [{"arm": 0.2}, {"arm": 0.9}]},
        **{"checks": {"blind_bc": check}},
        **{"evidence_nats_per_step": {"dynamics": 1.0, "actions": 1.0}},
    }
    monkeypatch.setattr(certify, "certify", lambda *given, **_: (asked.extend(given[2:]), result)[1])
    monkeypatch.setattr(certify, "picture", lambda *_: None)
    monkeypatch.setattr("sys.argv", ["certify", "--task", "bandit", "--out", str(tmp_path), "--trials", "7"])
    ended: Any = 0
    try:
        run_command(certify.main)
    except SystemExit as error:
        ended = error.code
    assert ended == code
    assert asked == [7]
    said = capsys.readouterr().out
    assert f"certificate {verdict}" in said
    assert "blind_bc: 0.900 +- 0.120 (required <= 0.7)" in said
    assert (": within two standard errors; --trials says more\n" in said) == (code == 1)
    assert "theta from expert trials (R2, or the share that is right): arm 0.90\n" in said


def test_a_checkpoint_is_of_its_own_job_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another salt, expert, or amount begins anew; when a job is done its checkpoint is gone, and others' are swept."""
    monkeypatch.setattr(progress, "_ticks", queue.Queue(), raising=False)
    monkeypatch.setattr(jobs, "SAVE_EVERY_S", 0.0)
    job = BenchmarkJob("bandit", tiny_preset(), "naive_rnn", (0,), tmp_path)
    begun = CurveMonitor(job, 0.8)
    begun.save(lambda: {"done": 3})
    for other in (replace(job, salt="x"), replace(job, preset=replace(job.preset, expert_trials=5))):
        assert CurveMonitor(other, 0.8).load() is None
    assert CurveMonitor(job, 0.8).load() == {"done": 3}
    begun.close()
    assert CurveMonitor(job, 0.8).load() is None


def test_a_failed_job_is_an_error_when_others_are_done(tmp_path: Path) -> None:
    """All are told of."""
    said: list[str] = []
    made = [BenchmarkJob("bandit", tiny_preset(), name, (0,), tmp_path) for name in ("random", "expert")]

    def run(every: Any, tick: Any, say: Any) -> None:
        for job, became in zip(every, (envs.InputError("it broke"), "all well"), strict=True):
            say(job, became)
            said.append(job.method)

    assert [str(error) for error in scheduler.run_jobs(made, "two", run)] == ["random, seed 0: it broke"]
    assert said == ["random", "expert"]


class Told(Here):
    """As in processes of their own: what fails is told, and the others go on."""

    def run(self, jobs: list[Any], tick: Any, say: Any) -> None:
        for job in jobs:
            try:
                say(job, scheduler.run_job(job))
            except envs.InputError as error:
                say(job, error)


class Failing(BenchmarkJob):
    """It leaves a checkpoint, and no more."""

    def run(self) -> str:
        self.checkpoint.touch()
        raise envs.InputError("out of memory")


def test_a_failed_job_s_checkpoint_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """So that the same command goes on from there."""
    monkeypatch.setattr(progress, "_ticks", queue.Queue(), raising=False)
    job = Failing("bandit", tiny_preset(), "blind_bc", (0,), tmp_path)
    _, _, failed = scheduler.run_all([job], "cpu", "failing", Told())
    assert [str(error) for error in failed] == ["blind_bc, seed 0: out of memory"]
    assert job.checkpoint.exists()


class Noting(Here):
    """It notes the jobs that it runs."""

    def __init__(self) -> None:
        self.jobs: list[Any] = []

    @property
    def ran(self) -> list[str]:
        """Their methods."""
        return [job.method for job in self.jobs]

    def run(self, jobs: list[Any], tick: Any, say: Any) -> None:
        self.jobs += jobs
        super().run(jobs, tick, say)


def test_a_resumed_run_makes_what_is_missing_alone(tmp_path: Path) -> None:
    """A method whose file is gone; not what it imitates, which is there, nor another method."""
    made = [BenchmarkJob("bandit", tiny_preset(), name, (0,), tmp_path) for name in ("blind_bc", "random")]
    engine = Noting()
    assert scheduler.run_all(made, "cpu", "first", engine)[1:] == (0, [])  # none was there before, and none failed
    assert engine.ran == ["random", "demonstrations", "blind_bc"]
    made[0].file(0).unlink()
    engine.jobs.clear()
    assert scheduler.run_all(made, "cpu", "again", engine)[1:] == (1, [])
    assert engine.ran == ["blind_bc"]


def test_a_result_that_fits_no_more_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """What it was made of changed when it was done and others were not: no table has it, and the command fails."""

    class Edited(Here):
        def run(self, jobs: list[Any], tick: Any, say: Any) -> None:
            super().run(jobs, tick, say)
            monkeypatch.setattr(references.random, "method", replace(METHODS["random"], version=9))

    job = BenchmarkJob("bandit", tiny_preset(), "random", (0,), tmp_path)
    finished, _, failed = scheduler.run_all([job], "cpu", "edited", Edited())
    assert finished == []
    assert [str(error) for error in failed] == ["random-0.npz: left out, as said above; run it again with --resume"]
    assert "random-0.npz is left out: it differs in its method_version (was 1, is 9)" in capsys.readouterr().out


def test_demonstrations_are_made_for_seeds_that_imitate(tmp_path: Path) -> None:
    """Once, before them, under their protocol; not for the seeds of methods that imitate nothing."""
    wanted = {"blind_bc": (1,), "oracle_bc": (1, 2), "random": (0, 1)}
    made = [
        BenchmarkJob("bandit", tiny_preset(), name, seeds, tmp_path, protocol="scarce")
        for name, seeds in wanted.items()
    ]
    engine = Noting()
    scheduler.run_all(made, "cpu", "", engine)
    assert sorted(job.seeds for job in engine.jobs if job.method == "demonstrations") == [(1,), (2,)]
    assert {*engine.ran[:3]} == {"demonstrations", "random"}
    assert {job.protocol for job in engine.jobs} == {"scarce"}


def test_long_jobs_come_first(tmp_path: Path) -> None:
    """So that no core waits for the last one; random actions and the expert before all."""
    wanted = ("blind_bc", "expert", "interventional", "random")
    made = [BenchmarkJob("bandit", tiny_preset(), name, (0,), tmp_path) for name in wanted]
    checked: list[str] = []
    engine = Noting()
    scheduler.run_all(made, "cpu", "", engine, lambda done: checked.extend([*engine.ran, *(name for name, *_ in done)]))
    assert engine.ran == ["expert", "random", "demonstrations", "interventional", "blind_bc"]
    assert checked == ["expert", "random", "demonstrations", "expert", "random"]


def test_the_time_that_is_left(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """A quarter took 10 s: 30 s are left."""
    monkeypatch.setattr(progress.time, "monotonic", iter([0.0, 10.0, 10.0]).__next__)
    progress.Progress(8, "work", every_s=5).update(2)
    assert capsys.readouterr().out == "work:  25%, 30 s left\n"


RARE = """
from tests.toys import Push

class Rare(Push):
    name = "rare"

    def reward(self, state, action, next_state, theta):
        return {4: super().reward}[len(theta)](state, action, next_state, theta)

    def terminated(self, state):
        return state[:, 0] > 1e9
"""


def test_an_error_of_a_task_from_outside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is a line that names the task, with the traceback aside; jobs that do not meet it are done all the same."""
    monkeypatch.setattr(progress, "_ticks", queue.Queue(), raising=False)
    monkeypatch.setattr(registry, "TASKS", dict(registry.TASKS))
    (tmp_path / "own.py").write_text(RARE)
    (tmp_path / "jobs").mkdir()
    reference, preset = f"{tmp_path}/own.py:Rare", replace(tiny_preset(), expert_trials=3)
    made = [
        BenchmarkJob(envs.get(reference).reference, preset, name, (0,), tmp_path / "jobs", "tests.toys:control")
        for name in ("blind_bc", "random")
    ]
    finished, before, failed = scheduler.run_all(made, "cpu", "rare", Told())
    assert [method for method, *_ in finished] == ["random"]
    assert before == 0
    failing = ("demonstrations", "blind_bc")
    assert [str(error) for error in failed] == [
        f"{name}, seed 0: {reference}: 3 (KeyError, own.py:8)" for name in failing
    ]
    for name in failing:
        assert (tmp_path / "errors" / f"{name}-0.txt").read_text().startswith("Traceback")


def test_an_error_of_ours_is_raised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(BenchmarkJob, "run", lambda self: {}["gone"])
    with pytest.raises(KeyError):
        scheduler.run_job(BenchmarkJob("bandit", tiny_preset(), "random", (0,), tmp_path))


def test_a_log_has_a_line_now_and_then(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """When so many seconds have passed since the line before, whatever is done meanwhile."""
    clock = Mock(return_value=0.0)
    monkeypatch.setattr(progress.time, "monotonic", clock)
    work = progress.Progress(10, "work", every_s=5)
    for clock.return_value in (4.0, 6.0, 8.0, 10.0, 12.0):
        work.update(1)
    assert capsys.readouterr().out == "work:  20%, 24 s left\nwork:  50%, 12 s left\n"


def test_seeds_side_by_side(tmp_path: Path) -> None:
    """As many groups as there are slots; references share nothing, nor does what is from outside."""
    learned = BenchmarkJob("bandit", tiny_preset(), "naive_rnn", (), tmp_path)
    assert scheduler.groups(learned, [0, 1, 2, 4, 7], 2) == [(0, 1, 2), (4, 7)]
    assert scheduler.groups(learned, [3], 2) == [(3,)]
    assert scheduler.groups(learned, [], 2) == []
    from_outside = replace(learned, guest=replace(learned.about, reference="mine.py:fit"))
    for alone in (replace(learned, method="random"), from_outside):
        assert scheduler.groups(alone, [0, 1, 2], 2) == [(0,), (1,), (2,)]


@pytest.mark.parametrize(
    ("begun", "left", "slots", "groups"),
    [
        ((0, 1), [0, 1], 2, [(0, 1)]),  # seed 2 was done before the interrupt
        ((3, 4), [0, 1, 2, 3, 4], 3, [(3, 4), (0, 1), (2,)]),
        ((0, 1, 2), [0, 1, 2, 3], 1, [(0, 1, 2), (3,)]),
        ((0, 1), [1, 2], 1, [(1, 2)]),  # seed 0 has a file: the checkpoint is of no use
        (tuple(range(12)), list(range(13)), 2, [tuple(range(12)), (12,)]),
    ],
)
def test_groups_that_were_begun_go_on(
    begun: tuple[int, ...], left: list[int], slots: int, groups: list[tuple[int, ...]], tmp_path: Path
) -> None:
    job = BenchmarkJob("bandit", tiny_preset(), "naive_rnn", begun, tmp_path)
    job.checkpoint.touch()
    replace(job, method="blind_bc", seeds=(0,)).checkpoint.touch()  # of another
    assert scheduler.groups(job, left, slots) == groups


@pytest.mark.parametrize(
    ("name", "control", "bandit"), [("smoke", (1, 32), (1, 2000)), ("default", (3, 256), (5, 24000))]
)
def test_amounts_of_presets(name: str, control: tuple[int, int], bandit: tuple[int, int]) -> None:
    """Seeds and expert trials of each kind of task; of the paper, ten seeds of as many trials as by default."""
    for task, amounts in (("curling", control), ("bandit", bandit)):
        made, paper = (preset(each, envs.get(task), "cpu", ["random"]) for each in (name, "paper"))
        assert (made.seeds, made.expert_trials) == amounts
        assert (paper.seeds, paper.expert_trials >= made.expert_trials) == (10, True)


def test_each_exploration_is_under_thetas_of_its_own() -> None:
    """Those of a round are not those of the round before, and each seed has its own."""
    context = Context(envs.get("tilted_cartpole"), tiny_preset(), (0, 1))
    rngs = context.rngs
    drawn = np.concatenate([context.explore_with_theta(None, rngs)[1][:, 0, 0] for _ in range(2)])
    assert len(drawn) == 2 * 2 * context.preset.explore_trials
    assert len({*drawn.tolist()}) == len(drawn)


def test_the_paper_s_architecture_is_of_its_bandit() -> None:
    """On control, which the paper does not have, preset paper has the settings of the default one."""
    changed = [name for name, method in METHODS.items() if method.paper not in (None, method.on_bandit)]
    assert {"deconfounded", "naive_rnn"} <= {*changed}
    for task, same in (("tilted_cartpole", True), ("bandit", False)):
        default, paper = (preset(each, envs.get(task), "cpu", changed).configs for each in ("default", "paper"))
        assert [default[name] == paper[name] for name in changed] == [same] * len(changed)


def test_progress_of_a_training_is_its_share_of_the_job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Half of a training that takes .8 of a job are .4 of its ticks; the rest come when it is done."""
    ticks: queue.Queue[int] = queue.Queue()
    monkeypatch.setattr(progress, "_ticks", ticks, raising=False)
    job = BenchmarkJob("bandit", tiny_preset(), "naive_rnn", (0,), tmp_path)
    monitor = jobs.JobMonitor(job, 0.8)
    for done, sum_of_ticks in ((1, 0.4), (1, 0.4), (2, 0.8)):
        monitor.update(done, 2, {})
        assert sum(ticks.queue) == pytest.approx(sum_of_ticks * job.ticks, abs=1)
    monitor.close()
    assert sum(ticks.queue) == job.ticks
    resumed = jobs.JobMonitor(job, 0.8)
    resumed.before = [(0.0, 60.0)]
    ticks.queue.clear()
    resumed.update(1, 2, {})
    resumed.close()
    assert [*ticks.queue] == pytest.approx([-0.4 * job.ticks, 0.6 * job.ticks], abs=1)


def test_what_is_not_to_be_done_takes_no_time(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """4 of 8 were done by an interrupted run: of the others, 1 took 10 s."""
    monkeypatch.setattr(progress.time, "monotonic", iter([0.0, 10.0, 10.0]).__next__)
    bar = progress.Progress(8, "work", every_s=5)
    bar.update(-4)
    bar.update(1)
    assert capsys.readouterr().out == "work:  25%, 30 s left\n"


def test_a_failed_job_leaves_no_ticks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether it failed in the middle or at once, after another."""
    ticks: queue.Queue[int] = queue.Queue()
    monkeypatch.setattr(progress, "_ticks", ticks, raising=False)

    class Broken(jobs.Job):
        done = 30

        def run(self) -> str:
            progress.tick(self.done)
            raise envs.InputError("it broke")

    job = Broken("bandit", tiny_preset(), "random", (0,), tmp_path)
    for Broken.done in (30, 0):
        with pytest.raises(envs.InputError, match="it broke"):
            scheduler.run_job(job)
    assert [*ticks.queue] == [30, 30 - job.ticks, 0, -job.ticks]


def test_ticks_are_of_the_jobs_that_run(tmp_path: Path) -> None:
    """What comes late is not counted for the jobs after; what comes with the last outcome is counted."""
    engine, counted = Local(), list[int]()
    engine._ticks = queue.SimpleQueue()  # type: ignore[assignment]
    engine._ticks.put(5)
    (future := Future[str]()).set_result("well")
    engine._executor = Mock(submit=lambda *_: future)
    engine.run(
        [Failing("bandit", tiny_preset(), "random", (0,), tmp_path)],
        counted.append,
        lambda *_: engine._ticks.put(7),
    )
    assert counted == [7]


def test_a_task_by_two_paths_is_one_task(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copy(Path(toys.__file__), tmp_path / "mine.py")
    monkeypatch.chdir(tmp_path)
    others = {name: task for name, task in registry.TASKS.items() if name != "push"}  # which another test has
    monkeypatch.setattr(registry, "TASKS", others)
    paths = ("mine.py", "./mine.py", f"{tmp_path}/mine.py")
    assert [task.name for task in published.tasks([f"{path}:Push" for path in paths])] == ["push"]


def test_numbers_of_trials_that_a_method_asks_for() -> None:
    """Of numpy too, with `--debug` as without."""
    assert [provider._number(trials) for trials in (None, 3, np.int64(3))] == [None, 3, 3]
    for trials in (True, 0, 2.0, "3"):
        with pytest.raises(envs.InputError, match="it must be a number from 1 up"):
            provider._number(trials)
