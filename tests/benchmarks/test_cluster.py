"""Jobs on Ray: two nodes on this machine, one of which dies; what travels, and what is told where it cannot be."""

import os
import queue
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from deconfounded import envs
from deconfounded.benchmarks import commands
from deconfounded.benchmarks.engine import catalogue, identity, job_files, jobs, progress, sources
from deconfounded.benchmarks.engine.benchmark import BenchmarkJob
from deconfounded.benchmarks.engine.jobs import DemonstrationJob, Job
from deconfounded.benchmarks.engine.local import Local
from deconfounded.deconf.core.monitor import Training
from deconfounded.envs.support import outside
from tests.tools import processes, tiny_preset

ray = pytest.importorskip("ray", reason="Ray is not installed: pip install deconfounded-imitation[cluster]")

from deconfounded.benchmarks.engine import cluster, worker  # noqa: E402

GUEST = """
from pathlib import Path

import beside
from deconfounded.deconf.method import uses
from deconfounded.experts.agent import RandomAgent


@uses("demonstrations")
def fit(given):
    if not Path(__file__).parent.name == beside.FOLDER or Path(__file__).is_relative_to({home!r}):
        raise ValueError(f"it runs at {{__file__}}")
    return RandomAgent(given.action_space)


@uses("demonstrations")
def broken(given):
    raise ValueError("no luck")
"""


MARK = "DECONFOUNDED_TESTED_BY"  # in the environment of all that a test starts

TASK = """
import beside
from deconfounded.envs.tasks.slippery_cartpole import SlipperyCartpole


class OwnCartpole(SlipperyCartpole):
    name = "own_cartpole"
"""


@dataclass(frozen=True)
class Dawdling(BenchmarkJob):
    """Keeps a checkpoint at once, and waits there to be killed unless it went on from one, or is on the first node."""

    first_node: str = ""

    def run(self) -> str:
        fresh = not self.checkpoint.exists() and ray.get_runtime_context().get_node_id() != self.first_node
        keep, give_up = jobs.JobMonitor.save, time.monotonic() + 120

        def save(monitor: jobs.JobMonitor, state: Callable[[], Training]) -> None:
            keep(monitor, state)
            while fresh and monitor.file.exists() and time.monotonic() < give_up:
                time.sleep(0.1)

        jobs.SAVE_EVERY_S, jobs.JobMonitor.save = 0.0, save  # type: ignore[method-assign]
        try:
            return super().run()
        finally:
            jobs.SAVE_EVERY_S, jobs.JobMonitor.save = 60.0, keep  # type: ignore[method-assign]


@pytest.fixture
def two() -> Iterator[Any]:
    """A cluster of two nodes with a core each."""
    from ray.cluster_utils import Cluster

    quiet = {
        MARK: str(os.getpid()),
        "RAY_USAGE_STATS_ENABLED": "0",
        "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
        "OMP_NUM_THREADS": "1",
    }
    with pytest.MonkeyPatch.context() as patch:
        for key, value in quiet.items():
            patch.setenv(key, value)
        head = {"num_cpus": 1, "include_dashboard": False}
        # No hooks at exit: a forked process drops its hooks (Python 3.13), and dropping Ray's crashes it.
        made = Cluster(initialize_head=True, head_node_args=head, shutdown_at_exit=False)
        try:
            made.second = made.add_node(num_cpus=1)
            yield made
        finally:
            ray.shutdown()
            made.shutdown()


def workers() -> list[str]:
    """Processes of this test's Ray that run jobs."""
    return [line for _, line in processes(f"{MARK}={os.getpid()}", "ray::work", "ray::Mailbox")]


