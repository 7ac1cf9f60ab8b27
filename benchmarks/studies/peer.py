"""EnvPool beside our vector environment, on its own models: control steps a second of HalfCheetah and Ant.

The MJCF, frame skip, torques and time limit are gymnasium's, which EnvPool has too; process noise, readings, rewards
and hidden latents are those of our tasks with these bodies. EnvPool (C++) brings a MuJoCo of its own: raw mj_step is
measured on the same MJCF, in one thread of ours, times the threads.
"""

from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from typing import Any

import mujoco
import numpy as np

from deconfounded import envs
from deconfounded.benchmarks.studies.stepping import closed_loop, raw, seconds
from deconfounded.envs.physics import cores
from deconfounded.envs.task import Array, Mask
from deconfounded.envs.tasks import gymnasium_body
from deconfounded.envs.tasks.ant_goal import AntGoal
from deconfounded.envs.tasks.cheetah_speed import CheetahSpeed

ENVIRONMENTS, STEPS, PHYSICS = 64, 100, 2000  # steps of a repeat, of control and of raw physics
TIMESTEP, FRAME_SKIP, LIMIT = 0.01, 5, 1000  # gymnasium's, of both: s, physics steps, control steps
HEALTHY = (0.2, 1.0)  # height of gymnasium's ant, m


class HalfCheetah(CheetahSpeed):
    """Gymnasium's body, in its own time step, with the reward and the lamp of `cheetah_speed`."""

    substeps, horizon = FRAME_SKIP, LIMIT

    def spec(self) -> mujoco.MjSpec:
        spec = super().spec()
        spec.option.timestep = TIMESTEP
        return spec


class Ant(AntGoal):
    """Gymnasium's, with the reward and the bearings of `ant_goal`, and with gymnasium's end of an episode."""

    substeps, horizon, controls = FRAME_SKIP, LIMIT, (np.zeros(8), np.ones(8))

    def spec(self) -> mujoco.MjSpec:
        return gymnasium_body.load("ant", TIMESTEP)

    def terminated(self, state: Array) -> Mask:
        height = self.qpos(state, "root")[..., 2]
        return (height < HEALTHY[0]) | (height > HEALTHY[1])


PEERS: dict[str, type[envs.MujocoTask]] = {"HalfCheetah-v4": HalfCheetah, "Ant-v4": Ant}


def _steps(env: Any, actions: Array) -> None:
    for action in actions:
        env.step(action)


def against_envpool() -> dict[str, Any]:
    """Control steps a second of both and of raw mj_step, by environment. Raises InputError where EnvPool is missing."""
    try:
        import envpool  # type: ignore[import-not-found]
    except ImportError:
        raise envs.InputError("envpool is not installed; `pip install envpool` brings it") from None
    measured: dict[str, Any] = {"version": version("envpool"), "environments": ENVIRONMENTS, "threads": cores()}
    for name, kind in PEERS.items():
        task = kind()
        theirs = envpool.make(name, env_type="gymnasium", num_envs=ENVIRONMENTS, num_threads=cores(), seed=0)
        theirs.reset()
        actions = np.random.default_rng(0).uniform(-1, 1, (STEPS, ENVIRONMENTS, task.action_width))
        runs: dict[str, Callable[[], object]] = {
            "ours": closed_loop(envs.GymVectorEnv(task, ENVIRONMENTS), actions),
            "envpool": partial(_steps, theirs, actions),
            "mj_step": raw(task.model, PHYSICS),
        }
        counts = {**dict.fromkeys(("ours", "envpool"), STEPS * ENVIRONMENTS), "mj_step": PHYSICS * cores() / FRAME_SKIP}
        rates = measured[name] = {way: counts[way] / each for way, each in seconds(runs).items()}
        print(f"{name}: {', '.join(f'{way} {rate:,.0f}' for way, rate in rates.items())} control steps a second")
    return measured
