"""MuJoCo, batched: one model per environment in one mujoco.rollout thread pool. The only file that steps MuJoCo."""

from __future__ import annotations

import copy
import os
from abc import abstractmethod
from functools import cached_property, partial
from typing import Any, ClassVar, Protocol

import mujoco
import numpy as np
from gymnasium import spaces
from mujoco import rollout
from numpy.typing import ArrayLike, NDArray

from deconfounded.envs import render
from deconfounded.envs.handles import Handle
from deconfounded.envs.noise import ProcessNoise, columns
from deconfounded.envs.streams import Streams
from deconfounded.envs.task import Array, Painter, Simulator, Task

STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS


class Edit(Protocol):
    """What a latent may change in a model, by the element's name; values are absolute or times the MJCF's own."""

    def body_tilt(self, name: str, angle: float) -> None:
        """Set a body's angle about its parent's y axis, in place of the MJCF's; rad."""

    def body_shift(self, name: str, x: float) -> None:
        """Set a body's x in its parent's frame; m."""

    def body_mass(self, name: str, scale: float) -> None:
        """Scale a body's mass and inertia."""

    def geom_friction(self, name: str, value: float) -> None:
        """Sliding friction coefficient of a geom."""

    def joint_damping(self, name: str, value: float) -> None:
        """Damping of a hinge or slide joint; N m s or N s/m."""

    def slope(self, angle: float) -> None:
        """Turn gravity about the y axis, so that the world rises along x; rad."""

    def wind(self, x: float, y: float, z: float) -> None:
        """Velocity of the medium, which the MJCF gives a density or a viscosity; m/s."""

    def joint_stiffness(self, name: str, value: float) -> None:
        """Spring of a hinge or slide joint; N m/rad or N/m."""

    def actuator_gain(self, name: str, scale: float) -> None:
        """Scale what a motor makes of its control; of -1, it is wired the wrong way round."""

    def tendon_friction(self, name: str, value: float) -> None:
        """Coulomb friction of a tendon; N, or N m for a tendon over hinges."""


def cores() -> int:
    """How many threads to use: the cores this process may run on, or OMP_NUM_THREADS if that is fewer."""
    wanted = os.environ.get("OMP_NUM_THREADS", "")
    there = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(there, int(wanted)) if wanted.isdecimal() and int(wanted) > 0 else there


def _tilt(angle: float) -> list[float]:
    return [np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0]


def _uphill(gravity: Array, angle: float) -> list[float]:
    return [gravity[2] * np.sin(angle), 0.0, gravity[2] * np.cos(angle)]


class ModelEdit:
    """Edits a compiled model in place. Scales are of the nominal model's values, so that they never compound.

    data: scratch space, which many edits may share (an MjData takes megabytes).
    """

    def __init__(self, model: mujoco.MjModel, nominal: mujoco.MjModel, data: mujoco.MjData) -> None:
        self.model, self._nominal, self._data, self._stale = model, nominal, data, False

    def body_tilt(self, name: str, angle: float) -> None:
        self._stale = True
        self.model.body(name).quat[:] = _tilt(angle)

    def body_shift(self, name: str, x: float) -> None:
        self._stale = True
        self.model.body(name).pos[0] = x

    def body_mass(self, name: str, scale: float) -> None:
        self._stale = True
        self.model.body(name).mass[:] = self._nominal.body(name).mass * scale
        self.model.body(name).inertia[:] = self._nominal.body(name).inertia * scale

    def geom_friction(self, name: str, value: float) -> None:
        self.model.geom(name).friction[0] = value

    def joint_damping(self, name: str, value: float) -> None:
        self.model.joint(name).damping[0] = value

    def slope(self, angle: float) -> None:
        self.model.opt.gravity[:] = _uphill(self._nominal.opt.gravity, angle)

    def wind(self, x: float, y: float, z: float) -> None:
        self.model.opt.wind[:] = x, y, z

    def joint_stiffness(self, name: str, value: float) -> None:
        self.model.joint(name).stiffness[0] = value

    def actuator_gain(self, name: str, scale: float) -> None:
        self.model.actuator(name).gainprm[0] = self._nominal.actuator(name).gainprm[0] * scale

    def tendon_friction(self, name: str, value: float) -> None:
        self.model.tendon_frictionloss[self.model.tendon(name).id] = value

    def finish(self) -> None:
        """Recompute what MuJoCo derives from bodies' places and masses (subtree masses, invweight0, ...), if edited."""
        if self._stale:
            mujoco.mj_setConst(self.model, self._data)
            self._stale = False


