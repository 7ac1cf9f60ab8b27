"""The benchmark: expert demonstrations, exploration, imitation, deployment over resets, scores, a report.

    python benchmarks/run.py --task slippery_cartpole

Seeds of a method run side by side in one program, in as many groups as there are cores (one group on a GPU). Every
(method, seed) has a file, written when it is done, and --resume goes on from the files that are there.
"""

from __future__ import annotations

import argparse
import csv
import io
import os
import platform
import time
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch

import envs
from benchmarks import report, score
from benchmarks.jobs import CLIPPED, BenchmarkJob
from benchmarks.methods import METHODS, REFERENCES, Preset
from benchmarks.pool import Finished, prepare, run_all, worked
from benchmarks.presets import DEFAULT_METHODS, PRESETS, preset
from envs.console import Parser, run_command, write_atomically, write_json
from experts import policy

LIBRARIES = ("mujoco", "gymnasium", "numpy", "torch", "stable-baselines3")


def parse() -> argparse.Namespace:
    """The command line."""
    parser = Parser(__doc__)
    parser.add_argument("--task", help="which task; see --list")
    parser.add_argument("--list", action="store_true", help="list tasks and methods, and stop")
    parser.add_argument(
        "--preset", default="default", help="; ".join(f"{name}: {text}" for name, text in PRESETS.items())
    )
    parser.add_argument("--methods", nargs="+", metavar="NAME", help="`all`, or some of those that --list names")
    parser.add_argument("--seeds", type=int, metavar="N", help="how many seeds; default: the preset's")
    parser.add_argument("--device", default="cpu", help="torch device of training, e.g. cuda")
    parser.add_argument("--out", type=Path, help="output folder; default: results/<task>-<preset>")
    parser.add_argument("--resume", action="store_true", help="keep what is finished in the output folder, and go on")
    return parser.parse_args()


def check_device(device: str) -> None:
    """Raises InputError if torch cannot use it here."""
    try:
        torch.zeros(1, device=device).item()
    except (RuntimeError, AssertionError, NotImplementedError):
        raise envs.InputError(f"--device {device} cannot be used here; cpu always can") from None


def about(task: envs.Task, name: str, settings: Preset) -> dict[str, Any]:
    """What a run must agree in for its jobs to be kept."""
    return {
        "task": task.name,
        "task_version": task.version,
        "preset": name,
        "settings": asdict(settings),
        "versions": {"python": platform.python_version(), **{name: version(name) for name in LIBRARIES}},
        "expert": policy.fingerprint(task),
    }


def check(args: argparse.Namespace) -> tuple[envs.Task, list[str]]:
    """The task and methods asked for. Raises InputError for anything that cannot be run."""
    if args.task is None:
        raise envs.InputError(f"--task is missing; there are {', '.join(envs.names())}")
    task = envs.get(args.task)
    if args.preset not in PRESETS:
        raise envs.closest("preset", args.preset, list(PRESETS))
    methods = list(METHODS) if args.methods == ["all"] else args.methods or list(DEFAULT_METHODS)
    for name in methods:
        if name not in METHODS:
            raise envs.closest("method", name, list(METHODS))
    if args.seeds is not None and args.seeds < 1:
        raise envs.InputError(f"--seeds was {args.seeds}; it must be at least 1")
    check_device(args.device)
    policy.load(task)
    return task, [name for name in METHODS if name in {*methods, *REFERENCES}]


def pictures(task: envs.Task, results: dict[str, Any], finished: Finished, folder: Path) -> None:
    """Curves, and a video where a GL works."""
    report.adaptation(results, folder / "adaptation.png")
    curves: dict[str, list[dict[str, Any]]] = {}
    clips: dict[str, dict[str, Any]] = {}
    for method, _, data in finished:
        curve = data["meta"]["curve"]  # of all seeds of a group
        if curve and curve not in curves.setdefault(method, []):
            curves[method].append(curve)
        for name in CLIPPED:
            if f"{name}/state" in data:
                theta = data["theta"][int(data[f"{name}/trial"])]
                clips[name] = {"state": data[f"{name}/state"], "action": data[f"{name}/action"], "theta": theta}
    report.learning(curves, task.name, folder / "learning.png")
    try:
        report.video(task, {name: clips[name] for name in CLIPPED if name in clips}, folder / "video.mp4")
    except (envs.InputError, OSError, RuntimeError) as error:  # no GL, or no encoder: the run is good all the same
        print(f"no video: {error}")


def rows(task: envs.Task, results: dict[str, Any], finished: Finished) -> str:
    """rows.csv: one row per method, seed, latent (trial) and episode."""
    text = io.StringIO()
    out = csv.writer(text, lineterminator="\n")
    out.writerow(["method", "seed", "trial", *(lat.name for lat in task.latents), "episode", "return", "score"])
    zero, one = (np.mean(results["methods"][name]["return"]) for name in REFERENCES)
    for _, seed, data in finished:
        for name in data["meta"]["agents"]:
            for trial, (theta, returns) in enumerate(zip(data["theta"], data[f"{name}/returns"], strict=True)):
                latents = [f"{value:.6g}" for value in theta]
                for episode, value in enumerate(returns):
                    scored = round(float(score.normalise(value, zero, one)), 4)
                    out.writerow([name, seed, trial, *latents, episode + 1, round(float(value), 4), scored])
    return text.getvalue()


def main() -> None:
    """The experiment on one page."""
    args = parse()
    if args.list:
        for name in envs.names():
            task = envs.get(name)
            latents = (f"{lat.name} {lat.low:g}..{lat.high:g} {lat.unit}".strip() for lat in task.latents)
            print(f"{name}: {', '.join(latents)}")
        print(f"methods: {', '.join(METHODS)}\nby default: {', '.join(DEFAULT_METHODS)}")
        return
    task, methods = check(args)
    settings = preset(args.preset, task, args.device)
    seeds = args.seeds or settings.seeds
    folder = args.out or Path("results") / f"{task.name}-{args.preset}"
    described = about(task, args.preset, settings)
    prepare(folder, described, args.resume)
    start = time.time()
    label = f"{task.name}, {args.preset}"
    finished, resumed = run_all(BenchmarkJob, task.name, settings, methods, seeds, args.device, folder / "jobs", label)
    results = {
        "task": task.name,
        "task_version": task.version,
        "preset": args.preset,
        "seeds": list(range(seeds)),
        "eval_trials": settings.eval_trials,
        "versions": described["versions"],
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, trained on {args.device}",
        "wall_s": round(worked(start, finished), 1),
        "resumed": resumed,
        "methods": score.summarise(finished, task.episodes),
    }
    write_json(folder / "results.json", results)
    write_atomically(folder / "rows.csv", rows(task, results, finished))
    pictures(task, results, finished, folder)
    write_atomically(folder / "report.html", report.page(results, folder))
    print(f"\n{task.name}: 0 = random actions, 1 = the expert that sees theta\n\n{score.table(results)}\n")
    print(f"{results['wall_s']:.0f} s -> {folder / 'report.html'}")


if __name__ == "__main__":
    run_command(main, "what was finished is kept, and --resume goes on")
