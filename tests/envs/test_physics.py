"""MuJoCo as tasks from outside use it: a simulation that fails says so, and edits mean what the MJCF means."""

import copy
import ctypes
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import mujoco
import numpy as np
import pytest

from deconfounded import envs
from deconfounded.envs import models, physics
from deconfounded.envs.contract.physics import same_model
from deconfounded.envs.contract.probe import gl_works
from deconfounded.envs.edits import Edit, ModelEdit, SpecEdit
from deconfounded.envs.streams import Streams
from deconfounded.envs.task import Array


class Spring(envs.MujocoTask):
    """A weight on a spring, pushed; the spring's stiffness is hidden."""

    name = "spring"
    latents = (envs.Latent("stiffness", "N/m", 1.0, 60000.0),)
    horizon, expert_noise = 40, 0.1
    process_noise = {"slider": (0.001, 0.001)}
    observation = {"x": (-1e9, 1e9)}
    more: ClassVar[str] = ""

    def spec(self) -> Any:
        return mujoco.MjSpec.from_string(
            f"""<mujoco><option timestep=".01"/><worldbody>
            <camera name="view" pos="0 -4 1" xyaxes="1 0 0 0 0 1"/><light name="sun"/>
            <body name="weight"><joint name="slider" type="slide" axis="1 0 0"/>
            <geom name="weight" size=".1" mass="1"/></body>{self.more}</worldbody>
            <actuator><motor name="push" joint="slider"/></actuator></mujoco>"""
        )

    def init_state(self, rng: Streams) -> Array:
        (x,) = rng.uniform([0.1], [0.2])
        return self.state(slider=(x, 0.0))

    def observe(self, state: Array) -> Array:
        return self.qpos(state, "slider")[:, None]

    def reward(self, state: Array, action: Array, next_state: Array, theta: Array) -> Array:
        return np.exp(-abs(self.qpos(next_state, "slider")))

    def apply_latent(self, edit: Edit, theta: Array) -> None:
        edit.joint_stiffness("slider", float(theta[0]))


class SpringAtOnce(Spring):
    """So stiff that the first substep fails, where it is the only one of a control step: time goes on as it would."""

    substeps = 1
    latents = (envs.Latent("stiffness", "N/m", 1.0, 1e13),)


class NoControl(Spring):
    def control(self, action: Array) -> Array:
        return np.where(action > 0.5, np.nan, action)


class NoControlAtOnce(NoControl):
    substeps = 1


class Crowd(Spring):
    """More contacts than there is memory for."""

    more = "".join(
        f'<body name="b{i}" pos="0 5 {i * 1e-3}"><joint name="j{i}" type="slide" axis="1 0 0"/>'
        f'<geom name="g{i}" type="box" size=".1 .1 .1"/></body>'
        for i in range(20)
    )
    memory = 400_000
    process_noise = {**Spring.process_noise, **{f"j{i}": (0.0, 0.001) for i in range(20)}}

    def spec(self) -> Any:
        spec = super().spec()
        spec.memory = self.memory
        return spec


class CrowdAtOnce(Crowd):
    substeps = 1


class Full(Crowd):
    """So many that MuJoCo does not even warn, but fails."""

    memory = 130_000


FAILS = "the physics of spring failed in step"


def steps(env: envs.BatchEnv, count: int = 20) -> None:
    """Actions that rise, of the first environment alone."""
    for k in range(count):
        env.step(np.eye(env.n)[:, :1] * k / count)


