"""Where delusion begins, and where everything drowns in noise: `deconf spectrum`

The cartpole on a tilted rail and the car on an icy road, with process noise or the expert's action noise times 1/4 to
8. Of each: its certificate, and the last episode's score of the exact policies, naive_rnn, deconfounded and dagger.
Interrupted, it goes on where it was.
"""

from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from deconfounded import envs
from deconfounded.benchmarks import commands
from deconfounded.benchmarks.engine.catalogue import EXACT, REFERENCES, check_names
from deconfounded.benchmarks.output.pictures import colour, panels
from deconfounded.benchmarks.output.scoring import two_decimals
from deconfounded.benchmarks.studies import noise, runs
from deconfounded.benchmarks.studies.cards import markdown_table, nats
from deconfounded.envs.support.files import write_json
from deconfounded.envs.task import ASSETS

LEARNED = ("deconfounded", "naive_rnn", "dagger")
KINDS = {"process": "process noise", "expert": "the expert's action noise"}

Point = dict[str, Any]
"""The task, the kind of its noise, times which factor, made where; its certificate; the last scores of each method."""


def variants(base: str) -> list[tuple[str, str, float, str]]:
    """The task, the kinds of its noise, times which factor each, and the task with that."""
    points = [(kind, factor) for kind in KINDS for factor in noise.FACTORS[kind]]
    return [(base, *one, f"{noise.__name__}:{noise.title(base, *one)}") for one in points]


def _columns(points: list[Point]) -> list[tuple[str, str, list[Point]]]:
    """Each task and kind of noise, and its points in the order of their factors; that times 1 belongs to all kinds."""
    tasks = dict.fromkeys(point["task"] for point in points)
    columns = []
    for task, kind in ((task, kind) for task in tasks for kind in KINDS):
        of = [point for point in points if point["task"] == task and (point["kind"] == kind or point["factor"] == 1)]
        columns.append((task, KINDS[kind], sorted(of, key=lambda point: point["factor"])))
    return columns


def predictions(points: list[Point]) -> str:
    """By how much deconfounded is ahead of naive_rnn, where the certificate is passed and where it is failed."""
    parts = []
    for verdict in ("passed", "failed"):
        of = [point["scores"] for point in points if point["certificate"]["verdict"] == verdict]
        ahead = [np.mean(scores["deconfounded"]) - np.mean(scores["naive_rnn"]) for scores in of]
        ends = " to ".join(two_decimals(end(ahead)) for end in (min, max)) if ahead else "(none)"
        parts.append(f"where it is {verdict}, on {len(ahead)}, by {ends}")
    return (
        f"The certificate predicts where a clone is deluded. `deconfounded` is ahead of `naive_rnn` {'; '.join(parts)}."
    )


def table(points: list[Point]) -> str:
    """A row for each point of each column, in markdown."""
    rows = [
        (
            *(task, kind, f"{point['factor']:g}", *nats(point["certificate"]), point["certificate"]["verdict"]),
            *(two_decimals(np.mean(point["scores"][method])) for method in _methods(points)),
        )
        for task, kind, of in _columns(points)
        for point in of
    ]
    certified = ("dynamics, nats a step", "actions, nats a step", "certificate")
    return markdown_table(("task", "noise", "times", *certified, *_methods(points)), rows)


def _methods(points: list[Point]) -> list[str]:
    """Those that every point has scores of."""
    return [name for name in (*EXACT, *LEARNED) if all(name in point["scores"] for point in points)]


def picture(points: list[Point], file: Path, mark: str = "") -> None:
    """A column for each task and kind of noise: scores above, evidence below."""
    columns = _columns(points)
    shared: dict[str, Any] = {"sharex": True, "sharey": "row", "height_ratios": (3, 2)}
    with panels(file, 2, len(columns), size=(4.1 * len(columns), 6.2), dpi=100, mark=mark, **shared) as grid:
        for (task, kind, of), (above, below) in zip(columns, grid.T, strict=True):
            factors = [point["factor"] for point in of]
            for method in _methods(points):
                scores = [np.array(point["scores"][method]) for point in of]
                hue, style = colour(method), "--" if method in EXACT else "o-"
                above.plot(factors, [x.mean() for x in scores], style, color=hue, label=method)
                above.vlines(factors, [x.min() for x in scores], [x.max() for x in scores], color=hue, alpha=0.4)
            for point in of:
                hue = "tab:green" if point["certificate"]["verdict"] == "passed" else "0.5"
                above.axvspan(point["factor"] / 1.2, point["factor"] * 1.2, color=hue, alpha=0.09, lw=0)
            for source, hue in (("dynamics", "tab:green"), ("actions", "tab:red")):
                evidence = [point["certificate"]["evidence_nats_per_step"][source] for point in of]
                below.plot(factors, evidence, "s-", color=hue, label=f"of {source}")
            above.set(title=f"{task}\n{kind}", xscale="log")
            below.set(yscale="log", xlabel="times that of the suite")
            below.set_xticks(factors, [f"{factor:g}" for factor in factors])
            below.minorticks_off()
        grid[0, 0].set(ylabel="score, last episode", ylim=(0, None))
        grid[1, 0].set_ylabel("evidence of theta, nats a step")
        grid[0, 0].legend(frameon=False, fontsize=8)
        grid[1, 0].legend(frameon=False, fontsize=8)


def main() -> None:
    parser = commands.parser(__doc__, f"some of {', '.join(LEARNED)}; default: all", seeds=3)
    parser.add_argument("--tasks", nargs="+", metavar="NAME", default=list(noise.BASES), help="default: both")
    args = parser.parse_args()
    methods = commands.check(args, LEARNED, LEARNED)
    check_names("task", args.tasks, list(noise.BASES))
    from deconfounded.benchmarks.engine.presets import changed, preset
    from deconfounded.benchmarks.output import aggregation
    from deconfounded.benchmarks.output.index import last_scores

    folder, points = args.out or Path("results") / "spectrum", list[Point]()
    options = {"preset": args.preset, "changes": args.set, "cluster": args.cluster}
    for base, kind, factor, name in chain(*map(variants, args.tasks)):
        task, weights = envs.get(name), str(ASSETS / "experts" / f"{base}.safetensors")
        settings, own = changed(preset(args.preset, task, args.device), args.set), folder / task.name
        certificate, wanted = runs.certificate(task, weights, own), (*REFERENCES, *EXACT, *methods)
        made = runs.run(task, settings, wanted, range(args.seeds), own / "run", expert=weights, **options)
        results = aggregation.gather(made)
        scores = last_scores(results["methods"])
        last = {method: [*scores[method].values()] for method in scores if method in wanted}
        about = {"commit": results["commits"][-1], "machine": results["machine"], "versions": results["versions"]}
        point = {"task": base, "kind": kind, "factor": factor, **about}
        points.append({**point, "certificate": certificate, "scores": last})
        means = ", ".join(f"{method} {np.mean(last[method]):.2f}" for method in (*EXACT, *methods))
        print(f"{task.name}: certificate {certificate['verdict']}; {means}")
    write_json(folder / "spectrum.json", {"seeds": args.seeds, "preset": args.preset, "points": points})
    picture(points, folder / "spectrum.png")
    print(f"-> {folder / 'spectrum.png'}")
