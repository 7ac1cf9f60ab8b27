"""What learning costs: `deconf cost --task slippery_cartpole`

Score in the last episode against CPU seconds, for each learned method, with shares of the default preset's updates. How
its amounts were chosen: where the curve is flat, a smaller share does.
"""

from __future__ import annotations

if __name__ == "__main__":  # Ctrl-C while the rest is imported is one line too
    from deconfounded.benchmarks.console import stop_at_once

    stop_at_once()

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from deconfounded import envs
from deconfounded.benchmarks import commands
from deconfounded.benchmarks.console import run_command
from deconfounded.benchmarks.engine.catalogue import METHODS, REFERENCES
from deconfounded.benchmarks.output.pictures import save_figure
from deconfounded.envs.support.files import write_json
from deconfounded.experts import policy

SHARES = (0.25, 0.5, 1.0)
LEARNED = tuple(name for name, method in METHODS.items() if method.learned and name != "deconfounded_gru")


def scaled(config: dict[str, Any], share: float) -> dict[str, Any]:
    """A method's configuration with that share of its updates."""
    return {name: max(1, round(of * share)) if name.endswith("updates") else of for name, of in config.items()}


def picture(task: str, found: dict[str, Any], file: Path) -> None:
    """A panel a method: score against CPU seconds, a dot a share."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(2, -(-len(found) // 2), figsize=(13, 6), layout="constrained", squeeze=False)
    for axes in panels.flat[len(found) :]:
        axes.axis("off")
    for axes, (method, points) in zip(panels.flat, found.items(), strict=False):
        cpu, scores = [[point[key] for point in points.values()] for key in ("cpu_s", "scores")]
        axes.plot(
            cpu, [np.mean(one) for one in scores], "o-", color="tab:blue", label="1/4, 1/2 and all of the updates"
        )
        axes.vlines(cpu, [min(one) for one in scores], [max(one) for one in scores], color="tab:blue", alpha=0.4)
        axes.set(title=method, xlabel="CPU seconds a seed", xlim=(0, None), ylim=(-0.05, 1.1))
    panels.flat[0].set_ylabel("score, last episode")
    panels.flat[0].legend(frameon=False, fontsize=8)
    figure.suptitle(task)
    save_figure(figure, file, 100)
    plt.close(figure)


def main() -> None:
    """The command line."""
    parser = commands.parser(__doc__, f"some of {', '.join(LEARNED)}; default: all", seeds=1)
    parser.add_argument("--task", required=True)
    args = parser.parse_args()
    task, methods = envs.get(args.task), commands.check(args, LEARNED, LEARNED)
    envs.check_task(task)
    policy.load(task)
    from deconfounded.benchmarks.engine.benchmark import BenchmarkJob
    from deconfounded.benchmarks.engine.presets import changed, preset
    from deconfounded.benchmarks.engine.scheduler import run_all
    from deconfounded.benchmarks.engine.store import prepare
    from deconfounded.benchmarks.output import records, score

    folder = args.out or Path("results") / f"cost-{task.name}"
    full = changed(preset(args.preset, task, args.device), args.set)
    found: dict[str, Any] = {method: {} for method in methods}
    for share in SHARES:
        settings = replace(full, configs={name: scaled(config, share) for name, config in full.configs.items()})
        own = folder / f"{share:g}"
        label = f"{task.name}, {share:g} of the updates"
        wanted = [*REFERENCES, *methods]
        jobs = [BenchmarkJob(task.reference, settings, name, tuple(range(args.seeds)), own / "jobs") for name in wanted]
        with commands.locked(own), commands.engine(args.cluster) as engine:
            prepare(own, commands.about(BenchmarkJob, task, args.preset, settings, args.set), args.resume)
            finished, _ = run_all(jobs, args.device, label, engine)
        made = records.of_run(finished, args.preset, args.set, task.episodes)
        results = records.gather(made)["methods"]
        zero, one = (float(np.mean(results[name]["return"])) for name in REFERENCES)
        for method in methods:
            last = score.normalise(np.array(results[method]["return"])[:, -1], zero, one)
            found[method][f"{share:g}"] = {"cpu_s": results[method]["cpu_s"], "scores": last.round(4).tolist()}
            print(f"{method:22} {share:5g} of the updates: {results[method]['cpu_s']:6.1f} CPU s, {last.mean():.3f}")
    write_json(folder / "cost.json", {"task": task.name, "seeds": args.seeds, "methods": found})
    picture(task.name, found, folder / "cost.png")
    print(f"-> {folder / 'cost.png'}")


if __name__ == "__main__":
    run_command(main, commands.KEPT)
