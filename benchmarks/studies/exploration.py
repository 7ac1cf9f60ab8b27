"""Scores against the amount of exploration, or of queries: `deconf exploration`

Each method that explores or queries the expert, with all of its preset's trials of that, a 4th, a 16th and a 64th.
Records in docs/ stand for the first. Interrupted, it goes on where it was; points of former runs are kept.
"""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from deconfounded import envs
from deconfounded.benchmarks import commands
from deconfounded.benchmarks.engine import published
from deconfounded.benchmarks.engine.catalogue import METHODS, REFERENCES
from deconfounded.benchmarks.engine.protocols import STEPWISE
from deconfounded.benchmarks.output.pictures import colour, panels
from deconfounded.benchmarks.output.scoring import two_decimals
from deconfounded.benchmarks.studies import runs
from deconfounded.benchmarks.studies.cards import DOCS, changed, markdown_table
from deconfounded.envs.support.files import check_folder

if TYPE_CHECKING:
    from deconfounded.benchmarks.engine.presets import Preset
    from deconfounded.benchmarks.output.records import Record

SHARES = (1, 4, 16, 64)  # an n-th of the preset's trials
AMOUNTS = ("explore_trials", "query_trials")
ENOUGH = 3  # amounts, from which on a task is drawn
TASKS = ("slippery_cartpole", "curling")
ENDS = ("first", "last")
PLAIN: dict[str, Any] = {"preset": "default", "set": []}  # of which a point says nothing
TICKS = (8, 32, 128, 512)  # trials

Key = tuple[str, str, int]
Point = dict[str, Any]
"""The task, the method, its version, n of SHARES, explored trials of a seed; scores of ENDS by seed; made where."""


def explorers() -> list[str]:
    """The methods whose exploration or queries the preset's amounts set."""
    kinds = {"exploration", "queries"}
    return [name for name, method in METHODS.items() if kinds & {*method.uses} and name not in STEPWISE]


def fewer(settings: "Preset", share: int) -> list[str]:
    """Changes of the settings, as for --set, to a share of exploration and queries; none for all of them."""
    return [f"{name}={max(1, getattr(settings, name) // share)}" for name in AMOUNTS] if share > 1 else []


def median_losses(points: list[Point]) -> str:
    """By how much each method loses, in the last episode: the median over tasks, of each share, against all trials."""
    rows = []
    for method in dict.fromkeys(point["method"] for point in points):
        last = {(p["task"], p["share"]): float(np.mean(p["last"])) for p in points if p["method"] == method}
        cells = []
        for share in SHARES[1:]:
            losses = [last[task, 1] - last[task, share] for task, n in last if n == share and (task, 1) in last]
            cells.append(f"{two_decimals(float(np.median(losses)))} ({len(losses)})" if losses else "")
        rows.append((method, *cells))
    return markdown_table(("method", *(f"a {share}th" for share in SHARES[1:])), rows)


def table(points: list[Point]) -> str:
    """A row for each task and method, in markdown: first and last score of each share, and explored trials."""
    rows = []
    for task, method in dict.fromkeys((point["task"], point["method"]) for point in points):
        of = {point["share"]: point for point in points if (point["task"], point["method"]) == (task, method)}
        cells = []
        for share in SHARES:
            ends = (two_decimals(float(np.mean(of[share][end]))) for end in ENDS if share in of)
            cells.append(f"{', '.join(ends)} ({of[share]['explored']})" if share in of else "")
        versions = sorted({f"v{point['version']}" for point in of.values()})
        seeds = max(len(point["last"]) for point in of.values())
        rows.append((task, method, ", ".join(versions), str(seeds), *cells))
    head = ("task", "method", "version", "seeds, at most", "all", *(f"a {share}th" for share in SHARES[1:]))
    return markdown_table(head, rows)


def picture(points: list[Point], file: Path, mark: str = "") -> None:
    """A column for each task with several amounts, if there is one, or else each: first episode above, last below."""
    tasks = dict.fromkeys(point["task"] for point in points)
    amounts = {task: {point["share"] for point in points if point["task"] == task} for task in tasks}
    drawn = [task for task in tasks if len(amounts[task]) >= ENOUGH] or list(tasks)
    size = (4.6 * len(drawn) + 1.6, 7.0)
    with panels(file, 2, len(drawn), size=size, dpi=100, mark=mark, sharex="col", sharey=True) as grid:
        for task, column in zip(drawn, grid.T, strict=True):
            of_task = [point for point in points if point["task"] == task]
            for method in dict.fromkeys(point["method"] for point in of_task):
                of = sorted((p for p in of_task if p["method"] == method), key=lambda point: point["explored"])
                trials = [point["explored"] for point in of]
                for end, panel in zip(ENDS, column, strict=True):
                    scores = [np.array(point[end]) for point in of]
                    panel.plot(trials, [x.mean() for x in scores], "o-", color=colour(method), label=method)
                    ends = [x.min() for x in scores], [x.max() for x in scores]
                    panel.vlines(trials, *ends, color=colour(method), alpha=0.4)
            column[0].set(title=task, xscale="log", ylim=(0, None))
            column[1].set(xlabel="trials of exploration, or of queries, a seed")
            column[1].set_xticks(TICKS, map(str, TICKS))
            column[1].minorticks_off()
        for end, panel in zip(ENDS, grid[:, 0], strict=True):
            panel.set_ylabel(f"score, {end} episode")
        entries = [entry for panel in grid[1] for entry in zip(*panel.get_legend_handles_labels(), strict=True)]
        lines = {name: line for line, name in entries}
        grid[1, 0].figure.legend(lines.values(), lines, loc="outside right center", frameon=False, fontsize=8)


