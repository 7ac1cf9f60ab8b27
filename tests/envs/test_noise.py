"""Process noise by hand, and on rotations: normalised, blind to a quaternion's sign, and of the std it states."""

import mujoco
import numpy as np
import pytest
from gymnasium import spaces

from deconfounded import envs
from deconfounded.benchmarks.studies import cards
from deconfounded.envs.contract.core import CONTRACT
from deconfounded.envs.contract.probe import Skipped
from deconfounded.envs.edits import Edit
from deconfounded.envs.noise import ProcessNoise
from deconfounded.envs.streams import Array, Streams

XML = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <camera name="view" pos="0 -4 1" xyaxes="1 0 0 0 0 1"/>
    <light name="lamp" pos="0 -2 4"/>
    <body name="brick" pos="0 0 1" gravcomp="1">
      <freejoint name="brick"/>
      <geom name="brick" type="box" size=".3 .2 .1" mass="1" contype="0" conaffinity="0"/>
      <site name="push" pos=".1 .1 0"/>
    </body>
    <body name="bob" pos="2 0 1">
      <joint name="ball" type="ball" damping=".1"/>
      <geom name="bob" type="capsule" fromto="0 0 0 .1 .2 -.5" size=".1" mass="1" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator>
    <general name="push" site="push" gear="5 2 1 1 0 0"/>
    <motor name="swing" joint="ball" gear="2 3 1"/>
  </actuator>
