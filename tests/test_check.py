"""A slip in a task file is one line that names the part, whoever runs the task."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import envs
from envs.physics import Edit
from envs.slippery_cartpole import SlipperyCartpole
from envs.task import Array


class MissingFile(SlipperyCartpole):
    name = "nowhere"


class MisspeltJoint(SlipperyCartpole):
    process_noise = {"slyder": (0.004, 0.1)}


class MisspeltElement(SlipperyCartpole):
    def apply_latent(self, edit: Edit, theta: Array) -> None:
        edit.body_tilt("pool", 0.0)


class OneTooMany(SlipperyCartpole):
    observation = {**SlipperyCartpole.observation, "more": (0, 1)}


class NoReward(SlipperyCartpole):
    def reward(self, state: Array, action: Array, next_state: Array, theta: Array) -> Array:
        return np.full(len(state), np.nan)


@pytest.mark.parametrize(
    ("task", "says"),
    [
        (MissingFile, r"the model \(assets/nowhere.xml, .*\) of nowhere: .*nowhere.xml"),
        (MisspeltJoint, "process_noise of slippery_cartpole: .*'slyder'"),
        (MisspeltElement, "apply_latent of slippery_cartpole: .*'pool'"),
        (OneTooMany, "observe of slippery_cartpole gave 6 numbers; it must be 7"),
        (NoReward, "reward of slippery_cartpole was nan; it must be finite"),
    ],
)
def test_slips_are_named(task: type[envs.Task], says: str) -> None:
    with pytest.raises(envs.InputError, match=f"^{says}"):
        envs.check_task(task())


def test_broken_mjcf(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "nowhere.xml").write_text("<mujoco><worldbody></mujoco>")
    monkeypatch.setattr("envs.physics.ASSETS", tmp_path)
    with pytest.raises(envs.InputError, match=r"^the model \(assets/nowhere\.xml, .*\) of nowhere: XML") as caught:
        envs.check_task(MissingFile())
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", envs.names())
def test_registered_tasks_pass(name: str) -> None:
    envs.check_task(envs.get(name))


@pytest.mark.parametrize("given", [(1.0, 0.5), (0.3, 0.3), (0.0, 1.0, "loguniform"), (float("nan"), 1.0)])
def test_latent_ranges(given: tuple[Any, ...]) -> None:
    with pytest.raises(envs.InputError, match=r"^latent grip was .*low < high$"):
        envs.Latent("grip", "", *given)
