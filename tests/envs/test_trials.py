"""Trials of several episodes, and gymnasium's autoreset modes, for clients that reset without options."""

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from deconfounded import envs

NAME = "slippery_cartpole"  # whose episodes end early and late


def same(one: Any, other: Any) -> None:
    """Bit for bit."""
    for x, y in zip(one, other, strict=True):
        assert np.asarray(x).tobytes() == np.asarray(y).tobytes()


def test_a_reset_of_some_environments() -> None:
    """Each gets the theta that is given for it; what is asked of them depends on no other."""
    env, where = envs.BatchEnv(envs.get(NAME), 3), np.array([False, True, True])
    env.reset(0, where=where)
    with pytest.raises(envs.InputError, match="keep_theta was given before the first reset"):
        env.reset(options={"keep_theta": True}, where=~where)
    before = env.theta[where]
    env.reset(options={"keep_theta": True}, where=where)
    np.testing.assert_array_equal(env.theta[where], before)
    given = envs.get(NAME).theta_grid(3)
    env.reset(options={"theta": given}, where=where)
    np.testing.assert_array_equal(env.theta[where], given[where])


def test_actions_of_episodes_that_are_over_may_be_anything() -> None:
    """As an agent's that was not asked; of the others NaN is an error."""
    env = envs.BatchEnv(envs.get("weak_thruster"), 2)
    env.reset(0)
    env.state[0, 1] = -0.4  # m; it falls below the ground in the first step
    env.state[0, 2] = -5.0
    _, _, terminated, _ = env.step(np.zeros((2, 1)))
    assert terminated.tolist() == [True, False]
    env.step(np.array([[np.nan], [0.0]]))
    with pytest.raises(envs.InputError, match="held NaN or infinity"):
        env.step(np.array([[0.0], [np.nan]]))


def test_a_theta_out_of_bounds_is_named() -> None:
    """It, and not one of those beside it."""
    env = envs.BatchEnv(envs.get("tilted_cartpole"), 3)
    with pytest.raises(
        envs.InputError, match=r"^tilt of tilted_cartpole was 7; it must be a number from -0\.3 to 0\.3"
    ):
        env.reset(0, {"theta": [[0.1], [0.2], [7.0]]})


def test_resets_keep_theta_until_the_trial_is_over() -> None:
    env = gymnasium.make(envs.get(NAME).gym_id, episodes=3)
    batch = env.unwrapped.batch  # type: ignore[attr-defined]
    env.reset(seed=0)
    thetas = [batch.theta.copy()]
    for _ in range(5):
        over = False
        while not over:
            *_, terminated, truncated, _ = env.step(env.action_space.sample())
            over = terminated or truncated
        env.reset()
        thetas.append(batch.theta.copy())
    assert [bool((x == thetas[0]).all()) for x in thetas] == [True, True, True, False, False, False]
    assert (thetas[3] == thetas[5]).all()
    env.reset(seed=0)
    assert (batch.theta == thetas[0]).all()
    with pytest.raises(envs.InputError, match="episodes"):
        envs.make(NAME, episodes=0)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_vectors_are_gymnasium_s(mode: AutoresetMode) -> None:
    """Trials of two episodes, under each autoreset mode, with the last observations in info."""
    ours = envs.make_vec(NAME, 3, episodes=2, autoreset_mode=mode)
    theirs = SyncVectorEnv([lambda: envs.make(NAME, episodes=2) for _ in range(3)], autoreset_mode=mode)
    assert ours.metadata["autoreset_mode"] == mode
    same(ours.reset(seed=5)[:1], theirs.reset(seed=5)[:1])
    rng, ended = np.random.default_rng(0), 0
    for _ in range(450):
        action = rng.uniform(-1, 1, (3, 1)).astype(np.float32)
        *one, info = ours.step(action)
        *other, expected = theirs.step(action)
        same(one, other)
        assert set(info) == set(expected)
        if info:
            ended += int(info["_final_obs"].sum())
            assert (info["_final_obs"] == expected["_final_obs"]).all()
            assert (info["_final_info"] == expected["_final_info"]).all()
            for x, y in zip(info["final_obs"], expected["final_obs"], strict=True):
                same([x if x is not None else 0], [y if y is not None else 0])
    assert bool(ended) == (mode == AutoresetMode.SAME_STEP)
    for _ in range(3):  # a trial is gone on with, or another one begun, whose theta shows in steps
        same(ours.reset()[:1], theirs.reset()[:1])
        same(ours.step(action)[:4], theirs.step(action)[:4])
    with pytest.raises(envs.InputError, match=r"it must be AutoresetMode\.NEXT_STEP or SAME_STEP"):
        envs.make_vec(NAME, 3, autoreset_mode=AutoresetMode.DISABLED)


