"""What the benchmark costs: `deconf performance` (hours), or some of its parts: `deconf performance speed growth`

speed: how fast environments step (minutes). peer: EnvPool beside ours, on its models (a minute; `pip install
envpool`; only where it is named). growth: CPU seconds by the steps of a trial (an update of the belief, a
pass of the RNN) and by the values of the exact policies' grid, each with the power of n that fits best. seeds: seconds
an update of S seeds in one program over those of one seed: S means that stacking gains nothing, 1 that the other seeds
come for free. training: CPU seconds of one seed of each learned method (set OMP_NUM_THREADS=1). latency: milliseconds
of an agent's step in one environment, by method (minutes). particles: the exact policy's belief by particles beside
that by a grid (half an hour). cost: score in the last episode against CPU seconds, for each learned method, with shares
of the default preset's updates; where the curve is flat, a smaller share does. Parts of learned methods leave out
deconfounded_gru, which takes long. Each part writes a .json, and most a .png.
"""

import argparse
import platform
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

import numpy as np

from deconfounded import envs
from deconfounded.benchmarks import commands
from deconfounded.benchmarks.console import Parser, place
from deconfounded.benchmarks.engine import identity
from deconfounded.benchmarks.engine.catalogue import EXACT, METHODS, REFERENCES, check_names
from deconfounded.benchmarks.output.pictures import panels
from deconfounded.benchmarks.studies import runs, stepping
from deconfounded.envs.physics import cores
from deconfounded.envs.support.files import check_folder, write_json

if TYPE_CHECKING:
    from deconfounded.benchmarks.engine.presets import Preset

STEPS, VALUES = (200, 400, 800, 1600, 3200), (5, 11, 21, 41, 81)  # of a trial, and of the exact policies' grid
GRID, STACKED = "slippery_cartpole", "bandit"  # the tasks of the exact policies, and of seeds in one program
SEEDS = (1, 2, 5, 10)
UPDATES = 12  # of each kind, timed; the first ones warm up
TIMED = ("naive_rnn", "deconfounded", "deconfounded_discrete")
COST = ("bandit", "tilted_cartpole", "slippery_cartpole")
SHARES = (0.25, 0.5, 1.0)
LEARNED = tuple(name for name in METHODS if name not in (*EXACT, *REFERENCES, "deconfounded_gru"))


def speed(args: argparse.Namespace) -> None:
    """Of all tasks with physics, or those asked for."""
    physics = [task for task in map(envs.get, envs.SUITE) if isinstance(task, envs.MujocoTask)]
    measured = stepping.by_task(args.tasks or physics)
    about = {"machine": f"{platform.machine()}, {cores()} threads", "python": platform.python_version()}
    made = {**about, "versions": identity.versions(), "tasks": measured}
    write_json(args.out / "speed.json", made)
    stepping.picture(measured, args.out / "speed.png")


def peer(args: argparse.Namespace) -> None:
    """EnvPool beside our vector environment."""
    from deconfounded.benchmarks.studies.peer import against_envpool

    about = {"machine": f"{platform.machine()}, {cores()} threads", "versions": identity.versions()}
    write_json(args.out / "peer.json", {**about, **against_envpool()})


def by_steps(steps: int) -> dict[str, float]:
    """CPU seconds of an update of the evidence belief, and of a pass of the RNN, on 16 trials of so many steps."""
    from deconfounded.deconf.core.adam import Adam
    from deconfounded.deconf.core.data import Batch, Draws, Signature
    from deconfounded.deconf.core.models import VariationalModel
    from deconfounded.deconf.core.monitor import Monitor
    from deconfounded.deconf.core.nets import Scales
    from deconfounded.deconf.methods.sequence_bc import RecurrentAgent, RecurrentConfig, RecurrentTrainer
    from deconfounded.experts.trials import Trials

    rng = np.random.default_rng(0)
    obs = rng.standard_normal((16, 1, steps + 1, 6), np.float32)
    action = 2 * rng.random((16, 1, steps, 1), np.float32) - 1
    trials = Trials(obs, action, np.ones((16, 1, steps), bool))
    data, draws, signature = Batch.of(trials, 1), Draws([rng], "cpu"), Signature.of(trials)
    scales = Scales.of(signature, data)
    model, config = VariationalModel("evidence", 4, 64, scales, draws), RecurrentConfig()
    optimizer, agent = Adam([model], 1e-3), RecurrentAgent.new(config.width, scales, draws)
    trainer = RecurrentTrainer(agent, config, steps, Monitor())
    timed = {
        "an update of the belief": lambda: model.learn(optimizer, data, 1024, 1e-3, draws),
        "a pass of the RNN": lambda: trainer.learn(data, data.action),
    }
    return stepping.seconds(timed, time.process_time)