class SpecEdit:
    """The same edits before compilation: the reference that tests hold ModelEdit to."""

    def __init__(self, spec: mujoco.MjSpec) -> None:
        self.spec = spec

    def body_tilt(self, name: str, angle: float) -> None:
        self.spec.body(name).quat = _tilt(angle)

    def body_shift(self, name: str, x: float) -> None:
        self.spec.body(name).pos[0] = x

    def body_mass(self, name: str, scale: float) -> None:
        for geom in self.spec.body(name).geoms:
            geom.mass *= scale

    def geom_friction(self, name: str, value: float) -> None:
        self.spec.geom(name).friction[0] = value

    def joint_damping(self, name: str, value: float) -> None:
        self.spec.joint(name).damping[0] = value

    def slope(self, angle: float) -> None:
        self.spec.option.gravity = _uphill(self.spec.option.gravity, angle)

    def wind(self, x: float, y: float, z: float) -> None:
        self.spec.option.wind = x, y, z

    def joint_stiffness(self, name: str, value: float) -> None:
        self.spec.joint(name).stiffness[0] = value

    def actuator_gain(self, name: str, scale: float) -> None:
        self.spec.actuator(name).gainprm[0] *= scale

    def tendon_friction(self, name: str, value: float) -> None:
        self.spec.tendon(name).frictionloss = value


