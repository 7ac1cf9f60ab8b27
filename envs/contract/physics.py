"""Checks of MuJoCo tasks: their model, its noise, and pictures of it."""

from collections.abc import Callable
from functools import wraps

import mujoco
import numpy as np

from deconfounded.envs.adapters import GymEnv
from deconfounded.envs.batch import BatchEnv
from deconfounded.envs.contract.probe import Skipped, actions, beyond_bounds, far_thetas, gl_works, require, same
from deconfounded.envs.edits import SpecEdit
from deconfounded.envs.models import lean
from deconfounded.envs.physics import STATE, MujocoTask
from deconfounded.envs.render import gravity_in_view, level
from deconfounded.envs.task import Task

DERIVED = ("dof_M0", "dof_invweight0", "body_invweight0", "actuator_acc0", "tendon_invweight0")
ROUNDED = {"body_inertia": 1e-15, **dict.fromkeys(DERIVED, 1e-12)}
NAMED = ("bodies", "geoms", "joints", "actuators", "tendons", "cameras", "lights", "textures", "sensors")


def bounds_are_wide_enough(task: MujocoTask) -> None:
    """Observations stay within their bounds, where they would be clipped, under random actions."""
    batch, steps = BatchEnv(task, 32), 0
    batch.reset(0)
    for action in actions(task, 32, task.horizon):
        batch.step(action)
        steps += batch.alive.sum()
        require(not (message := beyond_bounds(task, batch.state[batch.alive])), message)
    require(steps >= 32, f"32 random episodes lasted {steps} steps in all; a start must not be an end")


def set_in_place_equals_recompiled(task: MujocoTask) -> None:
    """A model in which several thetas were set in turn equals one compiled with the last, in every number."""
    simulator = task.simulator(1)
    for theta in far_thetas(task):
        simulator.set_theta(0, theta)
        spec = task.spec()
        task.apply_latent(SpecEdit(spec), theta)
        same_model(simulator.models[0], lean(spec), f"set in place and compiled with theta {theta.tolist()}")


def nominal_model_is_not_touched(task: MujocoTask) -> None:
    """Setting theta changes copies of the nominal model alone."""
    before = task.spec().compile()
    BatchEnv(task, 2).reset(0)
    same_model(task.model, before, "of the task, after a reset, and compiled anew")


def same_model(model: mujoco.MjModel, other: mujoco.MjModel, what: str) -> None:
    """Raise AssertionError unless two models are equal in every array, to the bit. what: how they were made.

    Inertia, which scaling rounds in another order, and quantities derived from it may differ in the last bits.
    """
    names = [name for name in dir(model) if name[0] != "_" and isinstance(getattr(model, name, None), np.ndarray)]
    require(len(names) > 100, f"only {len(names)} arrays of the models were compared; it must be more than 100")
    for name in names:
        value, right = getattr(model, name), getattr(other, name)
        if name in ROUNDED and value.shape == right.shape:
            value = np.where(np.isclose(value, right, rtol=ROUNDED[name], atol=0), right, value)
        same(value, right, f"{name} of models {what}")


def rollout_equals_single_steps(task: MujocoTask) -> None:
    """The thread pool gives the states of mj_step on the whole model, without a warm start at a control step."""
    batch, size = BatchEnv(task, 3), mujoco.mj_stateSize(task.model, STATE.value)  # without the readings
    batch.reset(4)
    state = np.zeros(size)
    for action in actions(task, 3, 12):
        outcome, control = batch.simulator.outcome(batch.state, action), task.control(action[:, None])[:, 0]
        for i, theta in enumerate(task.acting_theta(batch.theta, batch.state)):
            model = task.edited(task.model, theta)
            data = mujoco.MjData(model)
            mujoco.mj_setState(model, data, batch.state[i, :size], STATE.value)
            data.ctrl[:] = control[i]
            for _ in range(task.substeps):
                mujoco.mj_step(model, data)
            mujoco.mj_getState(model, data, state, STATE.value)
            same(outcome[i, :size], state, "states of the thread pool and of mj_step on the whole model")
        batch.step(action)


