"""A job: one method with some seeds, its files, its checkpoint, and its progress."""

import hashlib
import io
import json
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from deconfounded import __version__, envs
from deconfounded.benchmarks.engine import job_files, progress
from deconfounded.benchmarks.engine.catalogue import METHODS, Method, label
from deconfounded.benchmarks.engine.context import Context
from deconfounded.benchmarks.engine.identity import commit, identity, machine
from deconfounded.benchmarks.engine.presets import Preset
from deconfounded.benchmarks.engine.protocols import STANDARD
from deconfounded.benchmarks.engine.sources import last_edit
from deconfounded.deconf.core.monitor import Monitor, Training
from deconfounded.envs.support.files import write_atomically
from deconfounded.envs.support.outside import is_outside
from deconfounded.experts.agent import Agent

SAVE_EVERY_S = 60.0  # a checkpoint within a job
LAYOUT = 2  # of checkpoints: those of another one are not gone on with


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
    salts: tuple[str, str] | None = None  # of a guest's training and evaluation; None: drawn
    track: bool = False  # whether losses go to TensorBoard as they come
    walled: bool = True  # whether a guest has a process of its own
    protocol: str = STANDARD

    @property
    def about(self) -> Method:
        """The method's entry in the catalogue."""
        return self.guest or METHODS[self.method]

    def context(self, monitor: Monitor | None = None, salt: str = "") -> Context:
        """The data and environments of its seeds; salt: of its training, whose data is then kept nowhere."""
        folder = None if salt else self.folder
        return Context(envs.get(self.task), self.preset, self.seeds, monitor, folder, self.expert, salt, self.protocol)

    @property
    def from_outside(self) -> list[str]:
        """The references of its task and its method, where these are from outside."""
        return [name for name in (self.task, self.about.reference) if is_outside(name)]

    @abstractmethod
    def run(self) -> str:
        """Do it, in a worker process, and write the files; returns a line that says how it went."""

    def file(self, seed: int) -> Path:
        """An .npz file."""
        return self.folder / f"{self.method}-{seed}.npz"

    def agent_folders(self, deployment: str) -> list[Path]:
        """Folders of the agents of a deployment, one a seed."""
        folder = self.folder.parent / "agents"
        return [folder / f"{label(self.method, deployment)}-{seed}" for seed in self.seeds]

    @property
    def device(self) -> str:
        """What it trains on; the CPU if it trains nothing."""
        return self.preset.device if self.about.learned else "cpu"

    @property
    def checkpoint(self) -> Path:
        """What an interrupted job goes on from."""
        return self.folder / f".{self.method}-{job_files.in_name(self.seeds)}.pt"

    @property
    def ticks(self) -> int:
        """Of progress: in proportion to how long a job takes."""
        return 100 * self.about.cost * len(self.seeds)

    def save(self, seed: int, arrays: dict[str, Any], monitor: "JobMonitor", meta: dict[str, Any]) -> None:
        """Write the file of a seed, atomically; beside `meta` it holds the seed's budget, and when work went on."""
        buffer = io.BytesIO()
        i = self.seeds.index(seed)
        budget = {kind: each[i] for kind, each in monitor.budget.items()}
        cpu = round(monitor.cpu() / len(self.seeds), 2)
        if monitor.identity != identity(self):
            files = "its code, or a file beside it that the code names, where no run may write"
            raise envs.InputError(f"{self.method} is made of files that changed while it ran ({files}); run it again")
        version = commit()
        if monitor.last_edit != last_edit() and version:  # not the code of that commit alone
            version = f"{version.rstrip('+')}+"
        origin = {"identity": monitor.identity, "seed": seed, "commit": version, "machine": machine(monitor.device)}
        origin |= {"package": __version__, "reference": self.about.reference, "arrays": list(arrays)}
        whole = {**meta, **origin, "budget": budget, "spans": monitor.spans(), "cpu_s": cpu}
        text = json.dumps(whole)
        if why := job_files.broken({"meta": json.loads(text), **arrays}):
            raise envs.InputError(f"{self.method} with seed {seed} left no result that can be kept: {why}")
        np.savez_compressed(buffer, meta=np.array(text), **arrays)
        write_atomically(self.file(seed), buffer.getvalue())

    def load(self, seed: int) -> dict[str, Any] | None:
        """What was written of a seed: arrays, and `meta` decoded. None if there is nothing that fits: see `unfit`."""
        result, why = self.read(seed)
        return None if why else result

    def read(self, seed: int) -> tuple[dict[str, Any] | None, str]:
        """What the file of a seed holds, and why that is not this job's result, see `unfit`; empty if it is."""
        result = job_files.read(self.file(seed))
        return result, job_files.DAMAGED if result is None else self.unfit(seed, result)

    def unfit(self, seed: int, result: dict[str, Any]) -> str:
        """Why what a file holds is not this job's result of that seed, as it would come out today; empty if it is."""
        if why := job_files.broken(result):
            return why
        meta, expected = result["meta"], identity(self)
        made = meta["identity"]
        if differ := [key for key in {**expected, **made} if expected.get(key) != made.get(key)]:
            which = job_files.differing(differ[0], made.get(differ[0]), expected.get(differ[0]))
            return f"it differs in its {which}"
        if meta["seed"] != seed:
            return f"it is of seed {meta['seed']}"
        for key, value in result.items():
            if key.endswith("/returns") and len(value) != self.preset.eval_trials:
                return f"{key} has shape {value.shape}, for {self.preset.eval_trials} trials"
        return ""


