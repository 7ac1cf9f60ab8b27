"""A job in a worker of a cluster, in a folder of its own: what it needs is sent there, what it leaves is sent back."""

import contextlib
import os
import re
import secrets
import shutil
import socket
import tempfile
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from ray.exceptions import RayError

from deconfounded import envs
from deconfounded.benchmarks.engine import identity, progress, sources
from deconfounded.benchmarks.engine.jobs import Job
from deconfounded.benchmarks.engine.scheduler import run_job
from deconfounded.envs.support import outside
from deconfounded.envs.support.files import write_atomically
from deconfounded.experts import policy

EVERY_S = 1.0  # it tells how far it has come
AS_THEY_COME = ("jobs/.*.pt", "tensorboard/*/*")  # of a run's folder; all else comes back when the job is done

Files = dict[str, bytes]
"""By name in the run's folder."""


class Unlike(envs.InputError):
    """What is installed on a worker's machine would give other results than what is installed here."""


def work(
    job: Job, expected: dict[str, Any], number: int, mailbox: Any, names: list[str], *contents: bytes
) -> tuple[str, Files]:
    """Do a job in a folder of its own; returns its line, and the files it left. Raises Unlike before it has begun."""
    with scratch() as folder:
        for name, content in zip(names, contents, strict=True):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            write_atomically(folder / name, content)
        os.environ[outside.SENT] = str(folder / "outside")
        job = replace(job, folder=folder / "jobs")
        if job.expert and not policy.names_callable(job.expert):
            job = replace(job, expert=str(outside.here(Path(job.expert))))
        check(expected, {**identity.identity(job), "code": sources.package()})
        courier = Courier(folder, number, mailbox)
        progress.tell(courier)
        try:
            line = run_job(job)
        finally:
            courier.over.set()
        left = {str(file.relative_to(folder)): file for file in folder.rglob("*") if file.is_file()}
        new = {name for name in left if name not in names and not name.startswith("outside/")}
        return line, {name: left[name].read_bytes() for name in new}


def check(expected: dict[str, Any], here: dict[str, Any]) -> None:
    """Raises Unlike if a job's result would not be here what it would be where the command runs."""
    wanted, found = ({**one, **one["versions"]} for one in (expected, here))
    for key in sorted(set(wanted) | set(found)):
        if key != "versions" and wanted.get(key) != found.get(key):
            what = f"other {key}" if key in expected else f"{key} {found.get(key, 'missing')}, not {wanted.get(key)}"
            raise Unlike(f"machine {socket.gethostname()} has {what}; install the same of all on every machine")


PLACE = Path(tempfile.gettempdir()) / f"deconfounded-{os.getpid()}-{secrets.token_hex(8)}"
"""One for all jobs of this process, so that a file from outside stays the same module."""


@contextlib.contextmanager
def scratch() -> Iterator[Path]:
    """A run's folder for one job; what processes that were killed left of theirs is removed too."""
    for folder in PLACE.parent.glob("deconfounded-*"):
        owner = re.fullmatch(r"deconfounded-(\d+)-[0-9a-f]{16}", folder.name)
        if owner and not running(int(owner[1])):
            shutil.rmtree(folder, ignore_errors=True)
    PLACE.mkdir(mode=0o700)
    (PLACE / "jobs").mkdir()
    try:
        yield PLACE
    finally:
        shutil.rmtree(PLACE, ignore_errors=True)


def running(process: int) -> bool:
    """Whether there is a process of that number."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        pass
    return True


class Courier:
    """Sends ticks, and what a job leaves that is of use before it is done, to the command's machine."""

    def __init__(self, folder: Path, number: int, mailbox: Any) -> None:
        self.folder, self.number, self.mailbox = folder, number, mailbox
        self.ticks, self.sent, self.over = 0, 0, threading.Event()
        self.seen: dict[Path, tuple[int, int]] = {}
        threading.Thread(target=self._go, daemon=True).start()

    def put(self, ticks: int) -> None:
        self.ticks += max(ticks, 0)  # what is not to be done is settled when the job has ended

    def _go(self) -> None:
        while not self.over.wait(EVERY_S):
            with contextlib.suppress(OSError, RayError):  # a file that is gone again; a cluster that ends
                self._send()

    def _send(self) -> None:
        new: Files = {}
        for file in [file for pattern in AS_THEY_COME for file in self.folder.glob(pattern)]:
            stamp = (file.stat().st_mtime_ns, file.stat().st_size)
            if self.seen.get(file) != stamp:
                new[str(file.relative_to(self.folder))], self.seen[file] = file.read_bytes(), stamp
        if new or self.ticks > self.sent:
            self.sent = self.ticks
            self.mailbox.put.remote(self.number, self.sent, new)
