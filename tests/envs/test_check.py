"""A slip in a task file is one line that names the part, whoever runs the task."""

import json
import re
import subprocess
import sys
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from gymnasium import spaces
from numpy.typing import NDArray

from deconfounded import envs
from deconfounded.benchmarks import certify, check, run, train
from deconfounded.benchmarks.engine.context import EVALUATION, stream
from deconfounded.envs.contract.core import CONTRACT, STARTS
from deconfounded.envs.contract.densities import log_prob_is_the_density_of_the_noise
from deconfounded.envs.contract.probe import Skipped
from deconfounded.envs.edits import Edit, ModelEdit
from deconfounded.envs.streams import Array, Streams
from deconfounded.envs.tasks import slippery_walker
from deconfounded.envs.tasks.ant_goal import AntGoal
from deconfounded.envs.tasks.forked_path import ForkedPath
from deconfounded.envs.tasks.slippery_cartpole import SlipperyCartpole
from deconfounded.experts import policy
from tests.toys import Arms, Push


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


class SilentExpert(SlipperyCartpole):
    expert_noise = 0.0


class NanExpert(SlipperyCartpole):
    expert_noise = float("nan")


class NoNoise(SlipperyCartpole):
    process_noise = {joint: (0.0, 0.0) for joint in SlipperyCartpole.process_noise}


class ForgottenJoint(SlipperyCartpole):
    process_noise = {joint: stds for joint, stds in SlipperyCartpole.process_noise.items() if joint != "axle"}


class UnnamedJoint(SlipperyCartpole):
    process_noise = ForgottenJoint.process_noise

    def spec(self) -> mujoco.MjSpec:
        spec = super().spec()
        for tendon in spec.tendons:
            spec.delete(tendon)
        spec.delete(spec.actuator("spin"))
        spec.joint("axle").name = ""
        return spec


class TooManyStds(SlipperyCartpole):
    process_noise = {**SlipperyCartpole.process_noise, "hinge": (0.1, 0.1, 0.1)}


class LargeReward(SlipperyCartpole):
    def reward(self, state: Array, action: Array, next_state: Array, theta: Array) -> Array:
        return 1.5 * super().reward(state, action, next_state, theta)


class WideActions(SlipperyCartpole):
    action_space = spaces.Box(-1.0, 2.0, (1,), np.float32)


class OneSidedActions(SlipperyCartpole):
    action_space = spaces.Box(0.0, 1.0, (1,), np.float32)


class TableOfActions(SlipperyCartpole):
    action_space = spaces.Box(-1.0, 1.0, (1, 1), np.float32)


class NarrowBounds(SlipperyCartpole):
    observation = {**SlipperyCartpole.observation, "velocity": (-20, 0.5)}


class ChangesItsState(SlipperyCartpole):
    def observe(self, state: Array) -> Array:
        state[:, 0] += 1
        return super().observe(state)


class NumpyHorizon(SlipperyCartpole):
    horizon = np.int64(400)  # type: ignore[assignment]  # which no results hold


class NoCamera(SlipperyCartpole):
    def spec(self) -> mujoco.MjSpec:
        spec = super().spec()
        spec.camera("view").name = "side"
        return spec


