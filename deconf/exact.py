"""Exact interventional and conditional policies, Eq. (2) to (5), by a posterior over a grid of theta.

The bandit's grid is its five arms, and the posterior has a closed form. On MuJoCo the likelihood of a grid value is the
density of the process noise about the simulation of one control step. Values of small mass are pruned from the
simulation (`Grid.log_dynamics`).
"""

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from deconfounded.deconf.core.deployment import Way, acted_on
from deconfounded.deconf.equations import belief_update
from deconfounded.envs import BatchEnv, MujocoTask
from deconfounded.envs.patches import PatchedTask
from deconfounded.envs.streams import Array, Streams
from deconfounded.envs.task import Simulator, Task
from deconfounded.experts.agent import Agent
from deconfounded.experts.policy import Expert, sample_rows

PRUNE_BELOW = 1e-4  # of the mass: values with less are not simulated
AT_LEAST = 2  # values that are
GRID, GRID_OF_TWO = 21, 59  # the k of `Task.theta_grid`: 21 values of one latent, 15 of each of two


def log_next(
    simulator: Simulator,
    state: Array,
    action: Array,
    next_state: Array,
    theta: Array,
    rows: NDArray[np.int64] | None = None,
) -> Array:
    """log p(s' | s, a, theta) [M], of physics and sensors, up to a constant that does not depend on theta.

    state, next_state [M, S], action [M, A], theta [M, L]; rows [M]: the simulator's environment of that theta.
    """
    task = simulator.task
    log_prob = task.log_sense(next_state, theta)
    if task.moves_state:
        log_prob = log_prob + task.log_prob(next_state, simulator.outcome(state, action, rows))
    return log_prob


