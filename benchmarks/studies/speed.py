"""How fast environments step: `deconf speed` (all tasks, some minutes), or `--task slippery_cartpole`

Side by side in one run, in control steps a second: our vector env in closed loop (observations, rewards and resets
included), mujoco.rollout in open loop, gymnasium's SyncVectorEnv over our single env, and raw mj_step in one thread
times the threads; and memory an environment. If `envpool` is installed (a peer: C++ threads), both engines in closed
loop, on a cartpole each, as shares of raw mj_step on their own model. Writes speed.json and speed.png.
"""

from __future__ import annotations

if __name__ == "__main__":  # Ctrl-C while the rest is imported is one line too
    from deconfounded.benchmarks.console import stop_at_once

    stop_at_once()

import os
import platform
import time
from collections.abc import Callable
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from gymnasium.vector import SyncVectorEnv

from deconfounded import envs
from deconfounded.benchmarks.console import Parser, place, run_command
from deconfounded.benchmarks.engine import identity
from deconfounded.benchmarks.engine.progress import Progress
from deconfounded.benchmarks.output.pictures import save_figure
from deconfounded.envs.physics import Physics, cores
from deconfounded.envs.support.files import check_folder, write_json

SIZES = (1, 4, 16, 64, 256, 1024, 4096)
SYNC = 64  # environments, at most, that SyncVectorEnv is timed with
LOOKS = 5  # at each way of stepping, in turn


def rates(ways: dict[str, tuple[int, Callable[[], object]]]) -> dict[str, float]:
    """Steps a second by way (steps, run): the median of some looks at each, in turn, after one to warm up."""
    times: dict[str, list[float]] = {name: [] for name in ways}
    for look in range(LOOKS + 1):
        for name, (_, run) in ways.items():
            start = time.perf_counter()
            run()
            if look:
                times[name].append(time.perf_counter() - start)
    return {name: steps / float(np.median(times[name])) for name, (steps, _) in ways.items()}


def resident() -> int:
    """Bytes of memory that this process holds."""
    return int(Path("/proc/self/statm").read_text("utf-8").split()[1]) * os.sysconf("SC_PAGE_SIZE")


def raw(model: mujoco.MjModel, steps: int) -> Callable[[], object]:
    """So many physics steps of one environment in one thread, from its start, without control."""
    data = mujoco.MjData(model)

    def run() -> None:
        mujoco.mj_resetData(model, data)
        mujoco.mj_step(model, data, nstep=steps)

    return run


