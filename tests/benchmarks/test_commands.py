"""Commands as a user runs them: bad input, resuming, and the examples in the documents."""

import errno
import importlib
import json
import multiprocessing
import os
import re
import resource
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from deconfounded import envs
from deconfounded.__main__ import COMMANDS
from deconfounded.benchmarks import certify, data
from deconfounded.benchmarks.console import run_command
from deconfounded.benchmarks.engine import jobs, scheduler, sources
from deconfounded.benchmarks.engine.catalogue import REFERENCES
from deconfounded.benchmarks.engine.local import Local
from deconfounded.benchmarks.engine.protocols import PROTOCOLS
from deconfounded.benchmarks.output import film, records, run_report, scoring
from deconfounded.benchmarks.output.pictures import mark, mark_of, save_figure
from deconfounded.benchmarks.studies import publish, results
from deconfounded.benchmarks.studies.unconfounded import NoStakes, feedback
from deconfounded.deconf.methods import memoryless_bc
from deconfounded.envs import render
from deconfounded.envs.support.files import check_file, read_sealed, write_json, write_sealed
from deconfounded.experts.policy import CallableExpert
from tests.tools import deconf, tiny_preset

ROOT = Path(__file__).parents[2]


def command(*args: str, **environ: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *args], cwd=ROOT, capture_output=True, text=True, env={**os.environ, **environ}, timeout=300
    )


