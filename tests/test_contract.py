"""What every registered task must hold, and no task escapes: these tests run over the registry."""

from __future__ import annotations

import warnings

import gymnasium
import mujoco
import numpy as np
import pytest
from absl.testing import absltest
from dm_env import test_utils
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import SyncVectorEnv
from stable_baselines3.common.env_checker import check_env as check_env_sb3

from deconfounded import envs
from deconfounded.envs.physics import ModelEdit, SpecEdit
from deconfounded.envs.render import level
from deconfounded.experts import policy
from tests.tools import actions, far_thetas, gl_works, streams

TASKS = envs.names()
PHYSICS = [name for name in TASKS if isinstance(envs.get(name), envs.MujocoTask)]


@pytest.mark.parametrize("name", TASKS)
class TestProtocols:
    def test_gymnasium(self, name: str) -> None:
        env = gymnasium.make(envs.get(name).gym_id)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            check_env(env.unwrapped, skip_render_check=not gl_works())

    def test_stable_baselines(self, name: str) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            check_env_sb3(envs.make(name, privileged=True), skip_render_check=True)

    def test_adapters_agree(self, name: str) -> None:
        """The vector env, gymnasium's SyncVectorEnv, single envs and dm_env: same seeds, same bits, resets included."""
        n, task = 3, envs.get(name)
        ours, theirs = envs.make_vec(name, n), SyncVectorEnv([lambda: envs.make(name) for _ in range(n)])
        dm = envs.make_dm(name, seed=7)
        first, _ = ours.reset(seed=7)
        np.testing.assert_array_equal(first, theirs.reset(seed=7)[0])
        np.testing.assert_array_equal(first[0], dm.reset().observation)
        for action in actions(task, n, steps=2 * task.horizon + 5):
            flat = action[:, 0].astype(int) if task.action_space.shape == () else action
            mine, other = ours.step(flat), theirs.step(flat)
            for x, y in zip(mine[:4], other[:4], strict=True):
                np.testing.assert_array_equal(x, y)
            step = dm.step(flat[0])
            np.testing.assert_array_equal(mine[0][0], step.observation)
            assert step.last() == (mine[2][0] or mine[3][0])

    def test_time_limit(self, name: str) -> None:
        """Truncation comes at exactly the time limit, if the episode has not ended before."""
        task = envs.get(name)
        batch = envs.BatchEnv(task, 64)
        batch.reset(0)
        for step, action in enumerate(actions(task, 64, task.horizon), start=1):
            was_alive = batch.alive
            _, _, terminated, truncated = batch.step(action)
            assert (truncated == (was_alive & ~terminated & (step == task.horizon))).all()
        assert not batch.alive.any()


@pytest.mark.skipif(not gl_works(), reason="no GL")
def test_painters_do_not_touch_each_other() -> None:
    """A painter draws the same before and after another one is gone."""
    task = envs.get("tilted_cartpole")
    theta, state = task.theta_grid(3)[0], task.init_state(streams(0))[0]
    other = task.painter(theta)
    other(state, np.zeros(1))
    paint = task.painter(theta)
    del other
    picture = paint(state, np.zeros(1))
    np.testing.assert_array_equal(task.painter(theta)(state, np.zeros(1)), picture)
    assert 100 < picture.mean() < 250


@pytest.mark.parametrize("name", PHYSICS)
def test_down_is_down_in_pictures(name: str) -> None:
    """Whatever theta does to gravity, it points down in the picture."""
    task = envs.get(name)
    for theta in far_thetas(task):
        physics = task.simulator(1)
        physics.set_theta(0, theta)
        model = physics.models[0]
        level(model)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        right, up, _ = model.opt.gravity @ data.cam_xmat[model.camera("view").id].reshape(3, 3)
        assert abs(right) < 1e-6
        assert up < 1e-6


@pytest.mark.parametrize("name", PHYSICS)
def test_without_gravity_pictures_are_as_the_camera_stands(name: str) -> None:
    model = envs.get(name).simulator(1).models[0]
    model.opt.gravity[:] = 0
    before = model.camera("view").quat.copy()
    level(model)
    np.testing.assert_array_equal(model.camera("view").quat, before)