class Grid:
    """K equally likely thetas (`Task.theta_grid`), and their likelihoods for transitions of N environments."""

    def __init__(self, env: BatchEnv, expert: Expert, k: int) -> None:
        self.env, self.expert, self.theta = env, expert, env.task.theta_grid(k)
        self._transition = env.task.transition(k) if env.task.drifts else None
        self._switching = env.task.switching(k) if env.task.switches else None
        self._simulator = env.task.simulator(len(self.theta))
        for i, theta in enumerate(self.theta):
            self._simulator.set_theta(i, theta)
        quantile = np.stack([lat.cdf(self.theta[:, i]) for i, lat in enumerate(env.task.latents)], -1)
        self._distance = np.abs(quantile[:, None] - quantile).sum(-1)

    def prior(self, n: int) -> Array:
        """Log-belief [N, K] before any evidence."""
        return np.full((n, len(self.theta)), -np.log(len(self.theta)))

    def predict(self, log_belief: Array) -> Array:
        """The log-belief [N, K] about the next episode's theta: the same, unless theta drifts."""
        return log_belief if self._transition is None else _mixed(log_belief, self._transition)

    def predict_steps(self, log_belief: Array, steps: int = 1) -> Array:
        """The log-belief [N, K] about theta so many steps later, with no evidence: the same, unless theta switches."""
        if self._switching is None or not steps:
            return log_belief
        return _mixed(log_belief, np.linalg.matrix_power(self._switching, steps))

    def log_dynamics(self, state: Array, action: Array, next_state: Array, log_belief: Array | None = None) -> Array:
        """log p(s' | s, a, theta) [N, K]; state, next_state [N, S], action [N, A].

        log_belief [N, K]: where physics has to be simulated, values with less mass than PRUNE_BELOW are not, except for
        the two heaviest; each has the likelihood of the nearest simulated value instead. So a pruned value gains mass
        when its neighbours do, and is then simulated again. If theta is on the grid, it is ever pruned in at most a
        share K PRUNE_BELOW of trials (.2% for 21 values): by Ville's inequality, since the odds of all other values
        against it are a martingale that starts at K - 1 (for Eq. (5), where theta stands still). Without log_belief, or
        where nothing is pruned, this is the whole grid, bit for bit.
        """
        n, k = len(state), len(self.theta)
        kept = np.ones((n, k), bool)
        costly = isinstance(self.env.task, MujocoTask) and self.env.task.moves_state
        if log_belief is not None and costly and k > AT_LEAST:
            kept = log_belief >= np.log(PRUNE_BELOW)
            np.put_along_axis(kept, np.argpartition(log_belief, -AT_LEAST)[:, -AT_LEAST:], True, -1)
        row, value = np.nonzero(kept)
        log_prob, theta = np.zeros((n, k)), self.theta[value]
        log_prob[row, value] = log_next(self._simulator, state[row], action[row], next_state[row], theta, value)
        if (pruned := ~kept.all(-1)).any():
            nearest = np.where(kept[pruned, None], self._distance, np.inf).argmin(-1)
            log_prob[pruned] = np.take_along_axis(log_prob[pruned], nearest, -1)
        return log_prob

    def log_true(self, state: Array, action: Array, next_state: Array, theta: Array) -> Array:
        """log p(s' | s, a, theta) [N] under thetas [N, L] of the environments' own."""
        for i in np.flatnonzero((theta != self._true.theta).any(-1)).tolist():
            self._true.set_theta(i, theta[i])
        return log_next(self._true, state, action, next_state, theta)

    @cached_property
    def _true(self) -> Simulator:
        return self.env.task.simulator(self.env.n)

    def acting(self, log_belief: Array, state: Array) -> Array:
        """Log-belief [N, K] about what acts in states [N, S]."""
        return log_belief

    def updated(
        self, log_belief: Array, state: Array, obs: Array, log_dynamics: Array, log_policy: Array | None = None
    ) -> Array:
        """The log-belief after steps from states [N, S] and observations [N, O], by likelihoods [N, K]."""
        return belief_update(log_belief, log_dynamics, log_policy)

    def sample(self, log_belief: Array, rng: Streams) -> Array:
        """Thetas [N, L] drawn from beliefs."""
        return self.theta[sample_rows(np.exp(log_belief), rng)]

    def mode(self, log_belief: Array) -> Array:
        """Thetas [N, L]: the likeliest of the grid."""
        return self.theta[log_belief.argmax(-1)]

    def mean(self, log_belief: Array) -> Array:
        """Thetas [N, L]: of each latent the posterior mean; of a categorical one its value in the likeliest theta."""
        mean = np.exp(log_belief) @ self.theta
        categorical = [lat.distribution == "categorical" for lat in self.env.task.latents]
        return np.where(categorical, self.mode(log_belief), mean)

    def features(self, log_belief: Array) -> Array:
        """The posterior mean [N, F] of the encoded theta."""
        return np.exp(log_belief) @ self.env.task.encode_theta(self.theta)

    def log_policy(self, obs: Array, action: Array) -> Array:
        """log pi_exp(a | s, theta) [N, K]; obs [N, O], action [N, A]."""
        n, k = len(obs), len(self.theta)
        thetas = np.tile(self.theta, (n, 1))
        return self.expert.log_prob(np.repeat(obs, k, 0), np.repeat(action, k, 0), thetas).reshape(n, k)


class PatchGrid(Grid):
    """Beliefs of a task of patches, whose posterior factorises: log-beliefs are [N, L, K], about each patch.

    Thetas of the grid have all patches alike. A step is evidence of the patch that acted; an action, of the one that
    the expert heeds.
    """

    def __init__(self, env: BatchEnv, expert: Expert, k: int) -> None:
        super().__init__(env, expert, k)
        assert isinstance(env.task, PatchedTask)
        self.task = env.task

    def prior(self, n: int) -> Array:
        return np.repeat(super().prior(n)[:, None], self.theta.shape[1], 1)

    def acting(self, log_belief: Array, state: Array) -> Array:
        return log_belief[np.arange(len(state)), self.task.patch(state)]

    def updated(
        self, log_belief: Array, state: Array, obs: Array, log_dynamics: Array, log_policy: Array | None = None
    ) -> Array:
        new, rows = log_belief.copy(), np.arange(len(state))
        for patch, log_prob in ((self.task.patch(state), log_dynamics), (self.task.heeded(obs), log_policy)):
            if log_prob is not None:
                new[rows, patch] = belief_update(new[rows, patch], log_prob)
        return new

    def sample(self, log_belief: Array, rng: Streams) -> Array:
        drawn = [sample_rows(np.exp(log_belief[:, i]), rng) for i in range(log_belief.shape[1])]
        return self.theta[np.stack(drawn, -1), np.arange(len(drawn))]

    def mode(self, log_belief: Array) -> Array:
        return self.theta[log_belief.argmax(-1), 0]

    def mean(self, log_belief: Array) -> Array:
        if self.task.latents[0].distribution == "categorical":  # patches have one kind
            return self.mode(log_belief)
        return np.exp(log_belief) @ self.theta[:, 0]

    def features(self, log_belief: Array) -> Array:
        encoded = self.task.latents[0].encode(self.theta[:, 0])
        return (np.exp(log_belief) @ encoded).reshape(len(log_belief), -1)