def measure(task: envs.MujocoTask, n: int) -> dict[str, float]:
    """Control steps a second, by way of stepping; KiB an environment. The same actions and the same thetas for all."""
    steps = max(8, min(task.horizon, 20_000 // n))
    actions = np.random.default_rng(0).uniform(-1, 1, (steps, n, task.action_width)).astype(np.float32)
    before = resident()
    ours = envs.make_vec(task.name, n)
    ours.reset(seed=0)
    memory = (resident() - before) / 1024 / n
    start, simulator = ours.batch.state.copy(), ours.batch.simulator
    assert isinstance(simulator, Physics)
    controls = np.ascontiguousarray(actions.transpose(1, 0, 2), float)

    def closed_loop() -> None:
        for action in actions:
            ours.step(action)

    physics = 4000
    ways: dict[str, tuple[int, Callable[[], object]]] = {
        "closed_loop": (n * steps, closed_loop),
        "open_loop": (n * steps, lambda: simulator.rollout(start, controls)),
        "mj_step": (physics, raw(simulator.models[0], physics)),
    }
    if n <= SYNC:
        theirs = SyncVectorEnv([lambda: envs.make(task.name) for _ in range(n)])
        theirs.reset(seed=0)
        few = actions[: max(4, 600 // n)]

        def sync_vector_env() -> None:
            for action in few:
                theirs.step(action)

        ways["sync_vector_env"] = (n * len(few), sync_vector_env)
    found = rates(ways)
    found["mj_step"] *= cores() / task.substeps
    return {**found, "kib": memory}


def against_envpool(n: int = 64) -> dict[str, Any] | None:
    """Physics steps a second in closed loop over raw mj_step times threads, of ours and of envpool's cartpole."""
    try:
        import envpool  # type: ignore[import-not-found]

        cartpole = files("dm_control") / "suite" / "cartpole.xml"  # what suite.load makes of it fails under MuJoCo 4
    except ImportError:
        return None
    theirs = envpool.make("CartpoleBalance-v1", env_type="gymnasium", num_envs=n, num_threads=cores())
    theirs.reset()
    task, ours = envs.get("tilted_cartpole"), envs.make_vec("tilted_cartpole", n)
    assert isinstance(task, envs.MujocoTask)
    ours.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1, 1, (200, n, 1))
    model = mujoco.MjModel.from_xml_path(str(cartpole))
    found = rates(
        {
            "ours": (n * 200 * task.substeps, lambda: [ours.step(action) for action in actions]),
            "envpool": (n * 200, lambda: [theirs.step(action) for action in actions]),
            "our mj_step": (8000, raw(task.model, 8000)),
            "its mj_step": (8000, raw(model, 8000)),
        }
    )
    return {
        "environments": n,
        "version": version("envpool"),
        "physics_steps_a_second": found,
        "share_of_mj_step": {
            "ours": found["ours"] / found["our mj_step"] / cores(),
            "envpool": found["envpool"] / found["its mj_step"] / cores(),
        },
    }


def picture(found: dict[str, dict[str, dict[str, float]]], file: Path) -> None:
    """Closed loop as a share of open loop, and microseconds a step of one environment, by number of environments."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
    for axes in (left, right):
        axes.set_prop_cycle(color=matplotlib.color_sequences["tab20"])
    for name, by_size in found.items():
        sizes = [int(n) for n in by_size]
        left.plot(sizes, [row["closed_loop"] / row["open_loop"] for row in by_size.values()], "o-", ms=4, label=name)
        right.plot(sizes, [1e6 / row["closed_loop"] for row in by_size.values()], "o-", ms=4, label=name)
    left.set(xscale="log", ylim=(0, 1.1), xlabel="environments", title="closed loop / open loop")
    right.set(xscale="log", yscale="log", xlabel="environments", title="microseconds a control step of one")
    right.legend(frameon=False, bbox_to_anchor=(1, 0.5), loc="center left")
    save_figure(figure, file, 110)
    plt.close(figure)


def main() -> None:
    """The command line."""
    parser = Parser(__doc__)
    parser.add_argument("--task", nargs="+", metavar="NAME", help="default: all that have physics")
    parser.add_argument("--n", type=int, nargs="+", default=SIZES, help="environments; default: 1 to 4096")
    parser.add_argument("--out", type=place, default=Path("results") / "speed", help="output folder")
    args = parser.parse_args()
    physics = [name for name in envs.SUITE if isinstance(envs.get(name), envs.MujocoTask)]
    tasks = [envs.get(name) for name in args.task or physics]
    for task in tasks:
        if not isinstance(task, envs.MujocoTask):
            raise envs.InputError(f"{task.name} has no physics to time; give a MuJoCo task")
    if wrong := [n for n in args.n if not 1 <= n <= 1_000_000]:
        raise envs.InputError(f"--n was {wrong[0]}; it must be from 1 to 1,000,000")
    check_folder(args.out)
    progress = Progress(len(tasks) * len(args.n), "timing")
    found: dict[str, dict[str, dict[str, float]]] = {}
    for task in tasks:
        assert isinstance(task, envs.MujocoTask)
        found[task.name] = {}
        for n in args.n:
            row = found[task.name][str(n)] = measure(task, n)
            sync = f"{row['sync_vector_env']:9,.0f}" if "sync_vector_env" in row else ""
            progress.line(
                f"{task.name:18} {n:5} environments: closed loop {row['closed_loop']:9,.0f} steps/s, open loop"
                f" {row['open_loop']:9,.0f} (ratio {row['closed_loop'] / row['open_loop']:.2f}), raw mj_step"
                f" {row['mj_step']:9,.0f}, {row['kib']:5.0f} KiB each{', SyncVectorEnv ' + sync if sync else ''}"
            )
            progress.update(1)
    progress.close()
    peer = against_envpool()
    print("envpool is not installed" if peer is None else f"share of raw mj_step: {peer['share_of_mj_step']}")
    about = {"machine": f"{platform.machine()}, {cores()} threads", "python": platform.python_version()}
    write_json(args.out / "speed.json", {**about, "versions": identity.versions(), "tasks": found, "envpool": peer})
    picture(found, args.out / "speed.png")
    print(f"-> {args.out}")


if __name__ == "__main__":
    run_command(main)
