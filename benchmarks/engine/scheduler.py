"""Jobs side by side on an engine: those whose files are missing or stale, longest first."""

import itertools
import re
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol, Self, TypeVar

import numpy as np

from deconfounded.benchmarks.engine import catalogue, progress
from deconfounded.benchmarks.engine.catalogue import METHODS
from deconfounded.benchmarks.engine.job_files import Finished, in_name
from deconfounded.benchmarks.engine.jobs import DemonstrationJob, Job
from deconfounded.benchmarks.engine.progress import Progress
from deconfounded.envs.support.errors import InputError, error_line
from deconfounded.envs.support.files import check_folder, write_atomically

OUT_OF_MEMORY = re.compile("allocate memory|out of memory", re.IGNORECASE)  # of torch's RuntimeErrors


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


def run_job(job: Work) -> str:
    """The job's line. Raises InputError as `_run` does; no ticks of the job are left then."""
    progress.begin()
    try:
        return _run(job)
    except InputError:
        progress.give_up(job.ticks)
        raise


def _run(job: Work) -> str:
    """The job's line. Raises InputError for SystemExit, which would end the process, and where memory is exhausted.

    Of a task or method from outside, any other error is an InputError too, with the traceback as its note.
    """
    try:
        return job.run()
    except InputError:
        raise
    except SystemExit as error:
        raise InputError(f"the job was ended by {error_line(error)}") from None
    except Exception as error:
        if isinstance(error, MemoryError) or OUT_OF_MEMORY.search(str(error)):
            raise InputError(f"memory was exhausted: {error_line(error)}") from None
        if not (theirs := job.from_outside if isinstance(job, Job) else []):
            raise
        failure = InputError(f"{' and '.join(theirs)}: {error_line(error)}")
        failure.add_note("".join(traceback.format_exception(error)))
        raise failure from None


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

        tick: is called with progress; say: with what became of a job, an InputError if it failed: the others go on.
        """


def run_all(
    every: Sequence[Job],
    device: str,
    label: str,
    engine: Engine,
    check: Callable[[Finished], None] = lambda references: None,
) -> tuple[Finished, int, list[Exception]]:
    """Run what has no file yet; returns all that is in the folder now, how many files were there before, and failures.

    every: a job for each method, with all seeds, in one folder. check: is called with the results of random actions and
    of the expert before anything is trained, unless one of the first jobs failed, and may raise an error.
    """
    folder, left = every[0].folder, [list[int]() for _ in every]
    for job, missing in zip(every, left, strict=True):
        for seed in job.seeds:
            _, why = job.read(seed)
            if why and job.file(seed).exists():
                print(f"{job.file(seed).name} is made again: {why}")
            if why:
                missing.append(seed)
    parts = [
        replace(job, seeds=part)
        for job, missing in zip(every, left, strict=True)
        for part in groups(job, missing, engine.slots(device))
    ]
    ours = [job for job in parts if "demonstrations" in job.about.uses and job.guest is None]
    imitated = {seed: job for job in ours for seed in job.seeds}
    first: list[Job] = [
        DemonstrationJob(job.task, job.preset, "demonstrations", (seed,), folder, job.expert, protocol=job.protocol)
        for seed, job in sorted(imitated.items())
        if not job.context().has_demonstrations(seed)
    ]
    first += [job for job in parts if job.method in catalogue.REFERENCES]
    later = [job for job in parts if job.method not in catalogue.REFERENCES]
    errors = folder.parent / "errors"
    failed = run_jobs(first, f"{label}, demonstrations and references", engine.run, errors)
    if not failed:
        check(results([job for job in written(every[0], folder) if job.method in catalogue.REFERENCES]))
    failed += run_jobs(later, label, engine.run, errors)
    for job in () if failed else every:
        for stale in folder.glob(f".{job.method}-*.pt"):  # of groups that this command made otherwise
            stale.unlink()
    finished = results(written(every[0], folder), say=True)
    there = {(method, seed) for method, seed, _ in finished}
    lost = [job.file(seed).name for job in every for seed in job.seeds if (job.method, seed) not in there]
    if lost and not failed:
        failed.append(InputError(f"{', '.join(lost)}: left out, as said above; run it again with --resume"))
    made = {(job.method, seed) for job, missing in zip(every, left, strict=True) for seed in missing}
    return finished, sum((method, seed) not in made for method, seed, _ in finished), failed


def results(done: Sequence[Job], say: bool = False) -> Finished:
    """What jobs of a seed each have written: method, seed and arrays of each file that fits. say: print of others."""
    finished: Finished = []
    for job in done:
        result, why = job.read(seed := job.seeds[0])
        if result is not None and not why:
            finished.append((job.method, seed, result))
        elif say:
            print(f"{job.file(seed).name} is left out: {why}; run it again with --resume")
    return finished


def written(like: Job, folder: Path) -> list[Job]:
    """A job for each file in the folder, those of other methods and seeds than this command's too; in order."""
    named = [re.fullmatch(r"(\w+)-(\d+)", file.stem) for file in folder.glob("*.npz")]
    pairs = [(m[1], int(m[2])) for m in named if m and m[1] in METHODS and m[2] == str(int(m[2]))]
    order = list(METHODS)
    pairs.sort(key=lambda pair: (order.index(pair[0]), pair[1]))
    return [replace(like, method=name, seeds=(seed,), guest=catalogue.guest(name)) for name, seed in pairs]


