"""Latents that switch within an episode: when they do, what a roll-out says of them, and the exact filter."""

import itertools

import numpy as np
import pytest

from deconfounded import envs
from deconfounded.deconf.equations import belief_update
from deconfounded.deconf.exact import ExactAgent, Grid
from deconfounded.envs.contract.probe import streams
from deconfounded.envs.streams import Array
from deconfounded.experts import policy
from deconfounded.experts.agent import ExpertAgent, RandomAgent
from deconfounded.experts.rollout import run_trials, thetas
from tests.toys import Push


@pytest.mark.parametrize("distribution", ["uniform", "loguniform", "categorical"])
def test_switches_come_at_their_rate(distribution: str) -> None:
    """Of 100,000 steps a fifth switch, within 5 standard errors; new values follow the distribution."""
    latent, n = envs.Latent("x", "", 1.0, 4.0, distribution, switch=0.2), 100_000  # type: ignore[arg-type]
    before = latent.ppf(np.full(n, 0.3))
    after = latent.switched(before, np.random.default_rng(0).random(n))
    stay = latent.switching(4)[1, 1] if distribution == "categorical" else 0.8
    assert abs((after == before).mean() - stay) < 5 * 0.4 / np.sqrt(n)
    counts = np.histogram(latent.cdf(after[after != before]), 4, (0, 1))[0] / (after != before).sum()
    expected = [1 / 3, 0, 1 / 3, 1 / 3] if distribution == "categorical" else 0.25  # one category is the one before
    np.testing.assert_allclose(counts, expected, atol=0.02)


def test_latents_switch_independently() -> None:
    """Of two that switch in a fifth of 8,000 steps, both do in a twenty-fifth, within 5 standard errors."""
    latents = tuple(envs.Latent(name, "", -1.0, 1.0, switch=0.2) for name in "ab")
    task = Push().changed(latents=latents, horizon=400)
    moved = np.diff(task.theta_path(np.zeros((20, 2)), streams(*range(20))), axis=1) != 0
    np.testing.assert_allclose(moved.mean((0, 1)), 0.2, atol=5 * 0.4 / np.sqrt(8000))
    assert moved.all(-1).mean() == pytest.approx(0.04, abs=5 * 0.2 / np.sqrt(8000))


def test_a_rate_is_a_probability() -> None:
    """Anything else is refused."""
    for wrong in (-0.1, 1.0, np.nan):
        with pytest.raises(envs.InputError, match="switch of x was"):
            envs.Latent("x", "", 0, 1, switch=wrong)


def test_thetas_are_those_of_the_trials_whatever_was_done() -> None:
    """Drawn once more from their seeds, step by step, also where episodes ended early; only the wind switches."""
    task = envs.get("gusty_drone")
    env = envs.BatchEnv(task, 4)
    bold = run_trials(env, RandomAgent(task.action_space), 3, [5, 9])
    careful = run_trials(env, ExpertAgent(env, policy.load(task)), 3, [5, 9])
    assert bold.trials.mask.sum() < careful.trials.mask.sum()  # it ended early
    assert bold.theta.shape == (4, 3, task.horizon, 2)
    for rollout in (bold, careful):
        np.testing.assert_array_equal(rollout.theta, thetas(task, 4, 3, [5, 9]))
    moved = (np.diff(bold.theta.reshape(4, -1, 2), axis=1) != 0).any((0, 1))
    assert moved.tolist() == [True, False]


def test_environments_have_the_present_theta() -> None:
    """Theta at each step is the path's; forced, it starts elsewhere and switches at the same steps to the same wind."""
    task = envs.get("gusty_drone")
    env, still = envs.BatchEnv(task, 2), np.zeros((2, 4))
    env.reset(6)
    drawn = env.path.copy()
    for t in range(task.horizon):
        np.testing.assert_array_equal(env.theta[env.alive], env.path[env.alive, t])
        np.testing.assert_array_equal(env.simulator.theta, env.theta)
        env.step(still)
    env.reset(6, {"theta": [3.0, 0.01]})
    changed = drawn[:, :, 0] != drawn[:, :1, 0]
    assert changed.any()
    np.testing.assert_array_equal(env.path[changed, 0], drawn[changed, 0])
    np.testing.assert_array_equal(env.path[~changed], np.broadcast_to([3.0, 0.01], drawn[~changed].shape))


