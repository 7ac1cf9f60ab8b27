"""Certificates: which of two is kept, and a picture of stakes, exact policies and evidence."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from deconfounded import envs
from deconfounded.benchmarks.engine import sources
from deconfounded.benchmarks.output.pictures import panels


def check_kept(file: Path, task: envs.Task, trials: int) -> None:
    """Raise InputError if the file has a certificate of the same task, of more trials than are asked for."""
    files = sources.of_task(task)
    today = (task.version, sources.digest(files) if files else None)
    try:
        kept = json.loads(file.read_bytes())
        more = (kept["task_version"], kept.get("text")) == today and kept["trials"] > trials
    except (OSError, ValueError, TypeError, KeyError, AttributeError):  # there is none
        return
    if more:
        right = f"give --trials {kept['trials']} or more, or another --out"
        raise envs.InputError(f"--trials was {trials}, and {file} is of {kept['trials']} trials; {right}")


def picture(result: dict[str, Any], file: Path) -> None:
    """The result of `certify` on one page."""
    with panels(file, 1, 3, size=(13, 3.9)) as [[left, middle, right]]:
        score, levels = np.array(result["stakes"]["score"], float), result["stakes"]["levels"]
        size, legible = (8, levels) if len(levels) < 9 else (4, [])
        for (i, j), value in np.ndenumerate(score):
            hue = "white" if value < 0.6 else "black"
            number = "" if np.isnan(value) else f"{value:.2f}"
            left.text(j, i, number, ha="center", va="center", color=hue, fontsize=size)
        alike = len(levels[0]) > 1 and all(len(set(level)) == 1 for level in levels)  # of patches
        ticks = ["\n".join(f"{x:.3g}" for x in (level[:1] if alike else level)) for level in legible]
        each = ", of each patch" * alike
        left.set(
            xlabel=f"theta given{each}", ylabel=f"true theta{each}", title="score of an expert given a wrong theta"
        )
        left.set_xticks(range(len(ticks)), ticks)
        left.set_yticks(range(len(ticks)), ticks)
        left.figure.colorbar(left.imshow(score, vmin=0, vmax=1, cmap="viridis"), ax=left)
        kind = "learned" if "learned_dynamics" in result else "exact"
        lines = {"interventional": "tab:green", "conditional": "tab:red", "static": "tab:olive"}
        for name in (name for name in lines if name in result):
            label = "interventional, theta taken to stand still" if name == "static" else f"{kind} {name}"
            middle.plot(
                range(1, len(result[name]["score"]) + 1), result[name]["score"], "o--", color=lines[name], label=label
            )
        middle.axhline(result["checks"]["blind_bc"]["measured"], color="tab:brown", label="blind BC")
        middle.set(xlabel="episode of one theta", ylabel="score", ylim=(-0.1, 1.1), title=f"{kind} policies")
        middle.legend(frameon=False)
        evidence = result["evidence_nats_per_step"]
        right.bar(["dynamics", "actions"], [evidence["dynamics"], evidence["actions"]], color=["tab:green", "tab:red"])
        ratio = evidence["delusion_ratio"]
        title = "no evidence from dynamics" if ratio is None else f"evidence of theta, ratio {ratio:.3g}"
        right.set(yscale="symlog", ylabel="nats a step", title=title)
        left.figure.suptitle(f"{result['task']}: certificate {result['verdict']}")
