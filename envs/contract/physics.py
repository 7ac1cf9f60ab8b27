"""Checks of MuJoCo tasks: their model, its noise, and pictures of it."""

import mujoco
import numpy as np

from deconfounded.envs.adapters import GymEnv
from deconfounded.envs.batch import BatchEnv
from deconfounded.envs.contract.probe import (
    Skipped,
    actions,
    beyond_bounds,
    far_thetas,
    gl_works,
    physics,
    require,
    same,
    streams,
)
from deconfounded.envs.edits import SpecEdit
from deconfounded.envs.physics import STATE
from deconfounded.envs.render import level
from deconfounded.envs.task import Task

ROUNDED = {"body_inertia": 1e-15, **dict.fromkeys(("dof_M0", "dof_invweight0", "body_invweight0"), 1e-12)}
ROUNDED |= dict.fromkeys(("actuator_acc0", "tendon_invweight0"), 1e-12)
NAMED = ("bodies", "geoms", "joints", "actuators", "tendons", "cameras", "lights", "textures", "sensors")


def bounds_are_wide_enough(task: Task) -> None:
    """Observations stay within their bounds, where they would be clipped, under random actions."""
    batch, steps = BatchEnv(physics(task), 32), 0
    batch.reset(0)
    for action in actions(task, 32, task.horizon):
        batch.step(action)
        steps += batch.alive.sum()
        require(not (message := beyond_bounds(task, batch.state[batch.alive])), message)
    require(steps >= 32, f"32 random episodes lasted {steps} steps in all; a start must not be an end")


def set_in_place_equals_recompiled(task: Task) -> None:
    """A model in which several thetas were set in turn equals one compiled with the last, in every number."""
    simulator = physics(task).simulator(1)
    for theta in far_thetas(task):
        simulator.set_theta(0, theta)
        spec = physics(task).spec()
        physics(task).apply_latent(SpecEdit(spec), theta)
        same_model(simulator.models[0], spec.compile(), f"set in place and compiled with theta {theta.tolist()}")


def nominal_model_is_not_touched(task: Task) -> None:
    """Setting theta changes copies of the nominal model alone."""
    before = physics(task).spec().compile()
    BatchEnv(task, 2).reset(0)
    same_model(physics(task).model, before, "of the task, after a reset, and compiled anew")


def same_model(model: mujoco.MjModel, other: mujoco.MjModel, what: str) -> None:
    """Raise AssertionError unless two models are equal in every array, to the bit. what: how they were made.

    Inertia, which scaling rounds in another order, and quantities derived from it may differ in the last bits.
    """
    compared = 0
    for field in dir(model):
        value = getattr(model, field, None) if not field.startswith("_") else None
        if isinstance(value, np.ndarray):
            right = getattr(other, field)
            if field in ROUNDED and value.shape == right.shape:
                value = np.where(np.isclose(value, right, rtol=ROUNDED[field], atol=0), right, value)
            same(value, right, f"{field} of models {what}")
            compared += 1
    require(compared > 100, f"only {compared} arrays of the models were compared; it must be more than 100")


def rollout_equals_single_steps(task: Task) -> None:
    """The thread pool gives the states of mj_step, without a warm start at a control step."""
    batch = BatchEnv(physics(task), 3)
    batch.reset(4)
    action = actions(task, 3, 1)[0]
    outcome = batch.simulator.outcome(batch.state, action)
    for i, model in enumerate(batch.simulator.models):  # type: ignore[attr-defined]
        data = mujoco.MjData(model)
        size = mujoco.mj_stateSize(model, STATE.value)  # without the readings
        mujoco.mj_setState(model, data, batch.state[i, :size], STATE.value)
        data.ctrl[:] = physics(task).control(action)[i]
        for _ in range(physics(task).substeps):
            mujoco.mj_step(model, data)
        state = np.zeros(size)
        mujoco.mj_getState(model, data, state, STATE.value)
        same(outcome[i, :size], state, "states of the thread pool and of mj_step")


