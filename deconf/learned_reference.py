"""Learned references for tasks without likelihoods: posteriors of theta by dynamics that were learned *with* theta.

They take the place of the exact ones where those cannot be: the same policies over the same kind of grid, but with a
likelihood that is as good as its fit. They see theta in training, so they are no imitators.
"""

import warnings
from dataclasses import dataclass

import numpy as np
from sklearn.exceptions import ConvergenceWarning
from sklearn.neural_network import MLPRegressor
from sklearn.preprocessing import StandardScaler

from deconfounded.deconf.exact import Grid
from deconfounded.envs import BatchEnv, Task
from deconfounded.envs.streams import Array, Mask, Streams
from deconfounded.envs.support.errors import InputError
from deconfounded.experts.agent import ExpertAgent, RandomAgent
from deconfounded.experts.policy import Expert
from deconfounded.experts.rollout import Rollout, run_trials
from deconfounded.experts.trials import of_steps

HELD_OUT = 4  # every so many-th trial fits the noise, not the mean
SHRINKAGE = 0.05  # of the residuals' covariance to its diagonal: what is nearly deterministic is what the fit misses
EXPONENTS = (1.0, 0.7, 0.5, 0.3, 0.2, 0.1, 0.05, 0.02)  # of the likelihood: errors of a fit agree from step to step
DECOYS = 16  # thetas beside the true one, by which the exponent is chosen


@dataclass
class LearnedDynamics:
    """p(o' | o, a, theta)^exponent: a network gives the mean of the change, held-out residuals its covariance.

    Changes are in units of their standard deviation; columns that never change, or always by the same amount, are
    left out.
    """

    task: Task
    network: MLPRegressor
    inputs: StandardScaler
    scale: Array  # [O], 0 where a column is left out
    precision: Array
    exponent: float = 1.0
    r2: float = 0.0  # of the change, on held-out trials

    def residual(self, obs: Array, action: Array, next_obs: Array, theta: Array) -> Array:
        """The scaled change [M, O'] less its mean, at observations [M, O], actions [M, A], thetas [M, L]."""
        mean = self.network.predict(self.inputs.transform(features(self.task, obs, action, theta)))
        moves = self.scale > 0
        return (next_obs - obs)[:, moves] / self.scale[moves] - mean.reshape(len(obs), -1)

    def log_prob(self, obs: Array, action: Array, next_obs: Array, theta: Array) -> Array:
        """Log density [M] to the power of the exponent, up to a constant that does not depend on theta."""
        residual = self.residual(obs, action, next_obs, theta)
        return -0.5 * self.exponent * np.einsum("mi,ij,mj->m", residual, self.precision, residual)

    def log_grid(self, obs: Array, action: Array, next_obs: Array, thetas: Array) -> Array:
        """The same [M, K] for each of thetas [K, L]."""
        k = len(thetas)
        before, taken, after = (np.repeat(x, k, 0) for x in (obs, action, next_obs))
        return self.log_prob(before, taken, after, np.tile(thetas, (len(obs), 1))).reshape(-1, k)


def features(task: Task, obs: Array, action: Array, theta: Array) -> Array:
    """The network's inputs: observation, action (one-hot if discrete), encoded theta."""
    acted = np.eye(task.n_actions)[action[:, 0].astype(int)] if task.n_actions else action
    return np.concatenate([obs, acted, task.encode_theta(theta)], -1)


