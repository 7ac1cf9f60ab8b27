"""docs/index.html: all results as one static file, to sort, filter and look into; made of the records alone."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from PIL import Image

from deconfounded import envs
from deconfounded.benchmarks.engine.catalogue import EXACT, METHODS, REFERENCES, labels
from deconfounded.benchmarks.output import score, statistics
from deconfounded.benchmarks.output.answers import NOTE, PEER, answers
from deconfounded.benchmarks.output.pictures import colour

THRESHOLDS = np.linspace(-0.2, 1.2, 57)  # of performance profiles
COMPARED = (PEER, *EXACT[::-1])  # in paired differences
Found = Sequence[tuple[envs.Task, dict[str, Any]]]


def template(name: str, filters: Mapping[str, Callable[..., Any]] | None = None) -> jinja2.Template:
    """A page's, beside this file; filters: of its own."""
    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    made = jinja2.Environment(loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    made.filters.update(filters or {})
    return made.get_template(name)


def last_scores(methods: dict[str, Any]) -> dict[str, dict[int, float]]:
    """The `methods` of results.json -> score in the last episode, by method and seed."""
    zero, one = (float(np.mean(methods[name]["return"])) for name in REFERENCES)
    found = {}
    for name, entry in methods.items():
        scores = score.normalise(np.array(entry["return"])[:, -1], zero, one)
        found[name] = dict(zip(entry["seeds"], scores.tolist(), strict=True))
    return found


def _short(values: Any) -> Any:
    """Four decimals, in lists."""
    return (np.round(values, 4) + 0.0).tolist()


def _told(figure: statistics.Figure | None) -> dict[str, Any] | None:
    """A figure as the page's data has it."""
    if figure is None:
        return None
    interval = None if figure.interval is None else _short(figure.interval)
    return {"value": _short(figure.value), "interval": interval, "n": figure.n}


def row(task: envs.Task, name: str, entry: dict[str, Any], last: dict[str, dict[int, float]]) -> dict[str, Any]:
    """One method on one task."""
    return {
        "task": task.name,
        "method": name,
        "n": len(entry["seeds"]),
        "value": entry["score_last"],
        "interval": None if entry["ci95"] is None else _short(entry["ci95"]),
        "scores": entry["score"] + entry.get("score_beyond", []),
        "band": entry["band"],
        "trained": len(entry["score"]),
        "minus": {
            other: _told(statistics.paired(last[name], last[other]))
            for other in COMPARED
            if other in last and other != name
        },
        "return": round(float(np.mean(entry["return"], 0)[-1]), 2),
        "objective": round(entry["objective"][-1]),
        "r2": entry["theta_r2"],
        "data": ", ".join(f"{n:,} {kind.replace('_', ' ')}" for kind, n in entry["budget"].items() if n),
        "cpu": entry["cpu_s"],
        "curve": entry.get("curve", {}),
    }


def over_tasks(scores: dict[str, dict[str, dict[int, float]]], tasks: list[str]) -> dict[str, Any]:
    """What scores by task, method and seed come to over tasks: of each method, on those where it was run."""
    names = dict.fromkeys(name for task in tasks for name in scores[task])
    runs = {
        name: {task: np.array(list(scores[task][name].values())) for task in tasks if name in scores[task]}
        for name in names
    }
    found = {}
    for name, by_task in runs.items():
        found[name] = {
            "tasks": len(by_task),
            "iqm": _told(statistics.over_tasks(statistics.iqm, by_task)),
            "profile": _told(statistics.over_tasks(lambda x: statistics.profile(x, THRESHOLDS), by_task)),
        }
        if name != PEER and PEER in runs and set(by_task) & set(runs[PEER]):
            shared = sum(task in by_task for task in runs[PEER])
            beaten = _told(statistics.over_tasks(statistics.improvement, runs[PEER], by_task))
            found[name]["improvement"] = {**(beaten or {}), "tasks": shared}
    return {"tasks": tasks, "methods": found}


def certificate(docs: Path, task: envs.Task, found: dict[str, Any] | None) -> dict[str, Any] | None:
    """A task's certificate as the pages show it."""
    if found is None:
        return None
    picture = docs / "certificates" / f"{task.name}.png"
    size = Image.open(picture).size if picture.is_file() else None
    return {
        "verdict": found["verdict"],
        "checks": found["checks"],
        "nats": found["evidence_nats_per_step"],
        "file": f"certificates/{task.name}.json",
        "picture": {"file": f"certificates/{task.name}.png", "size": size} if size else None,
    }


def about(docs: Path, task: envs.Task, results: dict[str, Any], certified: dict[str, Any] | None) -> dict[str, Any]:
    """A task, as its part of the page shows it."""
    clip = docs / f"{task.name}.webp"
    first, *others = (inspect.getdoc(inspect.getmodule(type(task))) or task.name).split("\n\n")
    return {
        "name": task.name,
        "version": task.version,
        "tier": "none" if task.tier is None else str(task.tier),
        "headline": first,
        "text": [part.replace("\n", " ") for part in others],
        "latents": [
            f"{lat.name}, {lat.low:g} to {lat.high:g} {lat.unit}".strip() + f", {lat.distribution}"
            for lat in task.latents
        ],
        "episodes": task.episodes,
        "trials": results["eval_trials"],
        "outcome": score.outcome(results["methods"]),
        "clip": {"file": clip.name, "size": Image.open(clip).size} if clip.exists() else None,
        "certificate": certificate(docs, task, certified),
        "records": f"records/{task.name}.jsonl",
        "made": f"{results['wall_s']:,.0f} s; {results['machine']}; "
        + ", ".join(f"{name} {results['versions'][name]}" for name in ("python", "mujoco", "torch")),
    }


def certified(found: Found, certificates: Mapping[str, Any]) -> dict[str, dict[str, dict[int, float]]]:
    """Scores in the last episode, by task, method and seed, of the tasks whose certificate is passed."""
    passed = {name for name, one in certificates.items() if one["verdict"] == "passed"}
    return {task.name: last_scores(results["methods"]) for task, results in found if task.name in passed}


def data(docs: Path, found: Found, certificates: dict[str, Any], command: Callable[..., str]) -> dict[str, Any]:
    """All that the page shows, for json."""
    rows, tasks, scores = [], [], {}
    tiers: dict[str, list[str]] = {"": []}
    methods: dict[str, dict[str, str]] = {}
    for task, results in found:
        told = about(docs, task, results, certificates.get(task.name))
        tasks.append({**told, "command": command(task, results)})
        scores[task.name] = last_scores(results["methods"])
        for key in ("", told["tier"]):
            tiers.setdefault(key, []).append(task.name)
        for name, entry in results["methods"].items():
            made = row(task, name, entry, scores[task.name])
            rows.append({**made, "command": command(task, results, name)})
            kind = "exact" if name in EXACT else "reference" if name in REFERENCES else entry["tier"]
            hue = "var(--ink)" if name == "expert" else colour(entry["method"])
            methods.setdefault(name, {"tier": entry["tier"], "kind": kind, "colour": hue})
    rank = {name: i for i, name in enumerate(labels(METHODS))}
    order = sorted(methods, key=lambda name: rank.get(name, len(rank)))
    return {
        "tasks": sorted(tasks, key=lambda task: (task["tier"] == "none", task["tier"])),
        "methods": {name: methods[name] for name in order},
        "rows": rows,
        "compared": COMPARED,
        "note": NOTE,
        "answers": answers(certified(found, certificates)),
        "over": {key: over_tasks(scores, names) for key, names in tiers.items()},
        "thresholds": _short(THRESHOLDS),
    }


def page(
    docs: Path, found: Found, certificates: dict[str, Any], command: Callable[..., str], tiers: dict[str, str]
) -> str:
    """The file. tiers: what each tier of tasks says; command: what makes a task's results, or those of one method."""
    made = data(docs, found, certificates, command)
    counted = sum(entry["n"] for entry in made["rows"])
    opened = next((task["name"] for task in made["tasks"] if task["episodes"] > 1), "")
    seeds = score.fewest_to_most([entry["n"] for entry in made["rows"]])
    shown = {"tiers": tiers, "records": counted, "seeds": seeds, "peer": PEER, "opened": opened}
    return template("index.html.jinja").render(data=made, **shown) + "\n"
