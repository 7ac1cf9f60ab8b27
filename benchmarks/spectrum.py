"""Where delusion begins, and where everything drowns in noise: `python benchmarks/spectrum.py`

The cartpole on a tilted rail and the car on an icy road, with process noise or the expert's action noise times 1/4 to
8. Of each: its certificate, and the last episode's score of the exact policies, naive_rnn, deconfounded and dagger.
Interrupted, it goes on where it was.
"""

from __future__ import annotations

if __name__ == "__main__":  # Ctrl-C while the rest is imported is one line too
    from deconfounded.benchmarks.console import stop_at_once

    stop_at_once()

import json
from pathlib import Path
from typing import Any

import numpy as np

from deconfounded import envs
from deconfounded.benchmarks import commands, noisier
from deconfounded.benchmarks.console import run_command
from deconfounded.benchmarks.engine.catalogue import EXACT, METHODS, REFERENCES, check_names
from deconfounded.envs.files import save_figure, write_json
from deconfounded.envs.task import ASSETS
from deconfounded.experts import policy

LEARNED = ("deconfounded", "naive_rnn", "dagger")
KINDS = {"process": "process noise", "expert": "the expert's action noise"}


def variants(base: str, kind: str) -> list[tuple[float, str]]:
    """The factors of a kind of noise, in order, and the name of the task with it; 1 is process noise's."""
    named = {factor: noisier.title(base, kind, factor) for factor in noisier.FACTORS[kind]}
    named[1] = noisier.title(base, "process", 1)
    return [(factor, f"{noisier.__name__}:{named[factor]}") for factor in sorted(named)]


def picture(found: dict[str, Any], file: Path) -> None:
    """A column for each task and kind of noise: scores above, evidence below."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from deconfounded.benchmarks.output.colours import colour

    columns = [(base, kind) for base in found for kind in KINDS]
    figure, panels = plt.subplots(
        2,
        len(columns),
        sharex=True,
        height_ratios=(3, 2),
        figsize=(4.1 * len(columns), 6.2),
        layout="constrained",
        squeeze=False,
    )
    for k, (base, kind) in enumerate(columns):
        above, below = panels[:, k]
        points = [(factor, found[base][name]) for factor, name in variants(base, kind) if name in found[base]]
        for method in (*EXACT, *LEARNED):
            of = [(factor, np.array(point["scores"][method])) for factor, point in points]
            style = "--" if method in EXACT else "o-"
            above.plot([f for f, _ in of], [x.mean() for _, x in of], style, color=colour(method), label=method)
            above.vlines(
                [f for f, _ in of], [x.min() for _, x in of], [x.max() for _, x in of], color=colour(method), alpha=0.4
            )
        for factor, point in points:
            passed = point["certificate"]["verdict"] == "passed"
            above.axvspan(factor / 1.2, factor * 1.2, color="tab:green" if passed else "0.5", alpha=0.09, lw=0)
        for source, hue in (("dynamics", "tab:green"), ("actions", "tab:red")):
            nats = [point["certificate"]["evidence_nats_per_step"][source] for _, point in points]
            below.plot([factor for factor, _ in points], nats, "s-", color=hue, label=f"of {source}")
        above.set(title=f"{base}\n{KINDS[kind]}", ylim=(-0.1, 1.1), xscale="log")
        below.set(yscale="log", xlabel="times that of the suite")
        below.set_xticks([factor for factor, _ in points], [f"{factor:g}" for factor, _ in points])
        below.minorticks_off()
    panels[0, 0].set_ylabel("score, last episode")
    panels[1, 0].set_ylabel("evidence of theta, nats a step")
    panels[0, 0].legend(frameon=False, fontsize=8)
    panels[1, 0].legend(frameon=False, fontsize=8)
    save_figure(figure, file, 100)
    plt.close(figure)


def main() -> None:
    """The command line."""
    parser = commands.parser(__doc__, f"some of {', '.join(LEARNED)}; default: all", seeds=3)
    parser.add_argument("--tasks", nargs="+", metavar="NAME", default=list(noisier.BASES), help="default: both")
    args = parser.parse_args()
    methods = commands.check(args, LEARNED, LEARNED)
    check_names("task", args.tasks, list(noisier.BASES))
    from deconfounded.benchmarks.certify import certify
    from deconfounded.benchmarks.engine.jobs import BenchmarkJob
    from deconfounded.benchmarks.engine.pool import prepare, run_all
    from deconfounded.benchmarks.engine.presets import changed, preset
    from deconfounded.benchmarks.output import records
    from deconfounded.benchmarks.output.index import last_scores

    folder, found = args.out or Path("results") / "spectrum", dict[str, Any]()
    for base in args.tasks:
        weights, found[base] = str(ASSETS / "experts" / f"{base}.safetensors"), {}
        for name in dict.fromkeys(name for kind in KINDS for _, name in variants(base, kind)):
            task = envs.get(name)
            settings, own = changed(preset(args.preset, task, args.device), args.set), folder / task.name
            wanted = [*REFERENCES, *EXACT, *(name for name in METHODS if name in methods)]
            seeds = tuple(range(args.seeds))
            jobs = [BenchmarkJob(task.reference, settings, one, seeds, own / "jobs", expert=weights) for one in wanted]
            with commands.locked(own), commands.engine(args.cluster) as engine:
                prepare(own, commands.about(BenchmarkJob, task, args.preset, settings, args.set), resume=True)
                if not (kept := own / "certificate.json").is_file():
                    write_json(kept, certify(task, policy.load(task, weights)))
                finished, _ = run_all(jobs, args.device, task.name, engine)
            results = records.gather(records.of_run(finished, args.preset, args.set, task.episodes))["methods"]
            last = {one: [*of.values()] for one, of in last_scores(results).items() if one in wanted}
            found[base][name] = {"certificate": json.loads(kept.read_text()), "scores": last}
            told = ", ".join(f"{one} {np.mean(last[one]):.2f}" for one in (*EXACT, *methods))
            print(f"{task.name}: certificate {found[base][name]['certificate']['verdict']}; {told}")
    shown = {base: {envs.get(name).name: point for name, point in points.items()} for base, points in found.items()}
    write_json(folder / "spectrum.json", {"seeds": args.seeds, "preset": args.preset, "tasks": shown})
    picture(found, folder / "spectrum.png")
    print(f"-> {folder / 'spectrum.png'}")


if __name__ == "__main__":
    run_command(main, commands.KEPT)
