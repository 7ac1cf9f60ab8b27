"""What is kept of a run: when it is believed, what becomes of it, and whether it comes out again."""

import json
import platform
import queue
import re
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import filelock
import numpy as np
import pytest

from deconfounded import envs
from deconfounded.benchmarks import commands, report, verify
from deconfounded.benchmarks.console import run_command
from deconfounded.benchmarks.engine import identity, job_files, local, progress, scheduler, sources
from deconfounded.benchmarks.engine.benchmark import BenchmarkJob
from deconfounded.benchmarks.engine.catalogue import METHODS
from deconfounded.benchmarks.engine.local import Here
from deconfounded.benchmarks.output import aggregation, records, run_report
from deconfounded.benchmarks.studies import table as table_command
from deconfounded.deconf import methods
from deconfounded.deconf.methods import dagger
from deconfounded.envs.support.files import PARTIAL, write_sealed
from deconfounded.envs.support.origin import ROOT
from deconfounded.experts import policy
from deconfounded.experts.trials import Trials
from tests.tools import tiny_preset


def blind(folder: Path) -> BenchmarkJob:
    """Blind BC on the bandit, seeds 0 and 1."""
    return BenchmarkJob("bandit", tiny_preset(), "blind_bc", (0, 1), folder / "jobs")


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which it has run."""
    folder = tmp_path_factory.mktemp("finished")
    (folder / "jobs").mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(progress, "_ticks", queue.Queue(), raising=False)
        blind(folder).run()
    return folder


@pytest.fixture
def job(finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> BenchmarkJob:
    """Finished, in a folder of the test's own."""
    monkeypatch.setattr(progress, "_ticks", queue.Queue(), raising=False)
    shutil.copytree(finished, tmp_path, dirs_exist_ok=True)
    return blind(tmp_path)


