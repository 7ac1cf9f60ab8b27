"""Records by what they claim: what they were made of decides whether they are kept, and they can be made again."""

import queue
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from deconfounded import envs
from deconfounded.benchmarks.engine import identity, job_files, progress
from deconfounded.benchmarks.engine.benchmark import BenchmarkJob
from deconfounded.benchmarks.engine.catalogue import REFERENCES
from deconfounded.benchmarks.engine.context import Context
from deconfounded.benchmarks.engine.jobs import JobMonitor
from deconfounded.benchmarks.output import records
from deconfounded.benchmarks.studies import table
from deconfounded.experts import policy
from tests import toys
from tests.tools import tiny_preset

CONTROL = "tilted_cartpole"


def other_weights(folder: Path, more: float = 0.01) -> str:
    """A file with an expert's weights, some of them a little larger than the task's own."""
    weights = load_file(policy.path(envs.get(CONTROL)))
    weights["0.bias"] = weights["0.bias"] + np.float32(more)
    save_file(weights, folder / f"other{more}.safetensors")
    return str(folder / f"other{more}.safetensors")


def test_an_identity_is_of_expert_salt_and_settings(tmp_path: Path) -> None:
    """Each alone makes another one; the same weights under another name do not."""
    job = BenchmarkJob(CONTROL, tiny_preset(), "naive_rnn", (0,), tmp_path)
    shutil.copy(policy.path(envs.get(CONTROL)), tmp_path / "same.safetensors")
    own = identity.identity(job)
    named = identity.identity(replace(job, expert=str(tmp_path / "same.safetensors")))
    assert named["expert"] == own["expert"]
    one, another = (identity.identity(replace(job, expert=other_weights(tmp_path, more))) for more in (0.01, 0.02))
    assert len({own["expert"], one["expert"], another["expert"]}) == 3
    for other in (
        replace(job, expert=other_weights(tmp_path)),
        replace(job, salt="salt"),
        replace(job, preset=job.preset.configured("naive_rnn", updates=9)),
        replace(job, preset=replace(job.preset, eval_trials=5)),
    ):
        assert identity.identity(other) != own
        data = identity.demonstrations(envs.get(CONTROL), other.expert, 4, 0)
        assert (data != identity.demonstrations(envs.get(CONTROL), None, 4, 0)) == (other.expert is not None)


def test_a_file_of_other_settings_expert_or_salt_is_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a job left is believed by the same job alone."""
    monkeypatch.setattr(progress, "_ticks", queue.Queue(), raising=False)
    job = BenchmarkJob(CONTROL, replace(tiny_preset(), eval_trials=2), "blind_bc", (0,), tmp_path)
    job.run()
    assert job.load(0) is not None
    assert replace(job, salt="salt").load(0) is None
    assert replace(job, expert=other_weights(tmp_path)).load(0) is None
    assert replace(job, preset=job.preset.configured("blind_bc", updates=4)).load(0) is None


def test_a_run_replaces_no_files_of_others(tmp_path: Path) -> None:
    """Neither results nor notes that are in its folder, which no run left there."""
    (tmp_path / "results.json").write_text("mine")
    with pytest.raises(envs.InputError, match=r"holds results.json, and no run whose file that could be; give --out"):
        job_files.prepare(tmp_path, {}, resume=False)
    assert (tmp_path / "results.json").read_text() == "mine"


@pytest.mark.parametrize("key", ["settings", "versions", "expert", "salt", "preset", "set", "task_version"])
def test_a_folder_of_another_run_is_not_gone_on_with(key: str, tmp_path: Path) -> None:
    described = {**dict.fromkeys(("settings", "versions", "expert", "salt", "preset", "set", "task_version"), "a")}
    job_files.prepare(tmp_path, described, resume=False)
    job_files.prepare(tmp_path, described, resume=True)
    without = {name: value for name, value in described.items() if name != key}
    for other in ({**described, key: "b"}, without):
        with pytest.raises(envs.InputError, match=f"holds a run that differs in its {key}"):
            job_files.prepare(tmp_path, other, resume=True)


def test_what_the_table_lacks_is_of_today_s_settings_and_expert(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A record of other settings, of another expert, or of a salt, fills no place."""
    monkeypatch.setattr(progress, "_ticks", queue.Queue(), raising=False)
    job = BenchmarkJob("bandit", replace(tiny_preset(), eval_trials=2), "blind_bc", (0,), tmp_path)
    job.run()
    data = job.load(0)
    assert data is not None
    (record,) = records.of_job(data, "smoke", [], 1)
    assert table.missing(job, "smoke", [record]) == ()
    config = {**record["settings"]["config"], "updates": 99}
    for change in ({"settings": {**record["settings"], "config": config}}, {"expert": "0" * 64}, {"salt": "salt"}):
        assert table.missing(job, "smoke", [{**record, **change}]) == (0,)


