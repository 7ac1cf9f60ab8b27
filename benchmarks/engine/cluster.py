"""Jobs on a Ray cluster. Files go to a worker and come back by value: machines share nothing but what is installed."""

import itertools
import os
import shutil
import signal
import socket
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import ray
from ray.exceptions import RayError, RayTaskError
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from deconfounded import envs
from deconfounded.benchmarks.engine import identity, sources
from deconfounded.benchmarks.engine.context import demonstrations_file
from deconfounded.benchmarks.engine.jobs import Job
from deconfounded.benchmarks.engine.scheduler import Engine
from deconfounded.benchmarks.engine.worker import Files, Unlike, work
from deconfounded.envs.support import outside
from deconfounded.envs.support.errors import error_line
from deconfounded.envs.support.files import write_atomically
from deconfounded.envs.support.origin import is_ours
from deconfounded.experts import policy

TRIES = 5  # of a job, whose worker was lost each time


@dataclass
class Attempt:
    """A job at work somewhere. tries: how often it was started; ticks: of its progress, counted so far."""

    job: Job
    tries: int
    ticks: int = 0


class Cluster(Engine):
    """Ray tasks, one core or one GPU each; their files are written here."""

    def __init__(self, address: str) -> None:
        connect(address)
        here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)
        options: dict[str, Any] = {"num_cpus": 0, "max_restarts": -1, "max_task_retries": -1}
        self.mailbox = ray.remote(Mailbox).options(**options, scheduling_strategy=here).remote()
        self.numbers = itertools.count()

    def __exit__(self, *error: object) -> None:
        ray.shutdown()  # which ends this command's workers, wherever they are

    def slots(self, device: str) -> int:
        kind = "CPU" if device == "cpu" else "GPU"
        there = int(ray.cluster_resources().get(kind, 0))
        if not there:
            raise envs.InputError(f"the cluster has no {kind}; give another --device, or start Ray with --num-cpus")
        return there

    def run(self, jobs: list[Job], tick: Callable[[int], None], say: Callable[[Job, str | Exception], None]) -> None:
        running: dict[int, Attempt] = {}
        tasks: dict[Any, int] = {}  # each one's number
        sent: dict[Path, Any] = {}

        def start(attempt: Attempt) -> None:
            job, number = attempt.job, next(self.numbers)
            files = given(job)
            for file in files.values():
                if file not in sent or file == job.checkpoint:
                    sent[file] = ray.put(file.read_bytes())
            gpus = int(job.device != "cpu")
            task = ray.remote(work).options(num_cpus=1, num_gpus=gpus, max_retries=0, scheduling_strategy="SPREAD")
            portable = replace(job, expert=absolute(job.expert))
            expected = {**identity.identity(job), "code": sources.package()}
            contents = (sent[file] for file in files.values())
            running[number] = attempt
            tasks[task.remote(portable, expected, number, self.mailbox, list(files), *contents)] = number

        def ended(task: Any) -> None:
            attempt = running.pop(tasks.pop(task))
            job = attempt.job
            try:
                outcome, files = ray.get(task)
            except RayTaskError as error:
                if not isinstance(error.cause, envs.InputError) or isinstance(error.cause, Unlike):
                    raise envs.InputError(failure(error)) from None
                say(job, error.cause)
            except RayError as error:
                if attempt.tries == TRIES:
                    lost = f"its worker was lost {TRIES} times ({type(error).__name__}; out of memory?)"
                    say(job, envs.InputError(f"{job.method}: {lost}; --resume goes on"))
                else:
                    say(job, "its worker was lost; it is tried again")
                    start(Attempt(job, attempt.tries + 1, attempt.ticks))
            else:
                for way in ("", *job.about.deployments):
                    for folder in job.agent_folders(way):
                        shutil.rmtree(folder, ignore_errors=True)  # of results that are no longer there
                keep(job, files)
                job.checkpoint.unlink(missing_ok=True)
                tick(job.ticks - attempt.ticks)
                say(job, outcome)

        for job in jobs:
            start(Attempt(job, 1))
        try:
            while tasks:
                done, _ = ray.wait(list(tasks), num_returns=len(tasks), timeout=0.5)
                for number, ticks, files in ray.get(self.mailbox.take.remote()):
                    if (attempt := running.get(number)) is not None:  # and is not a lost worker's late one
                        tick(max(ticks - attempt.ticks, 0))
                        attempt.ticks = max(ticks, attempt.ticks)
                        keep(attempt.job, files)
                for task in done:
                    ended(task)
        except BaseException:
            for task in tasks:  # asked, jobs clean up; in the end none has a choice
                ray.cancel(task)
            if tasks:
                ray.wait(list(tasks), num_returns=len(tasks), timeout=2)
            raise


