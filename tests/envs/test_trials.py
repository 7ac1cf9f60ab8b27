"""Trials of several episodes, and gymnasium's autoreset modes, for clients that reset without options."""

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from deconfounded import envs

NAME = "slippery_cartpole"  # whose episodes end early and late


def same(one: Any, other: Any) -> None:
    """Bit for bit."""
    for x, y in zip(one, other, strict=True):
        assert np.asarray(x).tobytes() == np.asarray(y).tobytes()


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
    with pytest.raises(envs.InputError, match=r"it must be AutoresetMode\.NEXT_STEP or SAME_STEP"):
        envs.make_vec(NAME, 3, autoreset_mode=AutoresetMode.DISABLED)