def refusal(args: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> str:
    """What a command that must end with code 2 says, in this process."""
    monkeypatch.setattr("sys.argv", list(args))
    with pytest.raises(SystemExit) as ended:
        run_command(importlib.import_module(f"deconfounded.{COMMANDS[args[0]][0]}").main)
    assert ended.value.code == 2
    return capsys.readouterr().err


REFUSALS: list[tuple[tuple[str, ...], str]] = [
    (("run", "--task", "slipery_cartpole"), "did you mean 'slippery_cartpole'?"),
    (("run", "--task", "bandit", "--methods", "naive"), "did you mean 'naive_rnn'?"),
    (("run", "--task", "bandit", "--preset", "smok"), "did you mean 'smoke'?"),
    (("run", "--task", "bandit", "--preste", "smoke"), "--preste smoke; did you mean --preset? see --help"),
    (("run", "--task", "bandit", "--methods", "deconfounded_mode"), "give deconfounded, which is scored in every way"),
    (("check", "--task", "mine.py"), "it must name a class of that file: mine.py:CLASS"),
    (("score", "--agent", "nowhere", "--task", "bandit", "--out", "x.txt"), "--out was x.txt; it must end in .json"),
    (("run", "--task", "bandit", "--seeds", "0"), "must be at least 1"),
    (("run", "--task", "bandit", "--device", "cuda:99"), "cpu always can"),
    (("run", "--task", "bandit", "--out", "/proc/none"), "cannot be written"),
    (("compare", "docs/records/curling.jsonl", "--protocol", "onc"), "did you mean 'once'?"),
    (("run",), "neither --task nor --tasks was given; give one of them: there are bandit"),
    (("run", "--task", "bandit", "--tasks", "hard"), "--task and --tasks were both given"),
    (("run", "--list", "--task", "nonsense"), "it lists all; give it alone"),
    (("run", "--task", "bandit", "--out", ""), "argument --out: it must be a name"),
    (("run", "--task", "bandit", "--seeds", "1000000000"), "at most 1,000"),
    (("run", "--task", "bandit", "--set", "seeds=10000"), "at most 1,000"),
    (("table", "--list", "--set", "seeds=2"), "--set had seeds=2, and --seeds is 10; give --seeds alone"),
    (("run", "--task", "bandit", "--set", "random.updates=5"), "method 'random' has no config"),
    (("run", "--task", "bandit", "--methods", "my.py"), "one of your own is my.py:FUNCTION"),
    (("run", "--task", "bandit", "--set", f"eval_trials={10**20}"), "it must be like 4000"),
    (("certify", "--task", "slippery_cartpole", "--expert", ""), "expert was ''; it must be"),
    (("performance", "sped"), "did you mean 'speed'?"),
    (
        ("train", "--task", "slippery_cartpole", "--out", "/proc/none/e.safetensors"),
        "output folder /proc/none cannot be written",
    ),
    (("train", "--task", "slippery_cartpole", "--seed", "4294967296"), "it must be a whole number from 0 to"),
    (("run", "--task", "bandit", "--set", "seeds=0"), "--set seeds was '0'; it must be like 5"),
    (("run", "--task", "slippery_cartpole", "--expert", "gone.py:f"), "there is no file gone.py"),
    (("run", "--task", "bandit", "--methods", "gone.py:fit"), "there is no file gone.py"),
    (("play", "--agent", "nowhere", "--task", "bandit"), "nowhere holds no agent.json"),
    (("score", "--agent", "nowhere", "--task", "bandit"), "nowhere holds no agent.json"),
    (("push", "nowhere", "me/x"), "nowhere holds no agent.json, and 0 Minari data sets"),
    (("pull", "x"), "repository was 'x'; it must be OWNER/NAME"),
    (
        ("verify", "bandit", "random", "0", "--records", "nowhere.jsonl"),
        "records nowhere.jsonl cannot be read: No such file",
    ),
    (("report", "nowhere"), "nowhere holds no settings.json of a run"),
    (
        ("data", "--task", "bandit", "--out", "x", "--trials", "0"),
        "argument --trials: it was '0'; it must be a whole number from 1 to 100,000",
    ),
    (("check", "--task", "bandid"), "did you mean 'bandit'?"),
    (("check", "--task", "two\nlines.py:T"), "there is no file two lines.py"),
    (("run", "--task", "bandit", "--seeds", "many"), "invalid int value: 'many'"),
    (("run", "--task", "bandit", "--seed", "1"), "unrecognized arguments: --seed 1"),
    (("run", "--task", "leaning_beam"), "your own is path/file.py:Class"),
    (("paper", "--methods", "oracle_bc"), "method 'oracle_bc' is unknown"),
    (("publish", "nowhere"), "holds no records of a finished run"),
    (("certify", "--task", "bandid"), "did you mean 'bandit'?"),
    (("train", "--task", "bandit"), "nothing to train"),
    (("performance", "--tasks", "bandit"), "no physics to time"),
]


@pytest.mark.parametrize(("args", "says"), REFUSALS)
def test_bad_input_is_one_line(
    args: tuple[str, ...], says: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    told = refusal(args, monkeypatch, capsys)
    assert says in told
    assert len(told.strip().splitlines()) == 1


def test_what_is_not_installed_is_said_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before trials are made, which takes minutes."""
    monkeypatch.setattr(data, "find_spec", lambda name: None)
    monkeypatch.setattr(data, "run_trials", None)
    told = refusal(("data", "--task", "bandit", "--out", str(tmp_path)), monkeypatch, capsys)
    assert "`pip install deconfounded-imitation[data]` brings it" in told


def test_bad_input_from_the_shell() -> None:
    """As above, in a process of its own."""
    done = command("benchmarks/run.py", "--task", "slipery_cartpole")
    assert done.returncode == 2
    assert done.stderr.startswith("error: task 'slipery_cartpole' is unknown; did you mean 'slippery_cartpole'?")
    assert len(done.stderr.strip().splitlines()) == 1


@pytest.mark.slow
def test_what_lists_or_checks_does_not_import_what_takes_seconds() -> None:
    """`run --list`, and what commands refuse before they begin; paper, whose jobs stand in its file, is slow."""
    lines = [args for args, _ in REFUSALS if not {"paper", "--device", "--out", "--set"} & {*args}]
    lines = [("run", "--list"), *((name, "--help") for name in COMMANDS if name != "paper"), *lines]
    code = f"""
import contextlib, importlib, io, sys
from deconfounded.__main__ import COMMANDS
from deconfounded.benchmarks.console import run_command
for sys.argv in map(list, {lines}):
    with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()):
        run_command(importlib.import_module("deconfounded." + COMMANDS[sys.argv[0]][0]).main)
    slow = {{"torch", "stable_baselines3", "sklearn", "matplotlib"}} & {{*sys.modules}}
    assert not slow, (sys.argv, slow)
"""
    done = command("-c", code)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_smoke_run_resumes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """The whole command on the bandit; then a finished job is lost, and --resume makes the same numbers again."""
    out, args = tmp_path / "out", ("run", "--set", "eval_trials=256", "--task", "bandit", "--preset", "smoke", "--out")
    methods = ("--methods", "blind_bc", "conditional", "interventional")
    with monkeypatch.context() as patch:
        patch.setattr(film, "write", Mock(side_effect=envs.InputError("no GL for pictures")))
        first = deconf(ROOT, *args, str(out), *methods)
    assert not (out / "video.mp4").exists()
    assert first.returncode == 0, first.stderr
    results = json.loads((out / "results.json").read_text())
    for file in ("rows.csv", "adaptation.png", "learning.png", "report.html"):
        assert (out / file).stat().st_size > 0
    assert {"task", "task_version", "preset", "seeds", "versions", "wall_s", "methods"} <= set(results)
    ways = {f"interventional_{way}" for way in ("episode", "mode", "mean")}
    assert set(results["methods"]) == {"random", "expert", "blind_bc", "conditional", "interventional", *ways}
    for entry in results["methods"].values():
        assert {"return", "score", "score_last", "ci95"} <= set(entry)
    assert results["methods"]["interventional"]["score_last"] == pytest.approx((54.1 - 20) / 40, abs=0.05)
    assert results["methods"]["conditional"]["score_last"] == pytest.approx((32.3 - 20) / 40, abs=0.05)
    header, *lines = (out / "rows.csv").read_text().splitlines()
    assert header == "method,seed,trial,best_arm,episode,return,score,objective"
    assert len(lines) == results["eval_trials"] * len(results["methods"])

    assert "--resume" in refusal((*args, str(out)), monkeypatch, capsys)
    other = (*args[:-2], "default", "--out", str(out), "--resume")
    assert "differs in its preset" in refusal(other, monkeypatch, capsys)

    (out / "jobs" / "blind_bc-0.npz").unlink()
    (out / "jobs" / "random-0.npz").write_bytes(b"half a file")
    resumed = deconf(ROOT, *args, str(out), "--resume", *methods)
    assert resumed.returncode == 0, resumed.stderr
    repeated = json.loads((out / "results.json").read_text())
    for entry in (*repeated["methods"].values(), *results["methods"].values()):
        assert entry.pop("cpu_s") >= 0
    assert repeated["methods"] == results["methods"]
    assert repeated["resumed"] == 3

    (out / "settings.json").unlink()
    assert "not their settings.json" in refusal((*args, str(out), "--resume"), monkeypatch, capsys)


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
class TestSignals:
    """One line, 128 + n, and nothing is left running."""

    @pytest.fixture(autouse=True)
    def heard(self, name: str) -> Iterator[None]:
        """Though the tests themselves run under nohup, or in the background. Afterwards, all is as before."""
        number = getattr(signal, name)
        before = signal.getsignal(number)
        if before is signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)
        yield
        signal.signal(number, before)

    def test_while_a_command_is_imported(self, name: str, tmp_path: Path) -> None:
        """By a mujoco that sends the signal in its own import."""
        (tmp_path / "mujoco.py").write_text(f"import os, signal\nos.kill(os.getpid(), signal.{name})\n")
        path = f"{tmp_path}{os.pathsep}{ROOT}"
        for line in (("benchmarks/run.py", "--list"), ("-m", "deconfounded", "run", "--list")):
            done = command(*line, PYTHONPATH=path)
            assert (done.returncode, done.stderr) == (128 + getattr(signal, name), "interrupted\n")

    def test_twice(self, name: str, capsys: pytest.CaptureFixture[str]) -> None:
        """The second one does not disturb what the first one has begun to clean up; after that all is as before."""
        number, cleaned, before = getattr(signal, name), [], signal.getsignal(getattr(signal, name))

        def main() -> None:
            try:
                signal.raise_signal(number)
            finally:
                signal.raise_signal(number)
                cleaned.append(True)

        with pytest.raises(SystemExit) as ended:
            run_command(main, "it stays")
        assert (ended.value.code, cleaned) == (128 + number, [True])
        assert capsys.readouterr().err == "interrupted; it stays\n"
        assert signal.getsignal(number) is before

    def test_ignored_signals_stay_so(self, name: str) -> None:
        """As under nohup."""
        number = getattr(signal, name)
        signal.signal(number, signal.SIG_IGN)
        run_command(lambda: signal.raise_signal(number))
        assert signal.getsignal(number) is signal.SIG_IGN


class Deadly(jobs.Job):
    """Sends SIGTERM to the main process, and goes on."""

    def run(self) -> str:
        os.kill(os.getppid(), signal.SIGTERM)
        threading.Event().wait()
        return ""


class Told(jobs.Job):
    """Says who does it."""

    def run(self) -> str:
        return str(os.getpid())


@pytest.mark.slow
def test_workers_are_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """From one call to the next, until a signal ends them; what they inherit is put back, though a call fails."""
    given = ("bandit", tiny_preset(), "random", (0,), tmp_path)
    told, heard, threads = [], signal.getsignal(signal.SIGINT), os.environ.get("OMP_NUM_THREADS")

    def as_before() -> bool:
        same = signal.getsignal(signal.SIGINT) is heard and os.environ.get("OMP_NUM_THREADS") == threads
        return same and not multiprocessing.active_children()

    with Local() as engine:
        for _ in range(2):
            engine.run([Told(*given)], lambda ticks: None, lambda job, line: told.append(str(line)))
        with pytest.raises(SystemExit) as ended:
            run_command(lambda: scheduler.run_jobs([Deadly(*given)], "deadly", engine.run), "kept")
        assert (ended.value.code, capsys.readouterr().err) == (143, "interrupted; kept\n")
        assert as_before()
        engine._executor = ProcessPoolExecutor()
        engine._executor.shutdown()
        with pytest.raises(RuntimeError):
            engine.run([Told(*given)], lambda ticks: None, lambda job, line: None)
    assert len(told) == 2
    assert len(set(told)) == 1
    assert as_before()


def test_one_entrance() -> None:
    """Signals and errors are seen to in __main__.py; run.py alone is a script too, and goes there first of all."""
    scripts = [file.name for file in (ROOT / "benchmarks").rglob("*.py") if "__name__ ==" in file.read_text()]
    assert scripts == ["run.py"]


def test_an_error_of_the_system_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    """Whatever an import makes of a signal is an interruption; no memory is told as such."""

    def interrupted() -> None:
        try:
            signal.raise_signal(signal.SIGTERM)
        except KeyboardInterrupt:
            raise ImportError("numpy") from None

    def greedy() -> None:
        raise MemoryError("Unable to allocate 1. PiB")

    for main, code, says in (
        (interrupted, 143, "interrupted; nothing was written\n"),
        (greedy, 2, "error: not enough memory: Unable to allocate 1. PiB\n"),
    ):
        with pytest.raises(SystemExit) as ended:
            run_command(main)
        assert (ended.value.code, capsys.readouterr().err) == (code, says)


@pytest.mark.slow
@pytest.mark.parametrize("unbuffered", ["", "1"])
@pytest.mark.parametrize(
    ("args", "code"),
    [
        (("-m", "deconfounded", "--help"), 141),
        (("benchmarks/run.py", "--list"), 141),
        (("-m", "deconfounded", "publish", "--help"), 0),  # argparse thinks nothing of it
    ],
)
def test_a_closed_pipe_is_no_error(args: tuple[str, ...], code: int, unbuffered: str) -> None:
    """What nobody reads is not printed; the exit code is that of SIGPIPE."""
    read, write = os.pipe()
    os.close(read)
    environ = {**os.environ, "PYTHONUNBUFFERED": unbuffered}
    command = [sys.executable, *args]
    done = subprocess.run(command, cwd=ROOT, env=environ, stdout=write, stderr=subprocess.PIPE, text=True)
    os.close(write)
    assert (done.returncode, done.stderr) == (code, "")


@pytest.mark.slow
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
@pytest.mark.parametrize("args", [("-m", "deconfounded", "--help"), ("benchmarks/run.py", "--list")])
def test_a_full_disk_behind_the_output(args: tuple[str, ...]) -> None:
    with open("/dev/full", "w") as full:
        done = subprocess.run([sys.executable, *args], cwd=ROOT, stdout=full, stderr=subprocess.PIPE, text=True)
    assert (done.returncode, done.stderr) == (2, "error: file: No space left on device\n")


def test_another_closed_pipe_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """Such as that of a process of ours that is gone."""

    def main() -> None:
        raise BrokenPipeError(errno.EPIPE, os.strerror(errno.EPIPE))

    read, write = os.pipe()
    with os.fdopen(read) as reader:
        with os.fdopen(write, "w") as writer, monkeypatch.context() as patch:
            patch.setattr("sys.stdout", writer)
            patch.setattr("sys.stderr", writer)
            with pytest.raises(SystemExit) as ended:
                run_command(main)
        assert (ended.value.code, reader.read()) == (2, "error: file: Broken pipe\n")


class TestFiles:
    def test_a_full_disk(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """It is told of which file, which holds what it held before; nothing half written stays."""
        monkeypatch.setattr(sys, "dont_write_bytecode", True)  # Python would keep the first 100 bytes of it
        file, figure = tmp_path / "kept.json", pytest.importorskip("matplotlib.figure").Figure()
        file.write_text("{}")
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        for write in (lambda: write_json(file, {"x": "y" * 1000}), lambda: save_figure(figure, file, 50)):
            resource.setrlimit(resource.RLIMIT_FSIZE, (100, hard))
            try:
                with pytest.raises(SystemExit) as ended:
                    run_command(write)
            finally:
                resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
            assert ended.value.code == 2
            assert capsys.readouterr().err == f"error: {file}: File too large\n"
            assert [one.name for one in tmp_path.iterdir()] == ["kept.json"]
            assert file.read_text() == "{}"

    def test_interrupted(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        def interrupt(*_: object) -> None:
            raise KeyboardInterrupt

        monkeypatch.setattr(os, "replace", interrupt)
        with pytest.raises(KeyboardInterrupt):
            write_json(tmp_path / "x.json", {})
        assert not list(tmp_path.iterdir())

    def test_a_link_is_written_through(self, tmp_path: Path) -> None:
        file, link = tmp_path / "there" / "x.json", tmp_path / "link.json"
        file.parent.mkdir()
        link.symlink_to(file)
        write_json(link, [1])
        assert link.is_symlink()
        assert json.loads(file.read_text()) == [1]

    def test_what_is_no_plain_file_is_left_alone(self, tmp_path: Path) -> None:
        for file, says in ((tmp_path, "is a folder"), (Path("/dev/null"), "is no plain file")):
            with pytest.raises(envs.InputError, match=says):
                check_file(file)

    @pytest.mark.parametrize("change", [{"seeds": 4}, {"more": 1}, {"sha256": None}])
    def test_sealed(self, change: dict[str, object], tmp_path: Path) -> None:
        data = {"seeds": 3, "rate": 1e-3, "set": ["seeds=3"]}
        write_sealed(tmp_path / "x.json", data)
        assert read_sealed(tmp_path / "x.json") == data
        write_json(tmp_path / "x.json", {**json.loads((tmp_path / "x.json").read_text()), **change})
        with pytest.raises(envs.InputError, match="is damaged, or was changed by hand"):
            read_sealed(tmp_path / "x.json")


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["off", "nonsense"])
def test_no_gl_is_only_a_note(backend: str) -> None:
    """Without a GL, pictures raise InputError, which run.py turns into a note."""
    made = "envs.make('slippery_cartpole', render_mode='rgb_array')"
    code = f"from deconfounded import envs; e = {made}; e.reset(seed=0); e.render()"
    done = command("-c", code, MUJOCO_GL=backend)
    assert "InputError: no GL for pictures" in done.stderr


@pytest.mark.parametrize(("given", "meant"), [("EGL", "egl"), ("egl ", "egl"), ("OSMesa", "osmesa"), (" ", "egl")])
def test_gl_by_another_spelling(given: str, meant: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """What mujoco takes for a backend is one, and is loaded by its own name."""
    monkeypatch.setenv("MUJOCO_GL", given)
    probed = subprocess.CompletedProcess("", 0)
    monkeypatch.setattr(render.subprocess, "run", lambda *_, env, **__: probed if env["MUJOCO_GL"] == meant else None)
    assert render.backend.__wrapped__() == meant


class TestScore:
    def test_by_hand(self) -> None:
        """Random 10, expert 30: a return of 25 scores .75, and the interval of two seeds .7 and .8 holds both."""
        by_method = {}
        for name, by_seed in {"random": (10.0, 10.0), "expert": (30.0, 30.0), "other": (24.0, 26.0)}.items():
            by_method[name] = [
                {
                    **{"seed": seed, "returns": [value] * 2, "objective": [-value] * 2, "theta_r2": [1.0] * 2},
                    **{"budget": {}, "cpu_s": 1.5, "tier": "1", "method_version": 1, "method": name, "deployment": ""},
                }
                for seed, value in enumerate(by_seed)
            ]
        methods = scoring.summarise(by_method, 2, (10.0, 30.0))
        assert methods["other"]["objective"] == [-25, -25]
        assert methods["other"]["score"] == [0.75, 0.75]
        assert methods["other"]["return"] == [[24.0, 24.0], [26.0, 26.0]]
        assert methods["other"]["ci95"] == pytest.approx([0.7, 0.8])
        assert methods["expert"]["score_last"] == 1

    @pytest.mark.slow
    @pytest.mark.parametrize(("seeds", "share"), [(3, 0.75), (5, 0.84), (10, 0.89)])
    def test_few_seeds_cover_less(self, seeds: int, share: float) -> None:
        """As often as the pages say: 500 tries, four standard errors."""
        low, high = scoring.bootstrap(np.random.default_rng(0).standard_normal((seeds, 500))).T
        assert ((low <= 0) & (high >= 0)).mean() == pytest.approx(share, abs=4 * np.sqrt(share * (1 - share) / 500))
        assert scoring.bootstrap(np.array([1.0])) is None


@pytest.mark.slow
def test_certificate_fails_what_deserves_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """A cartpole without stakes: an expert told the wrong friction does as well, and so does cloning without memory."""
    monkeypatch.setattr(memoryless_bc, "MemorylessConfig", partial(memoryless_bc.MemorylessConfig, updates=200))
    monkeypatch.setattr(NoStakes, "horizon", 100)
    task = NoStakes()
    result = certify.certify(task, CallableExpert(task, feedback, "feedback"), trials=6, grid=3)
    assert result["return_expert"] > 2.5 * result["return_random"]
    assert result["verdict"] == "failed"
    assert not result["checks"]["wrong_theta"]["passed"]
    assert not result["checks"]["blind_bc"]["passed"]


@pytest.mark.slow
def test_publish_keeps_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Records and certificate go to docs; a clip of an older run does not stay beside them.

    What is amiss is told in a line, and nothing is changed.
    """
    run, docs = tmp_path / "results" / "bandit-default", tmp_path / "docs"
    for folder in (run, docs / "certificates", run.parent / "certificates"):
        folder.mkdir(parents=True)
    shown = records.of_task(ROOT / "docs" / "records", "bandit")
    file = run / "records" / "bandit.jsonl"
    records.write(file.parent, shown)
    whole = file.read_text()
    certificate = run.parent / "certificates" / "bandit.json"
    certificate.write_text((ROOT / "docs" / "certificates" / "bandit.json").read_text())
    (docs / "bandit.webp").write_bytes(b"an old clip")
    (run / "video.mp4").write_bytes(b"junk")
    monkeypatch.setattr(publish, "DOCS", docs)

    def kept() -> list[str]:
        return sorted(str(file.relative_to(docs)) for file in docs.rglob("*") if file.is_file())

    for says, text in (("is no video", whole), ("is not json", whole.replace('"returns":[', '"returns":[NaN,', 1))):
        file.write_text(text)
        with pytest.raises(envs.InputError, match=says):
            publish.keep(run)
        assert kept() == ["bandit.webp"]
    file.write_text(whole)
    (run / "video.mp4").unlink()
    fine = certificate.read_text()
    changed = [fine.replace(*change) for change in (('"passed"', '"<script>"', 1), ('_version": 0', '_version": 9'))]
    for text in ("{}", "[", '{"task": "bandit"}', *changed):
        certificate.write_text(text)
        with pytest.raises(envs.InputError, match=r"bandit.json is no certificate of bandit v0"):
            publish.keep(run)
    certificate.write_text(fine)
    (run / "video.mp4").symlink_to("/etc/passwd")
    with pytest.raises(envs.InputError, match=r"video.mp4 is a link"):
        publish.keep(run)
    (run / "video.mp4").unlink()
    file.write_text("".join(line for line in whole.splitlines(keepends=True) if '"method":"random"' not in line))
    with pytest.raises(envs.InputError, match="are without those of random"):
        publish.keep(run)
    file.write_text(whole)
    assert kept() == ["bandit.webp"]
    publish.keep(run)
    assert kept() == ["certificates/bandit.json", "records/.lock", "records/bandit.jsonl"]
    assert (docs / "records" / "bandit.jsonl").read_text() == whole
    older = [{**one, "method_version": 0} for one in shown if one["method"] in ("naive_rnn", "random", "expert")]
    records.write(tmp_path / "old" / "records", older)
    with pytest.raises(envs.InputError, match=r"old has .*naive_rnn.* of older versions than docs/; run it again"):
        publish.keep(tmp_path / "old")
    assert (docs / "records" / "bandit.jsonl").read_text() == whole
    with pytest.raises(envs.InputError, match="holds no records"):
        publish.keep(tmp_path)


@pytest.mark.parametrize(
    "change", [{"preset": "paper"}, {"set": ["eval_trials=9"]}, {"salt": "x"}, {"protocol_name": "once"}]
)
def test_publish_refuses_what_pages_do_not_show(
    change: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run of other amounts, thetas or protocol than theirs."""
    run, docs = tmp_path / "run", tmp_path / "docs"
    published = records.of_task(ROOT / "docs" / "records", "bandit")
    records.write(run / "records", [{**record, **change} for record in published if record["method"] in REFERENCES])
    monkeypatch.setattr(publish, "DOCS", docs)
    with pytest.raises(envs.InputError, match="pages show the default preset and the standard protocol alone"):
        publish.keep(run)
    assert not docs.exists()


@pytest.mark.slow
@pytest.mark.parametrize("task", envs.SUITE)
def test_records_hold_the_schema(task: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each line of the file; and none is of a setting that pages do not show."""
    monkeypatch.setattr(records, "held", cache(records.held))  # each protocol's are of the same file
    every = records.read(ROOT / "docs" / "records" / records.place(task))
    assert {(one["preset"], *one["set"], one["salt"]) for one in every} == {("default", "")}
    by_protocol = [records.of_task(ROOT / "docs" / "records", task, protocol=protocol) for protocol in PROTOCOLS]
    assert len(every) == sum(map(len, by_protocol))


def test_records_are_few_and_small() -> None:
    """Files and bytes that everybody who clones gets."""
    files = list((ROOT / "docs" / "records").rglob("*.jsonl"))
    assert {file.stem for file in files} <= {*envs.SUITE, *envs.HARD}
    assert sum(file.stat().st_size for file in files) <= 25e6


@pytest.mark.slow
def test_pages_are_up_to_date(monkeypatch: pytest.MonkeyPatch) -> None:
    """What publish.py writes of tasks, certificates and results; docs/ has a row for each of the latter two."""
    monkeypatch.setattr(records, "held", cache(records.held))  # pages read the same files
    kept = results.published(), results.published(names=envs.HARD), results.other_protocols()
    for file, text in publish.texts(*kept).items():
        assert file.read_text() == text, f"{file}: run `deconf publish`"
    docs = ROOT / "docs"
    for task, of_task in kept[0]:
        made_of = mark(publish.curves(of_task), sources.of_code(run_report.adaptation))
        assert mark_of(docs / f"{task.name}.png") == made_of, f"{task.name}.png: run `deconf publish`"
    of_results = re.findall(r"^\| \[(\w+)\]\(#", (docs / "results.md").read_text(), re.M)
    of_results += re.findall(r"^## (\w+)", (docs / "hard.md").read_text(), re.M)
    assert sorted(of_results) == sorted(file.stem for file in (docs / "records").glob("*.jsonl"))
    certified = re.findall(r"^\| (\w+) \|.* (?:passed|failed) \|$", (docs / "concepts.md").read_text(), re.M)
    assert sorted(certified) == sorted(file.stem for file in (docs / "certificates").glob("*.json"))


@pytest.mark.slow
@pytest.mark.parametrize("marked", ["envs.make_vec", "Trials"])
def test_snippets_run(marked: str) -> None:
    """What README and docs/ show is what runs; one's own task, expert, method and loop are in test_outside.py."""
    pages = {"environments": 2, "core": 2, "own_task": 2, "own_method": 1, "deploy": 1, "../README": 2}
    snippets = []
    for page, n in pages.items():
        of_page = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / f"{page}.md").read_text(), re.S)
        assert len(of_page) == n, page
        snippets += of_page
    code = "\n".join(code for code in snippets if marked in code or (marked == "Trials" and "Monitor" in code))
    done = command("-c", code)
    assert done.returncode == 0, done.stderr