def learn(task: Task, expert: Expert, trials: int, seed: int) -> LearnedDynamics:
    """Learn the dynamics from trials of the expert, of experts that assume another theta, and of random actions."""
    env = BatchEnv(task, trials)
    other = task.sample_theta(Streams(np.random.default_rng(seed).spawn(trials)))
    agents = ExpertAgent(env, expert), ExpertAgent(env, expert, other), RandomAgent(task.action_space)
    rollouts = [run_trials(env, agent, task.episodes, seed + i * trials) for i, agent in enumerate(agents)]
    fitted, held_out = (np.arange(trials) % HELD_OUT > 0), (np.arange(trials) % HELD_OUT == 0)
    obs, action, next_obs, theta = steps(rollouts, fitted)
    scale = (next_obs - obs).std(0)
    rounding = np.finfo(np.float32).eps * np.abs(obs).max(0)  # all that tells the steps of a clock apart
    scale[scale < np.maximum(1e-9, rounding)] = 0
    moves = scale > 0
    if not moves.any():
        raise InputError(f"observations of {task.name} never changed within an episode; there are no dynamics to learn")
    rows = features(task, obs, action, theta)
    inputs = StandardScaler().fit(rows)
    network = MLPRegressor(
        hidden_layer_sizes=(128, 128), batch_size=512, max_iter=50, early_stopping=True, random_state=seed
    )
    target = (next_obs - obs)[:, moves] / scale[moves]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # what the fit is worth is measured on held-out trials
        network.fit(inputs.transform(rows), target[:, 0] if moves.sum() == 1 else target)
    dynamics = LearnedDynamics(task, network, inputs, scale, np.eye(moves.sum()))
    obs, action, next_obs, theta = steps(rollouts, held_out)
    residual = dynamics.residual(obs, action, next_obs, theta)
    covariance = np.cov(residual.T, bias=True).reshape(len(residual.T), -1)
    dynamics.r2 = float(1 - residual.var(0).sum() / ((next_obs - obs)[:, moves] / scale[moves]).var(0).sum())
    shrunk = (1 - SHRINKAGE) * covariance + SHRINKAGE * np.diag(np.diag(covariance))
    dynamics.precision = np.linalg.inv(shrunk + 1e-8 * np.eye(len(shrunk)))
    dynamics.exponent = calibrated(dynamics, rollouts, held_out)
    return dynamics


def steps(rollouts: list[Rollout], which: Mask) -> tuple[Array, Array, Array, Array]:
    """Observation, action, next observation and theta of the steps that took place, of some trials, in rows."""
    parts = []
    for trials, _, hidden in rollouts:
        mask = trials.mask[which]
        theta = of_steps(hidden[which], mask.shape[2])
        of = trials.obs[which, :, :-1], trials.action[which], trials.obs[which, :, 1:], theta
        parts.append([x[mask].astype(float) for x in of])
    obs, action, next_obs, theta = (np.concatenate(x) for x in zip(*parts, strict=True))
    return obs, action, next_obs, theta


def calibrated(dynamics: LearnedDynamics, rollouts: list[Rollout], which: Mask) -> float:
    """The exponent under which posteriors of the true theta among others are best, over all beginnings of trials."""
    decoys = dynamics.task.theta_grid(DECOYS)
    score = np.zeros(len(EXPONENTS))
    for rollout in rollouts:
        for b in np.flatnonzero(which):
            trial = np.arange(len(which)) == b
            obs, action, next_obs, theta = steps([rollout], trial)
            true = dynamics.log_prob(obs, action, next_obs, theta)
            nats = dynamics.log_grid(obs, action, next_obs, decoys) - true[:, None]
            nats[(decoys == theta[:, None]).all(-1)] = -np.inf  # no other one: of a category the grid has each value
            nats = nats.cumsum(0)
            score -= [np.logaddexp.reduce(np.insert(e * nats, 0, 0, 1), 1).mean() for e in EXPONENTS]
    return EXPONENTS[int(score.argmax())]


class LearnedGrid(Grid):
    """The grid of thetas, with the likelihoods of learned dynamics."""

    def __init__(self, env: BatchEnv, expert: Expert, k: int, dynamics: LearnedDynamics) -> None:
        super().__init__(env, expert, k)
        self.dynamics = dynamics

    def log_dynamics(self, state: Array, action: Array, next_state: Array, log_belief: Array | None = None) -> Array:
        obs, next_obs = map(self.env.task.observe, (state, next_state))
        return self.dynamics.log_grid(obs, action, next_obs, self.theta)

    def log_true(self, state: Array, action: Array, next_state: Array, theta: Array) -> Array:
        obs, next_obs = map(self.env.task.observe, (state, next_state))
        return self.dynamics.log_prob(obs, action, next_obs, theta)
