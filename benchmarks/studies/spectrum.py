"""Where delusion begins, and where everything drowns in noise: `deconf spectrum`

The cartpole on a tilted rail and the car on an icy road, with process noise or the expert's action noise times 1/4 to
8. Of each: its certificate, and the last episode's score of the exact policies, naive_rnn, deconfounded and dagger.
Interrupted, it goes on where it was.
"""

from __future__ import annotations

if __name__ == "__main__":  # Ctrl-C while the rest is imported is one line too
    from deconfounded.benchmarks.console import stop_at_once

    stop_at_once()

import json
from itertools import chain
from pathlib import Path

import numpy as np

from deconfounded import envs
from deconfounded.benchmarks import commands
from deconfounded.benchmarks.console import run_command
from deconfounded.benchmarks.engine.catalogue import EXACT, METHODS, REFERENCES, check_names
from deconfounded.benchmarks.studies import noise
from deconfounded.benchmarks.studies.spectra import KINDS, LEARNED, Point, picture
from deconfounded.envs.support.files import write_json
from deconfounded.envs.task import ASSETS
from deconfounded.experts import policy


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
    from deconfounded.benchmarks.certify import certify
    from deconfounded.benchmarks.engine.benchmark import BenchmarkJob
    from deconfounded.benchmarks.engine.presets import changed, preset
    from deconfounded.benchmarks.engine.scheduler import run_all
    from deconfounded.benchmarks.engine.store import prepare
    from deconfounded.benchmarks.output import records
    from deconfounded.benchmarks.output.index import last_scores

    folder, points = args.out or Path("results") / "spectrum", list[Point]()
    for base, kind, factor, name in chain(*map(variants, args.tasks)):
        task, weights = envs.get(name), str(ASSETS / "experts" / f"{base}.safetensors")
        settings, own = changed(preset(args.preset, task, args.device), args.set), folder / task.name
        wanted = [*REFERENCES, *EXACT, *(name for name in METHODS if name in methods)]
        seeds = tuple(range(args.seeds))
        jobs = [BenchmarkJob(task.reference, settings, one, seeds, own / "jobs", expert=weights) for one in wanted]
        with commands.locked(own), commands.engine(args.cluster) as engine:
            prepare(own, commands.about(BenchmarkJob, task, args.preset, settings, args.set), resume=True)
            if not (kept := own / "certificate.json").is_file():
                write_json(kept, certify(task, policy.load(task, weights)))
            finished, _ = run_all(jobs, args.device, task.name, engine)
        results = records.gather(records.of_run(finished, args.preset, args.set, task.episodes))
        last = {one: [*of.values()] for one, of in last_scores(results["methods"]).items() if one in wanted}
        certificate = json.loads(kept.read_bytes())
        made = {"commit": results["commits"][-1], "machine": results["machine"], "versions": results["versions"]}
        point = {"task": base, "kind": kind, "factor": factor, **made}
        points.append({**point, "certificate": certificate, "scores": last})
        told = ", ".join(f"{one} {np.mean(last[one]):.2f}" for one in (*EXACT, *methods))
        print(f"{task.name}: certificate {certificate['verdict']}; {told}")
    write_json(folder / "spectrum.json", {"seeds": args.seeds, "preset": args.preset, "points": points})
    picture(points, folder / "spectrum.png")
    print(f"-> {folder / 'spectrum.png'}")


if __name__ == "__main__":
    run_command(main, commands.KEPT)