def by_values(values: int) -> dict[str, float]:
    """CPU seconds of two episodes of 32 trials of each exact policy, with a grid of so many values."""
    from deconfounded.deconf.exact import ExactAgent
    from deconfounded.experts import policy
    from deconfounded.experts.rollout import run_trials

    env = envs.BatchEnv(envs.get(GRID), 32)
    expert = policy.load(env.task)
    agents = {name: ExactAgent(env, expert, name == "conditional", values) for name in EXACT[::-1]}
    timed = {f"exact {name}": partial(run_trials, env, agent, 2, 0) for name, agent in agents.items()}
    return stepping.seconds(timed, time.process_time, 1)


def power(by: dict[int, float]) -> float:
    """The exponent of n that fits cost best."""
    return float(np.polyfit(np.log(list(by)), np.log(list(by.values())), 1)[0])


def growth(args: argparse.Namespace) -> None:
    """By the steps of a trial, and by the values of the grid."""
    measured: dict[str, dict[str, dict[int, float]]] = {}
    for what, sizes, measure in (("steps of a trial", STEPS, by_steps), ("values of the grid", VALUES, by_values)):
        rows = {n: measure(n) for n in sizes}
        measured[what] = {name: {n: row[name] for n, row in rows.items()} for name in rows[sizes[0]]}
        for name, by in measured[what].items():
            costs = ", ".join(f"{n}: {1000 * seconds:,.0f}" for n, seconds in by.items())
            print(f"{name}, by {what}: ms {costs}; grows as n^{power(by):.2f}")
    write_json(args.out / "growth.json", measured)
    with panels(args.out / "growth.png", 1, 2, size=(10, 4)) as [row]:
        for axes, (what, curves) in zip(row, measured.items(), strict=True):
            for name, by in curves.items():
                axes.plot(list(by), list(by.values()), "o-", label=f"{name}: n^{power(by):.2f}")
                axes.set(xscale="log", yscale="log", xlabel=what, ylabel="CPU seconds")
                axes.set_xticks(list(by), list(by))
            axes.set_xticks([], minor=True)
            axes.legend(frameon=False)


def few(full: "Preset") -> "Preset":
    """The preset's networks and batches, on little data and for few updates."""
    small = {"rounds": 1, "final_updates": 0, "inference_updates": UPDATES, "imitation_updates": UPDATES}
    little = replace(full, expert_trials=128, explore_trials=128, eval_trials=1, fresh=0)
    little = little.configured("deconfounded", **small).configured("deconfounded_discrete", **small)
    return little.configured("naive_rnn", updates=UPDATES, chunk=min(full.configs["naive_rnn"]["chunk"], 50))


def update_seconds(task: envs.Task, settings: "Preset", method: str, seeds: int) -> dict[str, float]:
    """Seconds of an update of so many seeds in one program, by kind of update."""
    from deconfounded.benchmarks.engine.context import Context
    from deconfounded.benchmarks.engine.provider import fit
    from deconfounded.deconf.core.monitor import Monitor
    from deconfounded.experts.agent import Agent

    class Clock(Monitor):
        """Times the updates of each kind."""

        times: dict[str, list[float]] = {}
        last, done = time.perf_counter(), 0

        def update(self, done: int, total: int, losses: dict[str, float], agent: Agent | None = None) -> None:
            now = time.perf_counter()  # a GPU is done by now: the loss was read
            self.times.setdefault(next(iter(losses)), []).append((now - self.last) / (done - self.done))
            self.last, self.done = now, done

    clock = Clock()
    fit(Context(task, settings, range(seeds), clock), method)
    return {kind: median(times[2:]) for kind, times in clock.times.items()}


def seeds(args: argparse.Namespace) -> None:
    """Side by side in one program, in one thread or on a GPU."""
    import torch

    from deconfounded.benchmarks.engine.presets import preset

    task = envs.get(STACKED)
    settings, measured = few(preset("default", task, args.device)), dict[str, dict[int, dict[str, float]]]()
    print(f"{task.name}, {args.device}, torch {torch.__version__}")
    for method in TIMED:
        by_count = measured[method] = {count: update_seconds(task, settings, method, count) for count in SEEDS}
        for kind, alone in by_count[1].items():
            for count, of in by_count.items():
                ms, ratio = 1000 * of[kind], of[kind] / alone
                print(f"{method:22} {kind:10} {count:3} seeds {ms:8.1f} ms an update, {ratio:5.2f} of one")
    write_json(args.out / "seeds.json", {"task": task.name, "device": args.device, "methods": measured})


