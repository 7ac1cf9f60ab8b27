"""Jobs, one (method, some seeds) each, side by side on an engine. What is in a job's files is finished, and kept."""

from __future__ import annotations

import hashlib
import io
import json
import re
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, Self, TypeVar

import numpy as np
import torch

from deconfounded import envs
from deconfounded.benchmarks.engine import catalogue
from deconfounded.benchmarks.engine.catalogue import METHODS, Method
from deconfounded.benchmarks.engine.context import Context
from deconfounded.benchmarks.engine.identity import commit, identity, machine
from deconfounded.benchmarks.engine.presets import Preset
from deconfounded.benchmarks.engine.progress import Progress
from deconfounded.deconf.core.agents import Monitor, Training
from deconfounded.envs.files import check_folder, read_sealed, sweep, write_atomically, write_sealed
from deconfounded.experts.rollout import Agent

SAVE_EVERY_S = 60.0  # a checkpoint within a job


@dataclass(frozen=True)
class Job(ABC):
    """What to run, and the folder that its files belong in, one a seed; seeds run side by side in one program."""

    task: str
    preset: Preset
    method: str
    seeds: tuple[int, ...]
    folder: Path
    expert: str | None = None  # another than the task's own
    salt: str = ""  # of evaluation's seeds
    guest: Method | None = None  # a method from outside
    track: bool = False  # whether losses go to TensorBoard as they come

    @property
    def about(self) -> Method:
        """The method's entry in the catalogue."""
        return self.guest or METHODS[self.method]

    def context(self, monitor: Monitor | None = None) -> Context:
        """The data and environments of its seeds."""
        return Context(envs.get(self.task), self.preset, self.seeds, monitor, self.folder, self.expert)

    @abstractmethod
    def run(self) -> str:
        """Do it, in a worker process, and write the files; returns a line that says how it went."""

    def file(self, seed: int) -> Path:
        """An .npz file."""
        return self.folder / f"{self.method}-{seed}.npz"

    @property
    def checkpoint(self) -> Path:
        """What an interrupted job goes on from."""
        return self.folder / f".{self.method}-{'-'.join(map(str, self.seeds))}.pt"

    @property
    def ticks(self) -> int:
        """Of progress: in proportion to how long a job takes."""
        return 100 * self.about.cost * len(self.seeds)

    def save(self, seed: int, arrays: dict[str, Any], monitor: JobMonitor, meta: dict[str, Any]) -> None:
        """Write the file of a seed, atomically; beside `meta` it holds the seed's budget, and when work went on."""
        buffer = io.BytesIO()
        i = self.seeds.index(seed)
        budget = {kind: each[i] for kind, each in monitor.budget.items()}
        cpu = round(monitor.cpu() / len(self.seeds), 2)
        known = {"identity": identity(self), "seed": seed, "commit": commit(), "machine": machine(monitor.device)}
        known |= {"reference": self.about.reference, "arrays": list(arrays)}
        whole = {**meta, **known, "budget": budget, "spans": monitor.spans(), "cpu_s": cpu}
        np.savez_compressed(buffer, meta=np.array(json.dumps(whole)), **arrays)
        write_atomically(self.file(seed), buffer.getvalue())

    def load(self, seed: int) -> dict[str, Any] | None:
        """What was written of a seed: arrays, and `meta` decoded. None if there is nothing that fits: see `unfit`."""
        found = read(self.file(seed))
        return None if found is None or self.unfit(seed, found) else found

    def unfit(self, seed: int, found: dict[str, Any]) -> str:
        """Why what a file holds is not this job's result of that seed, as it would come out today; empty if it is."""
        if why := broken(found):
            return why
        meta, expected = found["meta"], json.loads(json.dumps(identity(self)))
        told = meta["identity"]
        if differ := [key for key in {**expected, **told} if expected.get(key) != told.get(key)]:
            return f"it was made with another {differ[0].replace('_', ' ')}"
        if meta["seed"] != seed:
            return f"it is of seed {meta['seed']}"
        for key, value in found.items():
            if key.endswith("/returns") and len(value) != self.preset.eval_trials:
                return f"{key} has shape {value.shape}, for {self.preset.eval_trials} trials"
        return ""