@pytest.mark.parametrize(
    ("task", "says"),
    [
        (MissingFile, r"the model \(nowhere.xml, .*\) of nowhere: .*nowhere.xml"),
        (MisspeltJoint, "process_noise of slippery_cartpole: .*'slyder'"),
        (MisspeltElement, "apply_latent of slippery_cartpole: .*'pool'"),
        (OneTooMany, r"observe of slippery_cartpole gave an array of shape \(2, 6\) for .*; it must be \(2, 7\)"),
        (NoReward, r"reward of slippery_cartpole gave \[nan, nan\]; it must be finite"),
        (ColumnOfRewards, r"reward of slippery_cartpole gave an array of shape \(2, 1\)"),
        (NegativeNoise, r"process_noise of joint hinge, a hinge joint, was \(0.0, -0.1\); it must be standard "),
        (SilentExpert, "expert_noise of slippery_cartpole was 0; it must be above 0"),
        (NanExpert, "expert_noise of slippery_cartpole was nan; it must be above 0"),
        (NoNoise, "process_noise of slippery_cartpole was 0 throughout"),
        (ForgottenJoint, "process_noise of slippery_cartpole lacks joint axle; it must have every joint"),
        (UnnamedJoint, "process_noise of slippery_cartpole lacks joint number 1, which has no name"),
        (TooManyStds, r"process_noise of joint hinge, a hinge joint, was \(0.1, 0.1, 0.1\); it must be 2 "),
        (LargeReward, r"reward of slippery_cartpole was 1\.\d+; it must be at most 1 a step"),
        (WideActions, r"action_space of slippery_cartpole was Box\(-1.0, 2.0, .*; it must be Box\(-1, 1, "),
        (OneSidedActions, r"action_space of slippery_cartpole was Box\(0.0, 1.0, .*; it must be Box\(-1, 1, "),
        (TableOfActions, r"action_space of slippery_cartpole was .* \(1, 1\), .*; it must be Box\(-1, 1, "),
        (NarrowBounds, "observation velocity of slippery_cartpole was .*; its bounds, -20 to 0.5, must be wide enough"),
        (NoCamera, "cameras of slippery_cartpole were side; one must be called view"),
        (ChangesItsState, r"observe of slippery_cartpole: .*read-only.* \(ValueError, test_check.py:\d+\)"),
        (NumpyHorizon, r"horizon of slippery_cartpole was .*400.*; it must be a whole number, an int, from 1 up"),
        (MisspeltName, r"terminated of slippery_cartpole: .*'LIMIT'.* \(NameError, test_check.py:\d+\)"),
    ],
)
def test_slips_are_named(task: type[envs.Task], says: str) -> None:
    with pytest.raises(envs.InputError, match=f"^{says}") as caught:
        envs.check_task(task())
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("probs", "says"),
    [
        (lambda theta: np.where(np.arange(3) == theta, 1.0, 0.0), r"gave \[.*0\.0.*\]; each must be above 0"),
        (lambda theta: np.full((len(theta), 3), 0.5), r"gave \[0.5, 0.5, 0.5\]; each must be above 0, and their sum 1"),
        (
            lambda theta: np.where(np.arange(len(theta))[:, None] == 9, 0.5, np.full(3, 1 / 3)),
            r"gave \[0.5, 0.5, 0.5\]",
        ),
        (lambda theta: np.full((len(theta), 2), 0.5), r"had shape \(16, 2\); it must be \(16, 3\)"),
        (lambda theta: None, r"was None, as where a class has no expert_probs; it must be \(16, 3\)"),
    ],
)
def test_an_expert_takes_each_discrete_action_sometimes(probs: Any, says: str) -> None:
    """Else the log-likelihood of an imitator's action is minus infinity, which shows after a whole training."""
    task = type("Sure", (Arms,), {"expert_probs": lambda self, obs, theta: probs(theta)})()
    with pytest.raises(envs.InputError, match=f"^expert_probs of arms {says}"):
        envs.check_task(task)
    envs.check_task(Arms())


def slip(**changes: Any) -> envs.Task:
    """Push with other parts, which get the push that they replace."""
    return type("Slip", (Push,), changes)()  # type: ignore[no-any-return]


@pytest.mark.parametrize(
    ("task", "says"),
    [
        (slip(observation=["x"]), r"observation of push was \['x'\]; it must be a dict of names and bounds"),
        (slip(observation={**Push.observation, "velocity": (4, -4)}), "bounds of velocity of push were 4 and -4; low "),
        (slip(init_state=lambda self, rng: Push().init_state(rng)[:, 0]), r"init_state of push gave .* shape \(2,\) "),
        (slip(sample_noise=lambda self, rng: rng.standard_normal((2, 1))), r"sample_noise of push gave .* \(2, 1\) "),
        (slip(log_prob=lambda self, *at: Push().log_prob(*at)[:, None]), r"log_prob of push gave .* shape \(2, 1\) "),
        (
            slip(log_prob=lambda self, *at: Push().log_prob(*at) * np.nan),
            r"log_prob of push gave \[nan, nan\]; it must",
        ),
        (
            type("Late", (Arms,), {"action_space": spaces.Discrete(3, start=1)})(),
            "action_space of arms was .*begin at 0",
        ),
    ],
)
def test_slips_without_mujoco_are_named(task: envs.Task, says: str) -> None:
    with pytest.raises(envs.InputError, match=f"^{says}"):
        envs.check_task(task)