@pytest.mark.parametrize("name", TASKS)
class TestHiddenTheta:
    def test_no_leak(self, name: str) -> None:
        """Same seed, many thetas: the first observations and infos are identical."""
        env = envs.make(name)
        first = [env.reset(seed=3, options={"theta": theta}) for theta in far_thetas(env.task)]
        for obs, info in first:
            np.testing.assert_array_equal(obs, first[0][0])
            assert info == {}
        assert env.step(env.action_space.sample())[4] == {}

    def test_effect(self, name: str) -> None:
        """Same seed and actions, another theta: another trajectory. Where no tier has a cure, exactly the same one.

        Actions are random or, since Tier 3 may need to be looked for, each axis pushed for the whole episode.
        """
        task = envs.get(name)
        plans = [actions(task, 1, task.horizon)]
        if isinstance(task, envs.MujocoTask):
            axes = np.eye(task.action_space.shape[0])
            plans += [np.tile(axis, (task.horizon, 1, 1)) for axis in axes]
        differs = np.zeros((len(plans), len(far_thetas(task)) - 1), bool)
        for i, plan in enumerate(plans):
            runs = []
            for theta in far_thetas(task):
                batch = envs.BatchEnv(task, 1)
                batch.reset(3, {"theta": theta})
                runs.append(np.array([batch.step(action)[0] for action in plan]))
            differs[i] = [(runs[0] != run).any() for run in runs[1:]]
        if task.tier is None:
            assert not differs.any()
        else:
            assert differs.any(0).all()

    def test_privileged_view(self, name: str) -> None:
        """It appends the encoded theta, and is the same otherwise."""
        plain, privileged = envs.make(name), envs.make(name, privileged=True)
        obs, seen = plain.reset(seed=5)[0], privileged.reset(seed=5)[0]
        np.testing.assert_array_equal(seen[: len(obs)], obs)
        encoded = plain.task.encode_theta(plain.batch.theta)[0]
        np.testing.assert_allclose(seen[len(obs) :], encoded, rtol=1e-6)

    def test_keep_theta(self, name: str) -> None:
        """A trial keeps its theta and gets a new start or noise; the next trial gets a new theta."""
        task = envs.get(name)
        batch = envs.BatchEnv(task, 16)
        batch.reset(1)
        theta = batch.theta.copy()
        first = [batch.step(action)[0] for action in actions(task, 16, 3)]
        batch.reset(options={"keep_theta": True})
        np.testing.assert_array_equal(batch.theta, theta)
        assert (np.array(first) != np.array([batch.step(action)[0] for action in actions(task, 16, 3)])).any()
        batch.reset()
        assert (batch.theta != theta).any()

    def test_theta_follows_its_distribution(self, name: str) -> None:
        """The cdf of drawn thetas is uniform: Kolmogorov-Smirnov distance of 2,000 draws below .04 (p = .003)."""
        task = envs.get(name)
        draws = task.sample_theta(streams(*range(2000)))
        for i, latent in enumerate(task.latents):
            if latent.distribution == "categorical":
                counts = (draws[:, i, None] == latent.grid(0)).mean(0)
                np.testing.assert_allclose(counts, 1 / latent.features, atol=0.04)
            else:
                sorted_cdf = np.sort(latent.cdf(draws[:, i]))
                assert np.abs(sorted_cdf - (np.arange(2000) + 0.5) / 2000).max() < 0.04