def test_a_record_is_by_episode_over_trials() -> None:
    """Mean and deviation of each episode's returns over trials, and the mean of Eq. (1)."""
    returns = np.array([[1.0, 10.0, 100.0], [3.0, 10.0, 104.0]])
    made = {"task": "bandit", "method": "x", "settings": {}, "versions": {}, "outside": {}, "salt": ""}
    made |= dict.fromkeys(("task_version", "method_version", "protocol", "expert_version"), 0) | {"expert": "e"}
    curve = {"imitation": [(1, 0.5), (2, 0.25)]}
    meta = {"identity": made, "agents": {"x": "", "x_mode": "mode"}, "curve": curve, "seed": 4, "tier": "1"}
    meta |= {"budget": {}, "cpu_s": 1.0}
    meta |= {"spans": [[0.0, 1.0]], "commit": None, "machine": "m"}
    data = {"meta": meta, "x/returns": returns, "x/objective": -returns, "x/probe": np.array([0.5, 0.6, 0.7])}
    data |= {f"x_mode/{key}": data[f"x/{key}"] for key in ("returns", "objective", "probe")}
    record, by_mode = records.of_job(data, "smoke", [], 3)
    assert (record["returns"], record["returns_sd"]) == ([2.0, 10.0, 102.0], [1.0, 0.0, 2.0])
    assert (record["objective"], record["theta_r2"]) == ([-2.0, -10.0, -102.0], [0.5, 0.6, 0.7])
    assert (record["eval_trials"], record["episodes"], record["seed"]) == (2, 3, 4)
    assert record.pop("curve") == {"imitation": {"update": [1, 2], "loss": [0.5, 0.25]}}
    assert by_mode == {**record, "deployment": "mode"}  # one training: its curve is kept once


class TestBudget:
    """What a seed used is counted once each time, of the steps that took place, and CPU seconds are shared by seeds."""

    def test_queries(self) -> None:
        context = Context(toys.Push(), tiny_preset(), [0, 1], expert="tests.toys:control")
        for times in (1, 2):
            trials, _ = context.query(None, context.rngs)
            assert context.monitor.budget["exploration_trials"] == [4 * times] * 2
        steps = trials.mask.reshape(2, -1).sum(1)  # the same each time, as the generators are
        assert context.monitor.budget["queries"] == (2 * steps).tolist()
        assert steps.sum() < trials.mask.size

    @pytest.mark.parametrize(("n", "spent"), [(3, 3), (None, 4)])
    def test_exploration(self, n: int | None, spent: int) -> None:
        """As many trials as were asked for; else the preset's."""
        context = Context(toys.Push(), tiny_preset(), [0, 1], expert="tests.toys:control")
        assert len(context.explore(None, context.rngs, n)) == 2 * spent
        assert context.monitor.budget["exploration_trials"] == [spent] * 2

    def test_of_each_seed(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """A file has what its own seed used."""
        monkeypatch.setattr(progress, "_ticks", queue.Queue(), raising=False)
        job = BenchmarkJob("bandit", tiny_preset(), "dagger", (0, 1), tmp_path)
        monitor = JobMonitor(job, 1)
        monitor.spend("queries", [30, 50])
        for seed in job.seeds:
            job.save(seed, {}, monitor, {})
        held = [job_files.read(job.file(seed)) for seed in job.seeds]
        assert [data and data["meta"]["budget"] for data in held] == [{"queries": 30}, {"queries": 50}]

    def test_cpu_seconds(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(progress, "_ticks", queue.Queue(), raising=False)
        monkeypatch.setattr(JobMonitor, "cpu", lambda self: 8.0)
        job = BenchmarkJob("bandit", replace(tiny_preset(), eval_trials=2), "blind_bc", (0, 1), tmp_path)
        job.run()
        data = job.load(1)
        assert data is not None
        assert data["meta"]["cpu_s"] == 4.0

    def test_only_what_is_learned_trains_on_a_gpu(self, tmp_path: Path) -> None:
        on_gpu = replace(tiny_preset(), device="cuda")
        jobs = (BenchmarkJob("bandit", on_gpu, method, (0,), tmp_path) for method in ("naive_rnn", "gail", *REFERENCES))
        devices = [JobMonitor(job, 1.0).device for job in jobs]
        assert devices == ["cuda", "cuda", *["cpu"] * len(REFERENCES)]


def test_an_identity_is_of_no_device(tmp_path: Path) -> None:
    """A record that a GPU made stays when a CPU is asked for."""
    cpu, gpu = (tiny_preset().configured("naive_rnn", device=device) for device in ("cpu", "cuda"))
    jobs = (BenchmarkJob("bandit", each, "naive_rnn", (0,), tmp_path) for each in (cpu, replace(gpu, device="cuda")))
    first, second = map(identity.identity, jobs)
    assert first == second


def test_a_commit_of_changed_files_has_a_plus(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not where records alone have changed, as after each method of a table; a folder in another checkout has none."""
    code, record = tmp_path / "code.py", tmp_path / "docs" / "records" / "bandit.jsonl"
    record.parent.mkdir(parents=True)
    git = ("git", "-C", str(tmp_path), "-c", "user.name=A", "-c", "user.email=a@example.org")
    for file in (code, record):
        file.write_text("1")
    for words in (["init", "-q"], ["add", "."], ["commit", "-q", "-m", "first"]):
        subprocess.run([*git, *words], check=True)
    monkeypatch.setattr(identity, "ROOT", tmp_path.resolve())
    commit = identity.commit.__wrapped__()
    assert re.fullmatch("[0-9a-f]{40}", commit or "")
    record.write_text("2")
    assert identity.commit.__wrapped__() == commit
    code.write_text("2")
    assert identity.commit.__wrapped__() == f"{commit}+"
    monkeypatch.setattr(identity, "ROOT", record.parent.resolve())
    assert identity.commit.__wrapped__() is None


def test_a_short_commit_says_whether_files_were_changed() -> None:
    commits = (None, "0123456789abcdef", "0123456789abcdef+")
    assert [records.short_commit(commit) for commit in commits] == ["unknown", "0123456", "0123456+"]