@pytest.mark.slow
def test_two_nodes_one_dies(two: Any, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    """Bit for bit what this process makes, from a checkpoint where there was one; and nothing is left running."""
    home = tmp_path / "own"
    home.mkdir()
    (home / "my_guest.py").write_text(GUEST.format(home=str(home)))
    (home / "beside.py").write_text("from pathlib import Path\nFOLDER = Path(__file__).parent.name\n")
    names = [catalogue.add(f"{home}/my_guest.py:{function}") for function in ("fit", "broken")]
    request.addfinalizer(catalogue.METHODS.outside.clear)  # other tests count them
    assert names == ["my_guest", "my_guest_broken"]
    here, there = tmp_path / "here" / "jobs", tmp_path / "there" / "jobs"
    for folder in (here, there):
        folder.mkdir(parents=True)
    preset = tiny_preset().configured("naive_rnn", updates=40, chunk=300)
    local = [BenchmarkJob("slippery_cartpole", preset, "naive_rnn", (seed,), here) for seed in (0, 1)]
    progress.tell(queue.Queue())
    for job in local:
        job.run()

    lines: list[tuple[str, str | Exception]] = []
    ticks: list[int] = []
    seen: list[str] = []

    def tick(n: int) -> None:
        ticks.append(n)
        seen.extend(workers())
        if two.second is not None and list(there.glob(".*.pt")):
            two.remove_node(two.second, allow_graceful=False)
            two.second = None

    def say(job: Job, line: str | Exception) -> None:
        lines.append((job.method, line))

    with cluster.Cluster(two.address) as engine:
        assert (engine.slots("cpu"), two.second is not None) == (2, True)
        with pytest.raises(envs.InputError, match="the cluster has no GPU; give another --device"):
            engine.slots("cuda")
        demonstrations: list[Job] = [
            DemonstrationJob("slippery_cartpole", preset, "demonstrations", (seed,), there) for seed in (0, 1)
        ]
        engine.run(demonstrations, lambda n: None, say)
        first = ray.get_runtime_context().get_node_id()
        dawdling = [
            Dawdling("slippery_cartpole", preset, "naive_rnn", (seed,), there, first_node=first) for seed in (0, 1)
        ]
        (earlier := there.parent / "agents" / "naive_rnn-0" / "agent.py").parent.mkdir(parents=True)
        earlier.touch()
        guests = [BenchmarkJob("bandit", preset, name, (0,), there, guest=catalogue.guest(name)) for name in names]
        engine.run([*dawdling, *guests], tick, say)
    assert two.second is None
    assert sum(ticks) == sum(job.ticks for job in [*dawdling, guests[0]])
    lost = [line for method, line in lines if method == "naive_rnn" and "tried again" in str(line)]
    assert lost == ["its worker was lost; it is tried again"]
    failed = [line for _, line in lines if isinstance(line, Exception)]
    assert [str(error) for error in failed] == ["method my_guest_broken: no luck (ValueError, my_guest.py:18)"]
    spans = []
    for seed, mine, theirs in zip((0, 1), local, dawdling, strict=True):
        expected, result = job_files.read(mine.file(seed)), job_files.read(theirs.file(seed))
        assert expected is not None
        assert result is not None
        for key in expected.keys() - {"meta"}:
            np.testing.assert_array_equal(result[key], expected[key], err_msg=key)
        spans.append(len(result["meta"]["spans"]))
        for name in (f"jobs/demonstrations-{seed}.npz", f"agents/naive_rnn-{seed}/agent.safetensors"):
            assert (there.parent / name).read_bytes() == (here.parent / name).read_bytes()
    result = guests[0].load(0)
    assert result is not None
    assert result["meta"]["reference"] == f"{home}/my_guest.py:fit"  # where it is here
    assert not earlier.exists(), "of results that are no longer there"
    assert not list(there.glob(".*"))
    assert not list((there.parent).rglob("__pycache__"))
    deadline = time.monotonic() + 30
    while workers() and time.monotonic() < deadline:
        time.sleep(0.1)
    assert seen
    assert workers() == []


def test_what_a_job_needs_travels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its seeds' demonstrations, its checkpoint, files from outside and what these import; nothing of ours."""
    (tmp_path / "jobs").mkdir()
    ours = envs.get("slippery_cartpole").home / "slippery_cartpole.xml"
    (tmp_path / "own.py").write_text(TASK)
    for name in ("beside.py", "linear.py"):
        (tmp_path / name).write_text("def control(obs, theta):\n    return obs[:, :1]\n")
    (tmp_path / "own_cartpole.xml").write_bytes(ours.read_bytes())
    task, expert = f"{tmp_path}/own.py:OwnCartpole", f"{tmp_path}/linear.py:control"
    job = BenchmarkJob(task, tiny_preset(), "naive_rnn", (3, 4), tmp_path / "jobs", expert)
    for name in ("demonstrations-3.npz", "demonstrations-5.npz", ".naive_rnn-3-4.pt", ".naive_rnn-3.pt"):
        (job.folder / name).write_bytes(b"some")
    files = cluster.given(job)
    inside = {"jobs/demonstrations-3.npz", "jobs/.naive_rnn-3-4.pt"}
    theirs = {f"outside{tmp_path}/{name}" for name in ("own.py", "beside.py", "linear.py", "own_cartpole.xml")}
    assert set(files) == inside | theirs

    before = identity.expert(envs.get("slippery_cartpole"), expert)
    sent = tmp_path / "sent"
    for name in theirs:
        (sent / name).parent.mkdir(parents=True, exist_ok=True)
        (sent / name).write_bytes(files[name].read_bytes())
        files[name].unlink()
    monkeypatch.setenv(outside.SENT, str(sent / "outside"))
    assert outside.here(tmp_path / "own.py") == sent / "outside" / Path(*tmp_path.parts[1:]) / "own.py"
    assert outside.file(expert) == outside.here(tmp_path / "linear.py")
    assert identity.expert(envs.get("slippery_cartpole"), expert) == before


@pytest.mark.slow
def test_another_version_over_there_is_told() -> None:
    job = BenchmarkJob("bandit", tiny_preset(), "blind_bc", (0,), Path("jobs"))
    here = {**identity.identity(job), "code": sources.package()}
    worker.check(here, dict(here))
    versions = here["versions"]
    for change, says in (
        ({"code": "0"}, "has other code; install the same of all on every machine"),
        ({"versions": {**versions, "numpy": "1.0"}}, f"has numpy 1.0, not {versions['numpy']}; install"),
        ({"versions": {"python": versions["python"]}}, "has dm_control missing, not"),
    ):
        with pytest.raises(worker.Unlike, match=f"^machine .* {says}"):
            worker.check(here, {**here, **change})


@pytest.mark.parametrize(
    ("address", "says"),
    [
        ("nonsense", "--cluster was nonsense; it must be auto, or HOST:PORT of a Ray cluster"),
        ("somewhere:port", "it must be auto, or HOST:PORT"),
        ("127.0.0.1:1", "--cluster 127.0.0.1:1: nobody answers there"),
        ("127.0.0.1:99999", "nobody answers there"),
    ],
)
def test_an_address_where_nobody_is(address: str, says: str) -> None:
    with pytest.raises(envs.InputError, match=says) as error:
        cluster.Cluster(address)
    assert "\n" not in str(error.value)


def test_local_processes_need_no_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    assert isinstance(commands.engine(None), Local)
    monkeypatch.setattr(commands, "find_spec", lambda name: None)
    args = commands.parser("", "").parse_args(["--cluster", "auto"])
    with pytest.raises(envs.InputError, match=r"^--cluster needs Ray; `pip install deconfounded-imitation\[cluster\]`"):
        commands.check(args, ["blind_bc"], ["blind_bc"])
    args = commands.parser("", "").parse_args(["--cluster", "auto", "--device", "cuda:1"])
    with pytest.raises(envs.InputError, match=r"^--device was cuda:1; with --cluster it must be cpu, or cuda"):
        commands.check(args, ["blind_bc"], ["blind_bc"])


def test_what_killed_workers_left_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And what those at work need is not."""
    names = [f"deconfounded-{process}-{'ab' * 8}" for process in (2**22 + 1, os.getpid())]
    for name in [*names, "deconfounded-data", f"deconfounded-{2**22 + 1}-mine"]:
        (tmp_path / name).mkdir()
    monkeypatch.setattr(worker, "PLACE", tmp_path / "place")
    with worker.scratch() as folder:
        assert (folder / "jobs").is_dir()
        assert not (tmp_path / names[0]).exists()
    assert {one.name for one in tmp_path.iterdir()} == {names[1], "deconfounded-data", f"deconfounded-{2**22 + 1}-mine"}


def test_a_process_of_another_user_is_at_work(monkeypatch: pytest.MonkeyPatch) -> None:
    """Though it may not be signalled: its folder stays."""
    for error, right in ((PermissionError, True), (ProcessLookupError, False)):
        monkeypatch.setattr(worker.os, "kill", Mock(side_effect=error))
        assert worker.running(1) is right


def test_progress_is_sent_with_files_or_without(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All ticks so far, and each file when it has changed; nothing where there is nothing new."""
    sent: list[Any] = []
    monkeypatch.setattr(worker.threading, "Thread", Mock())  # it is asked to send by hand
    courier = worker.Courier(tmp_path, 3, SimpleNamespace(put=SimpleNamespace(remote=lambda *what: sent.append(what))))
    (tmp_path / "jobs").mkdir()
    for ticks, content in ((2, b""), (0, b""), (4, b"a"), (0, b""), (0, b"bc")):
        courier.put(ticks)
        if content:
            (tmp_path / "jobs" / ".x-0.pt").write_bytes(content)
        courier._send()
    assert sent == [(3, 2, {}), (3, 6, {"jobs/.x-0.pt": b"a"}), (3, 6, {"jobs/.x-0.pt": b"bc"})]


def test_a_seed_s_own_file_is_written_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It says that the seed is done: were the command killed before, its agent or its losses would be missing."""
    written: list[str] = []
    monkeypatch.setattr(cluster, "write_atomically", lambda file, content: written.append(file.name))
    job = BenchmarkJob("bandit", tiny_preset(), "blind_bc", (0,), tmp_path / "jobs")
    names = ("jobs/blind_bc-0.npz", "agents/blind_bc-0/agent.json", "tensorboard/blind_bc-0/events")
    cluster.keep(job, dict.fromkeys(names, b""))
    assert written == ["agent.json", "events", "blind_bc-0.npz"]