@pytest.mark.parametrize("name", TASKS)
class TestSeeds:
    def test_any_batch_size(self, name: str) -> None:
        """An environment's run depends on its own seed alone, to the bit."""
        task = envs.get(name)
        acts = actions(task, 5, task.horizon)
        large = envs.BatchEnv(task, 5)
        seen = [large.reset(11)] + [large.step(action)[0] for action in acts]
        for i in (0, 4):
            small = envs.BatchEnv(task, 1)
            again = [small.reset(11 + i)] + [small.step(action[i : i + 1])[0] for action in acts]
            np.testing.assert_array_equal(np.array(seen)[:, i], np.array(again)[:, 0])

    def test_streams(self, name: str) -> None:
        """Environment i of seed s draws theta, start and noise from SeedSequence(s + i).spawn(3), in that order."""
        task = envs.get(name)
        batch = envs.BatchEnv(task, 2)
        batch.reset(20)
        for i in range(2):
            theta, start, _ = map(streams, np.random.SeedSequence(20 + i).spawn(3))
            np.testing.assert_array_equal(batch.theta[i], task.sample_theta(theta)[0])
            np.testing.assert_array_equal(batch.state[i], task.init_state(start)[0])

    def test_seed_kinds(self, name: str) -> None:
        batch = envs.BatchEnv(envs.get(name), 2)
        first = batch.reset(3)
        np.testing.assert_array_equal(batch.reset(np.int64(3)), first)
        np.testing.assert_array_equal(batch.reset([3, 4]), first)
        for wrong in ([1], -1):
            with pytest.raises(envs.InputError, match="seed was"):
                batch.reset(wrong)

    def test_forced_theta_moves_nothing_else(self, name: str) -> None:
        """Start and noise belong to the seed: forcing the theta that would have been drawn changes no bit."""
        task = envs.get(name)
        acts = actions(task, 4, 10)
        free, forced = envs.BatchEnv(task, 4), envs.BatchEnv(task, 4)
        seen = [free.reset(2)] + [free.step(action)[0] for action in acts]
        again = [forced.reset(2, {"theta": free.theta.copy()})] + [forced.step(action)[0] for action in acts]
        np.testing.assert_array_equal(np.array(seen), np.array(again))

    def test_starts_vary_and_nothing_is_constant(self, name: str) -> None:
        task = envs.get(name)
        batch = envs.BatchEnv(task, 8)
        seen = np.array([batch.reset(0)] + [batch.step(action)[0] for action in actions(task, 8, task.horizon)])
        assert (seen.std((0, 1)) > 0).all()
        if name in PHYSICS:
            assert (seen[0].std(0) > 0).any()

    def test_observations_share_no_memory(self, name: str) -> None:
        env = envs.make(name)
        first, _ = env.reset(seed=0)
        copy = first.copy()
        for _ in range(3):
            env.step(env.action_space.sample())
        np.testing.assert_array_equal(first, copy)


@pytest.mark.parametrize("name", TASKS)
class TestBadInput:
    def test_theta_out_of_bounds(self, name: str) -> None:
        env = envs.make(name)
        latent = env.task.latents[0]
        for wrong in (latent.high + 1, latent.low - 1, float("nan")):
            theta = [wrong] + [lat.low for lat in env.task.latents[1:]]
            with pytest.raises(envs.InputError, match=rf"^{latent.name} of {name} was .*must be .*{latent.high:g}"):
                env.reset(options={"theta": theta})
        with pytest.raises(envs.InputError, match="must be"):
            env.reset(options={"theta": [0.0] * 7})

    def test_actions(self, name: str) -> None:
        env = envs.make_vec(name, 2)
        env.reset(seed=0)
        good = actions(env.task, 2, 1)[0]
        for wrong, what in ((good[:1], "shape"), (np.full_like(good, np.nan), "NaN"), ("left", "must be numbers")):
            with pytest.raises(envs.InputError, match=what):
                env.step(wrong)

    def test_reset_options(self, name: str) -> None:
        env = envs.make(name)
        with pytest.raises(envs.InputError, match="before the first reset"):
            env.reset(options={"keep_theta": True})
        with pytest.raises(envs.InputError, match="unknown"):
            env.reset(options={"thetas": [0]})
        with pytest.raises(envs.InputError, match="before the first reset"):
            envs.make(name).step(env.action_space.sample())