class Mailbox:
    """Between workers and the command, on its machine: what they tell while they are at work."""

    def __init__(self) -> None:
        self.mail: list[tuple[int, int, Files]] = []

    def put(self, number: int, ticks: int, files: Files) -> None:
        """Of an attempt: its ticks so far, and what it left since the last time."""
        self.mail.append((number, ticks, files))

    def take(self) -> list[tuple[int, int, Files]]:
        mail, self.mail = self.mail, []
        return mail


def connect(address: str) -> None:
    """Join a cluster that is there. Raises InputError, in one line, if that cannot be."""
    if address == "auto":
        address = os.environ.get("RAY_ADDRESS", address)
    if address != "auto":
        host, _, port = address.removeprefix("ray://").rpartition(":")
        if not host or not port.isdecimal():
            raise envs.InputError(f"--cluster was {address}; it must be auto, or HOST:PORT of a Ray cluster")
        try:  # Ray itself would try for minutes
            socket.create_connection((host.strip("[]"), int(port)), 5).close()
        except (OSError, OverflowError) as error:
            raise envs.InputError(f"--cluster {address}: nobody answers there ({error}); is Ray started?") from None
    heard = signal.getsignal(signal.SIGTERM)
    try:
        ray.init(address, log_to_driver=False, logging_level="ERROR")
    except Exception as error:  # Ray tells in many ways
        remedy = "; `ray start --head` starts one" * (address == "auto")
        raise envs.InputError(f"--cluster {address}: {error_line(error)}{remedy}") from None
    finally:
        signal.signal(signal.SIGTERM, heard)  # Ray has one of its own


def given(job: Job) -> dict[str, Path]:
    """The files that a job needs: as they are called over there, and where they are here."""
    seeds = job.seeds if "demonstrations" in job.about.uses else ()
    inside = [job.checkpoint, *(demonstrations_file(job.folder, seed) for seed in seeds)]
    files = {f"jobs/{file.name}": file for file in inside}
    files |= {str(Path("outside", *file.parts[1:])): file for file in from_outside(job)}
    return {name: file for name, file in files.items() if file.is_file()}


def from_outside(job: Job) -> set[Path]:
    """The files of a task, method and expert from outside, with what these import and name; weights and their card."""
    task, named = envs.get(job.task), [job.about.reference]
    weights = [policy.path(task)] if sources.of_task(task) else []
    if job.expert and policy.names_callable(job.expert):
        named.append(job.expert)
    elif job.expert:
        weights.append(Path(job.expert).resolve())
    files = sources.of_task(task).union(*(sources.of_reference(one) for one in named if ".py:" in one))
    files |= {file.with_suffix(suffix) for file in weights for suffix in (file.suffix, ".json")}
    return {file for file in files if not is_ours(file)}


def absolute(expert: str | None) -> str | None:
    """An expert's source, wherever it is read from."""
    return expert and (outside.absolute(expert) if policy.names_callable(expert) else str(Path(expert).resolve()))


def keep(job: Job, files: Files) -> None:
    """Write what came back where the job would have written it; a seed's own file, which says it is done, last."""
    for name in sorted(files, key=lambda name: name.startswith("jobs/")):
        file = job.folder.parent / name
        file.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(file, files[name])


def failure(error: RayTaskError) -> str:
    """What went wrong over there, in one line."""
    if isinstance(error.cause, Unlike):
        return str(error.cause)
    lines = f"{type(error.cause).__name__}\n{error.cause}".strip().splitlines()
    return f"a job failed on {error.ip}: {lines[-1].strip()}"
