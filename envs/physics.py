"""Batched MuJoCo: a model for each environment, stepped by mujoco.rollout's thread pool. No other file steps MuJoCo."""

import copy
import os
from abc import abstractmethod
from functools import cached_property, partial
from typing import Any, ClassVar

import mujoco
import numpy as np
from gymnasium import spaces
from mujoco import rollout
from numpy.typing import ArrayLike, NDArray

from deconfounded.envs import render
from deconfounded.envs.edits import Edit, ModelEdit
from deconfounded.envs.models import lean, no_clock
from deconfounded.envs.noise import ProcessNoise, columns
from deconfounded.envs.streams import Array, Streams
from deconfounded.envs.support.errors import InputError
from deconfounded.envs.support.handles import Handle
from deconfounded.envs.task import Renderer, Simulator, Task

STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS


def cores() -> int:
    """Number of threads to use: the cores that this process may run on, or OMP_NUM_THREADS if that is fewer."""
    limit = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0].strip()  # "4,2": of nested levels
    available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(available, int(limit)) if limit.isdecimal() and int(limit) > 0 else available


class Physics(Simulator):
    """Models of n environments, each with its own theta, stepped in a thread pool of `cores()` threads."""

    def __init__(self, task: "MujocoTask", n: int) -> None:
        super().__init__(task, n)
        self._mujoco_task = task
        self.models = [copy.copy(task.stepped_model) for _ in range(n)]
        self._allocate()
        for i in range(n):
            self.set_theta(i, self.theta[i])

    def _allocate(self) -> None:
        """Create thread pools and scratch space, which belong to this process and are no part of the state."""
        model, threads = self._mujoco_task.stepped_model, cores()
        self._threads = threads if threads > 1 else 0
        self._pools = {size: Handle(partial(rollout.Rollout, nthread=size)) for size in {0, self._threads}}
        self._datas = [mujoco.MjData(model) for _ in range(max(threads, 1))]
        self._warned = [data.warning.number for data in self._datas]  # views of MuJoCo's counts of warnings, by kind
        self._quiet = [np.zeros_like(warned).tobytes() for warned in self._warned]
        self._timestep = float(model.opt.timestep)
        self._edits = [ModelEdit(edited, self._mujoco_task.model, self._datas[0]) for edited in self.models]
        self._buffer: Array = np.empty(0)

    def __getstate__(self) -> dict[str, Any]:
        local = ("_threads", "_pools", "_datas", "_warned", "_quiet", "_edits", "_buffer")
        return {name: value for name, value in vars(self).items() if name not in local}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._allocate()

    def set_theta(self, i: int, theta: Array) -> None:
        self.theta[i] = theta
        self._mujoco_task.apply_latent(self._edits[i], theta)
        self._edits[i].finish()

    def outcome(self, state: Array, action: Array, rows: NDArray[np.int64] | None = None) -> Array:
        width, physical = state.shape[1], state.shape[1] - self._mujoco_task.readings
        shape = (len(state), self._mujoco_task.substeps, physical)
        if self._buffer.size < (size := int(np.prod(shape))):  # kept, as large arrays are slow to allocate
            self._buffer = np.empty(size)
        rolled = self._roll(state[:, :physical], action[:, None], rows, self._buffer[:size].reshape(shape))[:, -1]
        if width == physical:
            return rolled.copy()
        outcome = np.zeros((len(state), width))
        outcome[:, :physical] = rolled
        return outcome

    def rollout(self, state: Array, action: Array) -> Array:
        """Noise-free states [n, T * substeps, S - readings] from states [n, S] and actions [n, T, A], in open loop."""
        steps, physical = action.shape[1] * self._mujoco_task.substeps, state.shape[1] - self._mujoco_task.readings
        return self._roll(state[:, :physical], action, None, np.empty((len(state), steps, physical)))

    def _roll(self, state: Array, action: Array, rows: NDArray[np.int64] | None, out: Array) -> Array:
        n, steps, _ = out.shape
        if not n:
            return out
        control = np.repeat(self._mujoco_task.control(action), self._mujoco_task.substeps, axis=1)
        models = self.models if rows is None else [self.models[i] for i in rows.tolist()]
        threads = self._threads if n > 1 else 0
        # Arrays are float64 and contiguous already. There is no warm start: the solver starts from scratch in every
        # control step, so that the next state is a function of this state alone.
        try:
            with no_clock():
                self._pools[threads]().rollout(
                    models,
                    self._datas[: max(threads, 1)],
                    np.ascontiguousarray(state),
                    control,
                    nstep=steps,
                    state=out,
                    sensordata=np.empty((n, steps, models[0].nsensordata)),
                    skip_checks=True,
                    chunk_size=max(1, n // (2 * max(threads, 1))),  # two chunks a thread: each hand-over takes time
                )
        except mujoco.FatalError as error:  # too little memory for the solver, for example
            raise InputError(f"the physics of {self.task.name} failed: {error}") from None
        self._check_stability(models, state, control, rows, out)
        return out

    def _check_stability(
        self, models: list[mujoco.MjModel], state: Array, control: Array, rows: NDArray[np.int64] | None, out: Array
    ) -> None:
        """Call the task's `failed` where MuJoCo warned: it starts anew from qpos0, or drops contacts, and goes on.

        A rollout stops at a warning, so that time stands still or is set back. There are two exceptions: the only
        substep of an episode's first step, and full buffers in the last substep of a step, of which MuJoCo's counts
        cover the environments that each thread stepped last.
        """
        steps, advanced = out.shape[1], out[:, -1, 0] - state[:, 0]
        least, quiet = (steps - 0.5) * self._timestep, [warned.tobytes() for warned in self._warned] == self._quiet
        if quiet and steps > 1 and advanced[advanced.argmin()] > least:  # argmin is quick, and finds NaN
            return
        doubtful = ~(advanced > least) | (steps == 1) & (state[:, 0] == 0) | (not quiet)
        doubtful |= ~(abs(control).max((1, 2), initial=0) <= mujoco.mjMAXVAL)
        for warned in self._warned:
            warned[:] = 0
        for i in np.flatnonzero(doubtful).tolist():
            data = mujoco.MjData(models[i])
            mujoco.mj_setState(models[i], data, np.ascontiguousarray(state[i]), STATE.value)
            for ctrl in control[i]:
                data.ctrl[:], time = ctrl, data.time
                mujoco.mj_step(models[i], data)
                if (kinds := np.flatnonzero(data.warning.number)).size:
                    text = mujoco.mju_warningText(int(kinds[0]), int(data.warning.lastinfo[kinds[0]]))
                    where = self._where(i if rows is None else int(rows[i]), time)
                    message = f"the physics of {self.task.name} failed in {where}: {text}"
                    self._mujoco_task.failed(state[i], out[i, -1], message)
                    break

    def _where(self, i: int, time: float) -> str:
        """The step of environment i at this time, and its theta, for errors."""
        named = zip(self.task.latents, self.theta[i], strict=True)
        theta = ", ".join(f"{latent.name} {value:g} {latent.unit}".rstrip() for latent, value in named)
        return f"step {int(time / self._mujoco_task.control_dt + 1e-6) + 1} of an episode with {theta}"


class MujocoTask(Task):
    """A task whose outcome is MuJoCo's next state: x' = f(x, a, theta) + w, w ~ N(0, diag sigma^2), a control step.

    The state [S] is MuJoCo's full physics state (time, qpos, qvel, act), followed by the readings of the task's
    sensors. Joints are read by name.
    """

    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
    substeps: ClassVar[int] = 2  # physics steps a control step
    controls: ClassVar[tuple[Any, Any]] = (0.0, 1.0)  # middle and swing of MuJoCo's ctrl, numbers or [nu]
    # joint -> std of (position, velocity) a control step; of ball and free joints see envs/noise.py. A coordinate
    # without noise counts as no evidence: theta must not move it, or nothing observed may depend on it.
    process_noise: ClassVar[dict[str, tuple[float, ...]]]
    readings: ClassVar[int] = 0  # last columns of the state, which `sense` fills

    @abstractmethod
    def apply_latent(self, edit: Edit, theta: Array) -> None:
        """Set theta [L] in a model."""

    def failed(self, before: Array, after: Array, message: str) -> None:
        """MuJoCo could not go on from state `before` [S]: raise InputError with its message, or set `after` [S]."""
        raise InputError(message)

    def control(self, action: Array) -> Array:
        """Action [..., A] in [-1, 1] -> MuJoCo's ctrl [..., nu]; by default middle + swing * action, of `controls`."""
        middle, swing = self.controls
        return middle + swing * action

    def observe(self, state: Array) -> Array:
        """By default positions, then velocities, of the joints of `process_noise`, in its order."""
        return np.stack([read(state, joint) for read in (self.qpos, self.qvel) for joint in self.process_noise], -1)

    def spec(self) -> mujoco.MjSpec:
        """The nominal model, from <name>.xml in `home`. Every environment has a copy, so keep it small."""
        return mujoco.MjSpec.from_file(str(self.home / f"{self.name}.xml"))

    def decorate(self, spec: mujoco.MjSpec) -> None:
        """Add visual elements, for pictures only; by default a sky."""
        render.sky(spec)

    @cached_property
    def model(self) -> mujoco.MjModel:
        """The compiled nominal model, as the MJCF has it. It is never edited."""
        return self.spec().compile()

    @cached_property
    def stepped_model(self) -> mujoco.MjModel:
        """The nominal model without what changes no state. It is never edited: environments copy it."""
        return lean(self.spec())

    def edited(self, model: mujoco.MjModel, theta: Array) -> mujoco.MjModel:
        """A copy of a model under theta [L]."""
        model = copy.copy(model)
        edit = ModelEdit(model, copy.copy(model), mujoco.MjData(model))
        self.apply_latent(edit, theta)
        edit.finish()
        return model

    @property
    def control_dt(self) -> float:  # type: ignore[override]
        return float(self.model.opt.timestep) * self.substeps

    def qpos(self, state: Array, joint: str) -> Array:
        """Position [...] of a joint, m or rad; of a ball joint a quaternion [..., 4]; of a free joint both [..., 7]."""
        return state[..., self._address(joint)[0]]

    def qvel(self, state: Array, joint: str) -> Array:
        """Velocity [...] of a joint, rad/s or m/s; of a ball joint [..., 3] in its own axes; of a free one [..., 6]."""
        return state[..., self._address(joint)[1]]

    def state(self, **joints: tuple[ArrayLike, ArrayLike]) -> Array:
        """States [N, S] with given (position, velocity) of joints, [N] or numbers; other joints are at the MJCF's rest.

        Of ball and free joints they are [N, K] or [K], with K as of `qpos` and `qvel`, or a number for all K.
        """
        pairs = [zip(self._address(joint), pair, strict=True) for joint, pair in joints.items()]
        values = [(at, np.asarray(value, float)) for pair in pairs for at, value in pair]
        rows = {value.shape if isinstance(at, int) else value.shape[:-1] for at, value in values}
        state = np.empty((*np.broadcast_shapes((1,), *rows), len(self._rest)))
        state[:] = self._rest
        for at, value in values:
            state[:, at] = value
        return state

    @cached_property
    def _rest(self) -> Array:
        """The state [S] at the MJCF's rest."""
        rest = np.zeros(mujoco.mj_stateSize(self.model, STATE.value) + self.readings)
        rest[1 : 1 + self.model.nq] = self.model.qpos0
        return rest

    def _address(self, joint: str) -> tuple[int | slice, int | slice]:
        if joint not in self._addresses:
            q, v = columns(self.model, joint)
            self._addresses[joint] = (q[0], v[0]) if len(q) == 1 else (slice(q[0], q.stop), slice(v[0], v.stop))
        return self._addresses[joint]

    @cached_property
    def _addresses(self) -> dict[str, tuple[int | slice, int | slice]]:
        return {}

    @cached_property
    def noise(self) -> ProcessNoise:
        """The noise that `process_noise` states. Raises InputError where it does not fit the model's joints."""
        return ProcessNoise(self.model, self.process_noise)

    def simulator(self, n: int) -> Physics:
        return Physics(self, n)

    def renderer(self, theta: Array) -> Renderer:
        spec = self.spec()
        self.decorate(spec)
        return render.MujocoRenderer(self.edited(spec.compile(), theta))

    def sample_noise(self, rng: Streams) -> Array:
        """Unit normal noise: of the process first, then a column for each reading."""
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
