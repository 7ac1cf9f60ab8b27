"""What a result depends on, by versions: it is kept as long as these stay, and made again when one of them changes.

A task, a method and an expert each have a version, raised by hand when their numbers change; `PROTOCOL` is the version
of what all results share. The tests recompute a fingerprint of each (tests/fingerprints.py), so that a change of
behaviour without a new version is noticed. The text of this package is in no identity: comments, renames and moves
change nothing. What is from outside has no version: theirs is the text of their files (`sources.py`).
"""

import hashlib
import json
import os
import platform
import subprocess
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from deconfounded import envs
from deconfounded.benchmarks.engine import sources
from deconfounded.benchmarks.engine.protocols import STANDARD
from deconfounded.envs.support.origin import ROOT
from deconfounded.experts import policy

if TYPE_CHECKING:
    from deconfounded.benchmarks.engine.jobs import Job

PROTOCOL = 1  # of seeding, roll-outs, what methods are handed, and what is measured of an agent
LIBRARIES = ("dm_control", "gymnasium", "numpy", "scipy", "scikit-learn", "torch", "stable-baselines3", "sb3-contrib")
AMOUNTS = {  # of a preset, by what a method uses
    "demonstrations": ("expert_trials", "fresh"),
    "exploration": ("explore_trials",),
    "queries": ("query_trials",),
}


def identity(job: "Job") -> dict[str, Any]:
    """All that the results of a job's seeds depend on, but for the seed, as json holds it.

    `outside` is empty where all is ours.
    """
    task, method, preset = envs.get(job.task), job.about, job.preset
    amounts = ["eval_trials", *(name for use in method.uses for name in AMOUNTS.get(use, ()))]
    settings = {name: getattr(preset, name) for name in amounts}
    texts = {"task": sources.of_task(task)}
    if method.reference:
        texts["method"] = sources.of_reference(method.reference)
    config = preset.configs.get(job.method)
    if config is not None:  # without the device, which a record's `machine` names
        config = {name: value for name, value in config.items() if name != "device"}
    made_of = {
        "kind": type(job).__name__,
        "protocol": PROTOCOL,
        "task": task.name,
        "task_version": task.version,
        "method": job.method,
        "method_version": method.version,
        "settings": settings | ({"config": config} if config is not None else {}),
        **expert(task, job.expert),
        "salt": job.salt,
        "versions": versions(),
        "outside": {kind: sources.digest(files) for kind, files in texts.items() if files},
        **named(job.protocol),
    }
    return json.loads(json.dumps(made_of))


def named(protocol: str) -> dict[str, str]:
    """What records and folders say of a protocol: nothing of the standard one. `protocol` is the version of all."""
    return {} if protocol == STANDARD else {"protocol_name": protocol}


def demonstrations(task: envs.Task, source: str | None, trials: int, seed: int, protocol: str = STANDARD) -> str:
    """SHA-256 of all that a seed's demonstrations depend on."""
    text = sources.digest(sources.of_task(task))
    parts = [PROTOCOL, task.name, task.version, text, expert(task, source), trials, seed, versions()]
    parts += named(protocol).values()
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def expert(task: envs.Task, source: str | None) -> dict[str, Any]:
    """`expert`: SHA-256 of its weights, of a callable's name and files, or `closed form`; and `expert_version`."""
    if source is None or not policy.names_callable(source):
        return {"expert": policy.fingerprint(task, source), "expert_version": policy.version(task, source)}
    name = source.rpartition(":")[2]
    return {"expert": sources.digest(sources.of_reference(source), name), "expert_version": 0}


def versions() -> dict[str, str]:
    """Of Python, of the MuJoCo that steps (since 4, a package's version need not be its), and of other libraries."""
    import mujoco  # not before envs, which sets MUJOCO_GL aside

    installed = {"python": platform.python_version(), "mujoco": mujoco.__version__}
    return installed | {name: number for name in LIBRARIES if (number := _version(name))}


@cache
def _version(name: str) -> str | None:
    """Of a package that is installed; None if it is not."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def machine(device: str) -> str:
    """What it runs on: the CPU and its vector extensions, on which bits depend, BLAS and threads."""
    import torch

    blas = np.show_config(mode="dicts")["Build Dependencies"]["blas"]["name"]  # type: ignore[index]
    vectors, threads = torch.backends.cpu.get_cpu_capability(), torch.get_num_threads()
    mkl = "MKL" if torch.backends.mkl.is_available() else "no MKL"
    cpu = f"{_cpu()}, {vectors}, {os.cpu_count()} cores, torch threads: {threads}"
    return f"{cpu}; numpy with {blas}, torch with {mkl}; trained on {device}"


@cache
def _cpu() -> str:
    """The name of its model, or of its kind where the system does not say."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
        return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


@cache
def commit() -> str | None:
    """Of this checkout, with a + if files differ from it; None outside of one.

    Changed records, which `deconf table` makes one after another, are no difference: nothing is made of them but pages.
    """

    def run(*what: str) -> str:
        return os.fsdecode(subprocess.run(["git", *what], cwd=ROOT, capture_output=True, check=True).stdout)

    try:
        top = run("rev-parse", "--show-toplevel").strip()
        if Path(top).resolve() != ROOT:
            return None
        changed = run("status", "--porcelain", "-uno", "--", ".", ":(exclude)docs/records")
        return run("rev-parse", "HEAD").strip() + ("+" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return None