META: dict[str, Any] = {  # what a file says of itself, and of what types
    **{"identity": dict, "seed": int, "budget": dict, "spans": list, "cpu_s": (int, float), "arrays": list},
    **{"machine": str, "commit": (str, type(None))},
}
OF_AGENT = ("returns", "objective", "probe")
SCORED = {"agents": list, "curve": dict, "tier": str}  # and what one of a run of run.py says beside that


def broken(found: dict[str, Any]) -> str:
    """Why what a file holds cannot be what a job wrote; empty if it can."""
    meta = found["meta"]
    wanted = META | (SCORED if "agents" in meta else {})
    right = all(isinstance(meta.get(key, ...), kind) for key, kind in wanted.items())
    if not right or not isinstance(meta["identity"].get("method"), str):
        return "it does not say what it was made of"
    if not all(isinstance(amount, int) for amount in meta["budget"].values()):
        return "it does not say what data it used"
    if lost := {"meta", *meta["arrays"]} ^ set(found):
        return f"it lacks {', '.join(sorted(lost))}"
    for name in meta.get("agents", ()):
        returns, objective, probe = (found.get(f"{name}/{key}", np.zeros(())) for key in OF_AGENT)
        if returns.ndim != 2 or objective.shape != returns.shape or probe.ndim != 1:
            return f"returns of {name} have shape {returns.shape}, Eq. (1) {objective.shape}, probes {probe.shape}"
    for key, value in found.items():
        if key != "meta" and value.dtype.kind == "f" and not np.isfinite(value).all():
            return f"{key} holds NaN or infinity"
    return ""


def read(file: Path) -> dict[str, Any] | None:
    """A job's file: arrays, and `meta` decoded. None if it is missing, or damaged (a zip has checksums)."""
    try:
        with np.load(file, allow_pickle=False) as data:
            arrays = {key: data[key] for key in data.files}
        meta = json.loads(str(arrays["meta"]))
    except Exception:  # damaged, which shows in many ways
        return None
    return {**arrays, "meta": meta} if isinstance(meta, dict) else None


class DemonstrationJob(Job):
    """Makes what all methods imitate with a seed, so that no two of them do."""

    @property
    def about(self) -> Method:
        return Method(())

    @property
    def ticks(self) -> int:
        return 20

    def file(self, seed: int) -> Path:
        return self.folder / f"demonstrations-{seed}.npz"

    def run(self) -> str:
        start = time.time()
        trials = self.context().demonstrations
        tick(self.ticks)
        return f"{len(trials)} expert trials in {time.time() - start:.0f} s"


class Ticks(Protocol):
    """Where a worker process tells how far it has come."""

    def put(self, ticks: int) -> None: ...


_ticks: Ticks  # of this worker process


def tell(ticks: Ticks) -> None:
    """Let the jobs of this process tell their progress there."""
    global _ticks
    _ticks = ticks


def tick(ticks: int) -> None:
    """Work in this process has come so much further."""
    _ticks.put(ticks)