class TestFailures:
    """One line that names theta and the step, in place of a start anew from the MJCF's rest."""

    @pytest.mark.parametrize("n", [1, 5])
    @pytest.mark.parametrize(
        ("task", "stiffness", "says"),
        [
            (Spring, 60000, rf"{FAILS} 6 of an episode with stiffness 60000 N/m: .* in QACC .* unstable"),
            (SpringAtOnce, 1e13, rf"{FAILS} 1 of an episode with stiffness 1e\+13 N/m: .* in QACC .* unstable"),
            (NoControl, 10, rf"{FAILS} 12 of an episode with stiffness 10 N/m: .* in CTRL"),
            (NoControlAtOnce, 10, rf"{FAILS} 12 of an episode with stiffness 10 N/m: .* in CTRL"),
            (Crowd, 10, rf"{FAILS} 1 of an episode with stiffness 10 N/m: Too many contacts"),
            (CrowdAtOnce, 10, rf"{FAILS} 1 of an episode with stiffness 10 N/m: Too many contacts"),
        ],
    )
    def test_what_mujoco_warns_of(self, task: type[Spring], n: int, stiffness: float, says: str) -> None:
        env = envs.BatchEnv(task(), n)
        env.reset(0, {"theta": [[stiffness]] + [[10.0]] * (n - 1)})
        with pytest.raises(envs.InputError, match=f"^{says}") as caught:
            steps(env)
        assert "\n" not in str(caught.value)

    def test_full_buffers_later_on(self) -> None:
        """Where there is one substep, time goes on, and MuJoCo's own count tells."""
        env = envs.BatchEnv(CrowdAtOnce(), 1)
        env.reset(0)
        env.state[:, 0] = 1.0
        with pytest.raises(envs.InputError, match=f"{FAILS} 101 of an episode .*: Too many contacts"):
            steps(env)

    def test_others_of_the_batch_are_not_blamed(self) -> None:
        """Where some episodes are over, too; and after it all, soft springs go on."""
        env = envs.BatchEnv(Spring(), 4)
        env.reset(0, {"theta": [[10.0], [20.0], [60000.0], [30.0]]})
        env.alive[:2] = False
        with pytest.raises(envs.InputError, match="stiffness 60000 N/m"):
            steps(env)
        env.reset(0, {"theta": [[10.0], [20.0], [40.0], [30.0]]})
        steps(env)

    def test_the_walker_falls(self) -> None:
        """Whose leg is thrown too hard for the time step: an end of the episode, and no start anew."""
        task = envs.get("slippery_walker")
        assert isinstance(task, envs.MujocoTask)
        env = envs.BatchEnv(task, 3)
        env.reset(3)
        env.step(np.zeros((3, 6)))
        task.qvel(env.state, "left_knee")[1] = 1000.0
        assert env.step(np.zeros((3, 6)))[2].tolist() == [False, True, False]
        np.testing.assert_allclose(env.state[:, 0], 2 * task.control_dt)

    def test_open_loop(self) -> None:
        env = envs.BatchEnv(Spring(), 2)
        env.reset(0, {"theta": [[10.0], [60000.0]]})
        with pytest.raises(envs.InputError, match=f"{FAILS} 6 of an episode with stiffness 60000"):
            env.simulator.rollout(env.state, np.zeros((2, 20, 1)))  # type: ignore[attr-defined]

    @pytest.mark.parametrize("task", [Spring, SpringAtOnce, NoControl, NoControlAtOnce, Crowd, CrowdAtOnce, Full])
    def test_check_task(self, task: type[Spring]) -> None:
        with pytest.raises(envs.InputError, match="the physics of spring failed") as caught:
            envs.check_task(task())
        assert "\n" not in str(caught.value)


MJCF = """<mujoco><compiler angle="radian" {compiler}/><option gravity="0 2 -9.81"/><worldbody>
<frame pos="1 2 3" euler=".1 .2 .3"><frame pos="0 0 1" axisangle="1 0 0 .4">
  <body name="b" pos=".1 .2 .3" euler="0 .5 0"><joint name="j" springdamper=".1 .5"/>
    <geom name="g" type="box" size=".1 .2 .3" density="500"/><geom name="bent" type="capsule" fromto="0 0 0 .3 .2 .1"
     size=".05"/><site name="s1"/>
    <body name="c" pos="0 0 1"><inertial pos="0 0 .1" mass="2" fullinertia="1 1.1 1.2 .1 .05 .02"/>
      <joint name="k" type="slide"/><geom name="g3" size=".1"/></body>
    <body name="d" pos="0 0 2"><joint name="m"/><geom name="g4" type="ellipsoid" size=".1 .2 .3" mass="3"/></body>
  </body></frame></frame><site name="s0" pos="0 0 4"/></worldbody>
<tendon><spatial name="t" stiffness="3"><site site="s0"/><site site="s1"/></spatial></tendon>
<equality><connect body1="c" body2="d" anchor=".1 0 0"/><weld body1="b"/></equality>
<actuator><motor name="a" joint="m"/><position name="servo" joint="j" kp="5" dampratio=".7"/></actuator></mujoco>"""


def _tilt(body: str, edit: Edit) -> None:
    edit.body_tilt(body, 0.3)


def _shift(body: str, edit: Edit) -> None:
    edit.body_shift(body, 0.7)


def _weigh(body: str, edit: Edit) -> None:
    edit.body_mass(body, 0.6)


EDITS: list[Callable[[Edit], None]] = [
    *(partial(_tilt, body) for body in "bcd"),
    *(partial(_shift, body) for body in "bcd"),
    *(partial(_weigh, body) for body in "bcd"),
    lambda edit: edit.slope(0.2),
    lambda edit: edit.joint_stiffness("j", 4.0),
    lambda edit: edit.joint_damping("j", 4.0),
    lambda edit: edit.actuator_gain("servo", -1.0),
    lambda edit: edit.tendon_friction("t", 0.7),
]