</mujoco>
"""
STEEP = {"brick": (0.01, 0.2, 0.05, 0.3), "ball": (0.3, 0.4)}  # rotations that wide show how the measure bends


class Loose(envs.MujocoTask):
    """A brick that nothing holds, and a pendulum on a ball joint; their mass is hidden: 1, 2 or 4 kg."""

    name = "loose"
    latents = (envs.Latent("doublings", "", 0, 2, "categorical"),)  # by powers of two, inertia scales to the last bit
    horizon = 20
    expert_noise = 0.1
    process_noise = {"brick": (0.01, 0.05, 0.05, 0.3), "ball": (0.05, 0.4)}
    action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
    observation = {f"{joint}_{i}": (-20, 20) for joint, width in (("brick", 13), ("ball", 7)) for i in range(width)}

    def spec(self) -> mujoco.MjSpec:
        return mujoco.MjSpec.from_string(XML)

    def apply_latent(self, edit: Edit, theta: Array) -> None:
        for body in ("brick", "bob"):
            edit.body_mass(body, 2.0 ** float(theta[0]))

    def init_state(self, rng: Streams) -> Array:
        x, spin = rng.uniform([-0.1, -0.1], 0.1)
        pose = np.pad(x[:, None], ((0, 0), (0, 6))) + np.array([0, 0, 1, 1, 0, 0, 0])
        return self.state(brick=(pose, 0), ball=([1, 0, 0, 0], np.pad(spin[:, None], ((0, 0), (0, 2)))))

    def observe(self, state: Array) -> Array:
        return np.concatenate(
            [read(state, joint) for joint in ("brick", "ball") for read in (self.qpos, self.qvel)], -1
        )

    def reward(self, state: Array, action: Array, next_state: Array, theta: Array) -> Array:
        return np.exp(-np.abs(self.qpos(next_state, "brick")[:, 0]))


def some_states(task: envs.MujocoTask, n: int, seed: int) -> Array:
    """[n, S], each joint anywhere."""
    rng = np.random.default_rng(seed)
    quaternions = rng.standard_normal((2, n, 4))
    quaternions /= np.linalg.norm(quaternions, axis=-1, keepdims=True)
    brick = np.concatenate([rng.standard_normal((n, 3)), quaternions[0]], -1)
    return task.state(brick=(brick, rng.standard_normal((n, 6))), ball=(quaternions[1], rng.standard_normal((n, 3))))


def test_hinge_by_hand() -> None:
    """Columns in the order of process_noise, position before velocity, without those of std 0."""
    task = envs.get("slippery_cartpole")
    assert isinstance(task, envs.MujocoTask)
    noise = ProcessNoise(task.model, {"hinge": (0.1, 0.0), "slider": (0.2, 0.4)})
    assert noise.size == 3
    outcome = task.state(hinge=(0.5, -1.0), slider=(2.0, 3.0))
    after = noise.apply(outcome.copy(), np.array([[1.0, -2.0, 0.5]]))
    assert task.qpos(after, "hinge")[0] == 0.5 + 0.1
    assert task.qvel(after, "hinge")[0] == -1.0
    assert task.qpos(after, "slider")[0] == 2.0 - 0.4
    assert task.qvel(after, "slider")[0] == 3.0 + 0.2
    normalisers = np.log(0.1 * 0.2 * 0.4) + 1.5 * np.log(2 * np.pi)
    np.testing.assert_allclose(noise.log_prob(after, outcome), -0.5 * (1 + 4 + 0.25) - normalisers, rtol=1e-12)


def test_ball_by_hand() -> None:
    """A quarter turn about z, then noise of .2 rad about the body's own x axis: about the world's y axis."""
    task = Loose()
    noise = ProcessNoise(task.model, {"ball": (0.1, 0.0)})
    outcome = task.state(ball=([np.sqrt(0.5), 0, 0, np.sqrt(0.5)], 0))
    after = noise.apply(outcome.copy(), np.array([[2.0, 0.0, 0.0]]))
    turned, vector = np.empty(9), np.empty(3)
    mujoco.mju_quat2Mat(turned, task.qpos(after, "ball")[0])
    np.testing.assert_allclose(turned.reshape(3, 3)[:, 0], [0, 1, 0], atol=1e-12)
    mujoco.mju_mulMatVec3(vector, turned, np.array([0.0, 1.0, 0.0]))
    np.testing.assert_allclose(vector, [-np.cos(0.2), 0, np.sin(0.2)], atol=1e-12)
    expected = -0.5 * 4 - 3 * np.log(0.1) - 1.5 * np.log(2 * np.pi) - 2 * np.log(np.sin(0.1) / 0.1)
    np.testing.assert_allclose(noise.log_prob(after, outcome), expected, rtol=1e-12)


def test_free_by_hand() -> None:
    """Three draws for each of position, rotation, velocity and angular velocity, in that order."""
    task = Loose()
    noise = ProcessNoise(task.model, {"brick": (0.1, 0.2, 0.3, 0.4)})
    assert noise.size == 12
    outcome = task.state(brick=([1, 2, 3, 1, 0, 0, 0], [1, 2, 3, 4, 5, 6]))
    after = noise.apply(outcome.copy(), np.array([[1.0, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 1]]))
    np.testing.assert_allclose(task.qpos(after, "brick")[0], [1.1, 2, 3, np.cos(0.1), 0, np.sin(0.1), 0], atol=1e-12)
    np.testing.assert_allclose(task.qvel(after, "brick")[0], [1, 2, 3.3, 4, 5, 6.4], atol=1e-12)
    fall = noise.log_prob(outcome, outcome) - noise.log_prob(after, outcome)
    np.testing.assert_allclose(fall, 2 + 2 * np.log(np.sin(0.1) / 0.1), rtol=1e-9)
    np.testing.assert_array_equal(after[:, :1], outcome[:, :1])  # time


@pytest.mark.parametrize("joint", ["ball", "brick"])
def test_normalised_over_all_rotations(joint: str) -> None:
    """The mean density of uniform rotations, times their volume 8 pi^2, is 1; 400,000 draws, 4 standard errors."""
    task, n = Loose(), 400_000
    stds = (0.5, 0.0) if joint == "ball" else (0.0, 0.5, 0.0, 0.0)
    at, rng = slice(-4, None), np.random.default_rng(0)
    outcome, states = some_states(task, 1, 1), np.repeat(some_states(task, 1, 1), n, 0)
    quaternions = rng.standard_normal((n, 4))
    task.qpos(states, joint)[:, at] = quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True)
    density = 8 * np.pi**2 * np.exp(ProcessNoise(task.model, {joint: stds}).log_prob(states, outcome))
    error = density.std() / np.sqrt(n)
    assert error < 0.01
    assert abs(density.mean() - 1) < 4 * error


@pytest.mark.parametrize("joint", ["ball", "brick"])
def test_densities_about_two_outcomes_compare(joint: str) -> None:
    """Importance sampling: under outcome p, E[q(s') / p(s')] = 1 for another outcome q; 100,000 draws."""
    task, n = Loose(), 100_000
    noise = ProcessNoise(task.model, {joint: STEEP[joint]})
    p = some_states(task, 1, 2)
    q = noise.apply(p.copy(), np.full((1, noise.size), 0.7 / np.sqrt(noise.size)))
    drawn = noise.apply(np.repeat(p, n, 0), np.random.default_rng(3).standard_normal((n, noise.size)))
    ratio = np.exp(noise.log_prob(drawn, q) - noise.log_prob(drawn, p))
    assert abs(ratio.mean() - 1) < 4 * ratio.std() / np.sqrt(n) < 0.02
    assert ratio.std() > 0.5
    apart = noise.log_prob(p, p) - noise.log_prob(drawn, p)  # half a chi-squared, but for the measure
    np.testing.assert_allclose(apart.mean(), noise.size / 2, rtol=0.02)


def test_sign_of_a_quaternion_does_not_matter() -> None:
    task = Loose()
    outcome = some_states(task, 50, 4)
    noise = ProcessNoise(task.model, STEEP)
    after = noise.apply(outcome.copy(), np.random.default_rng(5).standard_normal((50, noise.size)))
    flipped, turned = after.copy(), outcome.copy()
    task.qpos(flipped, "ball")[...] *= -1
    task.qpos(turned, "brick")[:, 3:] *= -1
    expected = noise.log_prob(after, outcome)
    np.testing.assert_allclose(noise.log_prob(flipped, outcome), expected, rtol=1e-12)
    np.testing.assert_allclose(noise.log_prob(after, turned), expected, rtol=1e-12)
    every = noise.log_prob(after[:, None], turned[None])  # leading axes broadcast
    np.testing.assert_allclose(np.diag(every), expected, rtol=1e-12)


def test_quaternions_stay_unit() -> None:
    """Whatever their length was."""
    task = Loose()
    noise, outcome = ProcessNoise(task.model, STEEP), 1.01 * some_states(task, 50, 6)
    after = noise.apply(outcome, np.random.default_rng(7).standard_normal((50, noise.size)))
    for quaternion in (task.qpos(after, "ball"), task.qpos(after, "brick")[:, 3:]):
        np.testing.assert_allclose(np.linalg.norm(quaternion, axis=-1), 1, rtol=1e-12)


def test_states_by_joint() -> None:
    """Ball and free joints in and out; one that is left out rests as in the MJCF; a number is for all columns."""
    task = Loose()
    state = task.state(ball=(np.tile([0, 1, 0, 0], (3, 1)), 2.0))
    assert state.shape == (3, 1 + 11 + 9)
    np.testing.assert_array_equal(task.qpos(state, "brick"), np.tile([0, 0, 1, 1, 0, 0, 0], (3, 1)))
    np.testing.assert_array_equal(task.qvel(state, "brick"), np.zeros((3, 6)))
    np.testing.assert_array_equal(task.qpos(state, "ball"), np.tile([0, 1, 0, 0], (3, 1)))
    np.testing.assert_array_equal(task.qvel(state, "ball"), np.full((3, 3), 2))
    assert task.qpos(state[:, None], "ball").shape == (3, 1, 4)
    assert task.state().shape == (1, 1 + 11 + 9)


@pytest.mark.parametrize(
    ("joint", "stds", "says"),
    [
        (
            "brick",
            (0.1, 0.2),
            "joint brick, a free joint, was .* must be 4 .*: position m, rotation rad, velocity m/s, ",
        ),
        ("ball", (0.1,), "joint ball, a ball joint, was .* must be 2 .*: rotation rad, angular velocity rad/s$"),
        ("ball", (0.7, 0.1), "joint ball, a ball joint, was .* its rotation's must be at most 0.5 rad$"),
        ("brick", (0.1, -0.2, 0.1, 0.1), "joint brick, a free joint, was .* must be standard deviations, from 0 up$"),
        (
            "brick",
            (0.1, float("inf"), 0.1, 0.1),
            "joint brick, a free joint, was .* must be standard deviations, from 0 up$",
        ),
    ],
)
def test_wrong_stds(joint: str, stds: tuple[float, ...], says: str) -> None:
    with pytest.raises(envs.InputError, match=rf"^process_noise of {says}") as caught:
        ProcessNoise(Loose().model, {joint: stds})
    assert "\n" not in str(caught.value)


def test_card_of_a_free_joint() -> None:
    """Its two stds of each kind share a cell."""
    card = cards.card(Loose())
    assert "| brick | 0.01, 0.05 | 0.05, 0.3 |" in card
    assert "| ball | 0.05 | 0.4 |" in card


def test_check_task_passes() -> None:
    envs.check_task(Loose())


@pytest.mark.parametrize("check", CONTRACT)
def test_contract(check: str) -> None:
    """Whatever the registered tasks hold, one with a ball and a free joint can hold, too."""
    try:
        CONTRACT[check](Loose())
    except Skipped as why:
        pytest.skip(str(why))
