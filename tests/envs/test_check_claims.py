"""What a task claims, the contract checks: no effect of theta, readings, states that stay, MuJoCo's steps, down."""

import numpy as np
import pytest
from numpy.typing import NDArray

from deconfounded import envs
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


class Sloping(SlipperyCartpole):
    def apply_latent(self, edit: Edit, theta: Array) -> None:
        edit.slope(float(theta[0]))


def test_the_contract_catches_a_picture_that_is_not_level(monkeypatch: pytest.MonkeyPatch) -> None:
    """No task can have such a picture by itself: cameras are rolled until gravity points down."""
    CONTRACT["down_is_down_in_pictures"](Sloping())
    monkeypatch.setattr("deconfounded.envs.contract.physics.level", lambda model: None)
    with pytest.raises(AssertionError, match=r"gravity points .* to the right and .* up in the picture"):
        CONTRACT["down_is_down_in_pictures"](Sloping())