@pytest.mark.parametrize("compiler", ["", 'inertiafromgeom="true"', 'balanceinertia="true"', 'boundmass="4"'])
class TestEdits:
    """Masses by density, by <inertial>, by geoms; places in frames; angles by euler; gravity in any direction."""

    def edited(self, compiler: str, *edits: Callable[[Edit], None]) -> tuple[mujoco.MjModel, mujoco.MjModel]:
        """In place, and before it was compiled."""
        nominal = mujoco.MjSpec.from_string(MJCF.format(compiler=compiler)).compile()
        spec = mujoco.MjSpec.from_string(MJCF.format(compiler=compiler))
        in_place, before = ModelEdit(copy.copy(nominal), nominal, mujoco.MjData(nominal)), SpecEdit(spec)
        for edit in edits:
            edit(in_place)
            edit(before)
        in_place.finish()
        return in_place.model, spec.compile()

    @pytest.mark.parametrize("edit", EDITS)
    def test_in_place_equals_recompiled(self, compiler: str, edit: Callable[[Edit], None]) -> None:
        same_model(*self.edited(compiler, edit), "set in place and compiled")

    def test_nothing_changes_nothing(self, compiler: str) -> None:
        """A slope of 0, masses times 1, the gain as it was."""
        nominal = mujoco.MjSpec.from_string(MJCF.format(compiler=compiler)).compile()

        def nothing(edit: Edit) -> None:
            edit.slope(0.0)
            edit.actuator_gain("servo", 1.0)
            for body in "bcd":
                edit.body_mass(body, 1.0)

        for model in self.edited(compiler, nothing):
            same_model(model, nominal, "edited by nothing and as it was")

    def test_masses_and_gravity(self, compiler: str) -> None:
        """What edits say, in numbers: not only alike in both."""
        nominal = mujoco.MjSpec.from_string(MJCF.format(compiler=compiler)).compile()
        shift: Callable[[Edit], None] = lambda edit: edit.body_shift("d", 0.7, 0.2)  # noqa: E731
        for model in self.edited(compiler, lambda edit: edit.slope(0.2), lambda edit: edit.body_mass("b", 3.0), shift):
            np.testing.assert_allclose(model.body("d").pos, (0.7, 0.2, 2))
            np.testing.assert_allclose(model.body("b").mass, 3 * nominal.body("b").mass)
            np.testing.assert_allclose(model.body("b").inertia, 3 * nominal.body("b").inertia)
            np.testing.assert_allclose(model.body("c").mass, nominal.body("c").mass)
            np.testing.assert_allclose(model.opt.gravity, (-9.81 * np.sin(0.2), 2, -9.81 * np.cos(0.2)))


class Leaning(Spring):
    """A weight on a board whose angle is hidden; the MJCF gives it by euler, in a frame."""

    name = "leaning"
    latents = (envs.Latent("angle", "rad", -0.5, 0.5),)
    more = """<frame euler="0 0 30"><body name="board" pos="0 0 1" euler="0 10 0">
        <geom name="board" type="box" size=".5 .5 .02" rgba="1 0 0 1"/></body></frame>"""

    def apply_latent(self, edit: Edit, theta: Array) -> None:
        edit.body_tilt("board", float(theta[0]))


@pytest.mark.skipif(not gl_works(), reason="no GL")
def test_pictures_show_a_tilt() -> None:
    task = Leaning()
    state = task.state(slider=(0.0, 0.0))[0]
    level, up = (task.renderer(np.array([angle]))(state, np.zeros(1)) for angle in (0.0, 0.5))
    assert (level != up).any()


def test_an_edit_of_no_geom_is_refused() -> None:
    """A model for stepping alone lacks those that are only seen; a name that the MJCF does not have is a slip."""
    model = Spring().model
    with pytest.raises(KeyError, match="wait"):
        ModelEdit(copy.copy(model), model, mujoco.MjData(model)).geom_friction("wait", 1.0)


def test_threads_are_at_most_the_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    """OMP_NUM_THREADS lowers their number, and never raises it."""
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    available = physics.cores()
    for limit, threads in (("1", 1), (str(available + 1), available), ("0", available), ("all", available)):
        monkeypatch.setenv("OMP_NUM_THREADS", limit)
        assert physics.cores() == threads


def test_the_clock_of_mujoco_is_put_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """After a failed step, too."""
    monkeypatch.setattr(models, "CLOCK", ctypes.c_void_p(7))
    with models.no_clock():
        assert models.CLOCK.value is None
    assert models.CLOCK.value == 7
    with pytest.raises(envs.InputError), models.no_clock():
        raise envs.InputError("failed")
    assert models.CLOCK.value == 7