def every_element_is_named(task: Task) -> None:
    """Every element of the MJCF has a name, for pages and errors; pictures need a camera called view."""
    spec = physics(task).spec()
    for kind in NAMED:
        unnamed = [i for i, element in enumerate(getattr(spec, kind)) if not element.name]
        require(not unnamed, f"of the {kind} of {task.name}, number {unnamed} of the MJCF must have a name")
    cameras = [camera.name for camera in spec.cameras]
    require("view" in cameras, f"the cameras of {task.name} were {cameras}; one must be called view")


def noise_covers_every_coordinate_that_matters(task: Task) -> None:
    """Every coordinate has process noise; otherwise a single step could reveal theta, and no posterior would be exact.

    Exempt are coordinates that theta does not move, and those that affect neither observations nor later states.
    """
    mine = physics(task)
    stated, joints = set(mine.process_noise), {joint.name for joint in mine.spec().joints}
    require(stated == joints, f"process_noise of {task.name} has {sorted(stated)}; it must have {sorted(joints)}")
    start = task.init_state(streams(0))
    action, simulator = np.ones((1, mine.action_width)), mine.simulator(1)
    noisy = mine.noise.columns
    quiet = set(range(1, 1 + mine.model.nq + mine.model.nv)) - set(noisy.tolist())
    thetas = task.theta_grid(3)
    each = task.outcome(np.repeat(start, len(thetas), 0), np.repeat(action, len(thetas), 0), thetas)
    for i in (i for i in quiet if (each[:, i] != each[0, i]).any()):
        moved = start.copy()
        moved[:, i] += 0.7
        hint = f"theta moves a coordinate without process noise, number {i - 1} of qpos and qvel, that "
        require(np.array_equal(task.observe(moved), task.observe(start)), hint + "is observed")
        both = simulator.outcome(np.concatenate([start, moved]), np.tile(action, (2, 1)), np.zeros(2, int))[:, noisy]
        require(np.allclose(both[0], both[1], rtol=1e-7, atol=1e-9), hint + "changes what follows")


def down_is_down_in_pictures(task: Task) -> None:
    """Gravity points down in the picture under every theta."""
    for theta in far_thetas(physics(task)):
        simulator = physics(task).simulator(1)
        simulator.set_theta(0, theta)
        model = simulator.models[0]
        level(model)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        right, up, _ = model.opt.gravity @ data.cam_xmat[model.camera("view").id].reshape(3, 3)
        message = f"of theta {theta.tolist()}, gravity points {right:g} to the right and {up:g} up in the picture"
        require(abs(right) < 1e-6 and up < 1e-6, message)


def without_gravity_pictures_are_as_the_camera_stands(task: Task) -> None:
    """Without gravity, the camera is not turned."""
    model = physics(task).simulator(1).models[0]
    model.opt.gravity[:] = 0
    before = model.camera("view").quat.copy()
    level(model)
    same(model.camera("view").quat, before, "quaternions of the camera view, levelled without gravity and before,")


def picture_shows_theta_or_state(task: Task) -> None:
    """A picture has 240 x 320 pixels, and differs five steps later."""
    physics(task)
    if not gl_works():
        raise Skipped("no GL for pictures works here")
    env = GymEnv(task, render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    for _ in range(5):
        env.step(env.action_space.high)  # type: ignore[attr-defined]
    require(first.shape == (240, 320, 3), f"a picture had shape {first.shape}; it must be (240, 320, 3)")
    require((env.render() != first).any(), "the picture is the same after five steps; camera view must see what moves")


CHECKS = (
    *(bounds_are_wide_enough, set_in_place_equals_recompiled, nominal_model_is_not_touched),
    *(rollout_equals_single_steps, every_element_is_named, noise_covers_every_coordinate_that_matters),
    *(down_is_down_in_pictures, without_gravity_pictures_are_as_the_camera_stands, picture_shows_theta_or_state),
)
