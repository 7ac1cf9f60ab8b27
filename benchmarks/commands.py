"""What run.py and paper.py share: their arguments, the checks of these, and what a run says of itself."""

from __future__ import annotations

import argparse
import hashlib
import os
import platform
import time
from collections.abc import Sequence
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from deconfounded import envs
from deconfounded.benchmarks.console import Parser
from deconfounded.benchmarks.engine import catalogue
from deconfounded.benchmarks.engine.catalogue import METHODS, PRESETS
from deconfounded.envs import outside
from deconfounded.experts import policy

if TYPE_CHECKING:  # torch takes seconds: what only checks its arguments goes without
    from deconfounded.benchmarks.engine.methods import Preset
    from deconfounded.benchmarks.engine.pool import Finished, Job

LIBRARIES = ("mujoco", "dm_control", "gymnasium", "numpy", "torch", "stable-baselines3")
KEPT = "what was finished is kept, and --resume goes on"


def parser(description: str | None, methods: str, seeds: int | None = None) -> Parser:
    """Arguments of a run; methods: help on what they may be; seeds: how many by default, if not the preset's."""
    made = Parser(description)
    made.add_argument(
        "--preset", default="default", help="; ".join(f"{name}: {text}" for name, text in PRESETS.items())
    )
    made.add_argument("--methods", nargs="+", metavar="NAME", help=methods)
    made.add_argument("--set", nargs="+", metavar="KEY=VALUE", default=[], help="amounts, e.g. naive.updates=500")
    made.add_argument("--seeds", type=int, default=seeds, metavar="N", help=f"default: {seeds or 'the preset'}")
    made.add_argument("--device", default="cpu", help="torch device of training, e.g. cuda")
    made.add_argument("--out", type=Path, help="output folder; default: a folder under results/")
    made.add_argument("--resume", action="store_true", help="keep what is finished in the output folder, and go on")
    return made


def check(args: argparse.Namespace, known: Sequence[str], default: Sequence[str], guests: bool = False) -> list[str]:
    """The methods asked for; guests: from outside too. Raises InputError for anything that cannot be run."""
    methods = list(known) if args.methods == ["all"] else args.methods or list(default)
    if guests:
        methods = [catalogue.add(name) if outside.is_outside(name) else name for name in methods]
        known = [*known, *(name for name, method in METHODS.items() if method.reference)]
    catalogue.check(args.preset, methods, args.seeds, known)
    check_device(args.device)
    return list(dict.fromkeys(methods))


def check_device(device: str) -> None:
    """Raises InputError for a torch device that cannot be used."""
    if device == "cpu":
        return
    import torch

    try:
        torch.zeros(1, device=device).item()
    except (RuntimeError, AssertionError, NotImplementedError):
        raise envs.InputError(f"--device {device} cannot be used here; cpu always can") from None


def about(task: envs.Task, name: str, settings: Preset, expert: str | None = None, salt: str = "") -> dict[str, Any]:
    """What a run must agree in for its jobs to be kept."""
    return {
        "task": task.name,
        "task_version": task.version,
        "preset": name,
        "settings": asdict(settings),
        "versions": {"python": platform.python_version(), **{name: version(name) for name in LIBRARIES}},
        "expert": policy.fingerprint(task, expert),
        "salt": salt,
        "code": code(task),
    }


def code(task: envs.Task) -> str:
    """SHA-256 of the source and the MJCF that a run's numbers depend on, those of a task or method from outside too."""
    root, digest = Path(__file__).resolve().parents[1], hashlib.sha256()
    sources = (file for name in ("envs", "experts", "deconf") for file in sorted((root / name).glob("*.py")))
    own = (root / "benchmarks" / f"{name}.py" for name in ("engine/methods", "engine/jobs", "engine/measure", "paper"))
    named = [task.reference, *(method.reference for method in METHODS.values())]
    files = (outside.source(outside.find("code", name)) for name in named if outside.is_outside(name))
    for file in (*sources, *own, task.home / f"{task.name}.xml", *files):
        digest.update(file.read_bytes() if file and file.exists() else b"")
    return digest.hexdigest()


def run(
    kind: type[Job], task: envs.Task, args: argparse.Namespace, methods: Sequence[str], folder: Path
) -> tuple[Finished, dict[str, Any]]:
    """Run what is not finished in the folder; returns all that is, and the head of its results.json."""
    from deconfounded.benchmarks.engine.pool import prepare, run_all, worked
    from deconfounded.benchmarks.engine.presets import changed, preset

    settings = changed(preset(args.preset, task, args.device), args.set)
    seeds = args.seeds or settings.seeds
    expert, salt = getattr(args, "expert", None), getattr(args, "salt", "")
    described = about(task, args.preset, settings, expert, salt)
    prepare(folder, described, args.resume)
    start, label = time.time(), f"{task.name}, {args.preset}"
    jobs = [
        kind(task.reference, settings, method, tuple(range(seeds)), folder / "jobs", expert, salt, guest)
        for method in methods
        for guest in [METHODS[method] if METHODS[method].reference else None]
    ]
    finished, resumed = run_all(jobs, args.device, label)
    return finished, {
        "task": task.name,
        "task_version": task.version,
        "preset": args.preset,
        **({"set": args.set} if args.set else {}),
        **({"expert": expert} if expert else {}),
        **({"salt": salt} if salt else {}),
        "seeds": list(range(seeds)),
        "eval_trials": settings.eval_trials,
        "versions": described["versions"],
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, trained on {args.device}",
        "wall_s": round(worked(start, finished), 1),
        "resumed": resumed,
    }