def recorded(task: envs.Task, settings: "Preset", method: str, seeds: int) -> "list[Record]":
    """The records in docs/ of a method and of the references, of the seeds 0, 1, ...; empty unless all are of today."""
    from deconfounded.benchmarks.engine.benchmark import BenchmarkJob
    from deconfounded.benchmarks.output import records
    from deconfounded.benchmarks.studies.table import missing

    of_task = records.of_task(DOCS / "records", task.name)
    job = BenchmarkJob(task.reference, settings, method, tuple(range(seeds)), Path())
    if missing(job, "default", of_task):
        return []
    return [record for record in of_task if record["method"] in (method, *REFERENCES) and record["seed"] < seeds]


def measured(made: "list[Record]", method: str, share: int) -> Point:
    """The point of a method's records, among which those of the references are."""
    from deconfounded.benchmarks.output import aggregation, index

    results = aggregation.gather(made)
    own = next(record for record in made if record["method"] == method)
    about = {"commit": own["commit"], "machine": own["machine"], "versions": own["versions"]}
    scores = {end: [*index.measured(results["methods"], end)[method].values()] for end in ENDS}
    return {
        **{"task": own["task"], "method": method, "version": own["method_version"], "share": share},
        **{"explored": own["budget"]["exploration_trials"], **scores, **about},
    }


def check_file(file: Path, asked: dict[str, Any]) -> None:
    """Raises InputError if a file holds points of another preset or --set than those asked for."""
    for point in json.loads(file.read_bytes()) if file.is_file() else ():
        if (before := {key: point.get(key, plain) for key, plain in PLAIN.items()}) != asked:
            what = ", ".join(f"{key} {before[key] or 'none'}" for key in PLAIN if before[key] != asked[key])
            raise envs.InputError(f"{file} holds points of {what}; give another --out")


def added(file: Path, point: Point) -> dict[Key, Point]:
    """The points of a file, with one more or in place of the one before."""

    def by_key(points: list[Point]) -> dict[Key, Point]:
        return {(p["task"], p["method"], p["share"]): p for p in points}

    def more(before: list[Point] | None) -> list[Point]:
        points = by_key([*(before or ()), point])
        return [points[key] for key in sorted(points)]

    return by_key(changed(file, more))


def main() -> None:
    parser = commands.parser(__doc__, "some of those that explore or query; default: all of them", seeds=1)
    several = f"names, or {', '.join(published.GROUPS)}; default: {' '.join(TASKS)}"
    parser.add_argument("--tasks", nargs="+", metavar="NAME", default=list(TASKS), help=several)
    shares = f"n, of an n-th of the preset's trials; default: {' '.join(map(str, SHARES))}"
    parser.add_argument("--shares", nargs="+", type=int, choices=SHARES, default=list(SHARES), help=shares)
    args = parser.parse_args()
    methods = commands.check(args, able := explorers(), able)
    tasks = published.tasks(args.tasks)
    from deconfounded.benchmarks.engine.presets import changed, preset

    folder = args.out or Path("results") / "exploration"
    check_folder(folder)
    file, points = folder / "exploration.json", dict[Key, Point]()
    check_file(file, asked := {"preset": args.preset, "set": list(args.set)})
    stated = {} if asked == PLAIN else asked
    for task in tasks:
        whole = changed(preset(args.preset, task, args.device), args.set)
        for share in args.shares:
            changes, own = fewer(whole, share), folder / f"{task.name}-{share}"
            settings, changes = changed(whole, changes), [*args.set, *changes]
            options = {"preset": args.preset, "changes": changes, "cluster": args.cluster}
            for method in methods:
                made = [] if changes or args.preset != "default" else recorded(task, settings, method, args.seeds)
                made = made or runs.run(task, settings, (*REFERENCES, method), range(args.seeds), own, **options)
                points = added(file, point := {**measured(made, method, share), **stated})
                ends = ", ".join(two_decimals(float(np.mean(point[end]))) for end in ENDS)
                print(f"{task.name}, {method}, {point['explored']} trials: {ends} in the first and the last episode")
    picture(list(points.values()), folder / "exploration.png")
    print(f"-> {folder / 'exploration.png'}")
