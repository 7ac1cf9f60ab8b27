"""Checks of the interfaces: gymnasium, Stable-Baselines3 and dm_env, and that all of them agree."""

import unittest
import warnings
from collections.abc import Iterator
from functools import partial
from typing import Any

import gymnasium
import numpy as np
from dm_env import test_utils
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import SyncVectorEnv

from deconfounded.envs.adapters import DmEnv, GymEnv, GymVectorEnv
from deconfounded.envs.batch import BatchEnv
from deconfounded.envs.contract.probe import Skipped, actions, gl_works, reported_by, require, same
from deconfounded.envs.task import Task


def gymnasium_env(task: Task) -> None:
    """Gymnasium's environment checker raises no error and no warning."""
    if task.horizon == 1:
        raise Skipped("gymnasium's checker takes an episode that is cut off after one step for an error")
    env = gymnasium.make(EnvSpec(task.gym_id, entry_point=partial(GymEnv, task)))
    with reported_by("gymnasium's checker"):
        if not task.has_likelihood:  # nor bounds of observations
            warnings.filterwarnings("ignore", ".*infinity", UserWarning)
        check_env(env.unwrapped, skip_render_check=not (task.has_likelihood and gl_works()))


def stable_baselines(task: Task) -> None:
    """Stable-Baselines3's environment checker raises none either, in the privileged view."""
    try:
        from stable_baselines3.common.env_checker import check_env as check_env_sb3
    except ModuleNotFoundError as error:
        raise Skipped(f"{error.name} is not installed") from None
    with reported_by("Stable-Baselines3's checker"):
        check_env_sb3(GymEnv(task, privileged=True), skip_render_check=True)


def dm_env_tests(task: Task) -> None:
    """The tests of dm_env's mixin pass."""

    class EnvironmentTest(test_utils.EnvironmentTestMixin, unittest.TestCase):
        def make_object_under_test(self) -> DmEnv:
            return DmEnv(task, seed=0)

        def make_action_sequence(self) -> Iterator[Any]:
            rng, spec = np.random.default_rng(0), self.environment.action_spec()
            for _ in range(200):
                yield spec.generate_value() if task.n_actions else rng.uniform(-1, 1, spec.shape).astype("f4")

    result = unittest.TestResult()
    unittest.defaultTestLoader.loadTestsFromTestCase(EnvironmentTest).run(result)
    for test, trace in result.failures + result.errors:
        raise AssertionError(f"dm_env's {test.id().split('.')[-1]}: {trace.strip().splitlines()[-1]}")
    require(result.testsRun >= 4, f"dm_env's mixin ran {result.testsRun} tests; it must be at least 4")


def adapters_agree(task: Task) -> None:
    """GymVectorEnv, SyncVectorEnv of GymEnv, and DmEnv give the same bits for the same seeds and actions."""
    n = 2
    ours, theirs = GymVectorEnv(task, n), SyncVectorEnv([lambda: GymEnv(task) for _ in range(n)])
    dm = DmEnv(task, seed=7)
    first, _ = ours.reset(seed=7)
    same(first, theirs.reset(seed=7)[0], "first observations of GymVectorEnv and SyncVectorEnv")
    same(first[0], dm.reset().observation, "first observations of GymVectorEnv and DmEnv")
    for at, action in enumerate(actions(task, n, steps=2 * task.horizon + 5), start=1):
        flat = action[:, 0].astype(int) if task.n_actions else action
        mine, other = ours.step(flat), theirs.step(flat)
        for name, x, y in zip(("observations", "rewards", "terminated", "truncated"), mine, other, strict=False):
            same(x, y, f"{name} of GymVectorEnv and SyncVectorEnv after {at} steps")
        step = dm.step(flat[0])
        same(mine[0][0], step.observation, f"observations of GymVectorEnv and DmEnv after {at} steps")
        if not step.first():
            same(mine[1][0], step.reward, f"rewards of GymVectorEnv and DmEnv after {at} steps")
            right = 0.0 if mine[2][0] else 1.0
            said = f"the discount of DmEnv after {at} steps was {step.discount}; it must be {right:g}"
            require(step.discount == right, f"{said}, as terminated was {mine[2][0]}")
        over = mine[2][0] or mine[3][0]
        require(step.last() == over, f"after {at} steps the episode was over {over} in GymVectorEnv, not so in DmEnv")


def time_limit(task: Task) -> None:
    """Episodes are truncated at exactly the time limit, unless they ended before.

    Where random actions end all of them before, as a pole falls, a limit of three steps would be kept, too.
    """
    _check_limit(task)
    if task.has_likelihood and task.horizon > 3:
        _check_limit(task.changed(horizon=3))


def _check_limit(task: Task) -> None:
    batch = BatchEnv(task, 64)
    batch.reset(0)
    for step, action in enumerate(actions(task, 64, task.horizon), start=1):
        was_alive = batch.alive
        _, _, _, truncated = batch.step(action)
        due = was_alive & ((step == task.horizon) | task.truncated(batch.state))
        same(truncated, due, f"truncation at step {step} and what the horizon of {task.horizon} asks for")
    require(not batch.alive.any(), f"{batch.alive.sum()} of 64 episodes went on after the horizon of {task.horizon}")


CHECKS = (gymnasium_env, stable_baselines, dm_env_tests, adapters_agree, time_limit)