@pytest.mark.parametrize("name", TASKS)
class TestTransitions:
    def test_log_prob_is_the_density_of_the_noise(self, name: str) -> None:
        """Importance sampling: under outcome p, E[q(s') / p(s')] = 1 for another theta's outcome q; 4,000 draws.

        It fails if log_prob is not normalised, or not that of the noise that apply_noise adds.
        """
        task = envs.get(name)
        m = 4000
        low, high = (lat.grid(9)[[0, -1]] for lat in task.latents[:1]).__next__()
        near = high if task.latents[0].distribution == "categorical" else low + 0.03 * (high - low)
        rest = [lat.low for lat in task.latents[1:]]
        batch = envs.BatchEnv(task, 1)
        batch.reset(0, {"theta": [low, *rest]})
        action = actions(task, 1, 1)[0]
        p = batch.simulator.outcome(batch.state, action)
        batch.reset(0, {"theta": [near, *rest]})
        q = batch.simulator.outcome(batch.state, action)
        if (p == q).all():  # theta is not to be seen here: another action's outcome then
            q = batch.simulator.outcome(batch.state, 0.8 * action)
        if isinstance(task, envs.MujocoTask):  # at most one standard deviation off: the ratio's variance is finite then
            distance = np.sqrt(2 * (task.log_prob(p, p) - task.log_prob(p, q)))
            q = p + (q - p) / max(1, distance[0])
        noise = np.concatenate(task.sample_noise(streams(*range(m // task.horizon + 1))))[:m]
        drawn = task.apply_noise(np.repeat(p, m, 0), noise)
        ratio = np.exp(task.log_prob(drawn, q) - task.log_prob(drawn, p))
        assert abs(ratio.mean() - 1) < 4 * ratio.std() / np.sqrt(m) + 1e-9
        assert ratio.std() > 0
        if isinstance(task, envs.MujocoTask):  # half of a chi-squared, a degree of freedom for each noisy coordinate
            fall = task.log_prob(p, p) - task.log_prob(drawn, p)
            assert abs(fall.mean() - noise.shape[1] / 2) < 4 * fall.std() / np.sqrt(m)


@pytest.mark.parametrize("name", PHYSICS)
class TestPhysics:
    def test_bounds_are_wide_enough(self, name: str) -> None:
        """Observations are clipped to their bounds: random actions do not get there, in an episode that goes on."""
        task = envs.get(name)
        batch, steps = envs.BatchEnv(task, 32), 0
        batch.reset(0)
        for action in actions(task, 32, task.horizon):
            off = np.abs(batch.step(action)[0] - task.observe(batch.state))[batch.alive].max(0, initial=0)
            steps += batch.alive.sum()
            assert not [name for name, clipped in zip(task.observation, off > 1e-3, strict=True) if clipped]
        assert steps >= 32

    def test_set_in_place_equals_recompiled(self, name: str) -> None:
        task = envs.get(name)
        assert isinstance(task, envs.MujocoTask)
        assert_set_in_place_equals_recompiled(task)

    def test_nominal_model_is_not_touched(self, name: str) -> None:
        task = envs.get(name)
        assert isinstance(task, envs.MujocoTask)
        before = task.spec().compile()
        batch = envs.BatchEnv(task, 2)
        batch.reset(0)
        assert_same_model(task.model, before)

    def test_rollout_equals_single_steps(self, name: str) -> None:
        """The thread pool is mj_step, one environment at a time, without a warm start at a control step."""
        task = envs.get(name)
        assert isinstance(task, envs.MujocoTask)
        batch = envs.BatchEnv(task, 3)
        batch.reset(4)
        action = actions(task, 3, 1)[0]
        outcome = batch.simulator.outcome(batch.state, action)
        for i, model in enumerate(batch.simulator.models):
            data = mujoco.MjData(model)
            mujoco.mj_setState(model, data, batch.state[i], mujoco.mjtState.mjSTATE_FULLPHYSICS.value)
            data.ctrl[:] = task.control(action)[i]
            for _ in range(task.substeps):
                mujoco.mj_step(model, data)
            state = np.empty(batch.state.shape[1])
            mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS.value)
            np.testing.assert_array_equal(outcome[i], state)

    def test_every_element_is_named(self, name: str) -> None:
        task = envs.get(name)
        assert isinstance(task, envs.MujocoTask)
        spec = task.spec()
        for kind in ("bodies", "geoms", "joints", "actuators", "tendons", "cameras", "lights", "textures", "sensors"):
            assert all(element.name for element in getattr(spec, kind)), kind
        assert "view" in [camera.name for camera in spec.cameras]

    def test_noise_covers_every_coordinate_that_matters(self, name: str) -> None:
        """Else one step could give theta away, and the grid posterior would not be exact.

        A coordinate without noise must be one that theta does not move, or that is of no consequence: neither
        observations nor what follows change if it is moved.
        """
        task = envs.get(name)
        assert isinstance(task, envs.MujocoTask)
        assert set(task.process_noise) == {joint.name for joint in task.spec().joints}
        start = task.init_state(streams(0))
        action, simulator = np.ones((1, *task.action_space.shape)), task.simulator(1)
        noisy = task.noise.columns
        quiet = set(range(1, 1 + task.model.nq + task.model.nv)) - set(noisy)
        thetas = task.theta_grid(3)
        each = task.outcome(np.repeat(start, len(thetas), 0), np.repeat(action, len(thetas), 0), thetas)
        for i in (i for i in quiet if (each[:, i] != each[0, i]).any()):
            moved = start.copy()
            moved[:, i] += 0.7
            hint = f"theta moves a coordinate without process noise: number {i - 1} of qpos and qvel"
            np.testing.assert_array_equal(task.observe(moved), task.observe(start), hint)
            after = simulator.outcome(np.concatenate([start, moved]), np.tile(action, (2, 1)), np.zeros(2, int))[
                :, noisy
            ]
            np.testing.assert_allclose(after[0], after[1], atol=1e-9, err_msg=hint)

    def test_picture_shows_theta_or_state(self, name: str) -> None:
        if not gl_works():
            pytest.skip("no GL here")
        env = envs.make(name, render_mode="rgb_array")
        env.reset(seed=0)
        first = env.render()
        for _ in range(5):
            env.step(env.action_space.high)
        assert first.shape == (240, 320, 3)
        assert (env.render() != first).any()


def assert_same_model(model: mujoco.MjModel, other: mujoco.MjModel) -> None:
    """Equal, bit for bit, in every array; only inertia, which scaling rounds in another order, to its last bits."""
    compared = 0
    for field in dir(model):
        value = getattr(model, field, None) if not field.startswith("_") else None
        if isinstance(value, np.ndarray):
            rounding = 1e-15 if field == "body_inertia" else 0
            np.testing.assert_allclose(value, getattr(other, field), rtol=rounding, atol=0, err_msg=field)
            compared += 1
    assert compared > 100


def assert_set_in_place_equals_recompiled(task: envs.MujocoTask) -> None:
    """Every number of the model, after several thetas were set one after the other."""
    simulator = task.simulator(1)
    for theta in far_thetas(task):
        simulator.set_theta(0, theta)
        spec = task.spec()
        task.apply_latent(SpecEdit(spec), theta)
        assert_same_model(simulator.models[0], spec.compile())


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
    assert_same_model(model, spec.compile())


class DmEnvMixin(test_utils.EnvironmentTestMixin):
    """dm_env's own test mixin; a subclass for each task is made below."""

    task_name: str

    def make_object_under_test(self):
        return envs.make_dm(self.task_name, seed=0)

    def make_action_sequence(self):
        rng, spec = np.random.default_rng(0), self.environment.action_spec()
        for _ in range(200):
            yield spec.generate_value() if hasattr(spec, "num_values") else rng.uniform(-1, 1, spec.shape).astype("f4")


for _name in TASKS:
    globals()[f"TestDmEnv_{_name}"] = type(f"TestDmEnv_{_name}", (DmEnvMixin, absltest.TestCase), {"task_name": _name})


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
