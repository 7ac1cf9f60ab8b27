"""The opponents' tuning: `python benchmarks/tune.py`

Each opponent gets four settings, its present one among them, on two development tasks: the cartpole on a tilted rail
and the bandit. Their seeds are no others' (`SEEDS`). What came of each setting is kept in docs/tuning.json at once.
Interrupted, it goes on where it was.
"""

from __future__ import annotations

if __name__ == "__main__":  # Ctrl-C while the rest is imported is one line too
    from deconfounded.benchmarks.console import stop_at_once

    stop_at_once()

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from deconfounded import envs
from deconfounded.benchmarks import commands
from deconfounded.benchmarks.console import Parser, place, run_command
from deconfounded.benchmarks.engine.catalogue import METHODS, REFERENCES, check_names
from deconfounded.envs.files import write_atomically, write_json

if TYPE_CHECKING:
    from deconfounded.benchmarks.engine.presets import Preset

DOCS = Path(__file__).resolve().parents[1] / "docs"
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
"""Of each opponent, what is tried beside the preset as it was before."""
BEFORE: dict[str, Change] = {
    "naive_obs": {"learning_rate": 1 / 0.3},
    "naive_dropout": {"learning_rate": 1 / 0.3},
    "palr": {"penalty": 0.1},
    "rma": {"learning_rate": 1 / 0.3},
    "deconfounded_mean": {"model": "gru"},
}
"""What was chosen, undone: so the search begins where it began, whatever today's preset has of it."""


def other(config: Any, change: Change) -> Any:
    """A method's configuration with the change."""
    values = {}
    for name, by in change.items():
        now = getattr(config, name)
        values[name] = by if isinstance(by, str) else round(now * by) if isinstance(now, int) else now * by
    return replace(config, **values)


def began(today: Preset) -> Preset:
    """The amounts that the search begins with."""
    undone = {METHODS[name].part: change for name, change in BEFORE.items()}
    return replace(today, **{part: other(getattr(today, part), change) for part, change in undone.items()})


def title(change: Change) -> str:
    """Of a setting."""
    told = (f"{name} {by}" if isinstance(by, str) else f"{name} x {by:g}" for name, by in change.items())
    return ", ".join(told) or "the preset"


def share(source: Path, other: Path, but: str = "") -> None:
    """Demonstrations and references are the same for all settings: those that another folder lacks are copied there."""
    other.mkdir(parents=True, exist_ok=True)
    for file in source.glob("*.npz"):
        if not (other / file.name).exists() and file.stem.rpartition("-")[0] != but:
            write_atomically(other / file.name, file.read_bytes())


def keep(row: dict[str, Any], file: Path) -> None:
    """Among the file's rows, in place of the one of the same method and setting."""
    rows = json.loads(file.read_text())["rows"] if file.is_file() else []
    same = [one for one in rows if (one["method"], one["setting"]) == (row["method"], row["setting"])]
    if same:
        rows[rows.index(same[0])] = row
    else:
        rows.append(row)
    write_json(file, {"seeds": SEEDS, "rows": sorted(rows, key=lambda one: list(TRIED).index(one["method"]))})


def main() -> None:
    """The command line."""
    parser = Parser(__doc__)
    parser.add_argument("--methods", nargs="+", metavar="NAME", help=f"some of {', '.join(TRIED)}; default: all")
    parser.add_argument("--out", type=place, default=Path("results") / "tuning", help="output folder")
    args = parser.parse_args()
    check_names("method", args.methods or (), list(TRIED))
    from deconfounded.benchmarks.engine.jobs import BenchmarkJob
    from deconfounded.benchmarks.engine.local import Local
    from deconfounded.benchmarks.engine.pool import prepare, run_all
    from deconfounded.benchmarks.engine.presets import preset
    from deconfounded.benchmarks.output import records
    from deconfounded.benchmarks.output.index import last_scores

    for name in args.methods or TRIED:
        for change in ({}, *TRIED[name]):
            row: dict[str, Any] = {"method": name, "setting": title(change)}
            row |= {"amounts": {}, "scores": {}, "loss": {}, "cpu_s": {}}  # by task
            for task in (envs.get(one) for one in TASKS):
                settings, part = began(preset("default", task, "cpu")), METHODS[name].part
                settings = replace(settings, **{part: (tried := other(getattr(settings, part), change))})
                row["amounts"][task.name] = asdict(tried)
                own = args.out / f"{task.name}-{name}-{title(change).replace(' ', '_')}"
                jobs = [BenchmarkJob(task.reference, settings, one, SEEDS, own / "jobs") for one in (*REFERENCES, name)]
                with commands.locked(own), Local() as engine:
                    prepare(own, commands.about(BenchmarkJob, task, "default", settings, []), resume=True)
                    share(args.out / task.name, own / "jobs")
                    finished, _ = run_all(jobs, "cpu", f"{name}, {title(change)}, {task.name}", engine)
                    share(own / "jobs", args.out / task.name, but=name)
                found = records.gather(records.of_run(finished, "default", [], task.episodes))
                row |= {"commit": found["commits"][-1], "machine": found["machine"], "versions": found["versions"]}
                entry = found["methods"][name]
                row["scores"][task.name] = [round(score, 4) for score in last_scores(found["methods"])[name].values()]
                row["loss"][task.name] = {kind: curve["loss"][-1] for kind, curve in entry["curve"].items()}
                row["cpu_s"][task.name] = entry["cpu_s"]
            keep(row, DOCS / "tuning.json")
            told = ", ".join(f"{task} {np.mean(scores):.3f}" for task, scores in row["scores"].items())
            print(f"{name}, {row['setting']}: {told}")
    print(f"-> {DOCS / 'tuning.json'}")


if __name__ == "__main__":
    run_command(main, "what was finished is kept, and the same command goes on")
