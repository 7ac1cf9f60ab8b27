"""How fast environments step: all ways of stepping side by side, in control steps a second.

Our vector env in closed loop (observations, rewards and resets included), mujoco.rollout in open loop, gymnasium's
SyncVectorEnv over our single env, and raw mj_step in one thread times the threads; and memory an environment.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import psutil
from gymnasium.vector import SyncVectorEnv

from deconfounded import envs
from deconfounded.benchmarks.engine.progress import Progress
from deconfounded.benchmarks.output.pictures import panels
from deconfounded.envs.physics import Physics, cores

SIZES = (1, 16, 64, 256, 1024, 4096)  # environments
SYNC = 64  # environments, at most, that SyncVectorEnv is timed with


def seconds(
    runs: Mapping[str, Callable[[], object]], clock: Callable[[], float] = time.perf_counter, repeats: int = 5
) -> dict[str, float]:
    """Seconds by that clock: the median of some repeats of each run, in turn, after one to warm up."""
    times: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(repeats + 1):
        for name, run in runs.items():
            start = clock()
            run()
            times[name].append(clock() - start)
    return {name: float(np.median(each[1:])) for name, each in times.items()}


def raw(model: mujoco.MjModel, steps: int) -> Callable[[], object]:
    """So many physics steps of one environment in one thread, from its start, without control."""
    data = mujoco.MjData(model)

    return lambda: (mujoco.mj_resetData(model, data), mujoco.mj_step(model, data, nstep=steps))


def closed_loop(env: Any, actions: Any) -> Callable[[], object]:
    """Those actions one after another in a vector env."""
    env.reset(seed=0)

    def run() -> None:
        for action in actions:
            env.step(action)

    return run


def measure(task: envs.MujocoTask, n: int) -> dict[str, float]:
    """Control steps a second, by way of stepping; KiB an environment. The same actions and the same thetas for all."""
    steps = max(8, min(task.horizon, 20_000 // n))
    actions = np.random.default_rng(0).uniform(-1, 1, (steps, n, *task.action_space.shape)).astype(np.float32)
    memory = psutil.Process().memory_info
    before = memory().rss
    ours = envs.make_vec(task.name, n)
    loop = closed_loop(ours, actions)
    kib = (memory().rss - before) / 1024 / n
    start, simulator = ours.batch.state.copy(), ours.batch.simulator
    assert isinstance(simulator, Physics)
    controls = np.ascontiguousarray(actions.transpose(1, 0, 2), float)
    physics = 4000
    runs = {
        "closed_loop": loop,
        "open_loop": lambda: simulator.rollout(start, controls),
        "mj_step": raw(simulator.models[0], physics),
    }
    counts = {"closed_loop": n * steps, "open_loop": n * steps, "mj_step": physics * cores() / task.substeps}
    if n <= SYNC:
        few = actions[: max(4, 600 // n)]
        runs["sync_vector_env"] = closed_loop(SyncVectorEnv([lambda: envs.make(task.name) for _ in range(n)]), few)
        counts["sync_vector_env"] = n * len(few)
    rates = {name: counts[name] / each for name, each in seconds(runs).items()}
    return {**rates, "kib": kib}


def by_task(tasks: Sequence[envs.Task]) -> dict[str, dict[str, dict[str, float]]]:
    """What is measured of each task by number of environments. Raises InputError for a task without physics."""
    physics = [task for task in tasks if isinstance(task, envs.MujocoTask)]
    if lacking := [task.name for task in tasks if task not in physics]:
        raise envs.InputError(f"{lacking[0]} has no physics to time; give a MuJoCo task")
    progress = Progress(len(tasks) * len(SIZES), "timing")
    measured: dict[str, dict[str, dict[str, float]]] = {}
    for task in physics:
        measured[task.name] = {}
        for n in SIZES:
            row = measured[task.name][str(n)] = measure(task, n)
            rates = ", ".join(f"{name} {rate:,.0f}" for name, rate in row.items() if name != "kib")
            progress.line(f"{task.name}, {n} environments: {rates} steps/s; {row['kib']:.0f} KiB each")
            progress.update(1)
    progress.close()
    return measured


def picture(measured: dict[str, dict[str, dict[str, float]]], file: Path) -> None:
    """Closed loop as a share of open loop, and microseconds a step of one environment, by number of environments."""
    import matplotlib

    with panels(file, 1, 2, size=(11, 4)) as [[left, right]]:
        for axes in (left, right):
            axes.set_prop_cycle(color=matplotlib.color_sequences["tab20"])
        for name, by_size in measured.items():
            sizes, rows = [int(n) for n in by_size], by_size.values()
            left.plot(sizes, [row["closed_loop"] / row["open_loop"] for row in rows], "o-", ms=4, label=name)
            right.plot(sizes, [1e6 / row["closed_loop"] for row in rows], "o-", ms=4, label=name)
        left.set(xscale="log", ylim=(0, 1.1), xlabel="environments", title="closed loop / open loop")
        right.set(xscale="log", yscale="log", xlabel="environments", title="microseconds a control step of one")
        right.legend(frameon=False, bbox_to_anchor=(1, 0.5), loc="center left")
