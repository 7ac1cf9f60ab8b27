"""What a task claims, the contract checks: no effect of theta, readings, states that stay, MuJoCo's steps, down."""

import numpy as np
import pytest
from numpy.typing import NDArray

from deconfounded import envs
from deconfounded.envs.contract import probe
from deconfounded.envs.contract.core import CONTRACT
from deconfounded.envs.edits import Edit
from deconfounded.envs.physics import Physics
from deconfounded.envs.streams import Array
from deconfounded.envs.tasks.cheetah_speed import CheetahSpeed
from deconfounded.envs.tasks.slippery_cartpole import SlipperyCartpole


class RareEffect(SlipperyCartpole):
    """By its tier there is none; the larger half of thetas has."""

    tier = None

    def apply_latent(self, edit: Edit, theta: Array) -> None:
        super().apply_latent(edit, np.maximum(theta, 0.2))


class SurerLamp(CheetahSpeed):
    """Its likelihood is that of a lamp which is wrong in a tenth of the steps, and not in a fifth."""

    def log_sense(self, state: Array, theta: Array) -> Array:
        right = (state[..., -1] > 0) == (self._off(state, theta) > 0)
        return np.log(np.where(right, 0.9, 0.1))


class MovedState(CheetahSpeed):
    """Theta damps a joint, though it is said to move no state."""

    def apply_latent(self, edit: Edit, theta: Array) -> None:
        edit.joint_damping("bthigh", 6 + float(theta[0]))


class InexactPhysics(Physics):
    def outcome(self, state: Array, action: Array, rows: NDArray[np.int64] | None = None) -> Array:
        return super().outcome(state, action, rows) + 1e-9 * (np.arange(state.shape[1]) > 0)


class Inexact(SlipperyCartpole):
    """Its states are not MuJoCo's, but for the time."""

    def simulator(self, n: int) -> Physics:
        return InexactPhysics(self, n)


@pytest.mark.parametrize(
    ("task", "check", "says"),
    [
        (RareEffect, "effect", "theta changes a trajectory, and the tier is None"),
        (SurerLamp, "log_sense_is_the_density_of_the_readings", "log_sense of cheetah_speed: the mean ratio of dens"),
        (MovedState, "log_sense_is_the_density_of_the_readings", "outcomes of thetas .* said to move no state, differ"),
        (Inexact, "rollout_equals_single_steps", "states of the thread pool and of mj_step on the whole model differ"),
    ],
)
def test_the_contract_catches(task: type[envs.Task], check: str, says: str) -> None:
    with pytest.raises(AssertionError, match=f"^{says}"):
        CONTRACT[check](task())


class LoudExpert(SlipperyCartpole):
    expert_noise = float("inf")


def test_an_expert_s_noise_is_finite() -> None:
    with pytest.raises(envs.InputError, match="expert_noise of slippery_cartpole was inf; it must be above 0, and fin"):
        envs.check_task(LoudExpert())


@pytest.mark.parametrize(
    ("left", "right", "says"),
    [
        ([1.0, np.nan, 3.0], [1.0, 2.0, 3.0], r"nan and 2.0 at \[1\], the first of 1 such places"),
        ([1.0, 2.0, 3.0], [0.0, np.nan, 3.0], r"1.0 and 0.0 at \[0\], the first of 2 such places"),
        ([1.0, 2.0], [1.0, 2.0, 3.0], r"their shapes are \(2,\) and \(3,\)"),
    ],
)
def test_arrays_that_differ_are_not_the_same(left: list[float], right: list[float], says: str) -> None:
    """A number differs from what is none, which is the same as what is none."""
    probe.same([np.nan, 1.0], [np.nan, 1.0], "states")
    with pytest.raises(AssertionError, match=f"^states differ: {says}"):
        probe.same(left, right, "states")


def test_a_refusal_is_one_by_its_words() -> None:
    """An InputError for another reason does not show that the input was looked at."""
    with probe.refused("a theta", "out of its bounds"):
        raise envs.InputError("theta was 2, out of its bounds")
    says = "a theta was refused by 'no such file', which does not match 'out of its bounds'"
    with pytest.raises(AssertionError, match=says), probe.refused("a theta", "out of its bounds"):
        raise envs.InputError("no such file")
    with pytest.raises(AssertionError, match="a theta was let through"), probe.refused("a theta", "bounds"):
        pass


class Sloping(SlipperyCartpole):
    def apply_latent(self, edit: Edit, theta: Array) -> None:
        edit.slope(float(theta[0]))


def test_the_contract_catches_a_picture_that_is_not_level(monkeypatch: pytest.MonkeyPatch) -> None:
    """No task can have such a picture by itself: cameras are rolled until gravity points down."""
    CONTRACT["down_is_down_in_pictures"](Sloping())
    monkeypatch.setattr("deconfounded.envs.contract.physics.level", lambda model: None)
    with pytest.raises(AssertionError, match=r"gravity points .* to the right and .* up in the picture"):
        CONTRACT["down_is_down_in_pictures"](Sloping())
