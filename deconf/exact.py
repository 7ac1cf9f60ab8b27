"""Exact interventional and conditional policies, Eq. (2) to (5), by a posterior over a grid of theta.

The bandit's grid is its five arms, and the posterior a closed form. On MuJoCo each grid value is simulated for one
control step from the present state, and weighed by the Gaussian process noise.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from deconf.equations import belief_update
from envs import BatchEnv
from envs.task import Array
from experts.demos import Agent, Streams
from experts.policy import Expert, sample_rows


class Grid:
    """K equally likely thetas, and what one transition of each of N environments says about them.

    k: values of the latent; of several latents, each gets a third as many, since every pair of them is simulated.
    """

    def __init__(self, env: BatchEnv, expert: Expert, k: int) -> None:
        one = len(env.task.latents) == 1
        self.env, self.expert, self.theta = env, expert, env.task.theta_grid(k if one else max(2, k // 3))
        self._simulator = env.task.simulator(len(self.theta))
        for i, theta in enumerate(self.theta):
            self._simulator.set_theta(i, theta)

    def prior(self, n: int) -> Array:
        """Log-belief [N, K] before any evidence."""
        return np.full((n, len(self.theta)), -np.log(len(self.theta)))

    def log_dynamics(self, state: Array, action: Array, next_state: Array) -> Array:
        """log p(s' | s, a, theta) [N, K]; state, next_state [N, S], action [N, A]."""
        n, k = len(state), len(self.theta)
        outcome = self._simulator.outcome(np.repeat(state, k, 0), np.repeat(action, k, 0)).reshape(n, k, -1)
        return self.env.task.log_prob(next_state[:, None], outcome)

    def log_policy(self, obs: Array, action: Array) -> Array:
        """log pi_exp(a | s, theta) [N, K]; obs [N, O], action [N, A]."""
        n, k = len(obs), len(self.theta)
        thetas = np.tile(self.theta, (n, 1))
        return self.expert.log_prob(np.repeat(obs, k, 0), np.repeat(action, k, 0), thetas).reshape(n, k)


class ExactAgent(Agent):
    """Samples theta from the grid posterior every step, and acts as the expert of that theta.

    conditional: count the expert's own probability of the actions taken as evidence too, Eq. (3): the causal delusion.
    Reads the environment's state, never its theta.
    """

    def __init__(self, env: BatchEnv, expert: Expert, conditional: bool, k: int = 21) -> None:
        self.env, self.expert, self.conditional = env, expert, conditional
        self.grid = Grid(env, expert, k)

    def begin(self, n: int) -> None:
        self.log_belief = self.grid.prior(n)

    def reset(self, rngs: Sequence[np.random.Generator]) -> None:
        self._rng = Streams(rngs)

    def act(self, obs: NDArray[np.float32]) -> Array:
        self._state = self.env.state
        index = sample_rows(np.exp(self.log_belief), self._rng)
        return self.expert.act(obs, self.grid.theta[index], self._rng)

    def observe(
        self, obs: NDArray[np.float32], action: Array, next_obs: NDArray[np.float32], alive: NDArray[np.bool_]
    ) -> None:
        log_dynamics = self.grid.log_dynamics(self._state, action, self.env.state)
        log_policy = self.grid.log_policy(obs, action) if self.conditional else None
        updated = belief_update(self.log_belief, log_dynamics, log_policy)
        self.log_belief = np.where(alive[:, None], updated, self.log_belief)

    def features(self) -> NDArray[np.float32]:
        """The posterior mean of the encoded theta."""
        return (np.exp(self.log_belief) @ self.env.task.encode_theta(self.grid.theta)).astype(np.float32)