class TestIdentity:
    """Versions, not the text of this package, decide what is made again; of what is from outside, its text."""

    @pytest.mark.parametrize("name", ["envs/task.py", "envs/physics.py", "experts/rollout.py", "deconf/core/nets.py"])
    def test_the_text_of_the_package_is_in_no_identity(self, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
        """A file with more in it than a comment: nothing is stale."""
        read = Path.read_bytes
        job = BenchmarkJob("slippery_cartpole", tiny_preset(), "naive_rnn", (0,), Path())

        def changed(self: Path) -> bytes:
            return read(self) + (b"x = 1\n" if self == ROOT / name else b"")

        before = identity.identity(job)
        monkeypatch.setattr(Path, "read_bytes", changed)
        assert identity.identity(job) == before

    def test_versions(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """A new one of a task, a method, an expert or the protocol makes its results stale, and no others."""
        jobs = [
            BenchmarkJob(task, tiny_preset(), method, (0,), Path())
            for task in ("curling", "icy_stop")
            for method in ("naive_rnn", "dagger")
        ]
        before = [identity.identity(job) for job in jobs]

        def stale() -> list[bool]:
            return [identity.identity(job) != was for job, was in zip(jobs, before, strict=True)]

        monkeypatch.setattr(type(envs.get("curling")), "version", 7)
        assert stale() == [True, True, False, False]
        monkeypatch.undo()
        monkeypatch.setattr(dagger.fit, "method", replace(METHODS["dagger"], version=7))
        assert stale() == [False, True, False, True]
        monkeypatch.undo()
        monkeypatch.setattr(identity, "PROTOCOL", 7)
        assert stale() == [True] * 4
        monkeypatch.undo()
        version = policy.version
        monkeypatch.setattr(
            policy, "version", lambda task, *rest: 7 if task.name == "curling" else version(task, *rest)
        )
        assert stale() == [True, True, False, False]

    def test_the_version_of_mujoco_is_that_of_what_steps(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Since 4 the package `mujoco` may be of another version than `mujoco-core`, or not there."""
        monkeypatch.setattr(identity, "LIBRARIES", ("no_such_package",))
        monkeypatch.setattr("mujoco.__version__", "4.5.6")
        assert identity.versions() == {"python": platform.python_version(), "mujoco": "4.5.6"}

    def test_an_outside_task_is_its_text(self, tmp_path: Path) -> None:
        """Of its file, modules and packages beside it, its MJCF and what that includes; comments are no matter."""
        texts = {
            "base_body.py": "from deconfounded.envs.tasks.bandit import Bandit\nclass Base(Bandit): pass\n",
            "parts/__init__.py": "",
            "parts/more.py": "from .again import ONE\n",
            "parts/again.py": "ONE = 1\n",
            "mine.py": "from base_body import Base\nfrom parts.more import ONE\nclass Mine(Base):\n    name = 'mine'\n",
            "mine.xml": '<mujoco><include file="world.xml"/></mujoco>',
            "world.xml": "<mujoco/>",
        }
        for name, text in texts.items():
            (tmp_path / name).parent.mkdir(exist_ok=True)
            (tmp_path / name).write_text(text)
        task = envs.get(f"{tmp_path}/mine.py:Mine")
        assert {str(file.relative_to(tmp_path)) for file in sources.of_task(task)} == set(texts)
        first = sources.digest(sources.of_task(task))
        for name in texts:
            if name.endswith(".py"):
                (tmp_path / name).write_text(f'"""A docstring."""\n# A comment.\n{texts[name]}')
                assert sources.digest(sources.of_task(task)) == first, name
            (tmp_path / name).write_text(texts[name] + ("x = 2\n" if name.endswith(".py") else "<!-- -->"))
            assert sources.digest(sources.of_task(task)) != first, name
            (tmp_path / name).write_text(texts[name])
        assert sources.of_task(envs.get("bandit")) == set()

    def test_settings_are_the_methods_own(self) -> None:
        """Another amount of dagger's training is none of naive_rnn's business."""
        preset = tiny_preset()
        other = replace(preset.configured("dagger", updates=9).configured("interventional", grid=9), query_trials=9)
        for name, same in (("naive_rnn", True), ("dagger", False), ("interventional", False)):
            one, two = (BenchmarkJob("bandit", p, name, (0,), Path()) for p in (preset, other))
            assert (identity.identity(one) == identity.identity(two)) == same


class TestKeptFiles:
    """A file that is not what its name says is told of in a line, and made again."""

    def spoilt(self, job: BenchmarkJob, **changes: Any) -> str:
        """Why the file of seed 0 is not believed, with these arrays or parts of meta in the place of its own."""
        result = job_files.read(job.file(0))
        assert result is not None
        meta = {**result["meta"], **{key: value for key, value in changes.items() if key in result["meta"]}}
        arrays = {key: changes.get(key, value) for key, value in result.items() if key != "meta"}
        np.savez(job.file(0), meta=np.array(json.dumps(meta)), **arrays)
        assert job.load(0) is None
        spoilt = job_files.read(job.file(0))
        assert spoilt is not None
        return job.unfit(0, spoilt)

    def test_fine(self, job: BenchmarkJob) -> None:
        assert job.load(0) is not None
        assert job.load(1) is not None
        assert job.load(2) is None

    def test_another_seed(self, job: BenchmarkJob) -> None:
        shutil.copy(job.file(1), job.file(0))
        result = job_files.read(job.file(0))
        assert result is not None
        assert job.unfit(0, result) == "it is of seed 1"

    def test_another_method(self, job: BenchmarkJob) -> None:
        other = replace(job, method="random", seeds=(0,))
        other.run()
        shutil.copy(other.file(0), job.file(0))
        result = job_files.read(job.file(0))
        assert result is not None
        assert job.unfit(0, result).startswith("it differs in its method (was ")

    @pytest.mark.slow
    def test_contents(self, job: BenchmarkJob) -> None:
        few = {"blind_bc/returns": np.ones((3, 1)), "blind_bc/objective": np.ones((3, 1))}
        assert "has shape (3, 1), for 4 trials" in self.spoilt(job, **few)
        job.run()
        assert "NaN or infinity" in self.spoilt(job, **{"blind_bc/objective": np.full((4, 1), np.nan)})
        job.run()
        assert "its versions" in self.spoilt(job, identity={**identity.identity(job), "versions": {}})
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
        assert [one.seeds for one in scheduler.written(job, job.folder)] == [(0,), (1,)]

    def test_a_file_over_another_s(self, job: BenchmarkJob, capsys: pytest.CaptureFixture[str]) -> None:
        """What is shown again of a run has a seed once; demonstrations are those of their seed and expert."""
        demonstrations = job.context().demonstrations
        first, second = (job.folder / f"demonstrations-{seed}.npz" for seed in (0, 1))
        assert job.context().has_demonstrations(0)
        shutil.copy(second, first)
        assert not job.context().has_demonstrations(0)
        assert job.context().demonstrations.sha256 == demonstrations.sha256
        assert job.context().has_demonstrations(0)
        assert not replace(job, preset=replace(job.preset, expert_trials=3)).context().has_demonstrations(0)
        shutil.copy(job.file(1), job.file(0))
        assert [(method, seed) for method, seed, _ in job_files.left_in(job.folder)] == [("blind_bc", 1)]
        assert capsys.readouterr().out == "blind_bc-0.npz is left out: it is of blind_bc-1\n"

    def test_a_damaged_file_is_told_of(self, job: BenchmarkJob, capsys: pytest.CaptureFixture[str]) -> None:
        """Of a report, and of a run that makes it again or not; demonstrations are made where they are needed."""
        job.file(0).write_bytes(job.file(0).read_bytes()[:-9])
        job.context().demonstrations  # noqa: B018 (made, and kept)
        assert [(method, seed) for method, seed, _ in job_files.left_in(job.folder)] == [("blind_bc", 1)]
        left = scheduler.results(scheduler.written(job, job.folder), say=True)
        assert [(method, seed) for method, seed, _ in left] == [("blind_bc", 1)]
        line = "blind_bc-0.npz is left out: it is damaged; run it again with --resume\n"
        assert capsys.readouterr().out == line * 2

    def test_a_result_of_another_version_is_told_of(
        self, job: BenchmarkJob, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """It is no part of what a run shows, though no seed of this command is it."""
        method = METHODS["blind_bc"]
        monkeypatch.setattr(methods.load("blind_bc"), "method", replace(method, version=method.version + 1))
        assert scheduler.results(scheduler.written(job, job.folder), say=True) == []
        lines = capsys.readouterr().out.splitlines()
        assert [line.partition(": it differs in its method_version")[0] for line in lines] == [
            f"blind_bc-{seed}.npz is left out" for seed in (0, 1)
        ]

    def test_returns_that_no_record_could_hold(self, job: BenchmarkJob) -> None:
        """Their spread is no number any more."""
        says = r"blind_bc/returns are up to 1e\+300; they must be at most 1e\+100"
        returns = job_files.read(job.file(0))["blind_bc/returns"]  # type: ignore[index]
        assert re.search(says, self.spoilt(job, **{"blind_bc/returns": 0 * returns - 1e300}))

    @pytest.mark.parametrize("text", ["[]", "{", '{"kind": "BenchmarkJob"}', "\xff", "[" * 100_000])
    def test_settings_of_wrong_shape(self, text: str, tmp_path: Path) -> None:
        (tmp_path / "settings.json").write_text(text, encoding="latin-1")
        with pytest.raises(envs.InputError, match=r"settings\.json is damaged"):
            job_files.prepare(tmp_path, {"kind": "BenchmarkJob"}, resume=True)

    def test_what_a_kill_left_half_written_goes(self, tmp_path: Path) -> None:
        (tmp_path / "jobs").mkdir()
        (tmp_path / "jobs" / f".naive_rnn-0.npz.77{PARTIAL}").write_bytes(b"half")
        job_files.prepare(tmp_path, {}, resume=False)
        assert not list((tmp_path / "jobs").iterdir())

    def test_flipped_bits(self, job: BenchmarkJob) -> None:
        """Of 100 single flips, each is noticed, or changes nothing."""
        content, expected, rng = job.file(0).read_bytes(), job.load(0), np.random.default_rng(0)
        assert expected is not None
        for _ in range(100):
            flipped = bytearray(content)
            flipped[rng.integers(len(content))] ^= 1 << int(rng.integers(8))
            job.file(0).write_bytes(bytes(flipped))
            loaded = job.load(0)
            if loaded is not None:
                assert loaded["meta"] == expected["meta"]
                np.testing.assert_array_equal(loaded["blind_bc/returns"], expected["blind_bc/returns"])

    def test_flipped_bits_of_experts_and_trials(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        task, rng = envs.get("tilted_cartpole"), np.random.default_rng(0)
        weights, trials = tmp_path / "tilted_cartpole.safetensors", tmp_path / "trials.npz"
        shutil.copy(policy.path(task).with_suffix(".json"), tmp_path)
        saved = Trials(rng.random((2, 1, 4, 3)), rng.random((2, 1, 3, 1)), np.ones((2, 1, 3), bool))
        saved.save(trials)
        for file, content, load in (
            (weights, policy.path(task).read_bytes(), lambda: policy.load(task, weights)),
            (trials, trials.read_bytes(), lambda: Trials.load(trials)),
        ):
            for _ in range(60):
                flipped = bytearray(content)
                flipped[rng.integers(len(content))] ^= 1 << int(rng.integers(8))
                file.write_bytes(bytes(flipped))
                try:
                    loaded = load()
                except envs.InputError:
                    continue
                assert isinstance(loaded, Trials)
                np.testing.assert_array_equal(loaded.obs, saved.obs)

    def test_a_second_command_waits_outside(self, tmp_path: Path) -> None:
        refused = pytest.raises(envs.InputError, match="another command is at work")
        with commands.locked(tmp_path), refused, commands.locked(tmp_path):
            pass
        with commands.locked(tmp_path):
            pass


def kept(job: BenchmarkJob) -> list[records.Record]:
    results = [job.load(seed) for seed in job.seeds]
    return [record for data in results if data is not None for record in records.of_job(data, "smoke", [], 1)]


def without_curve(*kept: records.Record) -> list[records.Record]:
    """What is left of records that are superseded."""
    assert all("curve" in record for record in kept)
    return [{key: value for key, value in record.items() if key != "curve"} for record in kept]


class TestRecords:
    def test_there_and_back(self, job: BenchmarkJob, tmp_path: Path) -> None:
        made = kept(job)
        records.write(tmp_path, made)
        assert records.of_task(tmp_path, "bandit", "smoke") == made
        assert records.of_task(tmp_path, "bandit") == []
        assert made[0]["tier"] == "1"
        assert made[0]["budget"] == {"expert_trials": 4}

    def test_one_in_a_slot(self, job: BenchmarkJob, tmp_path: Path) -> None:
        """A newer record takes the place of an older one; what is of an older version is kept apart, of any seed."""
        one, two = kept(job)
        records.write(tmp_path, [one, two])
        records.write(tmp_path, [{**one, "cpu_s": 9.0}])
        assert records.read(tmp_path / "bandit.jsonl") == [two, {**one, "cpu_s": 9.0}]
        assert not (tmp_path / "superseded").exists()
        newer = {**two, "method_version": 7}
        records.write(tmp_path, [newer])
        assert records.read(tmp_path / "bandit.jsonl") == [newer]
        assert records.read(tmp_path / "superseded" / "bandit.jsonl") == without_curve(two, {**one, "cpu_s": 9.0})
        assert records.of_task(tmp_path, "bandit", "smoke") == [newer]  # versions are never mixed
        records.write(tmp_path, [{**two, "method_version": 9}])  # of versions before the last, git's history has them
        assert records.read(tmp_path / "superseded" / "bandit.jsonl") == without_curve(newer, {**one, "cpu_s": 9.0})
        records.write(tmp_path, [{**two, "method_version": 6}])
        assert records.read(tmp_path / "superseded" / "bandit.jsonl") == without_curve(newer, {**one, "cpu_s": 9.0})

    def test_an_older_version_takes_no_place(self, job: BenchmarkJob, tmp_path: Path) -> None:
        """Of the method or of the task, of one seed or of all: it is kept with what is superseded."""
        one, two = kept(job)
        newer = [{**one, "method_version": 7, "task_version": 3}, {**two, "method_version": 7, "task_version": 3}]
        records.write(tmp_path, newer)
        older = [{**two, "method_version": 6, "task_version": 3}, {**one, "method_version": 8, "task_version": 2}]
        records.write(tmp_path, older)
        assert records.read(tmp_path / "bandit.jsonl") == newer
        assert records.read(tmp_path / "superseded" / "bandit.jsonl") == without_curve(*older)
        records.write(tmp_path, [{**two, "method_version": 6, "task_version": 3, "seed": 9}])
        assert records.read(tmp_path / "bandit.jsonl") == newer

    def test_half_written_files_are_swept(self, job: BenchmarkJob, tmp_path: Path) -> None:
        """What a killed program left is gone after the next write."""
        (half := tmp_path / ".bandit.jsonl.999.partial").write_text("half")
        records.write(tmp_path, kept(job))
        assert not half.exists()

    def test_an_empty_file(self, job: BenchmarkJob, tmp_path: Path) -> None:
        """As a loss of power may leave it: nothing is added to it as if there had been no records."""
        (tmp_path / "bandit.jsonl").write_text("")
        with pytest.raises(envs.InputError, match=r"records .*bandit.jsonl are empty; restore the file, or delete it"):
            records.write(tmp_path, kept(job))
        assert (tmp_path / "bandit.jsonl").read_text() == ""

    def test_a_kill_before_the_last_write(
        self, job: BenchmarkJob, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """What was superseded then is not superseded again."""
        one, two = kept(job)
        records.write(tmp_path, [one, two])
        newer = {**two, "method_version": 7}
        write = records.write_atomically

        def killed(file: Path, *content: Any) -> None:
            if file.parent == tmp_path:
                raise KeyboardInterrupt
            write(file, *content)

        monkeypatch.setattr(records, "write_atomically", killed)
        with pytest.raises(KeyboardInterrupt):
            records.write(tmp_path, [newer])
        monkeypatch.setattr(records, "write_atomically", write)
        records.write(tmp_path, [newer])
        assert records.read(tmp_path / "bandit.jsonl") == [newer]
        assert records.read(tmp_path / "superseded" / "bandit.jsonl") == without_curve(two, one)

    def test_writers_take_turns(self, job: BenchmarkJob, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """Nothing is written while another program writes; a lock that does not wait says so."""
        monkeypatch.setattr(filelock, "FileLock", partial(filelock.FileLock, timeout=0))
        with filelock.FileLock(tmp_path / ".lock"), pytest.raises(filelock.Timeout):
            records.write(tmp_path, kept(job))
        assert not (tmp_path / "bandit.jsonl").exists()
        records.write(tmp_path, kept(job))
        assert records.read(tmp_path / "bandit.jsonl") == kept(job)

    def test_names_of_many_seeds(self, job: BenchmarkJob) -> None:
        """They fit into a file's name, and groups of seeds have names of their own."""
        assert replace(job, seeds=(0, 1, 2)).checkpoint.name == ".blind_bc-0-1-2.pt"
        names = {replace(job, seeds=tuple(range(0, 1000, step))).checkpoint.name for step in (1, 2, 3)}
        assert len(names) == 3
        assert all(len(name) < 60 for name in names)

    @pytest.mark.parametrize("kind", ["task", "method"])
    def test_texts_from_outside_are_never_mixed(self, job: BenchmarkJob, tmp_path: Path, kind: str) -> None:
        """An edited task supersedes all records of before; an edited method, those of its own."""
        one, two = ({**record, "outside": {kind: "a" * 64}} for record in kept(job))
        other = {**one, "method": "naive_rnn", "outside": {"task": "a" * 64} if kind == "task" else {}}
        records.write(tmp_path, [one, two, other])
        edited = {**two, "outside": {kind: "b" * 64}}
        records.write(tmp_path, [edited])
        assert records.read(tmp_path / "bandit.jsonl") == ([edited] if kind == "task" else [other, edited])
        superseded = records.read(tmp_path / "superseded" / "bandit.jsonl")
        assert superseded == without_curve(*([two, one, other] if kind == "task" else [two, one]))
        says = "from two versions of its file" if kind == "task" else "of two versions of blind_bc"
        with pytest.raises(envs.InputError, match=says):
            aggregation.gather([edited, one])

    def test_an_expert_that_is_no_better_than_random(self, job: BenchmarkJob) -> None:
        record = {**kept(job)[0], "expert": "mine"}
        beside = [{**record, "method": name, "returns": [0.5]} for name in ("random", "expert")]
        with pytest.raises(envs.InputError, match=r"bandit: the expert returns 0\.5 an episode, random actions 0\.5;"):
            aggregation.references(record, beside)

    def test_nothing_is_written_of_what_is_none(self, job: BenchmarkJob, tmp_path: Path) -> None:
        one, two = kept(job)
        records.write(tmp_path, [one])
        before = (tmp_path / "bandit.jsonl").read_bytes()
        with pytest.raises(envs.InputError, match="blind_bc, seed 1 is no record"):
            records.write(tmp_path, [one, {**two, "returns": []}])
        assert (tmp_path / "bandit.jsonl").read_bytes() == before

    @pytest.mark.parametrize(
        ("spoil", "says"),
        [
            (lambda text: text.replace('"seed":1', '"seed":2', 1), "line 2 of .* is damaged, or was changed by hand"),
            (
                lambda text: text + text.splitlines()[0] + "\n",
                "line 3 of .* is a second record of blind_bc with seed 0",
            ),
            (lambda text: text[:-40], "line 2 of .* is not json"),
            (lambda text: text.replace('"cpu_s":', '"cpu_s":NaN,"x":', 1), "line 1 of .* is not json"),
        ],
    )
    def test_a_damaged_line(self, job: BenchmarkJob, tmp_path: Path, spoil: Any, says: str) -> None:
        records.write(tmp_path, kept(job))
        file = tmp_path / "bandit.jsonl"
        file.write_text(spoil(file.read_text()))
        with pytest.raises(envs.InputError, match=says):
            records.read(file)

    def test_of_another_task(self, job: BenchmarkJob, tmp_path: Path) -> None:
        records.write(tmp_path, kept(job))
        (tmp_path / "bandit.jsonl").rename(tmp_path / "curling.jsonl")
        with pytest.raises(envs.InputError, match=r"line 1 of .*curling\.jsonl is of bandit, which belongs in bandit"):
            records.read(tmp_path / "curling.jsonl")

    def test_stale(self, job: BenchmarkJob) -> None:
        record, today = kept(job)[0], identity.identity(job)
        assert records.stale(record, today) == []
        for key in records.MADE_OF:
            assert records.stale({**record, key: "other"}, today) == [key]

    def test_a_setting_that_is_newer_than_the_record(self, job: BenchmarkJob) -> None:
        """It does not make the record stale where it has its default; elsewhere it does."""
        record, today = kept(job)[0], identity.identity(job)
        config = record["settings"]["config"]
        default = {name: value for name, value in METHODS[job.method].defaults.items() if config.get(name) == value}
        other = next(name for name in config if name not in default)
        for name, what in ((next(iter(default)), []), (other, ["settings"])):
            before = {key: value for key, value in config.items() if key != name}
            assert records.stale({**record, "settings": {**record["settings"], "config": before}}, today) == what

    @pytest.mark.parametrize(
        ("change", "says"),
        [
            ({"task": "../../etc"}, "task "),
            ({"seed": -1}, "seed "),
            ({"returns": ["<script>"]}, r"returns\[0\] "),
            ({"machine": "<script>"}, "machine "),
            ({"spans": [[0, 1]]}, r"spans\[0\]\[0\] "),
            ({"spans": [[1.8e9, 1.7e9]]}, "spans must end after they begin"),
            ({"tier": "0"}, "tier "),
            ({"extra": 1}, "must not contain {'extra'}"),
            ({"objective": [1.0, 2.0]}, "must be of as many episodes"),
        ],
    )
    def test_what_is_none(self, job: BenchmarkJob, change: dict[str, Any], says: str) -> None:
        record = kept(job)[0]
        with pytest.raises(envs.InputError, match=says) as caught:
            records.check({**record, **change}, "it")
        assert "\n" not in str(caught.value)

    @pytest.mark.parametrize("key", ["task_version", "preset", "set", "salt", "eval_trials", "episodes", "expert"])
    def test_never_mixed(self, job: BenchmarkJob, key: str) -> None:
        one, two = kept(job)
        with pytest.raises(envs.InputError, match=f"records with {key} .* do not belong in one table"):
            aggregation.gather([one, {**two, key: "other"}])


def test_time_worked_counts_overlaps_once() -> None:
    assert aggregation.covered([(5, 6), (0, 2), (1, 3)]) == 4
    assert aggregation.covered([(0, 9), (1, 2), (4, 5)]) == 9


class TestVerify:
    @pytest.mark.slow
    def test_same_bits(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        """A seed run again, alone in another process, under its salt, has the same bits; a record that lies, others."""
        monkeypatch.setattr(progress, "_ticks", queue.Queue(), raising=False)
        small = ["eval_trials=4", "expert_trials=4", "blind_bc.updates=3", "oracle_bc.updates=3"]
        from deconfounded.benchmarks.engine.presets import changed, preset

        settings = changed(preset("smoke", envs.get("bandit"), "cpu"), small)
        (tmp_path / "jobs").mkdir()
        made = BenchmarkJob("bandit", settings, "blind_bc", (2, 3), tmp_path / "jobs", salt="any text")
        made.run()
        data = made.load(3)
        assert data is not None
        (record,) = records.of_job(data, "smoke", small, 1)
        records.write(tmp_path, [record])
        monkeypatch.setattr("sys.argv", ["verify", "bandit", "blind_bc", "3", "--records", str(tmp_path)])
        verify.main()
        assert capsys.readouterr().out.endswith("bandit blind_bc 3: same bits\n")
        records.write(tmp_path, [{**record, "returns": [99.0], "bits": "0" * 64, "commit": "0" * 40}])
        monkeypatch.setattr(local, "Local", Here)
        with pytest.raises(SystemExit) as ended:
            verify.main()
        assert ended.value.code == 1
        assert "not the same\n    commit: 0000" in capsys.readouterr().out

    def test_which_record(self, job: BenchmarkJob, tmp_path: Path) -> None:
        one, two = kept(job)
        file = tmp_path / "bandit.jsonl"
        records.write(tmp_path, [{**one, "protocol_name": "scarce"}])
        with pytest.raises(envs.InputError, match="no records of protocol standard; give --protocol, of scarce"):
            verify.pick(file, "blind_bc", 0)
        records.write(tmp_path, [one, two, {**two, "salt": "salt"}])
        assert verify.pick(file, "blind_bc", 0) == one
        assert verify.pick(file, "blind_bc", 0, "scarce")["protocol_name"] == "scarce"
        for method, seed, says in (
            ("blind", 0, r"did you mean 'blind_bc'\? there are blind_bc in .*; --records names"),
            ("blind_bc", 4, r"seed of blind_bc was 4; .* has 0, 1, 1"),
            ("blind_bc", 1, "has 2 records of blind_bc with seed 1"),
        ):
            with pytest.raises(envs.InputError, match=says):
                verify.pick(file, method, seed)

    def test_of_another_version(self, job: BenchmarkJob, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """Of its task: that is no longer here to run."""
        records.write(tmp_path, [{**kept(job)[0], "task_version": 9}])
        monkeypatch.setattr("sys.argv", ["verify", "bandit", "blind_bc", "0", "--records", str(tmp_path)])
        with pytest.raises(envs.InputError, match="the record is of bandit v9; here is bandit v0"):
            verify.main()

    def test_verdict(self, job: BenchmarkJob) -> None:
        record = {**kept(job)[0], "eval_trials": 100, "returns": [20.0], "returns_sd": [4.0]}
        for off, said in ((1.0, "inside the interval"), (2.0, "not the same")):  # three standard errors are 1.7
            again = {**record, "returns": [20.0 + off], "bits": "1" * 64, "machine": "another"}
            apart = f"mean returns: up to {off:.3g} apart, where the interval allows 1.7"
            assert verify.verdict(record, again) == (said, [f"machine: {record['machine']}, now another", apart])
        two = {**record, "returns": [20.0, 20.0], "returns_sd": [4.0, 4.0]}  # of two episodes, one of which agrees
        assert verify.verdict(two, {**two, "returns": [20.0, 22.0], "bits": "1" * 64})[0] == "not the same"


@pytest.mark.slow
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
    for file in ("rows.csv", "report.html", "adaptation.png", "records/bandit.jsonl"):
        assert (tmp_path / file).stat().st_size > 0


def test_jobs_of_another_text_are_left_out(job: BenchmarkJob, capsys: pytest.CaptureFixture[str]) -> None:
    """Those before the latest: of the task, or of the same method. The latest ended last, interrupted or not."""
    other = replace(job, method="random", seeds=(0,))
    other.run()
    for made, seed, text in ((other, 0, {"method": "c"}), (job, 0, {"method": "a"}), (job, 1, {"method": "b"})):
        data = job_files.read(made.file(seed))
        assert data is not None
        meta = data.pop("meta")
        meta["identity"]["outside"], meta["spans"] = text, [[1 - seed, 2 - seed], *[[4, 5]] * seed]
        np.savez(made.file(seed), meta=np.array(json.dumps(meta)), **data)
    left = [(method, seed) for method, seed, _ in job_files.left_in(job.folder)]
    assert left == [("blind_bc", 1), ("random", 0)]
    assert "blind_bc-0.npz is left out: its task or method had another text" in capsys.readouterr().out


def test_a_result_that_could_not_be_read_is_not_written(job: BenchmarkJob, monkeypatch: pytest.MonkeyPatch) -> None:
    for file in job.folder.glob("*.npz"):
        file.unlink()
    monkeypatch.setattr(job_files, "broken", lambda data: "it holds NaN")
    with pytest.raises(envs.InputError, match="blind_bc with seed 0 left no result that can be kept: it holds NaN"):
        job.run()
    assert not [*job.folder.glob("blind_bc-*.npz")]


def test_checkpoints_of_other_methods_stay(job: BenchmarkJob) -> None:
    for name in ("blind_bc-0", "dagger-0"):
        (job.folder / f".{name}.pt").touch()
    with Here() as engine:
        scheduler.run_all([job], "cpu", "", engine)
    assert [file.name for file in job.folder.glob(".*.pt")] == [".dagger-0.pt"]


def test_broken_pictures_leave_the_numbers(
    job: BenchmarkJob, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class FatalError(Exception):
        """As mujoco's: none of Python's own kinds."""

    def broken(*_: Any) -> None:
        raise FatalError("an OpenGL platform library has not been loaded")

    monkeypatch.setattr("deconfounded.benchmarks.output.run_report.pictures", broken)
    for method in ("random", "expert"):
        replace(job, method=method).run()
    about = {"reference": "bandit", "kind": "BenchmarkJob", "preset": "smoke", "set": []}
    write_sealed(tmp_path / "settings.json", about)
    monkeypatch.setattr("sys.argv", ["report", str(tmp_path)])
    run_command(report.main)
    assert "no pictures: an OpenGL platform library" in capsys.readouterr().out
    assert (tmp_path / "report.html").stat().st_size > 0


@pytest.mark.slow
@pytest.mark.usefixtures("here")
def test_table_makes_what_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """All of it at first; then nothing, but for a record that is gone, or of another version.

    It goes on in its folder after another method has got other settings.
    """

    def table(*more: str) -> str:
        line = ["table", "--tasks", "bandit", "--methods", "random", "--preset", "smoke", "--seeds", "2", *more]
        monkeypatch.setattr("sys.argv", [*line, "--set", "eval_trials=4", "--out", str(tmp_path)])
        table_command.main()
        return capsys.readouterr().out

    assert "bandit, random: seeds 0 1" in table("--list")
    table()
    made = records.read(tmp_path / "records" / "bandit.jsonl")
    assert [(one["method"], one["seed"]) for one in made] == [(m, i) for m in ("expert", "random") for i in (0, 1)]
    assert table() == "0 seeds to make, kept one by one: stop when you like\n"
    assert table("--list") == "0 seeds are missing or stale\n"
    (tmp_path / "records" / "bandit.jsonl").unlink()
    records.write(tmp_path / "records", [made[0], made[2], {**made[3], "method_version": 0}])
    left = [f"bandit, {method}: seeds {i}" for method, i in (("expert", 1), ("random", 1))]
    assert table("--list").splitlines()[:-1] == left
    (tmp_path / "records" / "bandit.jsonl").unlink()
    records.write(tmp_path / "records", [made[0], *({**one, "method_version": 0} for one in made[2:])])
    left = ["bandit, expert: seeds 1", "bandit, random: seeds 0 1 (stale: of v0)"]
    assert table("--list").splitlines()[:-1] == left
    other = METHODS["dagger"]
    config: Any = replace(other.on_bandit, learning_rate=7.0)  # type: ignore[type-var]
    monkeypatch.setattr(dagger.fit, "method", replace(other, on_bandit=config))
    assert table().startswith("3 seeds to make")
    assert table("--list") == "0 seeds are missing or stale\n"


def test_damaged_records_of_a_report_are_no_surprise_after_a_training(tmp_path: Path) -> None:
    """They are found before it, and the line says how they are made again."""
    task = envs.get("bandit")
    run_report.check_kept(task, tmp_path)
    (tmp_path / "records").mkdir()
    (tmp_path / "records" / "bandit.jsonl").write_text("{")
    says = r"^line 1 of .*bandit.jsonl is not json; remove that file, and `deconf report` makes it again from jobs/$"
    with pytest.raises(envs.InputError, match=says):
        run_report.check_kept(task, tmp_path)
    with pytest.raises(envs.InputError, match=says):
        run_report.write(task, {"preset": "smoke", "set": []}, [], tmp_path)
