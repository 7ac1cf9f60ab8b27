"""What is kept of a run: when it is believed, what becomes of it, and whether it comes out again."""

from __future__ import annotations

import json
import queue
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deconfounded import envs
from deconfounded.benchmarks import commands, report, verify
from deconfounded.benchmarks import table as table_command
from deconfounded.benchmarks.console import run_command
from deconfounded.benchmarks.engine import identity, pool
from deconfounded.benchmarks.engine.catalogue import METHODS
from deconfounded.benchmarks.engine.jobs import BenchmarkJob
from deconfounded.benchmarks.output import records
from deconfounded.envs.files import PARTIAL, write_sealed
from deconfounded.experts import policy
from deconfounded.experts.demos import Trials
from tests.tools import tiny_preset


@pytest.fixture
def job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> BenchmarkJob:
    """Finished: blind BC on the bandit, seeds 0 and 1."""
    monkeypatch.setattr(pool, "_ticks", queue.Queue(), raising=False)
    (tmp_path / "jobs").mkdir()
    made = BenchmarkJob("bandit", tiny_preset(), "blind_bc", (0, 1), tmp_path / "jobs")
    made.run()
    return made


class TestIdentity:
    @pytest.mark.parametrize(
        ("file", "changes"),
        [
            ("deconf/naive_rnn.py", {"naive_rnn"}),
            ("deconf/dagger.py", {"dagger"}),
            ("deconf/exact.py", {"conditional", "interventional"}),
            ("deconf/recurrent.py", {"naive_rnn", "naive_obs", "naive_dropout", "naive_transformer", "palr"}),
            ("envs/tasks/icy_road.py", set()),
            ("envs/tasks/slippery_cartpole.py", set(METHODS)),
            ("envs/render.py", set()),
            ("benchmarks/output/pages.py", set()),
            ("benchmarks/engine/jobs.py", set(METHODS)),
        ],
    )
    def test_a_comment_changes_its_own_results_alone(
        self, file: str, changes: set[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        task = envs.get("slippery_cartpole")
        before = {name: identity.code(task, method.module) for name, method in METHODS.items()}
        read = Path.read_bytes

        def commented(self: Path) -> bytes:
            return read(self) + (b"# a comment\n" if self == identity.ROOT / file else b"")

        monkeypatch.setattr(Path, "read_bytes", commented)
        after = {name: identity.code(task, method.module) for name, method in METHODS.items()}
        assert {name for name in METHODS if before[name] != after[name]} == changes

    def test_an_outside_task_is_noticed(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """Its file, that of a class it stands on, and its MJCF."""
        monkeypatch.setattr(envs.registry, "TASKS", dict(envs.TASKS))
        (tmp_path / "base_body.py").write_text(
            "from deconfounded.envs.tasks.bandit import Bandit\nclass Base(Bandit): pass\n"
        )
        (tmp_path / "mine.py").write_text("from base_body import Base\nclass Mine(Base):\n    name = 'mine'\n")
        task = envs.get(f"{tmp_path}/mine.py:Mine")
        seen = {identity.code(task, "")}
        for name, more in (("mine.py", "# more"), ("base_body.py", "# more"), ("mine.xml", "<mujoco/>")):
            with (tmp_path / name).open("a") as file:
                file.write(more)
            seen.add(identity.code(task, ""))
        assert len(seen) == 4

    def test_settings_are_the_methods_own(self) -> None:
        """Another amount of dagger's training is none of naive_rnn's business."""
        preset = tiny_preset()
        other = replace(preset, dagger=replace(preset.dagger, updates=9), query_trials=9, grid=9)
        for name, same in (("naive_rnn", True), ("dagger", False), ("interventional", False)):
            one, two = (BenchmarkJob("bandit", p, name, (0,), Path()) for p in (preset, other))
            assert (identity.identity(one) == identity.identity(two)) == same


class TestKeptFiles:
    """A file that is not what its name says is told of in a line, and made again."""

    def spoilt(self, job: BenchmarkJob, **changes: Any) -> str:
        """Why the file of seed 0 is not believed, with these arrays or parts of meta in the place of its own."""
        found = pool.read(job.file(0))
        assert found is not None
        meta = {**found["meta"], **{key: value for key, value in changes.items() if key in found["meta"]}}
        arrays = {key: changes.get(key, value) for key, value in found.items() if key != "meta"}
        np.savez(job.file(0), meta=np.array(json.dumps(meta)), **arrays)
        assert job.load(0) is None
        spoilt = pool.read(job.file(0))
        assert spoilt is not None
        return job.unfit(0, spoilt)

    def test_fine(self, job: BenchmarkJob) -> None:
        assert job.load(0) is not None
        assert job.load(1) is not None
        assert job.load(2) is None

    def test_another_seed(self, job: BenchmarkJob) -> None:
        shutil.copy(job.file(1), job.file(0))
        found = pool.read(job.file(0))
        assert found is not None
        assert job.unfit(0, found) == "it is of seed 1"

    def test_another_method(self, job: BenchmarkJob) -> None:
        other = replace(job, method="random", seeds=(0,))
        other.run()
        shutil.copy(other.file(0), job.file(0))
        found = pool.read(job.file(0))
        assert found is not None
        assert job.unfit(0, found) == "it was made with another method"

    def test_contents(self, job: BenchmarkJob) -> None:
        few = {"blind_bc/returns": np.ones((3, 1)), "blind_bc/objective": np.ones((3, 1))}
        assert "has shape (3, 1), for 4 trials" in self.spoilt(job, **few)
        job.run()
        assert "NaN or infinity" in self.spoilt(job, **{"blind_bc/objective": np.full((4, 1), np.nan)})
        job.run()
        assert "another versions" in self.spoilt(job, identity={**identity.identity(job), "versions": {}})
        job.run()
        assert "Eq. (1) (4,)" in self.spoilt(job, **{"blind_bc/objective": np.ones(4)})
        for key, value, says in (
            ("identity", [1], "does not say what it was made of"),
            ("budget", {"expert_trials": "4"}, "does not say what data"),
            ("agents", 3, "does not say what it was made of"),
            ("arrays", ["theta", "more"], r"it lacks blind_bc/objective, "),
        ):
            job.run()
            assert says in self.spoilt(job, **{key: value})

    def test_stray_names(self, job: BenchmarkJob) -> None:
        """blind_bc-00 is not one more seed."""
        shutil.copy(job.file(0), job.folder / "blind_bc-00.npz")
        shutil.copy(job.file(0), job.folder / "nonsense-0.npz")
        assert [one.seeds for one in pool.written(job, job.folder)] == [(0,), (1,)]

    def test_a_file_over_another_s(self, job: BenchmarkJob, capsys: pytest.CaptureFixture[str]) -> None:
        """What is shown again of a run has a seed once; demonstrations are those of their seed and expert."""
        shown = job.context().demonstrations
        first, second = (job.folder / f"demonstrations-{seed}.npz" for seed in (0, 1))
        assert job.context().has_demonstrations(0)
        shutil.copy(second, first)
        assert not job.context().has_demonstrations(0)
        assert job.context().demonstrations.sha256 == shown.sha256
        assert job.context().has_demonstrations(0)
        assert not replace(job, preset=replace(job.preset, expert_trials=3)).context().has_demonstrations(0)
        shutil.copy(job.file(1), job.file(0))
        assert [(method, seed) for method, seed, _ in pool.left_in(job.folder)] == [("blind_bc", 1)]
        assert capsys.readouterr().out == "blind_bc-0.npz is left out: it is of blind_bc-1\n"

    @pytest.mark.parametrize("text", ["[]", "{", '{"kind": "BenchmarkJob"}', "\xff", "[" * 100_000])
    def test_settings_of_wrong_shape(self, text: str, tmp_path: Path) -> None:
        (tmp_path / "settings.json").write_text(text, encoding="latin-1")
        with pytest.raises(envs.InputError, match=r"settings\.json is damaged"):
            pool.prepare(tmp_path, {"kind": "BenchmarkJob"}, resume=True)

    def test_what_a_kill_left_half_written_goes(self, tmp_path: Path) -> None:
        (tmp_path / "jobs").mkdir()
        (tmp_path / "jobs" / f".naive_rnn-0.npz.77{PARTIAL}").write_bytes(b"half")
        pool.prepare(tmp_path, {}, resume=False)
        assert not list((tmp_path / "jobs").iterdir())

    def test_flipped_bits(self, job: BenchmarkJob) -> None:
        """Of 100 single flips, each is noticed, or changes nothing."""
        content, expected, rng = job.file(0).read_bytes(), job.load(0), np.random.default_rng(0)
        assert expected is not None
        for _ in range(100):
            flipped = bytearray(content)
            flipped[rng.integers(len(content))] ^= 1 << int(rng.integers(8))
            job.file(0).write_bytes(bytes(flipped))
            found = job.load(0)
            if found is not None:
                assert found["meta"] == expected["meta"]
                np.testing.assert_array_equal(found["blind_bc/returns"], expected["blind_bc/returns"])

    def test_flipped_bits_of_experts_and_trials(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        task, rng = envs.get("tilted_cartpole"), np.random.default_rng(0)
        weights, trials = tmp_path / "tilted_cartpole.safetensors", tmp_path / "trials.npz"
        shutil.copy(policy.path(task).with_suffix(".json"), tmp_path)
        shown = Trials(rng.random((2, 1, 4, 3)), rng.random((2, 1, 3, 1)), np.ones((2, 1, 3), bool))
        shown.save(trials)
        for file, content, load in (
            (weights, policy.path(task).read_bytes(), lambda: policy.load(task, weights)),
            (trials, trials.read_bytes(), lambda: Trials.load(trials)),
        ):
            for _ in range(60):
                flipped = bytearray(content)
                flipped[rng.integers(len(content))] ^= 1 << int(rng.integers(8))
                file.write_bytes(bytes(flipped))
                try:
                    got = load()
                except envs.InputError:
                    continue
                assert isinstance(got, Trials)
                np.testing.assert_array_equal(got.obs, shown.obs)

    def test_a_second_command_waits_outside(self, tmp_path: Path) -> None:
        told = pytest.raises(envs.InputError, match="another command is at work")
        with commands.locked(tmp_path), told, commands.locked(tmp_path):
            pass
        with commands.locked(tmp_path):
            pass


def kept(job: BenchmarkJob) -> list[records.Record]:
    found = [job.load(seed) for seed in job.seeds]
    return [one for data in found if data is not None for one in records.of_job(data, "smoke", [], 1)]


class TestRecords:
    def test_there_and_back(self, job: BenchmarkJob, tmp_path: Path) -> None:
        made = kept(job)
        for record in made:
            records.write(tmp_path / "records", record)
        assert records.of_task(tmp_path / "records", "bandit", 0, "smoke") == made
        assert records.of_task(tmp_path / "records", "bandit", 1, "smoke") == []
        assert made[0]["tier"] == "1"
        assert made[0]["budget"] == {"expert_trials": 4}

    @pytest.mark.parametrize(
        ("change", "says"),
        [
            ({"task": "../../etc"}, "task "),
            ({"seed": -1}, "seed "),
            ({"returns": ["<script>"]}, r"returns\.0 "),
            ({"machine": "<script>"}, "machine "),
            ({"spans": [[0, 1]]}, r"spans\.0\.0 "),
            ({"spans": [[1.8e9, 1.7e9]]}, "spans must end after they begin"),
            ({"tier": "0"}, "tier "),
            ({"extra": 1}, "'extra' was unexpected"),
            ({"objective": [1.0, 2.0]}, "must be of as many episodes"),
        ],
    )
    def test_what_is_none(self, job: BenchmarkJob, change: dict[str, Any], says: str) -> None:
        record = kept(job)[0]
        with pytest.raises(envs.InputError, match=says) as caught:
            records.check({**record, **change}, "it")
        assert "\n" not in str(caught.value)

    @pytest.mark.parametrize("key", ["task_version", "preset", "salt", "eval_trials", "expert"])
    def test_never_mixed(self, job: BenchmarkJob, key: str) -> None:
        one, two = kept(job)
        with pytest.raises(envs.InputError, match=f"records with {key} .* do not belong in one table"):
            records.gather([one, {**two, key: "other"}])


class TestVerify:
    def test_same_bits(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        """A seed run again, alone and in another process, gives the bits of the run; a record that lies does not."""
        monkeypatch.setattr(pool, "_ticks", queue.Queue(), raising=False)
        small = ["eval_trials=4", "expert_trials=4", "cloning.updates=3"]
        from deconfounded.benchmarks.engine.presets import changed, preset

        settings = changed(preset("smoke", envs.get("bandit"), "cpu"), small)
        (tmp_path / "jobs").mkdir()
        made = BenchmarkJob("bandit", settings, "blind_bc", (2, 3), tmp_path / "jobs")
        made.run()
        data = made.load(3)
        assert data is not None
        (record,) = records.of_job(data, "smoke", small, 1)
        records.write(tmp_path, record)
        monkeypatch.setattr("sys.argv", ["verify", str(tmp_path / records.place(record))])
        verify.main()
        assert "blind_bc-3.json: same bits\n" in capsys.readouterr().out
        records.write(tmp_path, {**record, "returns": [99.0], "bits": "0" * 64, "commit": None})
        with pytest.raises(SystemExit) as ended:
            verify.main()
        assert ended.value.code == 1
        assert "not the same\n    commit: None, now " in capsys.readouterr().out

    def test_verdict(self, job: BenchmarkJob) -> None:
        record = {**kept(job)[0], "eval_trials": 100, "returns": [20.0], "returns_sd": [4.0]}
        for off, said in ((1.0, "inside the interval"), (2.0, "not the same")):  # three standard errors are 1.7
            again = {**record, "returns": [20.0 + off], "bits": "1" * 64, "machine": "another"}
            assert verify.verdict(record, again) == (said, [f"machine: {record['machine']}, now another"])


def test_report_again(job: BenchmarkJob, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From what jobs left, without training; what is not there is told in a line."""
    monkeypatch.setenv("MUJOCO_GL", "EGL ")
    monkeypatch.setattr("sys.argv", ["report", str(tmp_path)])
    with pytest.raises(envs.InputError, match=r"holds no settings.json"):
        report.main()
    about = {"reference": "bandit", "kind": "BenchmarkJob", "preset": "smoke", "set": []}
    write_sealed(tmp_path / "settings.json", about)
    with pytest.raises(envs.InputError, match="no finished jobs of random and expert"):
        report.main()
    for method in ("random", "expert"):
        replace(job, method=method).run()
    report.main()
    results = json.loads((tmp_path / "results.json").read_text())
    assert set(results["methods"]) == {"random", "expert", "blind_bc"}
    for file in ("rows.csv", "report.html", "adaptation.png", "records/bandit-v0/smoke/expert-1.json"):
        assert (tmp_path / file).stat().st_size > 0


def test_broken_pictures_leave_the_numbers(
    job: BenchmarkJob, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class FatalError(Exception):
        """As mujoco's: none of Python's own kinds."""

    def broken(*_: Any) -> None:
        raise FatalError("an OpenGL platform library has not been loaded")

    monkeypatch.setattr("deconfounded.benchmarks.output.report.pictures", broken)
    for method in ("random", "expert"):
        replace(job, method=method).run()
    about = {"reference": "bandit", "kind": "BenchmarkJob", "preset": "smoke", "set": []}
    write_sealed(tmp_path / "settings.json", about)
    monkeypatch.setattr("sys.argv", ["report", str(tmp_path)])
    run_command(report.main)
    assert "no pictures: an OpenGL platform library" in capsys.readouterr().out
    assert (tmp_path / "report.html").stat().st_size > 0


def test_table_makes_what_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """All of it at first; then nothing, but for a record that is gone, or of other code."""

    def table(*more: str) -> str:
        line = ["table", "--tasks", "bandit", "--methods", "random", "--preset", "smoke", "--seeds", "2", *more]
        monkeypatch.setattr("sys.argv", [*line, "--set", "eval_trials=4", "--out", str(tmp_path)])
        table_command.main()
        return capsys.readouterr().out

    assert "bandit, random: 2 of 2 seeds are missing" in table("--list")
    table()
    place = tmp_path / "records" / "bandit-v0" / "smoke"
    assert sorted(file.name for file in place.iterdir()) == [
        f"{m}-{i}.json" for m in ("expert", "random") for i in (0, 1)
    ]
    assert table() == table("--list") == ""
    (place / "expert-1.json").unlink()
    records.write(tmp_path / "records", {**records.read(place / "random-0.json"), "code": "0" * 64})
    assert table("--list").splitlines() == [f"bandit, {m}: 1 of 2 seeds are missing" for m in ("expert", "random")]