class JobMonitor(Monitor):
    """Tells the main process how far a job has come, and keeps a checkpoint of its training beside its files.

    share: of the whole job, that training takes. `kept` goes into the checkpoint, and comes back from it.
    """

    def __init__(self, job: Job, share: float) -> None:
        super().__init__()
        self.ticks, self.share, self.told = job.ticks, share, 0
        self.device = job.preset.naive.device
        self.file = job.checkpoint
        self.start, self.saved = time.time(), time.monotonic()
        self.before: list[tuple[float, float]] = []
        self.cpu_start, self.cpu_before, self.elsewhere = time.process_time(), 0.0, 0.0
        self.kept: Training = {}

    def spans(self) -> list[tuple[float, float]]:
        """When the job was at work: from, to."""
        return [*self.before, (self.start, time.time())]

    def cpu(self) -> float:
        """CPU seconds of this process, and of a guest's, for all seeds, so far."""
        return self.cpu_before + time.process_time() - self.cpu_start + self.elsewhere

    def worked(self) -> float:
        """Seconds of work so far."""
        return sum(end - start for start, end in self.spans())

    def _tell(self, share: float) -> None:
        if (now := int(self.ticks * share)) > self.told:
            tick(now - self.told)
            self.told = now

    def update(self, done: int, total: int, losses: dict[str, float], agent: Agent | None = None) -> None:
        self._tell(self.share * done / total)

    def save(self, state: Callable[[], Training]) -> None:
        if time.monotonic() - self.saved >= SAVE_EVERY_S:
            buffer = io.BytesIO()
            known = {"kept": self.kept, "budget": self.budget, "spans": self.spans(), "cpu": self.cpu()}
            torch.save({"training": state(), **known}, buffer)
            write_atomically(self.file, hashlib.sha256(buffer.getvalue()).digest() + buffer.getvalue())
            self.saved = time.monotonic()

    def load(self) -> Training | None:
        try:
            content = self.file.read_bytes()
            if hashlib.sha256(content[32:]).digest() != content[:32]:
                return None
            state = torch.load(io.BytesIO(content[32:]), self.device, weights_only=True)
        except Exception:  # missing, or of other code, which torch tells in many ways: begin again
            return None
        self.kept, self.before, self.budget = state["kept"], state["spans"], state["budget"]
        self.cpu_before = state["cpu"]
        return state["training"]

    def close(self) -> float:
        """The job is done, and its checkpoint is of no more use; returns the seconds of work it took."""
        self._tell(1)
        self.file.unlink(missing_ok=True)
        return self.worked()


Finished = list[tuple[str, int, dict[str, Any]]]
"""Method, seed, and what its job wrote."""


def know_guests(folder: Path) -> None:
    """Make the methods from outside known whose results are in a folder, so that they stay in its tables."""
    for file in sorted(folder.glob("*-*.npz")):
        if (found := read(file)) and (reference := found["meta"].get("reference")):
            try:
                catalogue.add(str(reference))
            except envs.InputError as error:
                print(f"{file.name} is left out: {error}")


class Work(Protocol):
    """A job, or anything that does its own work and says how it went."""

    @property
    def method(self) -> str: ...
    @property
    def seeds(self) -> tuple[int, ...]: ...
    @property
    def ticks(self) -> int: ...
    def run(self) -> str: ...


Some = TypeVar("Some", bound=Work)
Run = Callable[[list[Some], Callable[[int], None], Callable[[Some, str | Exception], None]], None]
"""An engine's `run`."""


class Engine(ABC):
    """Where jobs run, one core or one GPU each. Use it in a `with`: after that nothing of it is left running."""

    def __enter__(self) -> Self:
        return self

    @abstractmethod
    def __exit__(self, *error: object) -> None:
        """Let it go."""

    @abstractmethod
    def slots(self, device: str) -> int:
        """How many jobs that train on such a device to make of a method's seeds."""

    @abstractmethod
    def run(self, jobs: list[Job], tick: Callable[[int], None], say: Callable[[Job, str | Exception], None]) -> None:
        """Run them side by side, first come, first served; a job's files are in its folder when it has ended.

        tick: to be told of progress; say: what became of a job, an InputError if it failed: the others go on.
        """


def run_all(every: Sequence[Job], device: str, label: str, engine: Engine) -> tuple[Finished, int]:
    """Run what has no file yet; returns all that is in the folder now, and how many files were there before.

    every: a job for each method, with all seeds, in one folder.
    """
    folder, left = every[0].folder, [list[int]() for _ in every]
    for job, missing in zip(every, left, strict=True):
        for seed in job.seeds:
            found = read(job.file(seed))
            if found is not None and (why := job.unfit(seed, found)):
                print(f"{job.file(seed).name} is made again: {why}")
            if found is None or why:
                missing.append(seed)
    parts = [
        replace(job, seeds=part)
        for job, missing in zip(every, left, strict=True)
        for part in groups(job.about, missing, engine.slots(device))
    ]
    shown = {seed: job for job in parts if "demonstrations" in job.about.uses for seed in job.seeds}
    first: list[Job] = [
        DemonstrationJob(job.task, job.preset, "demonstrations", (seed,), folder, job.expert)
        for seed, job in sorted(shown.items())
    ]
    run_jobs([job for job in first if not job.context().has_demonstrations(job.seeds[0])], label, engine.run)
    run_jobs(parts, label, engine.run)
    for stale in folder.glob(".*.pt"):  # of groups that this command made otherwise
        stale.unlink()
    done = written(every[0], folder)
    finished = [(job.method, job.seeds[0], data) for job in done if (data := job.load(job.seeds[0])) is not None]
    return finished, len(finished) - sum(map(len, left))


