"""Where delusion begins, and where everything drowns in noise: `deconf spectrum`

The cartpole on a tilted rail and the car on an icy road, with process noise or the expert's action noise times 1/4 to
8. Of each: its certificate, and the last episode's score of the exact policies, naive_rnn, deconfounded and dagger.
Interrupted, it goes on where it was.
"""

from __future__ import annotations

if __name__ == "__main__":  # Ctrl-C while the rest is imported is one line too
    from deconfounded.benchmarks.console import stop_at_once

    stop_at_once()

from itertools import chain
from pathlib import Path

import numpy as np

from deconfounded import envs
from deconfounded.benchmarks import commands
from deconfounded.benchmarks.console import run_command
from deconfounded.benchmarks.engine.catalogue import EXACT, REFERENCES, check_names
from deconfounded.benchmarks.studies import noise, runs
from deconfounded.benchmarks.studies.spectra import KINDS, LEARNED, Point, picture
from deconfounded.envs.support.files import write_json
from deconfounded.envs.task import ASSETS


def variants(base: str) -> list[tuple[str, str, float, str]]:
    """The task, the kinds of its noise, times which factor each, and the task with that."""
    points = [(kind, factor) for kind in KINDS for factor in noise.FACTORS[kind]]
    return [(base, *one, f"{noise.__name__}:{noise.title(base, *one)}") for one in points]


def main() -> None:
    """The command line."""
    parser = commands.parser(__doc__, f"some of {', '.join(LEARNED)}; default: all", seeds=3)
    parser.add_argument("--tasks", nargs="+", metavar="NAME", default=list(noise.BASES), help="default: both")
    args = parser.parse_args()
    methods = commands.check(args, LEARNED, LEARNED)
    check_names("task", args.tasks, list(noise.BASES))
    from deconfounded.benchmarks.engine.presets import changed, preset
    from deconfounded.benchmarks.output import records
    from deconfounded.benchmarks.output.index import last_scores

    folder, points = args.out or Path("results") / "spectrum", list[Point]()
    options = {"preset": args.preset, "changes": args.set, "device": args.device, "cluster": args.cluster}
    for base, kind, factor, name in chain(*map(variants, args.tasks)):
        task, weights = envs.get(name), str(ASSETS / "experts" / f"{base}.safetensors")
        settings, own = changed(preset(args.preset, task, args.device), args.set), folder / task.name
        certificate, wanted = runs.certificate(task, weights, own), (*REFERENCES, *EXACT, *methods)
        made = runs.run(task, settings, wanted, range(args.seeds), own, expert=weights, **options)
        results = records.gather(made)
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


if __name__ == "__main__":
    run_command(main, commands.KEPT)
