"""The baselines' tuning: `deconf tune`

Each baseline gets four settings, the preset of before among them, on two development tasks: the cartpole on a tilted
rail and the bandit. Their seeds are no others' (`SEEDS`). What came of each setting is kept in docs/tuning.json at
once. Interrupted, it goes on where it was; what is there of today's versions and amounts stays.
"""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from deconfounded import envs
from deconfounded.benchmarks.console import Parser, place
from deconfounded.benchmarks.engine.catalogue import METHODS, REFERENCES, check_names
from deconfounded.benchmarks.studies import runs
from deconfounded.benchmarks.studies.cards import DOCS, changed

if TYPE_CHECKING:
    from deconfounded.benchmarks.engine.presets import Preset

TASKS, SEEDS = ("tilted_cartpole", "bandit"), (100, 101)
Change = dict[str, float | str]
"""Amounts by name, each times so much, or what is put in its place."""

_NETWORK: tuple[Change, ...] = ({"learning_rate": 0.3}, {"updates": 2}, {"width": 2})
TRIED: dict[str, tuple[Change, ...]] = {
    "naive_rnn": _NETWORK,
    "naive_obs": _NETWORK,
    "naive_dropout": _NETWORK,
    "palr": ({"penalty": 10}, {"penalty": 100}, {"updates": 2}),
    "rma": _NETWORK,
    "deconfounded_mean": ({"beta": 0.1}, {"model": "evidence"}, {"inference_updates": 4}),
    "naive_transformer": ({"learning_rate": 0.3}, {"updates": 2}, {"layers": 2}),
    "gail": ({"policy_rate": 0.3}, {"discriminator_rate": 0.3}, {"rounds": 2}),
}
"""Of each baseline, what is tried beside the preset as it was before."""
BEFORE: dict[str, Change] = {
    "naive_obs": {"learning_rate": 1 / 0.3},
    "naive_dropout": {"learning_rate": 1 / 0.3},
    "palr": {"penalty": 0.1},
    "rma": {"learning_rate": 1 / 0.3},
    "deconfounded_mean": {"model": "gru"},
    "naive_transformer": {"layers": 0.5},
    "gail": {"discriminator_rate": 1 / 0.3},
}
"""What was chosen, undone: so the search begins where it began, whatever today's preset has of it."""


def other(settings: "Preset", method: str, change: Change) -> "Preset":
    """The amounts with a change of a method's configuration."""
    values = {}
    for name, by in change.items():
        now = settings.configs[method][name]
        values[name] = by if isinstance(by, str) else round(now * by) if isinstance(now, int) else now * by
    return settings.configured(method, **values)


def began(today: "Preset") -> "Preset":
    """The amounts that the search begins with."""
    for method, change in BEFORE.items():
        today = other(today, method, change)
    return today


def title(change: Change) -> str:
    """Of a setting."""
    parts = (f"{name} {by}" if isinstance(by, str) else f"{name} x {by:g}" for name, by in change.items())
    return ", ".join(parts) or "the preset"


def kept(file: Path) -> list[dict[str, Any]]:
    """The rows of the file, one a setting."""
    return json.loads(file.read_bytes())["rows"] if file.is_file() else []


def keep(row: dict[str, Any], file: Path) -> None:
    """Among the file's rows, in place of the one of the same method and setting."""

    def more(before: dict[str, Any] | None) -> dict[str, Any]:
        rows = {(held["method"], held["setting"]): held for held in (*(before or {"rows": ()})["rows"], row)}
        return {"seeds": SEEDS, "rows": sorted(rows.values(), key=lambda row: list(TRIED).index(row["method"]))}

    changed(file, more)


def main() -> None:
    parser = Parser(__doc__)
    parser.add_argument("--methods", nargs="+", metavar="NAME", help=f"some of {', '.join(TRIED)}; default: all")
    parser.add_argument("--out", type=place, default=Path("results") / "tuning", help="output folder")
    args = parser.parse_args()
    check_names("method", args.methods or (), list(TRIED))
    from deconfounded.benchmarks.engine.presets import preset
    from deconfounded.benchmarks.output import aggregation
    from deconfounded.benchmarks.output.index import last_scores

    file, tasks = DOCS / "tuning.json", [envs.get(name) for name in TASKS]
    base = {task.name: began(preset("default", task, "cpu")) for task in tasks}
    versions = {task.name: task.version for task in tasks}
    for name, change in [(method, change) for method in args.methods or TRIED for change in ({}, *TRIED[method])]:
        settings = {task: other(before, name, change) for task, before in base.items()}
        amounts = {task: each.configs[name] for task, each in settings.items()}
        row: dict[str, Any] = {"method": name, "setting": title(change), "amounts": amounts}
        row |= {"method_version": METHODS[name].version, "task_versions": versions}
        if any(all(held.get(key) == value for key, value in row.items()) for held in kept(file)):
            print(f"{name}, {row['setting']}: it is in {file.name}")
            continue
        row |= {"scores": {}, "loss": {}, "cpu_s": {}}
        for task in tasks:
            # A folder a task: what does not depend on the setting, demonstrations and references, is made once.
            own, asked = args.out / task.name, (*REFERENCES, name)
            results = aggregation.gather(runs.run(task, settings[task.name], asked, SEEDS, own, base=base[task.name]))
            row |= {"commit": results["commits"][-1], "machine": results["machine"], "versions": results["versions"]}
            entry = results["methods"][name]
            row["scores"][task.name] = [round(score, 4) for score in last_scores(results["methods"])[name].values()]
            row["loss"][task.name] = {kind: curve["loss"][-1] for kind, curve in entry["curve"].items()}
            row["cpu_s"][task.name] = entry["cpu_s"]
        keep(row, file)
        means = ", ".join(f"{task} {np.mean(scores):.3f}" for task, scores in row["scores"].items())
        print(f"{name}, {row['setting']}: {means}")
    print(f"-> {file}")
