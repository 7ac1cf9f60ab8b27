"""How cost grows: `deconf growth`

CPU seconds by the steps of a trial (an update of the belief, a pass of the RNN) and by the values of the exact
policies' grid; each with the power of n that fits best. Seeds: `seeds.py`; environments: `speed.py`. Writes growth.json
and growth.png.
"""

from __future__ import annotations

if __name__ == "__main__":  # Ctrl-C while the rest is imported is one line too
    from deconfounded.benchmarks.console import stop_at_once

    stop_at_once()

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from deconfounded import envs
from deconfounded.benchmarks.console import Parser, place, run_command
from deconfounded.benchmarks.output.pictures import save_figure
from deconfounded.envs.support.files import check_folder, write_json

STEPS = (200, 400, 800, 1600, 3200)
VALUES = (5, 11, 21, 41, 81)


def cpu(run: Callable[[], object], looks: int = 5) -> float:
    """CPU seconds: the median of some looks, after one to warm up."""
    times = []
    for _ in range(looks + 1):
        start = time.process_time()
        run()
        times.append(time.process_time() - start)
    return float(np.median(times[1:]))


def by_steps(steps: int) -> dict[str, float]:
    """An update of the evidence belief, and a pass of the RNN, on 16 trials of so many steps of a cartpole's size."""
    from deconfounded.deconf.core.agents import Monitor
    from deconfounded.deconf.core.data import Batch, Draws, Signature
    from deconfounded.deconf.core.models import VariationalModel
    from deconfounded.deconf.core.nets import Adam, scalers
    from deconfounded.deconf.methods.recurrent import Cloner, RecurrentAgent, RecurrentConfig
    from deconfounded.experts.rollout import Trials

    rng = np.random.default_rng(0)
    obs = rng.standard_normal((16, 1, steps + 1, 6), np.float32)
    action = 2 * rng.random((16, 1, steps, 1), np.float32) - 1
    trials = Trials(obs, action, np.ones((16, 1, steps), bool))
    data, draws, signature = Batch.of(trials, 1), Draws([rng], "cpu"), Signature.of(trials)
    scaled = scalers(data)
    model, config = VariationalModel("evidence", 4, 64, signature, *scaled, draws), RecurrentConfig()
    optimizer, agent = Adam([model], 1e-3), RecurrentAgent.new(config.width, signature, scaled[0], draws)
    cloner = Cloner(agent, config, steps, Monitor())
    return {
        "an update of the belief": cpu(lambda: model.learn(optimizer, data, 1024, 1e-3, draws)),
        "a pass of the RNN": cpu(lambda: cloner.learn(data, data.action), 2),
    }


def by_values(task: envs.Task, values: int) -> dict[str, float]:
    """Two episodes of 32 trials of each exact policy, with a grid of so many values."""
    from deconfounded.deconf.exact import ExactAgent
    from deconfounded.experts import policy
    from deconfounded.experts.rollout import run_trials

    env, expert = envs.BatchEnv(task, 32), policy.load(task)
    found = {}
    for name in ("interventional", "conditional"):
        agent = ExactAgent(env, expert, name == "conditional", values)
        found[f"exact {name}"] = cpu(partial(run_trials, env, agent, 2, 0), 1)
    return found


def power(by: dict[int, float]) -> float:
    """The exponent of n that fits cost best."""
    return float(np.polyfit(np.log(list(by)), np.log(list(by.values())), 1)[0])


def picture(found: dict[str, dict[str, dict[int, float]]], file: Path) -> None:
    """Cost over n, both on logarithmic scales."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    for axes, (what, curves) in zip(panels, found.items(), strict=True):
        for name, by in curves.items():
            axes.plot(list(by), list(by.values()), "o-", label=f"{name}: n^{power(by):.2f}")
        axes.set(xscale="log", yscale="log", xlabel=what, ylabel="CPU seconds")
        axes.set_xticks(list(by), list(by))
        axes.set_xticks([], minor=True)
        axes.legend(frameon=False)
    save_figure(figure, file, 110)
    plt.close(figure)


def main() -> None:
    """The command line."""
    parser = Parser(__doc__)
    parser.add_argument("--task", default="slippery_cartpole", help="of the exact policies")
    parser.add_argument("--out", type=place, default=Path("results") / "speed", help="output folder")
    args = parser.parse_args()
    task = envs.get(args.task)
    check_folder(args.out)
    found: dict[str, dict[str, dict[int, float]]] = {"steps of a trial": {}, "values of the grid": {}}
    for what, sizes, measure in (
        ("steps of a trial", STEPS, by_steps),
        ("values of the grid", VALUES, lambda values: by_values(task, values)),
    ):
        for n in sizes:
            for name, seconds in measure(n).items():
                found[what].setdefault(name, {})[n] = seconds
        for name, by in found[what].items():
            costs = ", ".join(f"{n}: {1000 * seconds:,.0f}" for n, seconds in by.items())
            print(f"{name}, by {what}: ms {costs}; grows as n^{power(by):.2f}")
    write_json(args.out / "growth.json", found)
    picture(found, args.out / "growth.png")
    print(f"-> {args.out}")


if __name__ == "__main__":
    run_command(main)