def scaled(config: dict[str, Any], share: float) -> dict[str, Any]:
    """A method's configuration with that share of its updates."""
    return {name: max(1, round(of * share)) if name.endswith("updates") else of for name, of in config.items()}


def cost(args: argparse.Namespace) -> None:
    """Of some tasks: one seed of each learned method, with each share of its updates."""
    from deconfounded.benchmarks.engine.presets import preset
    from deconfounded.benchmarks.output import aggregation
    from deconfounded.benchmarks.output.index import last_scores

    for task in args.tasks or map(envs.get, COST):
        full, measured = preset("default", task, "cpu"), dict[str, Any]()
        for share in SHARES:
            settings = replace(full, configs={name: scaled(config, share) for name, config in full.configs.items()})
            own = args.out / f"cost-{task.name}" / f"{share:g}"
            made = runs.run(task, settings, (*REFERENCES, *LEARNED), (0,), own)
            results = aggregation.gather(made)["methods"]
            last = last_scores(results)
            for method in LEARNED:
                scores = [round(score, 4) for score in last[method].values()]
                point = {"cpu_s": results[method]["cpu_s"], "scores": scores}
                measured.setdefault(method, {})[f"{share:g}"] = point
                costs = f"{point['cpu_s']:6.1f} CPU s, {scores[0]:.3f}"
                print(f"{task.name}, {method:22} {share:5g} of the updates: {costs}")
        write_json(args.out / f"cost-{task.name}.json", {"task": task.name, "seeds": 1, "methods": measured})
        with panels(args.out / f"cost-{task.name}.png", 2, -(-len(measured) // 2), size=(13, 6)) as grid:
            for axes, (method, points) in zip(grid.flat, measured.items(), strict=False):
                cpu, scores = [[point[key] for point in points.values()] for key in ("cpu_s", "scores")]
                axes.plot(cpu, scores, "o-", color="tab:blue", label="1/4, 1/2 and all of the updates")
                axes.set(title=method, xlabel="CPU seconds a seed", xlim=(0, None), ylim=(-0.05, 1.1))
            for axes in grid.flat[len(measured) :]:
                axes.axis("off")
            grid[0, 0].set_ylabel(f"score on {task.name}, last episode")
            grid[0, 0].legend(frameon=False, fontsize=8)


def training(args: argparse.Namespace) -> None:
    """Of one seed of each learned method on a task, its data included."""
    from deconfounded.benchmarks.engine.context import Context
    from deconfounded.benchmarks.engine.presets import preset
    from deconfounded.benchmarks.engine.provider import fit
    from deconfounded.deconf.core.monitor import Monitor

    task, measured = envs.get(GRID), dict[str, float]()
    settings = preset("default", task, "cpu")
    for method in LEARNED:
        start = time.process_time()
        fit(Context(task, settings, (0,), Monitor()), method)
        measured[method] = round(time.process_time() - start, 3)
        print(f"{task.name}, {method:22} {measured[method]:6.1f} CPU s")
    write_json(args.out / "training.json", {"task": task.name, "versions": identity.versions(), "cpu_s": measured})


def particles(args: argparse.Namespace) -> None:
    """Of all tasks, or those asked for; what the output folder has of them stays."""
    from deconfounded.benchmarks.studies.particles import by_task

    by_task(args.tasks or [*map(envs.get, (*envs.SUITE, *envs.HARD))], args.out / "particles.json")


def latency(args: argparse.Namespace) -> None:
    """Of each learned method on a task."""
    from deconfounded.benchmarks.studies.latency import by_method

    task = envs.get(GRID)
    measured = by_method(task, [name for name in LEARNED if name != "oracle_bc"])  # which is given theta
    write_json(args.out / "latency.json", {"task": task.name, "versions": identity.versions(), "methods": measured})


PARTS = {
    "speed": speed,
    "peer": peer,
    "growth": growth,
    "seeds": seeds,
    "training": training,
    "latency": latency,
    "particles": particles,
    "cost": cost,
}


def main() -> None:
    parser = Parser(__doc__)
    parser.add_argument("--device", default="cpu", help="torch device, of seeds alone; the other parts are of a CPU")
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"some of {', '.join(PARTS)}; default: all")
    named = f"of speed, particles and cost; default: all with physics, all, and {', '.join(COST)}"
    parser.add_argument("--tasks", nargs="+", metavar="NAME", default=(), help=named)
    parser.add_argument("--out", type=place, default=Path("results") / "performance", help="output folder")
    args = parser.parse_args()
    check_names("part", args.parts, list(PARTS))
    args.tasks = [envs.get(name) for name in args.tasks]
    commands.check_device(args.device)
    check_folder(args.out)
    for part in args.parts or [part for part in PARTS if part != "peer"]:
        PARTS[part](args)
    print(f"-> {args.out}")
