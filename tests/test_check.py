"""A slip in a task file is one line that names the part, whoever runs the task."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from deconfounded import envs
from deconfounded.benchmarks import certify, run
from deconfounded.envs.physics import Edit
from deconfounded.envs.slippery_cartpole import SlipperyCartpole
from deconfounded.envs.task import Array
from deconfounded.experts import train


class MissingFile(SlipperyCartpole):
    name = "nowhere"


class MisspeltJoint(SlipperyCartpole):
    process_noise = {"slyder": (0.004, 0.1)}


class MisspeltElement(SlipperyCartpole):
    def apply_latent(self, edit: Edit, theta: Array) -> None:
        edit.body_tilt("pool", 0.0)


class OneTooMany(SlipperyCartpole):
    observation = {**SlipperyCartpole.observation, "more": (0, 1)}


class ColumnOfRewards(SlipperyCartpole):
    def reward(self, state: Array, action: Array, next_state: Array, theta: Array) -> Array:
        return super().reward(state, action, next_state, theta)[:, None]


class NegativeNoise(SlipperyCartpole):
    process_noise = {**SlipperyCartpole.process_noise, "hinge": (0.0, -0.1)}


class MisspeltName(SlipperyCartpole):
    def terminated(self, state: Array) -> NDArray[np.bool_]:
        return state[:, 0] > LIMIT  # type: ignore[name-defined]  # noqa: F821


class NoReward(SlipperyCartpole):
    def reward(self, state: Array, action: Array, next_state: Array, theta: Array) -> Array:
        return np.full(len(state), np.nan)


@pytest.mark.parametrize(
    ("task", "says"),
    [
        (MissingFile, r"the model \(assets/nowhere.xml, .*\) of nowhere: .*nowhere.xml"),
        (MisspeltJoint, "process_noise of slippery_cartpole: .*'slyder'"),
        (MisspeltElement, "apply_latent of slippery_cartpole: .*'pool'"),
        (OneTooMany, r"observe of slippery_cartpole gave \(2, 6\) of 2 environments; it must be \(2, 7\)"),
        (NoReward, r"reward of slippery_cartpole gave \[nan, nan\]; it must be finite"),
        (ColumnOfRewards, r"reward of slippery_cartpole gave \(2, 1\)"),
        (NegativeNoise, r"process_noise of joint hinge was \(0.0, -0.1\)"),
        (MisspeltName, r"terminated of slippery_cartpole: .*'LIMIT'.* \(NameError, test_check.py:\d+\)"),
    ],
)
def test_slips_are_named(task: type[envs.Task], says: str) -> None:
    with pytest.raises(envs.InputError, match=f"^{says}"):
        envs.check_task(task())


def test_broken_mjcf(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "nowhere.xml").write_text("<mujoco><worldbody></mujoco>")
    monkeypatch.setattr(MissingFile, "home", tmp_path)
    with pytest.raises(envs.InputError, match=r"^the model \(assets/nowhere\.xml, .*\) of nowhere: XML") as caught:
        envs.check_task(MissingFile())
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", envs.names())
def test_registered_tasks_pass(name: str) -> None:
    envs.check_task(envs.get(name))


@pytest.mark.parametrize(
    ("given", "right"),
    [
        ((1.0, 0.5), "low < high"),
        ((0.3, 0.3), "low < high"),
        ((float("nan"), 1.0), "low < high"),
        ((0.0, float("inf")), "low < high"),
        ((0.0, 1.0, "loguniform"), "0 < low < high"),
        ((0, 2.5, "categorical"), "whole numbers low < high"),
        ((0.1, 1.0, "log-uniform"), "one of uniform, loguniform, categorical"),
    ],
)
def test_latent_ranges(given: tuple[Any, ...], right: str) -> None:
    with pytest.raises(envs.InputError, match=rf"grip was .* it must be {right}$"):
        envs.Latent("grip", "", *given)


def test_commands_check_first(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Whatever trains or measures a task says what is wrong with it, before it makes a folder."""
    monkeypatch.setitem(envs.TASKS, "slippery_cartpole", NoReward)
    for main, args in ((run.main, ["--preset", "smoke"]), (certify.main, []), (train.main, [])):
        out = tmp_path / "out" / "x.safetensors"
        monkeypatch.setattr("sys.argv", ["command", "--task", "slippery_cartpole", "--out", str(out), *args])
        with pytest.raises(envs.InputError, match=r"^reward of slippery_cartpole gave"):
            main()
        assert not out.parent.exists()