@pytest.mark.parametrize("name", [NAME, "bandit"])
def test_a_trial_as_one_episode(name: str) -> None:
    """The same episodes in a row; it ends with the last alone, and flags where others start."""
    plain, whole = (gymnasium.make(envs.get(name).gym_id, episodes=3) for _ in range(2))
    whole = envs.TrialEnv(whole)
    batch, width = whole.unwrapped.batch, plain.observation_space.shape[0]  # type: ignore[attr-defined, index]
    discrete = plain.action_space if isinstance(plain.action_space, spaces.Discrete) else None
    whole.action_space.seed(0)
    for seed in (1, None):
        ours, theirs = whole.reset(seed=seed)[0], plain.reset(seed=seed)[0]
        theta, ended, over = batch.theta.copy(), 0, False
        assert ours[-1] == 1
        while not over:
            same([ours[:width]], [theirs])
            assert (batch.theta == theta).all()
            action = whole.action_space.sample()
            ours, reward, *flags, _ = whole.step(action)
            theirs, expected, *ends, _ = plain.step(action)
            assert whole.observation_space.contains(ours)
            same([ours[:width]], [theirs])  # an episode's last transition, too
            assert reward == expected
            assert ours[-1] == 0
            before = np.arange(discrete.n) == action if discrete else action.clip(-1, 1)
            np.testing.assert_allclose(ours[width:-1], before, rtol=1e-6)
            over, ended = any(flags), ended + any(ends)
            assert over == (ended == 3)
            if over:
                assert flags == ends
            elif any(ends):  # the next step takes no action
                ours, reward, *flags, _ = whole.step(action)
                theirs = plain.reset()[0]
                assert (reward, any(flags), ours[-1]) == (0, False, 1)
                assert not ours[width:-1].any()
    with pytest.raises(envs.InputError, match="TrialEnv was given an environment of one episode a trial"):
        envs.TrialEnv(envs.make(name))


def test_a_reset_in_the_middle_starts_a_new_trial() -> None:
    whole = envs.TrialEnv(envs.make(NAME, episodes=3))
    batch = whole.unwrapped.batch  # type: ignore[attr-defined]
    whole.reset(seed=0)
    first = batch.theta.copy()
    whole.step(whole.action_space.sample())
    whole.reset()
    assert (batch.theta != first).all()


def test_a_reset_between_two_episodes_starts_a_new_trial() -> None:
    """Whose first step takes its action."""
    whole = envs.TrialEnv(envs.make("bandit", episodes=2))
    whole.reset(seed=0)
    batch = whole.unwrapped.batch  # type: ignore[attr-defined]
    while batch.alive.any():
        whole.step(0)
    whole.reset(seed=1)
    np.testing.assert_array_equal(whole.step(1)[0][-6:], [0, 1, 0, 0, 0, 0])


def test_options_of_a_trial_are_a_dictionary() -> None:
    whole = envs.TrialEnv(envs.make(NAME, episodes=3))
    with pytest.raises(envs.InputError, match=r"reset options were \[1\]; they must be a dictionary"):
        whole.reset(options=[1])  # type: ignore[arg-type]


def test_a_seed_in_the_middle_starts_a_new_trial() -> None:
    """Whose theta is the seed's, where a reset without one goes on with the trial."""
    for env in (envs.make(NAME, episodes=3), envs.make_vec(NAME, 2, episodes=3)):
        thetas = []
        for seed in (0, None, 5, None, 0):
            env.reset(seed=seed)
            thetas.append(env.batch.theta.copy())
        first, kept, new, kept_too, again = thetas
        same((kept, kept_too, again), (first, new, first))
        assert (new != first).all()


def test_a_trial_of_actions_in_other_units() -> None:
    """The action before is in the units of the environment that was wrapped."""
    for low, high, taken in np.array([(-5.0, 5.0, 2.5), (1.0, 3.0, 2.5)], np.float32):
        whole = envs.TrialEnv(gymnasium.wrappers.RescaleAction(envs.make(NAME, episodes=2), low, high))
        assert whole.observation_space.contains(whole.reset(seed=0)[0])  # where there is no action before, 0
        for action, before in ((taken, taken), (9.0, high), (-9.0, low)):
            obs = whole.step(np.array([np.clip(action, low, high)], np.float32))[0]
            assert obs[-2] == before
            assert whole.observation_space.contains(obs)


@pytest.mark.parametrize("action", [1, np.int64(1), np.array(1), np.array([1])])
def test_a_trial_takes_what_its_environment_takes(action: Any) -> None:
    whole = envs.TrialEnv(envs.make("bandit", episodes=2))
    whole.reset(seed=0)
    np.testing.assert_array_equal(whole.step(action)[0][-6:-1], np.eye(5)[1])


def test_a_trial_has_the_action_that_was_taken() -> None:
    """Of an action beyond the bounds it is the bound."""
    whole = envs.TrialEnv(envs.make(NAME, episodes=2))
    whole.reset(seed=0)
    for sign in (1, -1):
        obs = whole.step(np.array([3.0 * sign], np.float32))[0]
        assert obs[-2] == sign
        assert whole.observation_space.contains(obs)
