"""Exact interventional and conditional policies, Eq. (2) to (5), by a posterior over a grid of theta.

The bandit's grid is its five arms, and the posterior a closed form. On MuJoCo each grid value is simulated for one
control step from the present state, and weighed by the Gaussian process noise. Once evidence is in, nearly all values
have next to no mass; those are left out of the simulation (`Grid.log_dynamics`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from deconfounded.deconf.equations import belief_update
from deconfounded.envs import BatchEnv, MujocoTask
from deconfounded.envs.streams import Array, Streams
from deconfounded.envs.task import Simulator
from deconfounded.experts.policy import Expert, sample_rows
from deconfounded.experts.rollout import Agent

LEFT_OUT = 1e-4  # of the mass: a value that has less is not simulated
AT_LEAST = 2


def log_next(
    simulator: Simulator,
    state: Array,
    action: Array,
    next_state: Array,
    theta: Array,
    rows: NDArray[np.int64] | None = None,
) -> Array:
    """log p(s' | s, a, theta) [M], of its physics and of its readings; but for what is the same for every theta.

    state, next_state [M, S], action [M, A], theta [M, L]; rows [M]: the simulator's environment of that theta.
    """
    task = simulator.task
    told = task.log_sense(next_state, theta)
    if task.moves_state:
        told = told + task.log_prob(next_state, simulator.outcome(state, action, rows))
    return told


class Grid:
    """K equally likely thetas (`Task.theta_grid`), and what one transition of each of N environments says of them."""

    def __init__(self, env: BatchEnv, expert: Expert, k: int) -> None:
        self.env, self.expert, self.theta = env, expert, env.task.theta_grid(k)
        self._next = env.task.transition(k) if env.task.drifts else None
        self._simulator = env.task.simulator(len(self.theta))
        for i, theta in enumerate(self.theta):
            self._simulator.set_theta(i, theta)
        place = np.stack([lat.cdf(self.theta[:, i]) for i, lat in enumerate(env.task.latents)], -1)
        self._distance = np.abs(place[:, None] - place).sum(-1)

    def prior(self, n: int) -> Array:
        """Log-belief [N, K] before any evidence."""
        return np.full((n, len(self.theta)), -np.log(len(self.theta)))

    def drifted(self, log_belief: Array) -> Array:
        """The log-belief [N, K] of the next episode's theta: that of a theta which walks, or else the same."""
        if self._next is None:
            return log_belief
        return np.log(np.exp(log_belief) @ self._next + 1e-300)

    def log_dynamics(self, state: Array, action: Array, next_state: Array, log_belief: Array | None = None) -> Array:
        """log p(s' | s, a, theta) [N, K]; state, next_state [N, S], action [N, A].

        log_belief [N, K]: where physics has to be simulated, values with less mass than LEFT_OUT are not, but for the
        two heaviest, which always are; each is given the evidence of the nearest one that is. A value left out keeps
        its mass that way, and gains when those beside it do: once it has enough, it is simulated again. By Ville's
        inequality, a theta of the grid that is the true one is ever left out in at most K LEFT_OUT of all trials
        (.2% for 21 values), since the odds of all others against it are a martingale, K - 1 at first. Without
        log_belief, or where it leaves nothing out, this is the whole grid, bit for bit.
        """
        n, k = len(state), len(self.theta)
        wanted = np.ones((n, k), bool)
        simulated = isinstance(self.env.task, MujocoTask) and self.env.task.moves_state
        if log_belief is not None and simulated and k > AT_LEAST:
            wanted = log_belief >= np.log(LEFT_OUT)
            np.put_along_axis(wanted, np.argpartition(log_belief, -AT_LEAST)[:, -AT_LEAST:], True, -1)
        row, value = np.nonzero(wanted)
        found = np.zeros((n, k))
        theta = self.theta[value]
        found[row, value] = log_next(self._simulator, state[row], action[row], next_state[row], theta, value)
        if (some := ~wanted.all(-1)).any():
            nearest = np.where(wanted[some, None], self._distance, np.inf).argmin(-1)
            found[some] = np.take_along_axis(found[some], nearest, -1)
        return found

    def log_policy(self, obs: Array, action: Array) -> Array:
        """log pi_exp(a | s, theta) [N, K]; obs [N, O], action [N, A]."""
        n, k = len(obs), len(self.theta)
        thetas = np.tile(self.theta, (n, 1))
        return self.expert.log_prob(np.repeat(obs, k, 0), np.repeat(action, k, 0), thetas).reshape(n, k)


class ExactAgent(Agent):
    """Samples theta from the grid posterior every step, and acts as the expert of that theta.

    conditional: count the expert's own probability of the actions taken as evidence too, Eq. (3): the causal delusion.
    static: take theta to be the same in all episodes, even where it drifts. Reads the environment's state, never its
    theta.
    """

    def __init__(self, env: BatchEnv, expert: Expert, conditional: bool, k: int = 21, static: bool = False) -> None:
        self.env, self.expert, self.conditional, self.static = env, expert, conditional, static
        self.grid = Grid(env, expert, k)

    def begin(self, n: int) -> None:
        self.log_belief, self._first = self.grid.prior(n), True

    def reset(self, rngs: Sequence[np.random.Generator]) -> None:
        self._rng = Streams(rngs)
        if not (self._first or self.static):
            self.log_belief = self.grid.drifted(self.log_belief)
        self._first = False

    def act(self, obs: NDArray[np.float32]) -> Array:
        self._state = self.env.state
        index = sample_rows(np.exp(self.log_belief), self._rng)
        return self.expert.act(obs, self.grid.theta[index], self._rng)

    def observe(
        self, obs: NDArray[np.float32], action: Array, next_obs: NDArray[np.float32], alive: NDArray[np.bool_]
    ) -> None:
        before = self.log_belief[alive]
        log_dynamics = self.grid.log_dynamics(self._state[alive], action[alive], self.env.state[alive], before)
        log_policy = self.grid.log_policy(obs[alive], action[alive]) if self.conditional else None
        self.log_belief[alive] = belief_update(before, log_dynamics, log_policy)

    def features(self) -> NDArray[np.float32]:
        """The posterior mean of the encoded theta."""
        return (np.exp(self.log_belief) @ self.env.task.encode_theta(self.grid.theta)).astype(np.float32)