def every_element_is_named(task: MujocoTask) -> None:
    """Every element of the MJCF has a name, for pages and errors."""
    spec = task.spec()
    for kind in NAMED:
        unnamed = [i for i, element in enumerate(getattr(spec, kind)) if not element.name]
        require(not unnamed, f"of the {kind} of {task.name}, number {unnamed} of the MJCF must have a name")


def _coordinate(task: MujocoTask, i: int) -> str:
    """What the i-th number of qpos and qvel is."""
    model, of = task.model, "position" if i < task.model.nq else "velocity"
    joint = int(np.flatnonzero(model.jnt_qposadr <= i)[-1]) if i < model.nq else int(model.dof_jntid[i - model.nq])
    return f"{of} of joint {model.joint(joint).name}"


def noise_covers_every_coordinate_that_matters(task: MujocoTask) -> None:
    """Every coordinate has process noise; otherwise a single step could reveal theta, and no posterior would be exact.

    Exempt are coordinates that theta does not move, and those that affect neither observations nor later states.
    """
    batch, action, thetas = BatchEnv(task, 1), np.ones((1, task.action_width)), task.theta_grid(3)
    batch.reset(0)
    start, simulator, noisy = batch.state, batch.simulator, task.noise.columns
    quiet = set(range(1, 1 + task.model.nq + task.model.nv)) - set(noisy.tolist())
    each = task.outcome(np.repeat(start, len(thetas), 0), np.repeat(action, len(thetas), 0), thetas)
    for i in (i for i in quiet if (each[:, i] != each[0, i]).any()):
        moved = start.copy()
        moved[:, i] += 0.7
        hint = f"theta moves a coordinate without process noise, {_coordinate(task, i - 1)}, that "
        require(np.array_equal(task.observe(moved), task.observe(start)), hint + "is observed")
        both = simulator.outcome(np.concatenate([start, moved]), np.tile(action, (2, 1)), np.zeros(2, int))[:, noisy]
        require(np.allclose(both[0], both[1], rtol=1e-7, atol=1e-9), hint + "changes what follows")


def down_is_down_in_pictures(task: MujocoTask) -> None:
    """Gravity points down in the picture under every theta; without gravity, the camera is not turned."""
    simulator = task.simulator(1)
    model, view = simulator.models[0], simulator.models[0].camera("view")
    for theta in far_thetas(task):
        simulator.set_theta(0, theta)
        level(model)
        right, up, _ = gravity_in_view(model)
        message = f"of theta {theta.tolist()}, gravity points {right:g} to the right and {up:g} up in the picture"
        require(abs(right) < 1e-6 and up < 1e-6, message)
    model.opt.gravity[:], before = 0, view.quat.copy()
    level(model)
    same(view.quat, before, "quaternions of the camera view, levelled without gravity and before,")


def picture_shows_theta_or_state(task: MujocoTask) -> None:
    """A picture has 240 x 320 pixels, and differs five steps later."""
    if not gl_works():
        raise Skipped("no GL for pictures works here")
    env = GymEnv(task, render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    for _ in range(5):
        env.step(env.action_space.high)  # type: ignore[attr-defined]
    require(first.shape == (240, 320, 3), f"a picture had shape {first.shape}; it must be (240, 320, 3)")
    require((env.render() != first).any(), "the picture is the same after five steps; camera view must see what moves")


def _of_mujoco(check: Callable[[MujocoTask], None]) -> Callable[[Task], None]:
    @wraps(check)
    def checked(task: Task) -> None:
        if not isinstance(task, MujocoTask):
            raise Skipped("this check is for MuJoCo tasks")
        check(task)

    return checked


CHECKS = tuple(
    _of_mujoco(check)
    for check in (
        *(bounds_are_wide_enough, set_in_place_equals_recompiled, nominal_model_is_not_touched),
        *(rollout_equals_single_steps, every_element_is_named, noise_covers_every_coordinate_that_matters),
        *(down_is_down_in_pictures, picture_shows_theta_or_state),
    )
)