def groups(job: Job, left: list[int], slots: int) -> list[tuple[int, ...]]:
    """Seeds to run side by side: as many groups as there are slots; references and guests share nothing.

    Groups that were begun stay as they are, since a checkpoint is of all seeds of a group.
    """
    if not job.about.learned or job.about.reference:
        return [(seed,) for seed in left]
    begun, rest = list[tuple[int, ...]](), [*left]
    for part in (tuple(left[start:end]) for start, end in itertools.combinations(range(len(left) + 1), 2)):
        if {*part} <= {*rest} and replace(job, seeds=part).checkpoint.exists():
            begun.append(part)
            rest = [seed for seed in rest if seed not in part]
    n = min(max(slots - len(begun), 1), len(rest))
    return begun + [tuple(part.tolist()) for part in np.array_split(rest, n)] if rest else begun


def run_jobs(jobs: list[Some], label: str, run: Run[Some], errors: Path | None = None) -> list[Exception]:
    """Run jobs side by side, longest first; returns the errors of those that failed.

    errors: a folder that keeps the tracebacks of code from outside that failed, until it does not.
    """
    if not jobs:
        return []
    bar, failed = Progress(sum(job.ticks for job in jobs), label), list[Exception]()

    def say(job: Some, outcome: str | Exception) -> None:
        name, file = f"{job.method}, {listed(job.seeds)}", errors and errors / f"{job.method}-{in_name(job.seeds)}.txt"
        if file is not None:
            file.unlink(missing_ok=True)
        if isinstance(outcome, Exception):
            failed.append(outcome)
            if isinstance(outcome, InputError):  # which ends a command with its line alone
                failed[-1] = InputError(f"{name}: {outcome}")
                failed[-1].__cause__ = outcome
            traces, outcome = getattr(outcome, "__notes__", ()), f"failed: {outcome}"
            if file is not None and traces:
                check_folder(file.parent)
                write_atomically(file, "\n".join(traces))
                outcome += f"; its traceback: {file}"
        bar.line(f"{name}: {outcome}")

    run(sorted(jobs, key=lambda job: -job.ticks), bar.update, say)
    bar.close()
    return failed


def listed(seeds: tuple[int, ...]) -> str:
    """seed 0, or seeds 0, 1, 2."""
    return f"seed {seeds[0]}" if len(seeds) == 1 else f"seeds {', '.join(map(str, seeds))}"
