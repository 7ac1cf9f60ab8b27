"""Latents that walk from episode to episode: their distribution, their transition matrix, and the exact filter."""

from __future__ import annotations

import numpy as np
import pytest

from deconfounded import envs
from deconfounded.deconf.exact import ExactAgent, Grid
from deconfounded.envs.streams import Array
from deconfounded.envs.tasks.tilted_cartpole import TiltedCartpole
from deconfounded.experts import policy
from deconfounded.experts.demos import ExpertAgent, run_trials, thetas


class Walking(TiltedCartpole):
    """tilted_cartpole, whose tilt walks."""

    latents = (envs.Latent("tilt", "rad", -0.3, 0.3, drift=0.15),)


@pytest.mark.parametrize("distribution", ["uniform", "loguniform"])
def test_transition_is_that_of_the_walk(distribution: str) -> None:
    """Of 200,000 walks from each bin's middle, as many end in each bin: within 5 standard errors and .002."""
    latent, k, n = envs.Latent("x", "m", 1.0, 4.0, distribution, 0.3), 7, 200_000  # type: ignore[arg-type]
    matrix, rng = latent.transition(k), np.random.default_rng(0)
    np.testing.assert_allclose(matrix.sum(0), 1, atol=1e-9)
    np.testing.assert_allclose(matrix.sum(1), 1, atol=1e-9)
    for i, value in enumerate(latent.grid(k)):
        ends = latent.cdf(latent.drifted(np.full(n, value), rng.standard_normal(n)))
        share = np.bincount(np.minimum((ends * k).astype(int), k - 1), minlength=k) / n
        np.testing.assert_allclose(share, matrix[i], atol=5 * np.sqrt(0.25 / n) + 0.002)


def test_what_does_not_drift_stays() -> None:
    """Its matrix is the identity; a categorical latent cannot drift."""
    np.testing.assert_array_equal(envs.Latent("x", "m", 1.0, 4.0).transition(5), np.eye(5))
    with pytest.raises(envs.InputError, match=r"drift of x was 0\.1"):
        envs.Latent("x", "", 0, 3, "categorical", 0.1)


def test_thetas_are_those_of_the_trials() -> None:
    """Drawn once more from their seeds, episode by episode; they move, and stay where they may be."""
    task, seen = Walking(), list[Array]()

    class Noting(ExpertAgent):
        def reset(self, rngs: object) -> None:
            super().reset(rngs)  # type: ignore[arg-type]
            seen.append(self.env.theta.copy())

    env = envs.BatchEnv(task, 4)
    run_trials(env, Noting(env, policy.load(envs.get("tilted_cartpole"))), 3, [5, 9])
    np.testing.assert_array_equal(thetas(task, 4, 3, [5, 9]), np.stack(seen, 1))
    assert (np.diff(np.stack(seen, 1), axis=1) != 0).all()
    assert np.abs(seen).max() <= 0.3


def test_the_exact_filter_spreads_between_episodes() -> None:
    """After an episode the belief is sharp; in the next it is the transition's; taken as static, it stays as it was."""
    task = Walking()
    expert = policy.load(envs.get("tilted_cartpole"))
    env = envs.BatchEnv(task, 3)
    env.reset(0)
    for static in (False, True):
        agent = ExactAgent(env, expert, False, 11, static)
        agent.begin(3)
        agent.reset([np.random.default_rng(0)])
        np.testing.assert_allclose(np.exp(agent.log_belief), 1 / 11)
        agent.log_belief = np.log(np.eye(11)[[0, 5, 10]] + 1e-300)
        agent.reset([np.random.default_rng(0)])
        expected = np.eye(11) if static else Grid(env, expert, 11).env.task.transition(11)
        np.testing.assert_allclose(np.exp(agent.log_belief), expected[[0, 5, 10]], atol=1e-12)
