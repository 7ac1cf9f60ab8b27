"""Exact interventional and conditional policies, Eq. (2) to (5), by a posterior over a grid of theta.

The bandit's grid is its five arms, and the posterior a closed form. On MuJoCo each grid value is simulated for one
control step from the present state, and weighed by the Gaussian process noise.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from deconf.equations import belief_update
from envs import BatchEnv
from envs.task import Array
from experts.demos import Agent
from experts.policy import Expert


class ExactAgent(Agent):
    """Samples theta from the grid posterior every step, and acts as the expert of that theta.

    conditional: count the expert's own probability of the actions taken as evidence too, Eq. (3): the causal delusion.
    Reads the environment's state, which observations of these tasks determine, and never its theta.
    """

    def __init__(self, env: BatchEnv, expert: Expert, conditional: bool, k: int = 21) -> None:
        self.env, self.expert, self.conditional = env, expert, conditional
        self.grid = env.task.theta_grid(k)
        self._simulator = env.task.simulator(len(self.grid))
        for i, theta in enumerate(self.grid):
            self._simulator.set_theta(i, theta)

    def begin(self, n: int, rng: np.random.Generator) -> None:
        self._rng = rng
        self.log_belief = np.full((n, len(self.grid)), -np.log(len(self.grid)))

    def act(self, obs: NDArray[np.float32]) -> Array:
        self._state = self.env.state
        cumulative = np.exp(self.log_belief).cumsum(-1)
        index = (self._rng.random((len(obs), 1)) * cumulative[:, -1:] > cumulative).sum(-1)
        return self.expert.act(obs, self.grid[index], self._rng)

    def observe(
        self, obs: NDArray[np.float32], action: Array, next_obs: NDArray[np.float32], alive: NDArray[np.bool_]
    ) -> None:
        n, k = self.log_belief.shape
        repeated = np.repeat(action, k, 0)
        outcome = self._simulator.outcome(np.repeat(self._state, k, 0), repeated).reshape(n, k, -1)
        log_dynamics = self.env.task.log_prob(self.env.state[:, None], outcome)
        log_policy = None
        if self.conditional:
            grid = np.tile(self.grid, (n, 1))
            log_policy = self.expert.log_prob(np.repeat(obs, k, 0), repeated, grid).reshape(n, k)
        self.log_belief = np.where(
            alive[:, None], belief_update(self.log_belief, log_dynamics, log_policy), self.log_belief
        )