def by_hand(task: envs.Task, likelihood: Array, grid: Array) -> Array:
    """Posterior [K] of the last theta of a hidden Markov model, by a sum over all paths of grid values."""
    steps, k = likelihood.shape
    hazard = np.array([lat.switch for lat in task.latents])
    values = [len(np.unique(column)) for column in grid.T]
    total = np.zeros(k)
    for path in np.ndindex(*[k] * steps):
        p = 1 / k
        for a, b in itertools.pairwise(path):
            same = grid[a] == grid[b]
            p *= np.prod(np.where(same, 1 - hazard, 0) + hazard / values)
        total[path[-1]] += p * np.prod(likelihood[np.arange(steps), path])
    return total / total.sum()


def test_the_exact_filter_is_that_of_a_hidden_markov_model() -> None:
    """After three steps the belief is the sum over all paths of four thetas; taken as static, it is not."""
    task = envs.get("gusty_drone")
    expert, env = policy.load(task), envs.BatchEnv(task, 1)
    for static in (False, True):
        obs = env.reset(3)
        grid, agent, evidence = Grid(env, expert, 2), ExactAgent(env, expert, False, 2, static), []
        agent.begin(1)
        agent.reset([np.random.default_rng(0)])
        for _ in range(3):
            before, action = env.state, agent.act(obs)
            following = env.step(action)[0]
            evidence.append(np.exp(grid.log_dynamics(before, action, env.state))[0])
            filtered = belief_update(agent.log_belief, grid.log_dynamics(before, action, env.state))
            agent.observe(obs, action, following, np.ones(1, bool))
            obs = following
        likelihood = np.array(evidence) / np.max(evidence, axis=1, keepdims=True)
        equal = np.allclose(np.exp(filtered[0]), by_hand(task, likelihood, grid.theta), atol=1e-9)
        assert equal != static


def test_an_episode_s_early_end_is_waited_out() -> None:
    """Between episodes the belief spreads by as many steps as are left, and the last."""
    task = envs.get("gusty_drone")
    env = envs.BatchEnv(task, 1)
    agent = ExactAgent(env, policy.load(task), False, 21)
    env.reset(0)
    agent.begin(1)
    agent.reset(rngs := [np.random.default_rng(0)])
    sure = np.log(np.eye(len(agent.grid.theta))[:1] + 1e-300)
    agent.log_belief = sure
    agent.reset(rngs)
    stays = 0.98**task.horizon + (1 - 0.98**task.horizon) / 7
    assert np.exp(agent.log_belief[0, 0]) == pytest.approx(stays)


def test_a_still_task_has_no_switches() -> None:
    """The stakes of a certificate are those of a theta that holds still; the task itself stays as it is."""
    task = envs.get("gusty_drone")
    still = task.without_switches()
    assert task.switches
    assert not still.switches
    env = envs.BatchEnv(still, 2)
    assert run_trials(env, RandomAgent(task.action_space), 1, 0).theta.shape == (2, 1, 2)
    assert task.theta_path(task.sample_theta(streams(1, 2)), streams(3, 4)).shape == (2, task.horizon + 1, 2)
    wind, load = envs.Latent("wind", "m/s", -16, 16, switch=0.02), envs.Latent("load", "m", -0.02, 0.02, drift=0.2)
    both = envs.get("windy_drone").changed(latents=(wind, load))
    assert (both.switches, both.drifts) == (True, True)
    assert (both.without_switches().switches, both.without_switches().drifts) == (False, True)
