"""The benchmark: expert demonstrations, exploration, imitation, deployment over resets, scores, a report.

    python benchmarks/run.py --task slippery_cartpole

Seeds of a method run side by side in one program, in as many groups as there are cores (one group on a GPU). Every
(method, seed) has a file, written when it is done, and --resume goes on from the files that are there.
"""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any

import numpy as np

import envs
from benchmarks import commands, report, score
from benchmarks.jobs import CLIPPED, BenchmarkJob
from benchmarks.methods import METHODS, REFERENCES
from benchmarks.pool import Finished
from benchmarks.presets import default_methods
from envs.console import run_command, write_atomically, write_json
from experts import policy


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
    latents = [lat.name for lat in task.latents]
    out.writerow(["method", "seed", "trial", *latents, "episode", "return", "score", "objective"])
    zero, one = (np.mean(results["methods"][name]["return"]) for name in REFERENCES)
    for _, seed, data in finished:
        for name in data["meta"]["agents"]:
            returns, objective = data[f"{name}/returns"], data[f"{name}/objective"]
            values = np.stack([returns, score.normalise(returns, zero, one), objective], -1).round(4)
            for trial, (theta, episodes) in enumerate(zip(data["theta"], values.tolist(), strict=True)):
                drawn = [f"{value:.6g}" for value in theta]
                for episode, row in enumerate(episodes):
                    out.writerow([name, seed, trial, *drawn, episode + 1, *row])
    return text.getvalue()


def main() -> None:
    """The experiment on one page."""
    parser = commands.parser(__doc__, "`all`, or some of those that --list names")
    parser.add_argument("--task", help="which task; see --list")
    parser.add_argument("--list", action="store_true", help="list tasks and methods, and stop")
    args = parser.parse_args()
    if args.list:
        for name in envs.names():
            task = envs.get(name)
            latents = (f"{lat.name} {lat.low:g}..{lat.high:g} {lat.unit}".strip() for lat in task.latents)
            print(f"{name}: {', '.join(latents)}\n    by default: {', '.join(default_methods(task))}")
        print(f"methods: {', '.join(METHODS)}")
        return
    if args.task is None:
        raise envs.InputError(f"--task is missing; there are {', '.join(envs.names())}")
    task = envs.get(args.task)
    wanted = {*commands.check(args, list(METHODS), default_methods(task)), *REFERENCES}
    envs.check_task(task)
    policy.load(task)
    folder = args.out or Path("results") / f"{task.name}-{args.preset}"
    finished, results = commands.run(BenchmarkJob, task, args, [name for name in METHODS if name in wanted], folder)
    results["methods"] = score.summarise(finished, task.episodes)
    write_json(folder / "results.json", results)
    write_atomically(folder / "rows.csv", rows(task, results, finished))
    pictures(task, results, finished, folder)
    write_atomically(folder / "report.html", report.page(results, folder))
    print(f"\n{task.name}: 0 = random actions, 1 = the expert that sees theta\n\n{score.table(results)}\n")
    print(f"{results['wall_s']:.0f} s -> {folder / 'report.html'}")


if __name__ == "__main__":
    run_command(main, commands.KEPT)