class Physics(Simulator):
    """n models, each with its own theta, stepped in a thread pool; OMP_NUM_THREADS sets its size."""

    def __init__(self, task: MujocoTask, n: int) -> None:
        super().__init__(task, n)
        self._mujoco_task = task
        self.models = [copy.copy(task.model) for _ in range(n)]
        self._furnish()
        for i in range(n):
            self.set_theta(i, self.theta[i])

    def _furnish(self) -> None:
        """Make what is of this machine and process, and no part of the state."""
        model, threads = self._mujoco_task.model, cores()
        self._threads = threads if threads > 1 else 0
        self._pools = {size: Handle(partial(rollout.Rollout, nthread=size)) for size in {0, self._threads}}
        self._datas = [mujoco.MjData(model) for _ in range(max(threads, 1))]
        self._edits = [ModelEdit(one, model, self._datas[0]) for one in self.models]
        self._buffer: Array = np.empty(0)

    def __getstate__(self) -> dict[str, Any]:
        furniture = ("_threads", "_pools", "_datas", "_edits", "_buffer")
        return {name: value for name, value in vars(self).items() if name not in furniture}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._furnish()

    def set_theta(self, i: int, theta: Array) -> None:
        self.theta[i] = theta
        self._mujoco_task.apply_latent(self._edits[i], theta)
        self._edits[i].finish()

    def outcome(self, state: Array, action: Array, rows: NDArray[np.int64] | None = None) -> Array:
        width, physical = state.shape[1], state.shape[1] - self._mujoco_task.readings
        shape = (len(state), self._mujoco_task.substeps, physical)
        if self._buffer.size < (size := int(np.prod(shape))):  # kept: large arrays are slow to get anew
            self._buffer = np.empty(size)
        rolled = self._roll(state[:, :physical], action[:, None], rows, self._buffer[:size].reshape(shape))[:, -1]
        return np.pad(rolled, ((0, 0), (0, width - physical))) if width > physical else rolled.copy()

    def rollout(self, state: Array, action: Array) -> Array:
        """Open loop: states [n, S] and actions [n, T, A] -> noise-free states [n, T * substeps, S - readings]."""
        steps, physical = action.shape[1] * self._mujoco_task.substeps, state.shape[1] - self._mujoco_task.readings
        return self._roll(state[:, :physical], action, None, np.empty((len(state), steps, physical)))

    def _roll(self, state: Array, action: Array, rows: NDArray[np.int64] | None, out: Array) -> Array:
        n, steps, _ = out.shape
        if not n:
            return out
        control = np.repeat(self._mujoco_task.control(action), self._mujoco_task.substeps, axis=1)
        models = self.models if rows is None else [self.models[i] for i in rows.tolist()]
        threads = self._threads if n > 1 else 0
        # Arrays are float64 and contiguous already; without a warm start, the solver starts from scratch in every
        # control step, so that the next state is a function of this state alone.
        self._pools[threads]().rollout(
            models,
            self._datas[: max(threads, 1)],
            np.ascontiguousarray(state),
            control,
            nstep=steps,
            state=out,
            sensordata=np.empty((n, steps, models[0].nsensordata)),
            skip_checks=True,
            chunk_size=max(1, n // (2 * max(threads, 1))),  # two for each thread: handing one over takes its time
        )
        return out


class MujocoTask(Task):
    """A task whose outcome is MuJoCo's next state: x' = f(x, a, theta) + w, w ~ N(0, diag sigma^2), a control step.

    The state [S] is MuJoCo's full physics state (time, qpos, qvel, act), and after it what the task's sensors read.
    Joints are read by name.
    """

    substeps: ClassVar[int] = 2  # physics steps a control step
    process_noise: ClassVar[dict[str, tuple[float, ...]]]  # joint -> std of (position, velocity) a control step
    readings: ClassVar[int] = 0  # columns, at the end of the state, that `sense` fills with what its noise gives them
    # Of ball and free joints, see envs/noise.py. A coordinate without noise counts as no evidence: it must be of no
    # consequence, or one that theta does not move.

    @abstractmethod
    def apply_latent(self, edit: Edit, theta: Array) -> None:
        """Set theta [L] in a model."""

    def control(self, action: Array) -> Array:
        """Action [..., A] in [-1, 1] -> MuJoCo's ctrl [..., nu]; by default one to one."""
        return action

    def spec(self) -> mujoco.MjSpec:
        """The nominal model, from <name>.xml in `home`. Every environment has a copy, so that it should be small."""
        return mujoco.MjSpec.from_file(str(self.home / f"{self.name}.xml"))

    def decorate(self, spec: mujoco.MjSpec) -> None:
        """Add what is to be looked at only, for pictures: by default, a sky."""
        render.sky(spec)

    @cached_property
    def model(self) -> mujoco.MjModel:
        """The compiled nominal model. Never edited: environments copy it."""
        return self.spec().compile()

    @property
    def control_dt(self) -> float:  # type: ignore[override]
        return float(self.model.opt.timestep) * self.substeps

    def qpos(self, state: Array, joint: str) -> Array:
        """Position [...] of a hinge or slide joint in states [..., S], rad or m.

        Of a ball joint its quaternion [..., 4], of a free one position (m) and quaternion [..., 7].
        """
        return state[..., self._address(joint)[0]]

    def qvel(self, state: Array, joint: str) -> Array:
        """Velocity [...] of a hinge or slide joint, rad/s or m/s.

        Of a ball joint its angular velocity about its own axes [..., 3], of a free one velocity and that [..., 6].
        """
        return state[..., self._address(joint)[1]]

    def state(self, **joints: tuple[ArrayLike, ArrayLike]) -> Array:
        """States [N, S] with the named joints' (position, velocity), [N] or numbers; all others at the MJCF's rest.

        Of ball and free joints they are [N, K] or [K], with K as of `qpos` and `qvel`, or a number for all K.
        """
        pairs = [zip(self._address(joint), pair, strict=True) for joint, pair in joints.items()]
        values = [(at, np.asarray(value, float)) for pair in pairs for at, value in pair]
        rows = (value.shape if isinstance(at, int) else value.shape[:-1] for at, value in values)
        width = mujoco.mj_stateSize(self.model, STATE.value) + self.readings
        state = np.zeros((*np.broadcast_shapes((1,), *rows), width))
        state[:, 1 : 1 + self.model.nq] = self.model.qpos0
        for at, value in values:
            state[:, at] = value
        return state

    def _address(self, joint: str) -> tuple[int | slice, int | slice]:
        if joint not in self._addresses:
            q, v = columns(self.model, joint)
            single = len(q) == 1
            self._addresses[joint] = (q[0], v[0]) if single else (slice(q.start, q.stop), slice(v.start, v.stop))
        return self._addresses[joint]

    @cached_property
    def _addresses(self) -> dict[str, tuple[int | slice, int | slice]]:
        return {}

    @cached_property
    def noise(self) -> ProcessNoise:
        """The noise of `process_noise`. Raises InputError where it does not fit the model's joints."""
        return ProcessNoise(self.model, self.process_noise)

    def simulator(self, n: int) -> Physics:
        return Physics(self, n)

    def painter(self, theta: Array) -> Painter:
        spec = self.spec()
        self.decorate(spec)
        self.apply_latent(SpecEdit(spec), theta)
        return render.Painter(spec.compile())

    def sample_noise(self, rng: Streams) -> Array:
        """Unit normal: of the process first, then a column for each reading."""
        return rng.standard_normal((rng.groups, self.horizon, self.noise.size + self.readings))

    def outcome(self, state: Array, action: Array, theta: Array) -> Array:
        physics = self.simulator(len(state))
        for i, row in enumerate(theta):
            physics.set_theta(i, row)
        return physics.outcome(state, action)

    def apply_noise(self, outcome: Array, noise: Array) -> Array:
        return self.noise.apply(outcome, noise)

    def log_prob(self, next_state: Array, outcome: Array) -> Array:
        return self.noise.log_prob(next_state, outcome)

    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