def grid_size(task: Task) -> int:
    """The k of `Task.theta_grid` for the exact policies of a task."""
    return GRID_OF_TWO if len(task.latents) == 2 else GRID


def grid_of(env: BatchEnv, expert: Expert, k: int) -> Grid:
    """The grid of k values that fits a task."""
    return (PatchGrid if isinstance(env.task, PatchedTask) else Grid)(env, expert, k)


def _mixed(log_belief: Array, transition: Array) -> Array:
    """Log-belief [N, K] after a transition [K, K] of theta."""
    return np.log(np.exp(log_belief) @ transition + 1e-300)


class ExactAgent(Agent):
    """Takes theta from the posterior on a grid, and acts as the expert under that theta.

    way: how it takes theta (`core/deployment.py`); at first drawn at every step. conditional: the posterior takes the
    agent's actions for evidence too, Eq. (3): the causal delusion. static: it assumes the same theta in all episodes,
    even where theta drifts or switches. Where theta switches, the posterior is the filter of a hidden Markov model,
    which goes on after an episode's early end. The agent reads the environment's state, not its theta.
    """

    def __init__(
        self, env: BatchEnv, expert: Expert, conditional: bool, k: int | Grid = GRID, static: bool = False
    ) -> None:
        """k: the grid, or how many values it has."""
        self.env, self.expert, self.conditional, self.static = env, expert, conditional, static
        self.way: Way = "step"
        self.grid = k if isinstance(k, Grid) else grid_of(env, expert, k)

    def begin(self, n: int) -> None:
        self.log_belief, self._first, self._steps = self.grid.prior(n), True, 0

    def reset(self, rngs: Sequence[np.random.Generator]) -> None:
        self._rng = Streams(rngs)
        if not (self._first or self.static):
            waited = self.grid.predict_steps(self.log_belief, self.env.task.horizon - self._steps)
            self.log_belief = self.grid.predict(waited)
        self._first, self._steps = False, 0
        self._theta: Array | None = None

    def act(self, obs: NDArray[np.float32]) -> Array:
        self._state = self.env.state
        self._theta = acted_on(self.grid, self.way, self.log_belief, self._rng, self._theta)
        return self.expert.act(obs, self._theta, self._rng)

    def observe(
        self, obs: NDArray[np.float32], action: Array, next_obs: NDArray[np.float32], alive: NDArray[np.bool_]
    ) -> None:
        before, state = self.log_belief[alive], self._state[alive]
        acting = self.grid.acting(before, state)
        log_dynamics = self.grid.log_dynamics(state, action[alive], self.env.state[alive], acting)
        log_policy = self.grid.log_policy(obs[alive], action[alive]) if self.conditional else None
        self.log_belief[alive] = self.grid.updated(before, state, obs[alive], log_dynamics, log_policy)
        if not self.static:
            self.log_belief = self.grid.predict_steps(self.log_belief)
        self._steps += 1

    def features(self) -> NDArray[np.float32]:
        """The posterior mean of the encoded theta."""
        return self.grid.features(self.log_belief).astype(np.float32)