@pytest.mark.parametrize("factor", [0.1, 0.5, 2, 100])
def test_a_density_of_another_width_is_noticed(factor: float) -> None:
    """In a task without MuJoCo, too; what it states is no density of its noise."""
    wrong = type("Wrong", (Push,), {"log_prob": lambda self, then, at: Push().log_prob(at + (then - at) / factor, at)})
    log_prob_is_the_density_of_the_noise(Push())
    with pytest.raises(AssertionError, match="log_prob of push: the mean ratio of densities is"):
        log_prob_is_the_density_of_the_noise(wrong())


@pytest.mark.parametrize("swapped", [False, True])
def test_stated_probabilities_are_those_of_the_noise(swapped: bool) -> None:
    """Of next states of which there are few, also where theta has no part in it: here a coin beside the push."""

    class Coin(Arms):
        def sample_noise(self, rng: Any) -> Any:
            return rng.random((rng.groups, self.horizon, 2))

        def init_state(self, rng: Any) -> Any:
            return np.zeros((rng.groups, 2))

        def apply_noise(self, outcome: Any, noise: Any) -> Any:
            return np.concatenate([super().apply_noise(outcome, noise[:, :1]), noise[:, 1:] < 0.8], -1)

        def log_prob(self, next_state: Any, outcome: Any) -> Any:
            heads = np.where(next_state[..., 1] == 1, *((0.2, 0.8) if swapped else (0.8, 0.2)))
            return super().log_prob(next_state[..., :1], outcome) + np.log(heads)

        def observe(self, state: Any) -> Any:
            return super().observe(state[:, :1])

    with pytest.raises(AssertionError, match=r"log_prob of arms gives") if swapped else nullcontext():
        log_prob_is_the_density_of_the_noise(Coin())


UNSURE = np.random.default_rng(0)


@pytest.mark.parametrize(
    ("mean", "says"),
    [
        (lambda obs: 0.1 * UNSURE.normal(size=(len(obs), 1)), "gave two actions for one observation"),
        (lambda obs: np.repeat(-obs[:1, :1], len(obs), 0), "gave two actions for one observation"),
        (lambda obs: -obs[:, 0], r"had shape \(16,\); it must be \(16, 1\), a row for each observation"),
        (lambda obs: None, r"was None, .* no expert_mean; it must be \(16, 1\)"),
        (lambda obs: np.where(obs[:, :1] > 0, np.nan, 0), r"gave \[nan\]; it must be finite"),
        (lambda obs: obs[:, 4, None], r"index 4.*"),
        (lambda obs: [[0.0], [0.0, 1.0]], "setting an array element with a sequence"),
    ],
)
def test_a_closed_form_expert_is_checked(mean: Any, says: str) -> None:
    with pytest.raises(envs.InputError, match=f"^expert_mean of push:? {says}"):
        envs.check_task(type("Sure", (Push,), {"expert_mean": lambda self, obs, theta: mean(obs)})())


def test_bounds_are_wide_enough_for_a_closed_form_expert() -> None:
    """It may go where random actions do not."""
    own = {"terminated": envs.Task.terminated, "horizon": 30, "observation": {"x": (-40, 40), "velocity": (-4.0, 4.0)}}
    envs.check_task(type("Still", (Push,), {**own, "expert_mean": lambda self, obs, theta: 0 * obs[:, :1] - theta})())
    away = {**own, "expert_mean": lambda self, obs, theta: np.sign(theta)}
    with pytest.raises(envs.InputError, match=r"observation x of push was .*; its bounds, -40 to 40, must be wide"):
        envs.check_task(type("Away", (Push,), away)())


