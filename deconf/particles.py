"""The exact policies' belief by particles, in place of a grid: for tasks of three latents or more.

A grid of so many latents has too few values of each. K particles are drawn from p(theta), and weighed by the
likelihood of every transition. Before their effective number falls below K / 2, they are drawn anew by their weights
and moved: by a normal kernel that keeps their mean and covariance (Liu and West 2001), in normal scores of the latents,
in which p(theta) is N(0, I): a latent of which nothing is known stays as it was. Values of categorical latents stay as
they are: between two of them lies a third. A transition that says much is taken in by several such stages, each with a
power of its likelihood.

Simulating every particle would cost too much. A share of them is simulated, and the outcomes of the others are those of
a quadratic function of theta, fitted to these by least squares for each transition. Where it misses the log-likelihoods
of those simulated (it misses others by more), and wherever a latent is categorical, every particle is simulated, trial
by trial, as a model of each particle of all trials would take gigabytes.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from deconfounded.deconf.core.deployment import Way, acted_on
from deconfounded.deconf.exact import GRID, ExactAgent, Grid
from deconfounded.envs import BatchEnv, Task
from deconfounded.envs.latent import folded
from deconfounded.envs.patches import PatchedTask
from deconfounded.envs.streams import Array, Mask, Streams
from deconfounded.envs.support.errors import InputError
from deconfounded.envs.task import Simulator
from deconfounded.experts.agent import Agent
from deconfounded.experts.policy import Expert, sample_rows

PARTICLES = 1024  # of a trial
GRID_UP_TO = 2  # latents: a task of more needs particles, unless its posterior factorises
SIMULATED, LEAST = 1.5, 15  # particles for each coefficient of the quadratic; in all, so that they show a kink
TOLERANCE, NEAR = 0.1, 10.0  # nats: rms error of the quadratic, over particles so near the likeliest one
KERNEL, IMPOSSIBLE = 0.5, 50  # the kernel's std, of the particles' own; nats from the least likelihood down to 0
EDGE, HALVINGS = 1e-9, 20  # of quantiles, from 0 and 1; of the interval, in the search for the power of a stage


class Particles:
    """A belief about theta in each of N trials: weighted particles, and the likelihoods that weigh them.

    Attributes: `theta` [N, K, L], `log_weight` [N, K]; `missed`: how often the quadratic missed.
    conditional: the expert's probability of an action counts as evidence too, Eq. (3). static: it assumes that theta
    neither drifts nor switches.
    """

    def __init__(self, env: BatchEnv, expert: Expert, conditional: bool, static: bool = False) -> None:
        self.env, self.task, self.expert = env, env.task, expert
        self.conditional, self.static = conditional, static
        self._categorical = np.array([lat.distribution == "categorical" for lat in env.task.latents])

    def begin(self, n: int) -> None:
        """Start n new trials."""
        self._n, self._started, self._steps = n, False, 0

    def reset(self, rng: Streams) -> None:
        """Start an episode: at first particles are drawn from p(theta), later theta drifts and switches.

        rng seeds a generator for each trial, so that trials do not depend on those beside them.
        """
        if self._started:
            for _ in range(0 if self.static else self.task.horizon - self._steps):
                self._switch()
            self._drift()
        else:
            self._start(rng)
        self._steps, self._started = 0, True

    @cached_property
    def _whole(self) -> Simulator:
        """For transitions that the quadratic missed: a model for each particle of one trial."""
        return self.task.simulator(PARTICLES)

    def _start(self, rng: Streams) -> None:
        seeds = (rng.random((self._n, 1))[:, 0] * 2**53).astype(np.int64)
        self._rngs = [np.random.default_rng(seed) for seed in seeds.tolist()]
        self._shape = self._n, PARTICLES, len(self.task.latents)
        moves = self.task.moves_state
        smooth = moves and not self._categorical.any()
        terms = quadratic(np.zeros(self._shape[2])).size
        wanted = max(round(SIMULATED * terms), LEAST) if smooth else 0
        self._simulated = np.arange(wanted) * PARTICLES // wanted  # evenly, among particles in their parents' order
        self._simulator = self.task.simulator(self._n * wanted)
        self._terms = np.zeros((*self._shape[:2], terms)) if smooth else None
        self._solver = np.zeros((self._n, terms, wanted))
        self.missed = 0  # transitions that the quadratic missed
        self._flat = self._n * PARTICLES, self._shape[2]
        self.log_weight = np.full(self._shape[:2], -np.log(PARTICLES))
        self._u, self.theta = np.zeros(self._shape), np.full(self._shape, np.nan)
        self._set(np.arange(self._n), Streams(self._rngs).random(self._flat).reshape(self._shape))

    def learn(self, state: Array, obs: Array, action: Array, next_state: Array, alive: Mask) -> None:
        """Take in a transition of each trial that is `alive` [N]; states [N, S], obs [N, O], action [N, A].

        Raises InputError for likelihoods that are NaN, are all 0, or differ too much.
        """
        rows, remaining = np.flatnonzero(alive), np.ones(len(alive))
        while rows.size:
            log_prob = self._log_prob(rows, state[rows], obs[rows], action[rows], next_state[rows])
            if not np.isfinite(log_prob).any(-1).all() or np.isnan(log_prob).any():
                raise InputError("a step's likelihood was NaN, or 0 under every particle; is the noise too small?")
            least = np.where(np.isfinite(log_prob), log_prob, np.inf).min(-1, keepdims=True) - IMPOSSIBLE
            log_prob = np.maximum(log_prob, least)
            power = self._power(self.log_weight[rows], log_prob, remaining[rows])
            if (full := rows[power == 0]).size:  # the step before left no room for this one: draw these anew first
                if not np.ptp(self.log_weight[full], -1).all():
                    raise InputError("likelihoods of a step differ too much among particles; is the noise too small?")
                self._move(full)
                continue
            weight = self.log_weight[rows] + power[:, None] * log_prob
            self.log_weight[rows] = weight - np.logaddexp.reduce(weight, -1, keepdims=True)
            remaining[rows] -= power
            rows = rows[remaining[rows] > 0]
            if rows.size:
                self._move(rows)
        self._switch()
        self._steps += 1

    def sample(self, log_weight: Array, rng: Streams) -> Array:
        """Thetas [N, L] drawn from particles of these weights [N, K]."""
        return self.theta[np.arange(len(self.theta)), sample_rows(np.exp(log_weight), rng)]

    def mode(self, log_weight: Array) -> Array:
        """As `mean`: that of a normal fitted to the particles, which have no density."""
        return self.mean(log_weight)

    def mean(self, log_weight: Array) -> Array:
        """Thetas [N, L]: of each latent the posterior mean; of a categorical one its likeliest value."""
        weight = np.exp(log_weight)[..., None]
        mean = (weight * self.theta).sum(1)
        for i in np.flatnonzero(self._categorical):
            mass = (weight * self.task.latents[i].encode(self.theta[..., i])).sum(1)
            mean[:, i] = self.task.latents[i].grid(0)[mass.argmax(-1)]
        return mean

    def features(self) -> NDArray[np.float32]:
        """The posterior mean [N, F] of the encoded theta."""
        return (np.exp(self.log_weight)[..., None] * self.task.encode_theta(self.theta)).sum(1).astype(np.float32)

    def _set(self, rows: NDArray[np.int64], u: Array) -> None:
        """Replace the particles of trials `rows` by those of quantiles u [M, K, L], folded into [0, 1)."""
        self._u[rows] = u = folded(u).clip(max=1 - EDGE)
        theta = np.stack([lat.ppf(u[..., i]) for i, lat in enumerate(self.task.latents)], -1)
        share = self._simulated
        changed = (theta != self.theta[rows])[:, share].any(-1)
        self.theta[rows] = theta
        for row, which in zip(*np.nonzero(changed), strict=True):
            self._simulator.set_theta(int(rows[row]) * len(share) + int(which), theta[row, share[which]])
        if self._terms is not None:
            middle, spread = (f(u[:, share], 1, keepdims=True) for f in (np.mean, np.std))
            self._terms[rows] = terms = quadratic((u - middle) / (spread + 1e-12))
            self._solver[rows] = np.linalg.pinv(terms[:, share])

    def _drift(self) -> None:
        if self.task.drifts and not self.static:
            draws = Streams(self._rngs).standard_normal(self._flat).reshape(self._shape)
            self._set(np.arange(self._n), self._u + draws * [lat.drift for lat in self.task.latents])

    def _switch(self) -> None:
        if self.task.switches and not self.static:
            draws = Streams(self._rngs).random(self._flat).reshape(self._shape)
            switch = np.array([lat.switch for lat in self.task.latents])
            anew = draws < switch  # and draws / switch are uniform then
            self._set(np.arange(self._n), np.where(anew, draws / np.maximum(switch, draws), self._u))

    def _log_prob(self, rows: NDArray[np.int64], state: Array, obs: Array, action: Array, next_state: Array) -> Array:
        """Log-likelihood [M, K] of transitions of trials `rows` [M]."""
        theta, following = self.theta[rows].reshape(-1, self._shape[2]), np.repeat(next_state, PARTICLES, 0)
        log_prob = self.task.log_sense(following, theta).reshape(len(rows), PARTICLES)
        if self.task.moves_state:
            log_prob = log_prob + self._log_physics(rows, state, action, next_state)
        if self.conditional:
            obs, action = np.repeat(obs, PARTICLES, 0), np.repeat(action, PARTICLES, 0)
            log_prob = log_prob + self.expert.log_prob(obs, action, theta).reshape(log_prob.shape)
        return log_prob

    def _log_physics(self, rows: NDArray[np.int64], state: Array, action: Array, next_state: Array) -> Array:
        """That of the next state alone, but for its readings, by simulation and fit."""
        if self._terms is None:
            return np.stack([self._by_each(*each) for each in zip(rows, state, action, next_state, strict=True)])
        n, share = len(rows), len(self._simulated)
        index = (rows[:, None] * share + np.arange(share)).ravel()
        outcome = self._simulator.outcome(np.repeat(state, share, 0), np.repeat(action, share, 0), index)
        simulated = self.task.log_prob(np.repeat(next_state, share, 0), outcome).reshape(n, share)
        fitted = self._terms[rows] @ (self._solver[rows] @ outcome.reshape(n, share, -1))
        log_prob = self.task.log_prob(next_state[:, None], fitted)
        near = simulated > simulated.max(-1, keepdims=True) - NEAR
        error = log_prob[:, self._simulated] - simulated
        error = np.where(near, error - (error * near).sum(-1, keepdims=True) / near.sum(-1, keepdims=True), 0)
        missed = np.square(error).sum(-1) > TOLERANCE**2 * near.sum(-1)
        for i in np.flatnonzero(missed).tolist():
            log_prob[i] = self._by_each(rows[i], state[i], action[i], next_state[i])
        self.missed += int(missed.sum())
        return log_prob

    def _by_each(self, row: int, state: Array, action: Array, next_state: Array) -> Array:
        """The same [K] of a transition of trial `row`, states [S] and action [A], by simulation of every particle."""
        for which, theta in enumerate(self.theta[row]):
            self._whole.set_theta(which, theta)
        outcome = self._whole.outcome(np.tile(state, (PARTICLES, 1)), np.tile(action, (PARTICLES, 1)))
        return self.task.log_prob(next_state[None], outcome)

    def _power(self, log_weight: Array, log_prob: Array, remaining: Array) -> Array:
        """The largest power [M] of likelihoods, at most `remaining`, that leaves K / 2 effective particles."""

        def enough(power: Array, rows: Any = slice(None)) -> Mask:
            weight = log_weight[rows] + power[:, None] * log_prob[rows]
            weight = np.exp(weight - weight.max(-1, keepdims=True))
            return weight.sum(-1) ** 2 >= PARTICLES / 2 * np.square(weight).sum(-1)

        power = remaining.copy()
        if (rows := np.flatnonzero(~enough(power))).size:
            low, high = np.zeros(len(rows)), power[rows]
            for _ in range(HALVINGS):
                middle = (low + high) / 2
                good = enough(middle, rows)
                low, high = np.where(good, middle, low), np.where(good, high, middle)
            power[rows] = low
        return power

    def _move(self, rows: NDArray[np.int64]) -> None:
        """Draw particles of trials `rows` anew by their weights, and move them, but for categorical latents."""
        z, weight = ndtri(self._u[rows].clip(min=EDGE)), np.exp(self.log_weight[rows])
        mean, root, category = self._moments(rows, z, weight)
        draws = Streams([self._rngs[i] for i in rows.tolist()])
        level = (draws.random((len(rows), 1)) + np.arange(PARTICLES)) / PARTICLES  # systematic resampling
        level = level * weight.sum(-1, keepdims=True)
        index = np.stack([np.searchsorted(*each) for each in zip(weight.cumsum(-1), level, strict=True)])
        index = index.clip(0, PARTICLES - 1)[..., None]
        row, of = np.arange(len(rows))[:, None], np.take_along_axis(category, index[..., 0], 1)
        mean, root = mean[row, of], root[row, of]
        normal = draws.standard_normal((z[..., 0].size, z.shape[-1])).reshape(z.shape)
        kept = np.take_along_axis(z, index, 1)
        moved = mean + np.sqrt(1 - KERNEL**2) * (kept - mean) + KERNEL * (root @ normal[..., None])[..., 0]
        self.log_weight[rows] = -np.log(PARTICLES)
        self._set(rows, np.where(self._categorical, np.take_along_axis(self._u[rows], index, 1), ndtr(moved)))

    def _moments(self, rows: NDArray[np.int64], z: Array, weight: Array) -> tuple[Array, Array, NDArray[np.int64]]:
        """Means [M, C, L] of z [M, K, L] in each category, roots of covariances, and categories of particles [M, K].

        So other latents go on depending on a category as they do: by moments over categories they would forget it.
        """
        values = self.theta[rows][..., self._categorical]
        categories, category = np.unique(values.reshape(weight.size, values.shape[-1]), axis=0, return_inverse=True)
        category = category.reshape(weight.shape)
        share = weight[:, None] * (category[:, None] == np.arange(len(categories))[:, None])
        total = np.maximum(share.sum(-1, keepdims=True), 1e-300)
        mean = share @ z / total
        products = (z[..., None] * z[..., None, :]).reshape(*z.shape[:2], -1)
        spread = (share @ products / total).reshape(*mean.shape, -1) - mean[..., None] * mean[..., None, :]
        return mean, np.linalg.cholesky(spread + 1e-12 * np.eye(z.shape[-1])), category


def quadratic(x: Array) -> Array:
    """Terms [..., 1 + L + L (L + 1) / 2] of a quadratic function of x [..., L]."""
    i, j = np.triu_indices(x.shape[-1])
    return np.concatenate([np.ones_like(x[..., :1]), x, x[..., i] * x[..., j]], -1)


class ParticleAgent(Agent):
    """Takes theta from the particles, at first by drawing it at every step, and acts as the expert, as `ExactAgent`."""

    def __init__(self, env: BatchEnv, expert: Expert, conditional: bool, static: bool = False) -> None:
        self.env, self.expert, self.belief = env, expert, Particles(env, expert, conditional, static)
        self.way: Way = "step"

    def begin(self, n: int) -> None:
        self.belief.begin(n)

    def reset(self, rngs: Sequence[np.random.Generator]) -> None:
        self._rng = Streams(rngs)
        self._theta: Array | None = None
        self.belief.reset(self._rng)

    def act(self, obs: NDArray[np.float32]) -> Array:
        self._state = self.env.state
        self._theta = acted_on(self.belief, self.way, self.belief.log_weight, self._rng, self._theta)
        return self.expert.act(obs, self._theta, self._rng)

    def observe(self, obs: NDArray[np.float32], action: Array, next_obs: NDArray[np.float32], alive: Mask) -> None:
        self.belief.learn(self._state, obs, action, self.env.state, alive)

    def features(self) -> NDArray[np.float32]:
        return self.belief.features()


def needs_particles(task: Task) -> bool:
    """Whether exact beliefs of a task are particles, not a grid."""
    return len(task.latents) > GRID_UP_TO and not isinstance(task, PatchedTask)


def exact_agent(env: BatchEnv, expert: Expert, conditional: bool, k: int | Grid = GRID, static: bool = False) -> Agent:
    """The exact policy of a task, by particles where it needs them, else by a grid k."""
    if needs_particles(env.task) and not isinstance(k, Grid):
        return ParticleAgent(env, expert, conditional, static)
    return ExactAgent(env, expert, conditional, k, static)
