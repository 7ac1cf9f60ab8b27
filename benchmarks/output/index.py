"""docs/index.html: all results as one static file, to sort, filter and look into; made of the records alone."""

import inspect
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from deconfounded import envs
from deconfounded.benchmarks.engine import published
from deconfounded.benchmarks.engine.catalogue import EXACT, METHODS, REFERENCES, labels
from deconfounded.benchmarks.output import scoring, statistics
from deconfounded.benchmarks.output.pictures import colours, encoded
from deconfounded.benchmarks.output.templates import template
from deconfounded.envs.streams import Array

NOTE = (
    "Scores in the last episode, over all tasks whose certificate is passed and where all three were run, with the"
    " seeds that all three have. Baselines were tuned for their scores on two of these tasks, with other seeds."
    " naive_rnn kept its preset, though other settings score higher, see baselines.md."
)
QUESTIONS = {
    "naive_transformer": "Does scale cure the delusion?",
    "naive_obs": "Is it enough not to see one's own past actions?",
    "gail": "Is it enough to practise in the world, and be taken for the expert?",
    "rma": "Is a student enough whose teacher sees theta, as robotics trains it?",
}
PEER, NAIVE = "deconfounded", "naive_rnn"
Scores = Mapping[str, Mapping[str, Mapping[int, float]]]
"""Of the last episode, by task, method and seed."""
THRESHOLDS = np.linspace(-0.2, 1.2, 57)  # of performance profiles
COMPARED = (PEER, *EXACT[::-1])  # in paired differences
Found = Sequence[tuple[envs.Task, dict[str, Any]]]


def measured(methods: dict[str, Any], measure: str) -> dict[str, dict[int, float]]:
    """The `methods` of results.json -> one of scoring.MEASURES, by method and seed."""
    zero, one = (methods[name]["reference"] for name in REFERENCES)
    scores = {name: scoring.normalise(np.array(entry["return"]), zero, one) for name, entry in methods.items()}
    values = {name: scoring.measured(of)[measure].tolist() for name, of in scores.items()}
    return {name: dict(zip(methods[name]["seeds"], of, strict=True)) for name, of in values.items()}


def last_scores(methods: dict[str, Any]) -> dict[str, dict[int, float]]:
    """The `methods` of results.json -> score in the last episode, by method and seed."""
    return measured(methods, "last")


def _short(values: Any, decimals: int = 4) -> Any:
    """So many decimals, in lists."""
    return (np.round(values, decimals) + 0.0).tolist()


def as_json(figure: statistics.Figure | None) -> dict[str, Any] | None:
    """A figure as the page's data has it."""
    if figure is None:
        return None
    interval = None if figure.interval is None else _short(figure.interval, scoring.EXACTLY)
    return {"value": _short(figure.value, scoring.EXACTLY), "interval": interval, "n": figure.n}


def row(task: envs.Task, name: str, entry: dict[str, Any], last: dict[str, dict[int, float]]) -> dict[str, Any]:
    """One method on one task."""
    others = [other for other in COMPARED if other in last and other != name]
    return {
        "task": task.name,
        "method": name,
        "n": len(entry["seeds"]),
        "version": of_versions(entry["method"], {entry["version"]}),
        "value": entry["score_last"],
        "interval": entry["ci95"] and _short(entry["ci95"]),
        "first": {"value": entry["score_first"], "interval": entry["ci95_first"] and _short(entry["ci95_first"])},
        "regret": {"value": entry["regret"], "interval": entry["ci95_regret"] and _short(entry["ci95_regret"])},
        "held": round(100 * scoring.coverage(len(entry["seeds"]))),
        "scores": entry["score"] + entry.get("score_beyond", []),
        "band": entry["band"],
        "trained": len(entry["score"]),
        "minus": {other: as_json(statistics.paired(last[name], last[other])) for other in others},
        "return": round(float(np.mean(entry["return"], 0)[-1]), 2),
        "objective": round(entry["objective"][-1]),
        "r2": entry["theta_r2"],
        "data": scoring.budget(entry["budget"]),
        "cpu": entry["cpu_s"],
        "curve": entry.get("curve", {}),
    }


def of_versions(method: str, versions: set[int]) -> str:
    """Versions of a method's records, and today's if these are of another: `v1 (now v2)`; empty if from outside."""
    if method not in METHODS:
        return ""
    now = "" if versions <= {METHODS[method].version} else f" (now v{METHODS[method].version})"
    return ", ".join(f"v{version}" for version in sorted(versions)) + now