class Places(Push):
    """Theta shows by where one starts: the middle one to the right, and the upper one to the left, of 0."""

    def outcome(self, state: Array, action: Array, theta: Array) -> Array:
        right, middle = state[:, 0] > 0, np.abs(theta[:, 0]) < 0.3
        shows = np.where(right, middle, theta[:, 0] > 0.3)
        return np.stack([state[:, 0] * (1 + 0.1 * shows), state[:, 1]], -1)

    def apply_noise(self, outcome: Array, noise: Array) -> Array:
        return outcome

    def terminated(self, state: Array) -> np.ndarray:
        return np.zeros(len(state), bool)


def test_an_effect_from_one_of_several_starts_is_enough() -> None:
    starts = [envs.BatchEnv(Places(), 1).reset(seed)[0, 0] for seed in range(3, 3 + STARTS)]
    assert min(starts) < 0 < max(starts)
    CONTRACT["effect"](Places())


def test_broken_mjcf(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "nowhere.xml").write_text("<mujoco><worldbody></mujoco>")
    monkeypatch.setattr(MissingFile, "home", tmp_path)
    with pytest.raises(envs.InputError, match=r"^the model \(nowhere\.xml, .*\) of nowhere: XML") as caught:
        envs.check_task(MissingFile())
    assert "\n" not in str(caught.value)


