"""The benchmark: expert demonstrations, exploration, imitation, deployment over resets, scores, a report.

    python benchmarks/run.py --task slippery_cartpole

Seeds of a method run side by side in one program, in as many groups as there are cores (one group on a GPU). Every
(method, seed) has a file, written when it is done, and --resume goes on from the files that are there.
"""

from __future__ import annotations

import argparse
import csv
import io
import json
import multiprocessing
import os
import platform
import signal
import time
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch

import envs
from benchmarks import report, score
from benchmarks.jobs import CLIPPED, Job, load_job, run_job, start_worker
from benchmarks.methods import LEARNED, METHODS, REFERENCES, Preset
from benchmarks.presets import DEFAULT_METHODS, PRESETS, preset
from envs.console import Parser, Progress, check_folder, run_command, write_atomically, write_json
from envs.physics import cores
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
    try:
        torch.zeros(1, device=args.device).item()
    except (RuntimeError, AssertionError, NotImplementedError):
        raise envs.InputError(f"--device {args.device} cannot be used here; cpu always can") from None
    policy.load(task)
    return task, [name for name in METHODS if name in {*methods, *REFERENCES}]


def prepare(folder: Path, settings: dict[str, Any], resume: bool) -> None:
    """Make the output folder, or see that what it holds can be gone on with."""
    check_folder(folder)
    check_folder(folder / "jobs")
    file = folder / "settings.json"
    if not file.exists():
        if any((folder / "jobs").iterdir()):
            raise envs.InputError(f"{folder} holds jobs, but not their settings.json; give another --out")
        write_json(file, settings)
    elif not resume:
        raise envs.InputError(f"{folder} holds a run already; give --resume to go on with it, or another --out")
    else:
        try:
            before = json.loads(file.read_text())
        except ValueError:
            raise envs.InputError(f"{file} is damaged; give another --out") from None
        if before != json.loads(json.dumps(settings)):
            raise envs.InputError(f"{folder} holds a run with other settings; give another --out")


Finished = list[tuple[str, int, dict[str, Any]]]
"""Method, seed, and what its job wrote."""


def _listed(seeds: tuple[int, ...]) -> str:
    return f"seed {seeds[0]}" if len(seeds) == 1 else f"seeds {', '.join(map(str, seeds))}"


def make_jobs(
    task: envs.Task, settings: Preset, methods: list[str], seeds: int, device: str, folder: Path
) -> list[Job]:
    """What is left to do: of each method the seeds without a file, in groups; references have nothing to share."""
    jobs = []
    for method in methods:
        every = Job(task.name, settings, method, tuple(range(seeds)), folder)
        left = [seed for seed in every.seeds if load_job(every, seed) is None]
        groups = len(left) if method not in LEARNED else min(cores(), len(left)) if device == "cpu" else 1
        jobs += [replace(every, seeds=tuple(map(int, part))) for part in np.array_split(left, groups) if len(part)]
    return jobs


def run_jobs(jobs: list[Job], label: str) -> None:
    """Run jobs side by side, one core each, longest first."""
    if not jobs:
        return
    context = multiprocessing.get_context("spawn")
    workers = min(cores(), len(jobs))
    os.environ["OMP_NUM_THREADS"] = "1"  # the networks are small: jobs side by side beat threads within one
    progress = Progress(sum(job.ticks for job in jobs), label)
    ticks = context.Queue()
    with ProcessPoolExecutor(workers, context, initializer=start_worker, initargs=(ticks,)) as pool:
        heard = signal.signal(signal.SIGINT, signal.SIG_IGN)  # for workers, which are made now, to inherit
        futures = {pool.submit(run_job, job): job for job in jobs}
        signal.signal(signal.SIGINT, heard)
        try:
            waiting = set(futures)
            while waiting:
                while not ticks.empty():
                    progress.update(ticks.get())
                for future in [f for f in waiting if f.done()]:
                    waiting.remove(future)
                    job = futures[future]
                    progress.line(f"{job.method}, {_listed(job.seeds)}: {future.result()}")
                time.sleep(0.1)
        except BrokenProcessPool:
            raise envs.InputError("a worker process was killed (out of memory?); --resume goes on") from None
        except BaseException:
            for process in multiprocessing.active_children():
                process.terminate()
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    progress.close()


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


def worked(spans: list[tuple[float, float]]) -> float:
    """Seconds covered by spans of time: those of this command, and of the jobs that an earlier one finished."""
    total, until = 0.0, -np.inf
    for start, end in sorted(spans):
        total += max(0.0, end - max(start, until))
        until = max(until, end)
    return total


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
    about = {
        "task": task.name,
        "task_version": task.version,
        "preset": args.preset,
        "settings": asdict(settings),
        "versions": {"python": platform.python_version(), **{name: version(name) for name in LIBRARIES}},
        "expert": policy.fingerprint(task),
    }
    prepare(folder, about, args.resume)
    start = time.time()
    left = make_jobs(task, settings, methods, seeds, args.device, folder / "jobs")
    run_jobs(left, f"{task.name}, {args.preset}")
    finished = []
    for method in methods:
        every = Job(task.name, settings, method, tuple(range(seeds)), folder / "jobs")
        finished += [(method, seed, data) for seed in every.seeds if (data := load_job(every, seed)) is not None]
    results = {
        "task": task.name,
        "task_version": task.version,
        "preset": args.preset,
        "seeds": list(range(seeds)),
        "eval_trials": settings.eval_trials,
        "versions": about["versions"],
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, trained on {args.device}",
        "wall_s": round(worked([(start, time.time()), *(tuple(data["meta"]["span"]) for *_, data in finished)]), 1),
        "resumed": len(finished) - sum(len(job.seeds) for job in left),
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
