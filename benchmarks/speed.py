"""How fast environments step: `python benchmarks/speed.py`

Side by side in one run: our vector env in closed loop (observations and rewards included), gymnasium's SyncVectorEnv
over our single env, the open-loop rate of mujoco.rollout, and raw mj_step. In control steps a second, and as ratios.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import mujoco
import numpy as np
from gymnasium.vector import SyncVectorEnv

import envs
from envs.console import Parser, run_command


def rate(steps: int, run: Callable[[], None], repeats: int = 5) -> float:
    """Steps a second: the median of several runs, after one to warm up."""
    run()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return steps / float(np.median(times))


def measure(task: envs.MujocoTask, n: int) -> dict[str, float]:
    """Control steps a second, by way of stepping; the same actions and the same thetas for all."""
    horizon = task.horizon
    width = task.action_space.shape[0]
    actions = np.random.default_rng(0).uniform(-1, 1, (horizon, n, width)).astype(np.float32)
    ours = envs.make_vec(task.name, n)
    theirs = SyncVectorEnv([lambda: envs.make(task.name) for _ in range(n)])
    ours.reset(seed=0)
    theirs.reset(seed=0)
    start, simulator = ours.batch.state.copy(), ours.batch.simulator
    assert isinstance(simulator, envs.physics.Physics)
    controls = np.ascontiguousarray(actions.transpose(1, 0, 2), float)
    model = simulator.models[0]
    data = mujoco.MjData(model)

    def closed_loop() -> None:
        for action in actions:
            ours.step(action)

    def sync_vector_env() -> None:
        for action in actions[:20]:
            theirs.step(action)

    def open_loop() -> None:
        simulator.rollout(start, controls)

    def mj_step() -> None:
        mujoco.mj_resetData(model, data)
        for action in controls[0]:
            data.ctrl[:] = task.control(action)
            for _ in range(task.substeps):
                mujoco.mj_step(model, data)

    return {
        "vector env, closed loop": rate(n * horizon, closed_loop),
        "SyncVectorEnv over the single env": rate(n * 20, sync_vector_env),
        "mujoco.rollout, open loop": rate(n * horizon, open_loop),
        "raw mj_step, one environment": rate(horizon, mj_step),
    }


def main() -> None:
    """The command line."""
    parser = Parser(__doc__)
    parser.add_argument("--task", default="slippery_cartpole")
    parser.add_argument("--n", type=int, default=64, help="environments")
    args = parser.parse_args()
    task = envs.get(args.task)
    if not isinstance(task, envs.MujocoTask):
        raise envs.InputError(f"{task.name} has no physics to time; give a MuJoCo task")
    if args.n < 1:
        raise envs.InputError(f"--n was {args.n}; it must be at least 1")
    rates = measure(task, args.n)
    ours = rates["vector env, closed loop"]
    print(
        f"{task.name}, {args.n} environments, {task.substeps} physics steps a control step, mujoco {mujoco.__version__}"
    )
    for name, value in rates.items():
        print(f"{name:36} {value:10,.0f} control steps/s   vector env / this: {ours / value:6.2f}")


if __name__ == "__main__":
    run_command(main)