def test_without_dm_control(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """The walker says in one line what is missing; listing the tasks needs it not."""
    monkeypatch.setattr(slippery_walker, "find_spec", lambda name: None)
    line = "^slippery_walker needs .* dm_control, which is not installed; `pip install --no-deps dm_control` brings it$"
    for ask in (envs.make, lambda name: envs.check_task(envs.get(name))):
        with pytest.raises(envs.InputError, match=line) as caught:
            ask("slippery_walker")
        assert "\n" not in str(caught.value)
    monkeypatch.setattr("sys.argv", ["run", "--list"])
    run.main()
    assert "slippery_walker" in capsys.readouterr().out


@pytest.mark.parametrize("name", envs.names())
def test_registered_tasks_pass(name: str) -> None:
    envs.check_task(envs.get(name))


class WiderNoise(SlipperyCartpole):
    def apply_noise(self, outcome: Array, noise: Array) -> Array:
        return super().apply_noise(outcome, 1.2 * noise)


class NoEffect(SlipperyCartpole):
    def apply_latent(self, edit: Edit, theta: Array) -> None:
        pass


class NoBump(ForkedPath):
    """A latent of two values."""

    def apply_latent(self, edit: Edit, theta: Array) -> None:
        pass


class InPlaceOnly(SlipperyCartpole):
    def apply_latent(self, edit: Edit, theta: Array) -> None:
        if isinstance(edit, ModelEdit):
            super().apply_latent(edit, theta)


class EditsTheNominal(SlipperyCartpole):
    def apply_latent(self, edit: Edit, theta: Array) -> None:
        self.model.tendon_frictionloss[:] = theta[0]
        super().apply_latent(edit, theta)


class Leaky(SlipperyCartpole):
    last = 0.0

    def apply_latent(self, edit: Edit, theta: Array) -> None:
        self.last = float(theta[0])
        super().apply_latent(edit, theta)

    def init_state(self, rng: Streams) -> Array:
        start = super().init_state(rng)
        self.qpos(start, "slider")[...] += 0.01 * self.last
        return start


class OwnRandomness(SlipperyCartpole):
    def init_state(self, rng: Streams) -> Array:
        return super().init_state(Streams([np.random.default_rng() for _ in range(rng.groups)]))


class ConstantObservation(SlipperyCartpole):
    def observe(self, state: Array) -> Array:
        return super().observe(state) * (np.arange(6) != 3)


class FixedStart(SlipperyCartpole):
    def init_state(self, rng: Streams) -> Array:
        return np.repeat(super().init_state(Streams([np.random.default_rng(0)])), rng.groups, 0)


class QuietPole(SlipperyCartpole):
    process_noise = {**SlipperyCartpole.process_noise, "hinge": (0.004, 0.0)}


class WrongBound(SlipperyCartpole):
    def check_theta(self, theta: object, n: int) -> Array:
        return np.broadcast_to(np.asarray(theta, float), (n, 1))


class HalfRange(SlipperyCartpole):
    def sample_theta(self, rng: Streams) -> Array:
        return self.latents[0].ppf(0.5 * self.latents[0].cdf(super().sample_theta(rng)))


class FixedTheta(SlipperyCartpole):
    def sample_theta(self, rng: Streams) -> Array:
        return np.full((rng.groups, 1), 0.3)


class Wanders(SlipperyCartpole):
    """Theta moves from one episode to the next, though no latent says so."""

    drifts = True  # type: ignore[assignment]

    def drifted(self, theta: Array, rng: Streams) -> Array:
        return 0.9 * theta


class StandsStill(SlipperyCartpole):
    """Theta does not move from one episode to the next, though its latent says so."""

    latents = (replace(SlipperyCartpole.latents[0], drift=0.3),)

    def drifted(self, theta: Array, rng: Streams) -> Array:
        return theta


class RoundedTheta(SlipperyCartpole):
    def check_theta(self, theta: object, n: int) -> Array:
        return super().check_theta(theta, n).round(2)


class Repeats(AntGoal):
    def check_theta(self, theta: object, n: int) -> Array:
        return super().check_theta(np.resize(theta, 2) if np.size(theta) < 2 else theta, n)


class LenientActions(SlipperyCartpole):
    def check_action(self, action: object, n: int, ignored: NDArray[np.bool_] | None = None) -> Array:
        return np.zeros((n, 1))


class LeftoverState(SlipperyCartpole):
    def simulator(self, n: int) -> Any:
        simulator, outcome, steps = super().simulator(n), type(super().simulator(n)).outcome, iter(range(10**9))

        def worn(state: Array, action: Array, rows: Any = None) -> Array:
            return outcome(simulator, state, action, rows) + 1e-9 * next(steps)

        simulator.outcome = worn  # type: ignore[method-assign]
        return simulator


class UnnamedGeom(SlipperyCartpole):
    def spec(self) -> mujoco.MjSpec:
        spec = super().spec()
        spec.worldbody.add_geom(size=[0.1, 0, 0], contype=0, conaffinity=0)
        return spec


@pytest.mark.parametrize(
    ("task", "check", "says"),
    [
        (WiderNoise, "log_prob_is_the_density_of_the_noise", "log_prob of slippery_cartpole"),
        (NoEffect, "effect", r"thetas .* have the trajectories of "),
        (NoBump, "effect", r"thetas \[\[1\]\] have the trajectories of \[0\]"),
        (InPlaceOnly, "set_in_place_equals_recompiled", "tendon_frictionloss of models set in place and compiled"),
        (EditsTheNominal, "nominal_model_is_not_touched", "tendon_frictionloss of models of the task"),
        (Leaky, "no_leak", r"first observations of theta .*, of the same seed, \(x\) differ"),
        (OwnRandomness, "gymnasium_env", "gymnasium's checker: "),
        (OwnRandomness, "adapters_agree", "first observations of GymVectorEnv and SyncVectorEnv differ"),
        (OwnRandomness, "any_batch_size", "runs of seed 11 among five and alone differ"),
        (LeftoverState, "episodes_repeat", "observations of two episodes of an environment with the same seeds differ"),
        (OwnRandomness, "seed_streams", "the start and what the seed's second stream draws differ"),
        (OwnRandomness, "seed_kinds", "first observations of seed 3 and .* differ"),
        (OwnRandomness, "privileged_view", "observations with and without the privileged view differ"),
        (ConstantObservation, "starts_vary_and_nothing_is_constant", "observation velocity of .* never moved"),
        (FixedStart, "starts_vary_and_nothing_is_constant", "eight episodes started with the same"),
        (
            QuietPole,
            "noise_covers_every_coordinate_that_matters",
            "theta moves a coordinate without process noise, velocity of joint hinge, that",
        ),
        (NarrowBounds, "bounds_are_wide_enough", "observation velocity of slippery_cartpole was"),
        (FixedTheta, "keep_theta", "a reset without keep_theta drew the theta of the trial before"),
        (Wanders, "keep_theta", "friction before and after a reset with keep_theta differ"),
        (StandsStill, "keep_theta", "friction, which drifts, stood still from one episode to the next"),
        (RoundedTheta, "forced_theta_moves_nothing_else", "runs of the same seed with theta drawn and forced differ"),
        (NoReward, "stable_baselines", "Stable-Baselines3's checker: reward of slippery_cartpole was nan"),
        (WrongBound, "theta_out_of_bounds", ".* was let through"),
        (Repeats, "theta_out_of_bounds", "a theta of too few numbers was let through"),
        (LenientActions, "wrong_actions", "action .* of two environments was let through"),
        (HalfRange, "theta_follows_its_distribution", r"2,000 draws of friction are 0\.[45]\d+ off its distribution"),
        (UnnamedGeom, "every_element_is_named", "of the geoms of slippery_cartpole, number "),
        (NoReward, "dm_env_tests", "dm_env's test_.*: .*reward of slippery_cartpole was nan"),
    ],
)
def test_the_contract_catches(task: type[envs.Task], check: str, says: str) -> None:
    with pytest.raises((AssertionError, envs.InputError), match=f"^{says}"):
        CONTRACT[check](task())


def test_tensors_with_a_gradient() -> None:
    """Whoever forgot to detach them reads what is wrong."""
    tensor = torch.zeros(1, requires_grad=True)
    for env in (envs.make("slippery_cartpole"), envs.make_vec("slippery_cartpole", 1)):
        env.reset(seed=0)
        with pytest.raises(envs.InputError, match=r"^action was tensor"):
            env.step(tensor)
    batch = envs.BatchEnv(envs.get("slippery_cartpole"), 1)
    batch.reset(0)
    with pytest.raises(envs.InputError, match=r"^action of slippery_cartpole was tensor"):
        batch.step(tensor[:, None])


def test_a_class_that_stands_in_no_file(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a notebook: it is checked, with its own `spec`; without weights it is said why there can be none."""
    made = type("InNotebook", (SlipperyCartpole,), {"name": "in_notebook", "__module__": "__main__"})
    monkeypatch.setattr("deconfounded.envs.support.outside.source", lambda of: None)
    monkeypatch.setattr(made, "spec", lambda self: envs.get("slippery_cartpole").spec())
    envs.check_task(made())
    with pytest.raises(envs.InputError, match=r"^task in_notebook has no folder for its model and its expert"):
        policy.load(made())


def test_a_task_by_the_module_that_it_is_in() -> None:
    assert type(envs.get("deconfounded.envs.tasks.bandit:Bandit")) is type(envs.get("bandit"))
    assert envs.get("bandit").reference == "bandit"


def test_the_contract_catches_shared_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """No task can share memory by itself: batches copy what it observes."""
    observe, shared = envs.BatchEnv.observe, np.zeros((1, 6), np.float32)

    def reused(self: envs.BatchEnv) -> NDArray[np.float32]:
        shared[...] = observe(self)
        return shared

    monkeypatch.setattr(envs.BatchEnv, "observe", reused)
    with pytest.raises(AssertionError, match=r"^the first observation before and after three steps differ"):
        CONTRACT["observations_share_no_memory"](SlipperyCartpole())


@pytest.mark.parametrize(("late", "says"), [(False, "truncation at step 2 and"), (True, "truncation at step 3 and")])
def test_the_contract_catches_a_wrong_time_limit(late: bool, says: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor can it have another time limit than its horizon: batches count the steps."""
    step = envs.BatchEnv.step

    def off(self: envs.BatchEnv, action: object) -> Any:
        obs, reward, terminated, truncated = step(self, action)
        if late:
            return obs, reward, terminated, truncated & False
        return obs, reward, terminated, truncated | (self._steps == self.task.horizon - 1) & ~terminated

    monkeypatch.setattr(envs.BatchEnv, "step", off)
    with pytest.raises(AssertionError, match=f"^{says}"):
        CONTRACT["time_limit"](SlipperyCartpole())


def test_episodes_of_one_step() -> None:
    """They are no error; gymnasium's checker, which would call them one, is not asked."""
    task = type("Short", (SlipperyCartpole,), {"horizon": 1})()
    with pytest.raises(Skipped, match=r"^gymnasium's checker takes an episode that is cut off after one step"):
        CONTRACT["gymnasium_env"](task)
    for name in ("stable_baselines", "dm_env_tests", "adapters_agree", "time_limit", "keep_theta"):
        CONTRACT[name](task)


def test_the_contract_is_whole() -> None:
    """A check that is left out is missed, also where each task would pass it."""
    of_interfaces = "gymnasium_env stable_baselines dm_env_tests adapters_agree time_limit reset_options wrong_actions"
    of_theta = "no_leak effect privileged_view keep_theta theta_follows_its_distribution theta_out_of_bounds"
    of_theta += " forced_theta_moves_nothing_else"
    of_seeds = "any_batch_size episodes_repeat seed_streams seed_kinds"
    of_maths = "starts_vary_and_nothing_is_constant observations_share_no_memory"
    of_maths += " log_prob_is_the_density_of_the_noise log_sense_is_the_density_of_the_readings"
    of_physics = "bounds_are_wide_enough set_in_place_equals_recompiled nominal_model_is_not_touched"
    of_physics += " rollout_equals_single_steps every_element_is_named noise_covers_every_coordinate_that_matters"
    of_physics += " down_is_down_in_pictures picture_shows_theta_or_state"
    assert set(CONTRACT) == set(" ".join((of_interfaces, of_theta, of_seeds, of_maths, of_physics)).split())


def test_check_command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """A line for each check, and exit code 1 if any failed."""
    names = ("effect", "reset_options", "bounds_are_wide_enough")
    monkeypatch.setattr(check, "CONTRACT", {name: CONTRACT[name] for name in names})
    monkeypatch.setitem(envs.TASKS, "slippery_cartpole", NoEffect)
    outputs = []
    for name in ("bandit", "slippery_cartpole"):
        monkeypatch.setattr("sys.argv", ["check", "--task", name])
        with pytest.raises(SystemExit) as done:
            check.main()
        outputs.append((done.value.code, capsys.readouterr().out.splitlines()))
    skipped = "skip bounds_are_wide_enough: this check is for MuJoCo tasks"
    assert outputs[0] == (0, ["ok   check_task", "ok   effect", "ok   reset_options", skipped])
    code, (_, failed, *rest) = outputs[1]
    assert code == 1
    assert failed.startswith("FAIL effect: thetas [")
    assert rest == ["ok   reset_options", "ok   bounds_are_wide_enough"]


def test_check_command_says_a_fault_once(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Where several checks fail by one fault, those after the first name that check."""

    def fault(text: str) -> Callable[[envs.Task], None]:
        def fail(task: envs.Task) -> None:
            raise envs.InputError(text)

        return fail

    checks = {"one": fault("no step"), "two": fault("checker: no step"), "three": fault("no start")}
    monkeypatch.setattr(check, "CONTRACT", checks)
    monkeypatch.setattr("sys.argv", ["check", "--task", "bandit"])
    with pytest.raises(SystemExit) as done:
        check.main()
    lines = capsys.readouterr().out.splitlines()
    assert lines[1:] == ["FAIL one: no step", "FAIL two: the same as one", "FAIL three: no start"]
    assert done.value.code == 1


def test_check_command_ends_with_the_quick_check(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """If that fails; others would say the same in their own ways."""
    monkeypatch.setitem(envs.TASKS, "slippery_cartpole", NoReward)
    monkeypatch.setattr("sys.argv", ["check", "--task", "slippery_cartpole"])
    with pytest.raises(SystemExit) as done:
        check.main()
    failed, *rest = capsys.readouterr().out.splitlines()
    assert failed.startswith("FAIL check_task: reward of slippery_cartpole gave [nan, nan]")
    assert rest == [f"skip the other {len(CONTRACT)} checks until that is mended"]
    assert done.value.code == 1


@pytest.mark.slow
def test_check_command_says_one_line() -> None:
    """Of a task that is not there, without a word of the interpreter's; and nothing is lost under `python -O`."""
    command = [sys.executable, "-O", "-m", "deconfounded", "check", "--task", "nowhere"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=Path(__file__).parents[2])
    assert done.returncode == 2
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1


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


def test_what_is_no_task() -> None:
    with pytest.raises(envs.InputError, match=r"^task was 'tilted_cartpole'; it must be a Task, such as envs.get"):
        envs.check_task("tilted_cartpole")  # type: ignore[arg-type]
    with pytest.raises(envs.InputError, match=r"^register was given 3; it takes a class of tasks"):
        envs.register(3)  # type: ignore[arg-type]
    with pytest.raises(envs.InputError, match=r"^distribution of x was \['uniform'\]; it must be one of uniform, "):
        envs.Latent("x", "", 0.0, 1.0, ["uniform"])  # type: ignore[arg-type]


@pytest.mark.parametrize(("returns", "better"), [((4.0, 8.0), ""), ((1.5, 2.5), "hardly"), ((0.0, 1.0), "not")])
def test_the_card_of_an_expert_that_was_trained(
    returns: tuple[float, float],
    better: str,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Its returns, those of random actions, and a warning if these deviate by half of what lies between."""
    held = {"ExpertAgent": np.array(returns), "RandomAgent": np.array([0.0, 2.0])}

    def rolled_out(env: envs.BatchEnv, agent: object, episodes: int, seed: int) -> Any:
        assert seed == stream(EVALUATION, 0)  # whose thetas are not those of training, which begins with seed 0
        return SimpleNamespace(returns=held[type(agent).__name__])

    monkeypatch.setattr(train, "run_trials", rolled_out)
    weights = {"0.weight": np.zeros((1, 7), np.float32), "0.bias": np.zeros(1, np.float32)}
    monkeypatch.setattr("deconfounded.experts.train.train", lambda *_: weights)
    monkeypatch.setattr("sys.argv", ["train", "--task", "slippery_cartpole", "--out", str(tmp_path / "x.safetensors")])
    train.main()
    card = json.loads((tmp_path / "x.json").read_text())
    assert (card["return_mean"], card["return_random"], card["episodes_scored"]) == (np.mean(returns), 1, 2)
    assert card["return_standard_error"] == pytest.approx(np.std(returns) / 2**0.5, abs=0.01)
    warnings = re.findall(r"is (\w+) better than random actions", capsys.readouterr().out)
    assert warnings == [better] * bool(better)


def test_a_card_replaces_no_file_of_others(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Before anything is trained."""
    (tmp_path / "x.json").write_text('{"my": "parameters"}')
    command = ["train", "--task", "slippery_cartpole", "--out", str(tmp_path / "x.safetensors")]
    monkeypatch.setattr("sys.argv", command)
    with pytest.raises(envs.InputError, match=r"x\.json, where the card of the weights belongs, is none; give another"):
        train.main()
    assert [file.name for file in tmp_path.iterdir()] == ["x.json"]


def test_an_expert_trained_anew(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Weights in place of others of the same name are not held to the card of those."""
    task, file = envs.get("slippery_cartpole"), tmp_path / "x.safetensors"
    monkeypatch.setattr("sys.argv", ["command", "--task", task.name, "--out", str(file)])
    for bias in (0.0, 0.1):
        weights = {"0.weight": np.zeros((1, 7), np.float32), "0.bias": np.full(1, bias, np.float32)}
        monkeypatch.setattr("deconfounded.experts.train.train", lambda *_, weights=weights: weights)
        train.main()
        assert policy.version(task, file) == (2 if bias else 1), "a version is raised by each training"
    kept = policy.load(task, file).mean(np.zeros((1, 6), np.float32), np.zeros((1, 1)))
    np.testing.assert_allclose(kept, 0.1, rtol=1e-6)