def _runs(scores: Scores, tasks: Sequence[str]) -> dict[str, dict[str, Array]]:
    """By method and task, on those where it was run: an array of seeds."""
    runs: dict[str, dict[str, Array]] = {}
    for task in tasks:
        for name, by_seed in scores[task].items():
            runs.setdefault(name, {})[task] = np.array(list(by_seed.values()))
    return runs


def over_tasks(scores: Scores, tasks: Sequence[str]) -> dict[str, Any]:
    """What scores by task, method and seed come to over tasks: of each method, on those where it was run."""
    methods = {}
    for name, by_task in _runs(scores, tasks).items():
        methods[name] = {
            "tasks": len(by_task),
            "iqm": as_json(statistics.over_tasks(statistics.iqm, by_task)),
            "profile": as_json(statistics.over_tasks(lambda x: statistics.profile(x, THRESHOLDS), by_task)),
        }
        both = statistics.matched(*({task: scores[task].get(each, {}) for task in tasks} for each in (PEER, name)))
        if name != PEER and both[0]:
            improvement = as_json(statistics.over_tasks(statistics.improvement, *both))
            methods[name]["improvement"] = {**(improvement or {}), "tasks": len(both[0])}
    return {"tasks": tasks, "methods": methods}


def certificate(docs: Path, task: envs.Task, certificate: dict[str, Any] | None) -> dict[str, Any] | None:
    """A task's certificate as the pages show it."""
    return certificate and {
        "verdict": certificate["verdict"],
        "checks": certificate["checks"],
        "nats": certificate["evidence_nats_per_step"],
        "file": f"certificates/{task.name}.json",
        "picture": _sized(docs, f"certificates/{task.name}.png"),
    }


def stills(docs: Path) -> dict[str, Path]:
    """By the name of a picture that the page links to, the file of the small one that it holds."""
    pictures = [*docs.glob("*.webp"), *(docs / "certificates").glob("*.png")]
    names = sorted(str(picture.relative_to(docs).as_posix()) for picture in pictures)
    return {name: docs / "stills" / Path(name).with_suffix(".webp") for name in names}


def _sized(docs: Path, name: str) -> dict[str, Any] | None:
    """A picture's name and size, if there is one."""
    return {"file": name, "size": Image.open(docs / name).size} if (docs / name).is_file() else None


def about(docs: Path, task: envs.Task, results: dict[str, Any], certified: dict[str, Any] | None) -> dict[str, Any]:
    """A task, as its part of the page shows it."""
    first, *others = (inspect.getdoc(inspect.getmodule(type(task))) or task.name).split("\n\n")
    versions = (f"{name} {results['versions'][name]}" for name in ("python", "mujoco", "torch"))
    units = {lat.name: f"{lat.name}, {lat.low:g} to {lat.high:g} {lat.unit}".strip() for lat in task.latents}
    return {
        "name": task.name,
        "version": task.version,
        "tier": task.tier_name,
        "headline": first,
        "text": [part.replace("\n", " ") for part in others],
        "latents": [f"{units[lat.name]}, {lat.distribution}" for lat in task.latents],
        "episodes": task.episodes,
        "trials": results["eval_trials"],
        "outcome": scoring.outcome(results["methods"]),
        "clip": _sized(docs, f"{task.name}.webp"),
        "certificate": certificate(docs, task, certified),
        "records": f"records/{task.name}.jsonl",
        "made": f"{results['wall_s']:,.0f} s; {results['machine']}; {', '.join(versions)}",
    }


def certified(
    found: Found, certificates: Mapping[str, Any], measure: str = "last"
) -> dict[str, dict[str, dict[int, float]]]:
    """One of scoring.MEASURES, by task, method and seed, of the tasks whose certificate is passed."""
    passed = published.passed(certificates)
    return {task.name: measured(results["methods"], measure) for task, results in found if task.name in passed}