def written(like: Job, folder: Path) -> list[Job]:
    """A job for each file in the folder, those of other methods and seeds than this command's too; in order."""
    named = [re.fullmatch(r"(\w+)-(\d+)", file.stem) for file in folder.glob("*.npz")]
    pairs = [(m[1], int(m[2])) for m in named if m and m[1] in METHODS and m[2] == str(int(m[2]))]
    order = list(METHODS)
    pairs.sort(key=lambda pair: (order.index(pair[0]), pair[1]))
    return [replace(like, method=name, seeds=(seed,), guest=catalogue.guest(name)) for name, seed in pairs]


def left_in(folder: Path) -> Finished:
    """What jobs left in a folder, whatever code made it: each file is what it says it is."""
    found = []
    for file in sorted(folder.glob("*-*.npz")):
        data = read(file)
        if data is None or "agents" not in data["meta"]:
            continue
        why, meta = broken(data), data["meta"]
        if not why and file.stem != (name := f"{meta['identity']['method']}-{meta['seed']}"):
            why = f"it is of {name}"
        if why:
            print(f"{file.name} is left out: {why}")
        else:
            found.append((meta["identity"]["method"], meta["seed"], data))
    return found


def by_method(finished: Finished) -> dict[str, list[dict[str, Any]]]:
    """What the jobs of each method wrote, by seed."""
    found: dict[str, list[dict[str, Any]]] = {}
    for method, _, data in finished:
        found.setdefault(method, []).append(data)
    return found


def groups(method: Method, left: list[int], slots: int) -> list[tuple[int, ...]]:
    """Seeds to run side by side: as many groups as there are slots; references and guests share nothing."""
    if not left:
        return []
    alone = not method.learned or method.reference
    n = len(left) if alone else min(slots, len(left))
    return [tuple(map(int, part)) for part in np.array_split(left, n)]


def prepare(folder: Path, settings: dict[str, Any], resume: bool) -> None:
    """Make the output folder, or see that what it holds can be gone on with."""
    for place in (folder, folder / "jobs"):
        check_folder(place)
        sweep(place)
    file = folder / "settings.json"
    if not file.exists():
        if any((folder / "jobs").iterdir()):
            raise envs.InputError(f"{folder} holds jobs, but not their settings.json; give another --out")
        write_sealed(file, settings)
    elif not resume:
        raise envs.InputError(f"{folder} holds a run already; give --resume to go on with it, or another --out")
    else:
        before = read_sealed(file)
        now = json.loads(json.dumps(settings))
        if differ := [key for key in {**now, **before} if before.get(key) != now.get(key)]:
            raise envs.InputError(
                f"{folder} holds a run that differs in its {differ[0]}; give another --out, or remove it"
            )


def run_jobs(jobs: list[Some], label: str, run: Run[Some]) -> None:
    """Run jobs side by side, longest first. Raises InputError in the end if one failed: a guest, say."""
    if not jobs:
        return
    progress, failed = Progress(sum(job.ticks for job in jobs), label), list[Exception]()

    def say(job: Some, told: str | Exception) -> None:
        if isinstance(told, Exception):
            failed.append(told)
            told = f"failed: {told}"
        progress.line(f"{job.method}, {listed(job.seeds)}: {told}")

    run(jobs, progress.update, say)
    progress.close()
    if failed:
        raise failed[0]


def listed(seeds: tuple[int, ...]) -> str:
    """seed 0, or seeds 0, 1, 2."""
    return f"seed {seeds[0]}" if len(seeds) == 1 else f"seeds {', '.join(map(str, seeds))}"
