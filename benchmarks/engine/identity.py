"""What a result depends on: kept as long as none of that has changed, made again as soon as some of it has.

Of the code, that is the task's own, the method's own, what these import, and what makes trials and measures them; a
change in another task's or method's file is none of its business.
"""

from __future__ import annotations

import ast
import hashlib
import json
import os
import platform
import subprocess
import sysconfig
from collections.abc import Iterable
from dataclasses import asdict
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from deconfounded import envs
from deconfounded.envs import outside
from deconfounded.experts import policy

if TYPE_CHECKING:
    from deconfounded.benchmarks.engine.pool import Job

ROOT = Path(__file__).resolve().parents[2]
LIBRARIES = ("mujoco", "dm_control", "gymnasium", "numpy", "torch", "stable-baselines3")
FRAMEWORK = tuple(
    ROOT / f"{name}.py"
    for name in (
        *("envs/task", "envs/batch", "envs/streams", "experts/demos", "experts/policy"),
        *("benchmarks/engine/context", "benchmarks/engine/jobs", "benchmarks/engine/measure"),
    )
)
GUESTS = tuple(ROOT / f"{name}.py" for name in ("benchmarks/engine/guest", "deconf/given", "deconf/wire"))
ASIDE = {ROOT / f"{name}.py" for name in ("envs/render", "envs/files", "envs/outside", "experts/saved")}  # no number's
AMOUNTS = {  # of a preset, by what a method uses
    "demonstrations": ("expert_trials", "fresh"),
    "exploration": ("explore_trials",),
    "queries": ("query_trials",),
    "environment": ("grid",),
}


def identity(job: Job) -> dict[str, Any]:
    """All that the results of a job's seeds depend on, but for the seed."""
    task, method, settings = envs.get(job.task), job.about, asdict(job.preset)
    amounts = [name for use in method.uses for name in AMOUNTS.get(use, ())]
    return {
        "kind": type(job).__name__,
        "task": task.name,
        "task_version": task.version,
        "method": job.method,
        "settings": {name: settings[name] for name in ("eval_trials", *amounts, *([method.part] * bool(method.part)))},
        "expert": expert(task, job.expert),
        "salt": job.salt,
        "versions": versions(),
        "code": code(task, method.module, method.reference),
    }


def demonstrations(task: envs.Task, source: str | None, trials: int, seed: int) -> str:
    """SHA-256 of all that a seed's demonstrations depend on."""
    known = [task.name, task.version, expert(task, source), trials, seed, versions(), code(task, "")]
    return hashlib.sha256(json.dumps(known).encode()).hexdigest()


def expert(task: envs.Task, source: str | None) -> str:
    """SHA-256 of the expert's weights, or of a callable's name and the files it is made of; or `closed form`."""
    if source is None or not policy.names_callable(source):
        return policy.fingerprint(task, source)
    file = outside.file(source)
    digest = hashlib.sha256(source.rpartition(":")[2].encode())
    for one in sorted(closure([file]) if file else (), key=_wherever):
        digest.update(one.read_bytes())
    return digest.hexdigest()


def versions() -> dict[str, str]:
    """Of Python, and of what is installed of the libraries that results depend on."""
    found = {"python": platform.python_version()}
    for name in LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def machine(device: str) -> str:
    """What it ran on."""
    return f"{platform.machine()}, {os.cpu_count()} cores, trained on {device}"


@cache
def commit() -> str | None:
    """Of this checkout, with a + if files differ from it; None outside of one."""
    try:
        run = lambda *what: subprocess.run(["git", *what], cwd=ROOT, capture_output=True, text=True, check=True)  # noqa: E731
        top = run("rev-parse", "--show-toplevel").stdout.strip()
        if Path(top).resolve() != ROOT:
            return None
        return run("rev-parse", "HEAD").stdout.strip() + ("+" if run("status", "--porcelain", "-uno").stdout else "")
    except (OSError, subprocess.CalledProcessError):
        return None


def code(task: envs.Task, module: str, reference: str = "") -> str:
    """SHA-256 of the sources and the MJCF that a result depends on. module: the method's, as path under the root."""
    own = [ROOT / f"{module}.py"] if module else []
    if reference and (file := outside.file(reference)):
        own.append(file)
    bases = [file for cls in type(task).__mro__ if (file := outside.source(cls)) and _counts(file)]
    digest = _digest({*FRAMEWORK, *closure([*own, *bases]), *(GUESTS if reference else ())})
    mjcf = task.home / f"{task.name}.xml"
    digest.update(mjcf.read_bytes() if mjcf.is_file() else b"")
    return digest.hexdigest()


def module(path: str) -> str:
    """SHA-256 of a module, given as path under the root, and of what it imports."""
    return _digest(closure([ROOT / f"{path}.py"])).hexdigest()


def _digest(files: Iterable[Path]) -> hashlib._Hash:
    """Of their names and contents, wherever they lie."""
    digest = hashlib.sha256()
    for file in sorted(files, key=_wherever):
        digest.update(file.name.encode() + b"\0" + file.read_bytes())
    return digest


def _wherever(file: Path) -> tuple[str, bytes]:
    """What to sort files by, so that it does not matter where they lie."""
    return file.name, file.read_bytes()


def _counts(file: Path) -> bool:
    """Ours, or somebody's own: not Python's or an installed library's."""
    return file.is_relative_to(ROOT) or not file.is_relative_to(Path(sysconfig.get_paths()["stdlib"]).resolve())


def closure(files: Iterable[Path]) -> set[Path]:
    """The files, and those of this package that they import, and so on; what only hands names on is left out."""
    found: set[Path] = set()
    left = [file.resolve() for file in files]
    while left:
        file = left.pop()
        if file not in found and file not in ASIDE:
            found.add(file)
            left += _imports(file)
    return found


@cache
def _imports(file: Path) -> tuple[Path, ...]:
    """The files of this package that a file imports; of one from outside, those beside it too."""
    found = []
    for node in ast.walk(ast.parse(file.read_text())):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        for name in names:
            top, *rest = name.split(".")
            ours = top == "deconfounded"
            path = (ROOT if ours else file.parent / top).joinpath(*rest).with_suffix(".py")
            if path.is_file() and path not in ASIDE and (ours or not file.is_relative_to(ROOT)):
                found.append(path)
    return tuple(found)