def data(docs: Path, found: Found, certificates: dict[str, Any], command: Callable[..., str]) -> dict[str, Any]:
    """All that the page shows, for json."""
    rows, tasks = [], []
    scores: dict[str, dict[str, dict[str, dict[int, float]]]] = {measure: {} for measure in scoring.MEASURES}
    tiers: dict[str, list[str]] = {}
    methods: dict[str, dict[str, str]] = {}
    hues = colours(entry["method"] for _, results in found for entry in results["methods"].values())
    for task, results in found:
        described = about(docs, task, results, certificates.get(task.name))
        tasks.append({**described, "command": command(task, results)})
        for measure, by_task in scores.items():
            by_task[task.name] = measured(results["methods"], measure)
        for key in ("", described["tier"]):
            tiers.setdefault(key, []).append(task.name)
        for name, entry in results["methods"].items():
            made = row(task, name, entry, scores["last"][task.name])
            rows.append({**made, "command": command(task, results, name)})
            kind = "exact" if entry["method"] in EXACT else "reference" if name in REFERENCES else entry["tier"]
            hue = "var(--ink)" if name == "expert" else hues[entry["method"]]
            methods.setdefault(
                name, {"tier": entry["tier"], "kind": kind, "colour": hue, "deployment": entry["deployment"]}
            )
    rank = {name: i for i, name in enumerate(labels(METHODS))}
    order = sorted(methods, key=lambda name: rank.get(name, len(rank)))
    over = {key: over_tasks(scores["last"], names) for key, names in tiers.items()}
    for key, names in tiers.items():
        for measure in ("first", "regret"):
            for name, runs in _runs(scores[measure], names).items():
                over[key]["methods"][name][measure] = as_json(statistics.over_tasks(statistics.iqm, runs))
    return {
        "tasks": sorted(tasks, key=lambda task: (task["tier"] == "none", task["tier"])),
        "methods": {name: methods[name] for name in order},
        "rows": rows,
        "compared": COMPARED,
        "note": NOTE,
        "answers": answers(certified(found, certificates)),
        "over": over,
        "thresholds": _short(THRESHOLDS),
    }


def answers(scores: Scores) -> list[str]:
    """A sentence for each of QUESTIONS whose method has several seeds on a task of these, as PEER and NAIVE have."""
    return [answer for method, question in QUESTIONS.items() if (answer := _answer(scores, method, question))]


def _answer(scores: Scores, method: str, question: str) -> str | None:
    """Whether a method is better than NAIVE, and no more than NEAR behind PEER, by 95% intervals of differences.

    Of interquartile means, over the tasks and seeds that all three have.
    """
    names = (method, NAIVE, PEER)
    own, naive, peer = statistics.matched(*({task: of.get(name, {}) for task, of in scores.items()} for name in names))
    tasks = [task for task, of in own.items() if len(of) > 1]
    if not tasks:
        return None
    runs = {name: {task: of[task] for task in tasks} for name, of in zip(names, (own, naive, peer), strict=True)}
    means = {name: _figure(statistics.iqm, of) for name, of in runs.items()}

    def ahead(one: str, other: str) -> tuple[float, float]:
        """From where to where the interval of the difference reaches."""
        return _figure(lambda x, y: statistics.iqm(x) - statistics.iqm(y), runs[one], runs[other])[1:]

    helps, (behind, near) = ahead(method, NAIVE)[0] > 0, ahead(method, PEER)
    if ahead(PEER, NAIVE)[0] <= 0 or (near >= -scoring.NEAR and not helps):
        word = "It cannot be decided yet"
    elif behind >= -scoring.NEAR:
        word = "Yes"
    elif near >= -scoring.NEAR:
        word = "It helps; whether it is enough cannot be decided yet"
    else:
        word = "It helps, but it is not enough" if helps else "No"
    ranges = ("{} {} ({} to {})".format(name, *map(scoring.two_decimals, mean)) for name, mean in means.items())
    better = scoring.two_decimals(_figure(statistics.improvement, runs[PEER], runs[method])[0])
    return (
        f"{question} {word}: {', '.join(ranges)}, interquartile means over {len(tasks)} task{'s' * (len(tasks) > 1)}"
        f" and their 95% intervals. A run of {PEER} is better than one of {method} in the same trials with"
        f" probability {better}."
    )


def _figure(figure: Callable[..., Array], *runs: statistics.Runs) -> tuple[float, float, float]:
    """Over tasks that all have: its value, and from where to where its interval reaches."""
    over = statistics.over_tasks(figure, *runs)
    assert over is not None
    assert over.interval is not None
    return float(over.value), *map(float, over.interval)  # type: ignore[return-value]


def page(
    docs: Path, found: Found, certificates: dict[str, Any], command: Callable[..., str], tiers: dict[str, str]
) -> str:
    """The file, which needs no other: a copy of it alone keeps its pictures, though films stand still.

    tiers: what each tier of tasks says; command: what makes a task's results, or those of one method.
    """
    content = data(docs, found, certificates, command)
    counts = [entry["n"] for entry in content["rows"]]
    opened = next((task["name"] for task in content["tasks"] if task["episodes"] > 1), "")
    held = " to ".join(dict.fromkeys(f"{scoring.coverage(n):.0%}" for n in (min(counts), max(counts))))
    head = {"records": sum(counts), "seeds": scoring.fewest_to_most(counts), "peer": PEER, "opened": opened}
    head |= {"held": held, "intervals": scoring.INTERVALS}
    head["stills"] = {name: f"data:image/webp;base64,{encoded(file)}" for name, file in stills(docs).items()}
    return template("index.html.jinja").render(data=content, tiers=tiers, **head) + "\n"
