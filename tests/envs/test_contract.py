"""What every registered task must hold, and no task escapes: the contract over the registry, and what is left of it."""

import gymnasium
import mujoco
import numpy as np
import pytest

from deconfounded import envs
from deconfounded.envs.contract.core import CONTRACT
from deconfounded.envs.contract.physics import same_model
from deconfounded.envs.contract.probe import Skipped, far_thetas, gl_works, streams
from deconfounded.envs.edits import ModelEdit, SpecEdit
from deconfounded.envs.latent import Latent
from deconfounded.experts import policy

TASKS = envs.names()


@pytest.mark.slow
@pytest.mark.parametrize("check", CONTRACT)
@pytest.mark.parametrize("name", TASKS)
def test_contract(name: str, check: str) -> None:
    try:
        CONTRACT[check](envs.get(name))
    except Skipped as why:
        pytest.skip(str(why))


@pytest.mark.parametrize("name", TASKS)
def test_registered(name: str) -> None:
    """By whichever name it is made, it is the same environment, to the bit."""
    task = envs.get(name)
    for render_mode in (None, "rgb_array"):
        env = gymnasium.make(task.gym_id, render_mode=render_mode)
        assert isinstance(env.unwrapped, envs.GymEnv)
        assert (env.unwrapped.task.name, env.unwrapped.render_mode) == (name, render_mode)
    first = envs.BatchEnv(task, 1).reset(3)
    np.testing.assert_array_equal(env.reset(seed=3)[0], first[0])
    np.testing.assert_array_equal(envs.make(name).reset(seed=3)[0], first[0])
    np.testing.assert_array_equal(envs.make_vec(name, 1).reset(seed=3)[0], first)
    np.testing.assert_array_equal(gymnasium.make_vec(task.gym_id).reset(seed=3)[0], first)
    np.testing.assert_array_equal(envs.make_dm(name, seed=3).reset().observation, first[0])


def test_each_interface_has_the_privileged_view() -> None:
    """The same, to the bit, and of the width that its space states."""
    name = "tilted_cartpole"
    single, vec = envs.make(name, privileged=True), envs.make_vec(name, 1, privileged=True)
    dm = envs.make_dm(name, privileged=True, seed=3)
    first = single.reset(seed=3)[0]
    np.testing.assert_array_equal(vec.reset(seed=3)[0], first[None])
    np.testing.assert_array_equal(dm.reset().observation, first)
    width = len(single.task.observation) + 1
    assert single.observation_space.shape == vec.single_observation_space.shape == (width,)
    assert dm.observation_spec().shape == first.shape == (width,)


@pytest.mark.slow
@pytest.mark.skipif(not gl_works(), reason="no GL")
def test_renderers_are_independent() -> None:
    """A renderer draws the same before and after another one is gone."""
    task = envs.get("tilted_cartpole")
    theta, state = task.theta_grid(3)[0], task.init_state(streams(0))[0]
    other = task.renderer(theta)
    other(state, np.zeros(1))
    render = task.renderer(theta)
    del other
    picture = render(state, np.zeros(1))
    np.testing.assert_array_equal(task.renderer(theta)(state, np.zeros(1)), picture)
    assert 100 < picture.mean() < 250


def test_mass_edit_equals_recompiled() -> None:
    """Mass with inertia and what MuJoCo derives from them; scales do not compound."""
    task = envs.get("slippery_cartpole")
    assert isinstance(task, envs.MujocoTask)
    model = task.spec().compile()
    edit = ModelEdit(model, task.model, mujoco.MjData(model))
    for scale in (3.0, 0.5, 2.0):
        edit.body_mass("pole", scale)
        edit.finish()
    spec = task.spec()
    SpecEdit(spec).body_mass("pole", 2.0)
    same_model(model, spec.compile(), "set in place and compiled")


def test_far_thetas_reach_both_ends() -> None:
    """Also of categories, in even numbers, and of two each where there are many latents."""
    six, two = Latent("size", "", 0, 5, "categorical"), Latent("side", "", 0, 1, "categorical")
    task = envs.get("slippery_cartpole")
    assert far_thetas(task.changed(latents=(six,)))[:, 0].tolist() == [0, 3, 5]
    many = far_thetas(task.changed(latents=(two,) * 4))
    assert many.shape == (9, 4)
    assert (many.min(0).tolist(), many.max(0).tolist()) == ([0] * 4, [1] * 4)
    ranges = far_thetas(task.changed(latents=(Latent("size", "", 0, 5),) * 4))
    assert (ranges.min(0).tolist(), ranges.max(0).tolist()) == ([0.5] * 4, [4.5] * 4)


@pytest.mark.parametrize("name", TASKS)
def test_expert_loads_and_acts(name: str) -> None:
    """Batched, in bounds, and its log-probability prefers its own actions to those of another theta's expert."""
    task = envs.get(name)
    expert, batch = policy.load(task), envs.BatchEnv(task, 32)
    obs = batch.reset(0)
    other = np.repeat(far_thetas(task)[:1], 32, 0)
    action = expert.act(obs, batch.theta, np.random.default_rng(0))
    assert task.check_action(action, 32).shape == action.shape
    own, foreign = expert.log_prob(obs, action, batch.theta), expert.log_prob(obs, action, other)
    assert own.shape == (32,)
    assert own.mean() > foreign.mean()


@pytest.mark.parametrize("end", [-1.0, 1.0])
def test_a_network_s_mean_is_in_bounds(end: float) -> None:
    """An output beyond them is the bound; so densities are those of the actions that are taken."""
    task = envs.get("tilted_cartpole")
    width = len(task.observation)
    weights = {"0.weight": np.zeros((1, width + task.seen_width), "f4"), "0.bias": np.full(1, 3 * end, "f4")}
    mean = policy.NetworkExpert(task, weights).mean(np.zeros((2, width)), np.zeros((2, 1)))
    np.testing.assert_array_equal(mean, [[end]] * 2)
