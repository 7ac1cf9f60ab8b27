"""What users of gymnasium and dm_env are in the habit of doing: trials in vectors, pictures, videos, time limits."""

import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import gymnasium
import imageio.v3 as iio
import numpy as np
import pytest
from gymnasium.vector import SyncVectorEnv
from gymnasium.wrappers import RecordVideo, vector
from numpy.typing import NDArray

from deconfounded import envs
from deconfounded.envs.contract.probe import actions, gl_works, streams
from deconfounded.envs.streams import Array
from deconfounded.envs.tasks.slippery_cartpole import SlipperyCartpole

TASKS = envs.names()
CONTROL = "slippery_cartpole"


def flat(task: envs.Task, n: int, steps: int) -> Array:
    """[steps, n, ...] actions as gymnasium wants them."""
    acts = actions(task, n, steps)
    return acts[..., 0].astype(int) if task.n_actions else acts


def thetas(task: envs.Task, seed: int, k: int) -> Array:
    """The first k thetas [k, L] of the environment of that seed."""
    rng = streams(np.random.SeedSequence(seed).spawn(3)[0])  # type: ignore[arg-type]
    return np.concatenate([task.sample_theta(rng) for _ in range(k)])


@pytest.mark.parametrize("name", TASKS)
class TestTrials:
    @pytest.mark.slow
    @pytest.mark.parametrize("episodes", [1, 2])
    def test_vector_equals_single_environments(self, name: str, episodes: int, monkeypatch: pytest.MonkeyPatch) -> None:
        """Bit for bit, with keep_theta given by hand; theta is the next of its own stream after `episodes` of them."""
        monkeypatch.setattr(type(envs.get(name)), "horizon", 12)
        task, n = envs.get(name), 2
        vec, single = envs.make_vec(name, n, episodes=episodes), [envs.make(name) for _ in range(n)]
        drawn = [thetas(task, 7 + i, 9) for i in range(n)]
        obs = vec.reset(seed=7)[0]
        ended, over = np.zeros(n, int), np.zeros(n, bool)
        for i, env in enumerate(single):
            np.testing.assert_array_equal(env.reset(seed=7 + i)[0], obs[i])
        for action in flat(task, n, (episodes + 1) * (task.horizon + 1)):
            obs, reward, terminated, truncated, info = vec.step(action)
            assert info == {}
            for i, env in enumerate(single):
                if over[i]:
                    keep = {"keep_theta": True} if ended[i] % episodes else None
                    np.testing.assert_array_equal(env.reset(options=keep)[0], obs[i])
                    assert (reward[i], terminated[i], truncated[i]) == (0, False, False)
                else:
                    one = env.step(action[i])
                    np.testing.assert_array_equal(one[0], obs[i])
                    assert one[1:4] == (reward[i], terminated[i], truncated[i])
                if ended[i] // episodes < 9 and not (task.drifts or task.switches):  # see test_drift.py
                    np.testing.assert_array_equal(vec.batch.theta[i], drawn[i][ended[i] // episodes])
            over = terminated | truncated
            ended += over
        assert (ended > episodes).all()

    def test_a_mask_keeps_theta_and_moves_nobody(self, name: str) -> None:
        """Kept, or not: each is, bit for bit, as in a batch where all are, or none is; its next theta is its next."""
        task, n = envs.get(name), 4
        mask = np.array([True, False, False, True])
        acts = actions(task, n, 5)

        def run(keep: bool | NDArray[np.bool_] | list[bool]) -> tuple[Array, Array]:
            batch = envs.BatchEnv(task, n)
            batch.reset(5)
            seen, theta = [batch.reset(options={"keep_theta": keep})], [batch.theta.copy()]
            for action in acts:
                seen.append(batch.step(action)[0])
            seen.append(batch.reset())
            theta.append(batch.theta.copy())
            return np.array(seen).swapaxes(0, 1), np.array(theta).swapaxes(0, 1)

        kept, drawn, mixed, again = run(True), run(False), run(mask), run(mask.tolist())
        for all_kept, none_kept, one, other in zip(kept, drawn, mixed, again, strict=True):
            np.testing.assert_array_equal(one, np.where(mask[:, None, None], all_kept, none_kept))
            np.testing.assert_array_equal(one, other)
        for i in range(0 if task.drifts or task.switches else n):
            own = thetas(task, 5 + i, 3)
            np.testing.assert_array_equal(mixed[1][i], own[:2] if mask[i] else own[1:])

    def test_a_mask_through_the_vector_env(self, name: str) -> None:
        """Kept environments go on with their trial, the others start one: the autoreset counts from there."""
        task = envs.get(name)
        vec = envs.make_vec(name, 2, episodes=2)
        vec.reset(seed=3)
        vec.reset(options={"keep_theta": [True, False]})
        first = vec.batch.theta.copy()
        ended, over = np.zeros(2, int), np.zeros(2, bool)
        own = thetas(task, 3, 2), thetas(task, 4, 3)
        assert task.drifts or task.switches or np.array_equal(first, [own[0][0], own[1][1]])
        for action in flat(task, 2, task.horizon + 1):
            *_, terminated, truncated, _ = vec.step(action)
            for i in np.flatnonzero(over & (ended == 1)):
                assert task.drifts or task.switches or np.array_equal(vec.batch.theta[i], own[i][1])
            over = terminated | truncated
            ended += over
        assert ended.all()

    def test_bad_masks(self, name: str) -> None:
        env, vec = envs.make(name), envs.make_vec(name, 3)
        vec.reset(seed=0)
        env.reset(seed=0)
        for wrong in ([True, False], [1, 0, 1], 1, None, "yes", [[True], [True, False]], np.ones((3, 1), bool)):
            with pytest.raises(
                envs.InputError, match=r"^keep_theta was .*must be True, False, or bool of shape \(3,\)"
            ):
                vec.reset(options={"keep_theta": wrong})
            if wrong is not None:
                with pytest.raises(envs.InputError, match=r"^where was .*must be True, False, or bool of shape \(3,\)"):
                    vec.batch.reset(where=wrong)  # type: ignore[arg-type]
        with pytest.raises(envs.InputError, match=r"must be True, False, or bool of shape \(1,\)"):
            env.reset(options={"keep_theta": np.ones(3, bool)})
        lows = [lat.low for lat in vec.task.latents]
        with pytest.raises(envs.InputError, match="give one of them"):
            vec.reset(options={"keep_theta": [True, False, False], "theta": lows})
        with pytest.raises(envs.InputError, match="before the first reset"):
            envs.make_vec(name, 3).reset(options={"keep_theta": [False, False, True]})
        begun = envs.make_vec(name, 3).batch
        begun.reset(0, where=np.array([True, True, False]))
        begun.reset(options={"keep_theta": np.array([True, True, False])})
        assert begun.alive.all()
        begun = envs.make_vec(name, 3).batch
        begun.reset(0, where=np.array([True, True, False]))
        with pytest.raises(envs.InputError, match="before the first reset"):
            begun.reset(options={"keep_theta": True})
        with pytest.raises(
            envs.InputError, match=r"^the number of episodes was 0; it must be a whole number from 1 up$"
        ):
            envs.make_vec(name, 3, episodes=0)


def test_a_forced_theta_starts_a_trial() -> None:
    """It stays for `episodes` episodes, and then the first theta of the stream follows."""
    task = envs.get(CONTROL)
    vec = envs.make_vec(CONTROL, 2, episodes=2)
    forced = task.theta_grid(3)[[1, 1]]
    vec.reset(seed=3, options={"theta": forced})
    ended, over = np.zeros(2, int), np.zeros(2, bool)
    for action in flat(task, 2, 2 * task.horizon + 3):
        *_, terminated, truncated, _ = vec.step(action)
        for i in range(2):
            if ended[i] <= 2 and over[i]:
                expected = forced[i] if ended[i] < 2 else thetas(task, 3 + i, 1)[0]
                np.testing.assert_array_equal(vec.batch.theta[i], expected)
        over = terminated | truncated
        ended += over
    assert (ended >= 2).all()


@pytest.mark.parametrize("name", TASKS)
class TestTimeLimits:
    @pytest.mark.slow
    def test_registered_limit_is_the_task_s(self, name: str) -> None:
        """The made environment truncates when ours does."""
        task, n = envs.get(name), 3
        assert gymnasium.spec(task.gym_id).max_episode_steps == task.horizon
        for seed in range(n):
            made, own = gymnasium.make(task.gym_id), envs.make(name)
            assert made.spec is not None
            assert made.spec.max_episode_steps == task.horizon
            np.testing.assert_array_equal(made.reset(seed=seed)[0], own.reset(seed=seed)[0])
            for step, action in enumerate(flat(task, n, task.horizon)[:, seed], start=1):
                obs, reward, terminated, truncated, info = made.step(action)
                mine = own.step(action)
                np.testing.assert_array_equal(obs, mine[0])
                assert (reward, terminated, info) == (mine[1], mine[2], {})
                assert truncated == mine[3] == (step == task.horizon)
                if terminated or truncated:
                    break
            assert mine[2] or step == task.horizon

    @pytest.mark.slow
    def test_vectors_of_gymnasium(self, name: str) -> None:
        """By the vector entry point and in a SyncVectorEnv: the same bits, over an autoreset."""
        task = envs.get(name)
        ours = gymnasium.make_vec(task.gym_id, num_envs=2, vectorization_mode="vector_entry_point")
        sync = gymnasium.make_vec(task.gym_id, num_envs=2, vectorization_mode="sync")
        assert isinstance(ours, envs.GymVectorEnv)
        assert isinstance(sync, SyncVectorEnv)
        assert ours.spec is not None
        assert ours.spec.max_episode_steps == task.horizon
        np.testing.assert_array_equal(ours.reset(seed=1)[0], sync.reset(seed=1)[0])
        for action in flat(task, 2, task.horizon + 3):
            mine, theirs = ours.step(action), sync.step(action)
            for x, y in zip(mine[:4], theirs[:4], strict=True):
                np.testing.assert_array_equal(x, y)
        trials = gymnasium.make_vec(task.gym_id, num_envs=2, episodes=4, privileged=True)
        assert isinstance(trials, envs.GymVectorEnv)
        assert (trials.episodes, trials.batch.privileged) == (4, True)
        with pytest.raises(envs.InputError, match=rf"^max_episode_steps of {name} was 7; it must be {task.horizon} "):
            gymnasium.make_vec(task.gym_id, num_envs=3, max_episode_steps=7)

    def test_stepping_on_after_the_end_warns_once(self, name: str) -> None:
        """Once an episode, as gymnasium's own do; dm_env restarts instead."""
        task = envs.get(name)
        env = envs.make(name)
        acts = flat(task, 1, task.horizon)[:, 0]
        for _ in range(2):
            env.reset(seed=0)
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                for action in acts:
                    _, _, terminated, truncated, _ = env.step(action)
                    if terminated or truncated:
                        break
            with pytest.warns(UserWarning, match=f"step of {name} was called after the end of an episode") as caught:
                rewards = [env.step(acts[0])[1] for _ in range(3)]
            assert len(caught) == 1
            assert rewards == [0, 0, 0]
        dm = envs.make_dm(name, seed=0)
        dm.reset()
        steps = [dm.step(action) for action in acts]
        end = next((i for i, step in enumerate(steps) if step.last()), None)
        assert end is not None
        assert (steps[end + 1] if end + 1 < len(steps) else dm.step(acts[0])).first()


def test_made_without_an_import_of_ours() -> None:
    """Gymnasium loads no plug-ins, but the module that an id names: in a process that has imported nothing else."""
    code = (
        "import gymnasium; env = gymnasium.make('deconfounded.envs:deconf/SlipperyCartpole-v1');"
        "env.reset(seed=0); print(env.unwrapped.task.name);"
        "print(gymnasium.make_vec('deconfounded.envs:deconf/SlipperyCartpole-v1', num_envs=3).reset(seed=0)[0].shape)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == [CONTROL, f"(3, {len(envs.get(CONTROL).observation)})"]


@pytest.mark.parametrize("name", TASKS)
def test_render_modes(name: str) -> None:
    """Pictures are made where they were asked for, at the speed of the task."""
    for env in (envs.make(name), envs.make_vec(name, 2)):
        env.reset(seed=0)
        assert env.render() is None
        assert env.metadata["render_modes"] == ["rgb_array"]
        assert env.metadata["render_fps"] == round(1 / envs.get(name).control_dt)
    line = f"^render_mode of {name} was 'human'; it must be 'rgb_array' or None$"
    for made in (lambda: envs.make(name, render_mode="human"), lambda: envs.make_vec(name, 2, render_mode="human")):
        with pytest.raises(envs.InputError, match=line):
            made()
    for early in (envs.make(name, render_mode="rgb_array"), envs.make_vec(name, 2, render_mode="rgb_array")):
        with pytest.raises(envs.InputError, match="render was called before the first reset"):
            early.render()
    with pytest.raises(envs.InputError, match="render was called before the first reset"):
        envs.make_dm(name).render()


def test_modes_that_gymnasium_adds() -> None:
    """Lists of pictures are made by gymnasium, of ours."""
    if not gl_works():
        pytest.skip("no GL for pictures")
    env = gymnasium.make("deconf/Bandit-v0", render_mode="rgb_array_list")
    env.reset(seed=0)
    env.step(1)
    first, second = env.render()  # type: ignore[misc]
    assert first.shape == second.shape == (240, 320, 3)
    assert (first[60:150] == 225).any(-1).sum() > (second[60:150] == 225).any(-1).sum(), "no arm is pulled at first"
    env.step(2)
    env.reset(options={"keep_theta": True})
    again = env.render()[-1]  # type: ignore[index]
    assert (again[60:150] == first[60:150]).all(), "nor after the next reset"


def test_odd_arguments() -> None:
    """As gymnasium and numpy take them: names of modes, ranges of seeds, no environment to reset."""
    vec = envs.make_vec("bandit", 3, autoreset_mode="SameStep")  # type: ignore[arg-type]
    assert vec.metadata["autoreset_mode"] is gymnasium.vector.AutoresetMode.SAME_STEP
    batch = vec.batch
    first = batch.reset(range(4, 7))
    thetas_of_range = batch.theta.copy()
    batch.reset(4)
    np.testing.assert_array_equal(batch.theta, thetas_of_range)
    np.testing.assert_array_equal(batch.reset(where=np.zeros(3, bool)), first)


def test_actions_beyond_the_bounds_are_the_bounds() -> None:
    """In what follows, and in pictures."""
    wide, ends = (envs.BatchEnv(envs.get(CONTROL), 2) for _ in range(2))
    for env, size in ((wide, 3.0), (ends, 1.0)):
        env.reset(0)
        for sign in (1, -1):
            env.step(np.full((2, 1), sign * size))
    np.testing.assert_array_equal(wide.state, ends.state)
    np.testing.assert_array_equal(wide.action, ends.action)


def test_observations_are_in_their_space() -> None:
    """Where the state exceeds the bounds, too."""
    narrow = {**SlipperyCartpole.observation, "velocity": (-0.01, 0.01)}
    task = type("Narrow", (SlipperyCartpole,), {"observation": narrow})()
    env = envs.BatchEnv(task, 8)
    assert all(task.observation_space.contains(row) for row in env.reset(0))
    assert np.abs(task.qvel(env.state, "slider")).max() > 0.01


def test_without_a_seed_every_environment_is_new() -> None:
    """Starts and thetas, of one batch and of another."""
    batches = [envs.BatchEnv(envs.get(CONTROL), 3) for _ in range(2)]
    starts = np.concatenate([batch.reset() for batch in batches])
    assert len(np.unique(starts, axis=0)) == 6
    assert len(np.unique([batch.theta for batch in batches])) == 6


Pictures = Callable[[Array, Array], Array]


@pytest.fixture
def renderers(monkeypatch: pytest.MonkeyPatch) -> list[Array]:
    """Thetas of the renderers that are made from now on. In place of pictures they give theta, state and action."""
    made: list[Array] = []

    def renderer(task: envs.Task, theta: Array) -> Pictures:
        made.append(theta.copy())
        return lambda state, action: np.concatenate([theta, state, action])

    for name in TASKS:
        monkeypatch.setattr(type(envs.get(name)), "renderer", renderer)
    return made


def draw_alike(name: str) -> int:
    """Two environments of a vector, of a SyncVectorEnv, and dm_env's of the first give the same pictures.

    After the first step, and after each autoreset until both have had one; returns how many pictures were compared.
    """
    task, n = envs.get(name), 2
    ours = envs.make_vec(name, n, render_mode="rgb_array")
    sync = SyncVectorEnv([lambda: envs.make(name, render_mode="rgb_array") for _ in range(n)])
    dm = envs.make_dm(name, seed=2)
    dm.reset()
    for vec in (ours, sync):
        vec.reset(seed=2)
    ended, over, compared = np.zeros(n, bool), np.ones(n, bool), 0
    for action in flat(task, n, task.horizon + 3):
        _, _, terminated, truncated, _ = ours.step(action)
        sync.step(action)
        dm.step(action[0])
        if over.any():
            pictures = ours.render()
            assert isinstance(pictures, tuple)
            for mine, theirs in zip(pictures, sync.render(), strict=True):
                np.testing.assert_array_equal(mine, theirs)
                compared += 1
            np.testing.assert_array_equal(dm.render(), pictures[0])
        if ended.all():
            break
        over = terminated | truncated
        ended |= over
    assert ended.all()
    return compared


class TestPictures:
    @pytest.mark.slow
    @pytest.mark.parametrize("name", TASKS)
    def test_vectors_and_dm_env_draw_as_single_environments(self, name: str, renderers: list[Array]) -> None:
        """Of the same theta, state and action; each renderer is that of its environment's theta."""
        assert draw_alike(name) >= 4
        assert len(renderers) >= 5

    @pytest.mark.slow
    @pytest.mark.skipif(not gl_works(), reason="no GL")
    @pytest.mark.parametrize("name", [CONTROL, "forked_path", "ant_goal"])
    def test_pixel_for_pixel(self, name: str) -> None:
        assert draw_alike(name) >= 4
        vec = envs.make_vec(name, 2, render_mode="rgb_array")
        vec.reset(seed=2)
        pictures = vec.render()
        assert isinstance(pictures, tuple)
        assert {(one.shape, one.dtype.name) for one in pictures} == {((240, 320, 3), "uint8")}

    @pytest.mark.parametrize("name", TASKS)
    def test_a_renderer_lives_as_long_as_its_theta(self, name: str, renderers: list[Array]) -> None:
        """A new one for each new theta, and for no other environment."""
        task = envs.get(name)
        vec = envs.GymVectorEnv(task, 2, render_mode="rgb_array")
        vec.reset(seed=0)
        vec.render()
        vec.render()
        np.testing.assert_array_equal(renderers, vec.batch.theta)
        low, high = ([getattr(lat, bound) for lat in task.latents] for bound in ("low", "high"))
        for options in ({"keep_theta": True}, {"theta": [low, high]}, {"theta": [low, low]}):
            renderers.clear()
            before = vec.batch.theta.copy()
            vec.reset(options=options)
            vec.render()
            now = vec.batch.theta
            np.testing.assert_array_equal(np.reshape(renderers, (-1, now.shape[1])), now[(now != before).any(1)])
        np.testing.assert_array_equal(renderers, [low])  # the second alone


@pytest.mark.slow
@pytest.mark.skipif(not gl_works(), reason="no GL")
def test_renderers_that_live_to_the_end_leave_in_silence() -> None:
    """The GL library is gone before the first finalizer of the process, whose place the others share."""
    code = (
        "import weakref; kept = {1}; weakref.finalize(kept, print)\n"
        "from deconfounded import envs; vec = envs.make_vec('slippery_cartpole', 2, render_mode='rgb_array')\n"
        "vec.reset(seed=0); vec.render()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.skipif(not gl_works(), reason="no GL")
class TestVideos:
    @pytest.mark.slow
    def test_record_video(self, tmp_path: Path) -> None:
        """A frame for the reset and one for each step, at the task's speed."""
        env = gymnasium.make("deconf/SlipperyCartpole-v1", render_mode="rgb_array")
        recorded = RecordVideo(env, str(tmp_path / "one"), episode_trigger=lambda _: True)
        recorded.reset(seed=0)
        for action in flat(envs.get(CONTROL), 1, 10)[:, 0]:
            recorded.step(action)
        recorded.close()
        film(tmp_path / "one" / "rl-video-episode-0.mp4", 11, (240, 320, 3))

    @pytest.mark.slow
    @pytest.mark.skipif(not hasattr(vector, "RecordVideo"), reason="gymnasium has it from 1.2.1 on")
    def test_vector_record_video(self, tmp_path: Path) -> None:
        vec = envs.make_vec(CONTROL, 4, render_mode="rgb_array")
        recorded = vector.RecordVideo(vec, str(tmp_path / "four"), episode_trigger=lambda _: True)
        recorded.reset(seed=0)
        for action in flat(envs.get(CONTROL), 4, 10):
            recorded.step(action)
        recorded.close()
        film(tmp_path / "four" / "rl-video-episode-0.mp4", 11, (480, 640, 3))


def film(path: Path, frames: int, shape: tuple[int, int, int]) -> None:
    """The file holds that many frames of that shape, at the speed of CONTROL, that are not all the same."""
    seen = iio.imread(path)
    assert seen.shape == (frames, *shape)
    assert (seen[0] != seen[-1]).any()
    assert round(iio.immeta(path)["fps"]) == round(1 / envs.get(CONTROL).control_dt)