class DemonstrationJob(Job):
    """Makes a seed's demonstrations once, before the methods that share them."""

    @property
    def about(self) -> Method:
        return Method(())

    @property
    def ticks(self) -> int:
        return 20

    def run(self) -> str:
        start = time.time()
        trials = self.context().demonstrations
        progress.tick(self.ticks)
        return f"{len(trials)} expert trials in {time.time() - start:.0f} s"


class JobMonitor(Monitor):
    """Tells the main process how far a job has come, and keeps a checkpoint of its training beside its files.

    share: of the whole job, that training takes. `kept` goes into the checkpoint, and comes back from it.
    """

    def __init__(self, job: Job, share: float) -> None:
        super().__init__()
        self.identity, self.last_edit = identity(job), last_edit()
        self.ticks, self.share, self.ticked = job.ticks, share, 0
        self.device = job.device
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
        if (now := int(self.ticks * share)) > self.ticked:
            settle = progress.skip if self.before and not self.ticked else progress.tick
            settle(now - self.ticked)
            self.ticked = now

    def update(self, done: int, total: int, losses: dict[str, float], agent: Agent | None = None) -> None:
        self._tell(self.share * done / total)

    def _made_of(self) -> str:
        """What a checkpoint goes with: the states of random generators are of a device."""
        return json.dumps([self.identity, self.device])

    def save(self, state: Callable[[], Training]) -> None:
        if time.monotonic() - self.saved >= SAVE_EVERY_S:
            buffer = io.BytesIO()
            known = {"kept": self.kept, "budget": self.budget, "spans": self.spans(), "cpu": self.cpu()}
            made_of = {"layout": LAYOUT, "identity": self._made_of()}
            torch.save({"training": state(), **made_of, **known}, buffer)
            write_atomically(self.file, hashlib.sha256(buffer.getvalue()).digest() + buffer.getvalue())
            self.saved = time.monotonic()

    def load(self) -> Training | None:
        try:
            content = self.file.read_bytes()
            if hashlib.sha256(content[32:]).digest() != content[:32]:
                return None
            state = torch.load(io.BytesIO(content[32:]), self.device, weights_only=True)
            if state["layout"] != LAYOUT or state["identity"] != self._made_of():
                print(f"{self.file.name} was begun with other code or amounts; training begins again")
                return None
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
