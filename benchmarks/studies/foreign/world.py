"""A foreign world, a simulator of others with a hidden theta and its expert: logs of it, and scores of agents in it."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

import gymnasium
import numpy as np

from deconfounded.envs.batch import BatchEnv
from deconfounded.envs.blackbox import BlackBox, task_of
from deconfounded.envs.streams import Array, Mask, Obs
from deconfounded.experts.agent import Agent, RandomAgent
from deconfounded.experts.rollout import Rollout, run_trials
from deconfounded.experts.trials import Trials

Controller = Callable[[Array], Array]
"""Maps an observation [O] to an action in the simulator's units."""


class World(ABC):
    """A world of envs/world.py, whose expert may have habits, and whose logs may have faults.

    evidence: the columns of observations whose motion is linear in theta and about linear in the rest, for
    LinearFilter; none where there is no such filter.
    """

    episodes = 2
    steps = 60
    noise = 0.0
    evidence: Sequence[int] = ()

    @abstractmethod
    def make(self, theta: Array) -> gymnasium.Env:
        """A fresh environment under that theta [D]."""

    @abstractmethod
    def sample_theta(self, rng: np.random.Generator) -> Array:
        """A draw [D] from p(theta)."""

    @abstractmethod
    def expert(self, obs: Array, theta: Array) -> Array:
        """The expert's action without noise, in the simulator's units, on an observation [O]."""

    def controller(self, theta: Array, rng: np.random.Generator) -> Controller:
        """The expert with its noise, for one trial under that theta."""
        return lambda obs: (a := np.asarray(self.expert(obs, theta))) + self.noise * rng.standard_normal(a.shape)

    def logged(self, trials: Trials) -> Trials:
        """The expert's trials as they are logged."""
        return trials


def task(world: World) -> BlackBox:
    """The world as a task."""
    return task_of(type(world))()


class WorldExpert(Agent):
    """The expert in N trials. theta [N, D]: what it acts by."""

    def __init__(self, world: World, theta: Array) -> None:
        self.world, self.theta, self.space = world, theta, task(world).facts.space
        self._controllers: list[Controller] = []

    def begin(self, n: int) -> None:
        self._controllers = []

    def reset(self, rngs: Sequence[np.random.Generator]) -> None:
        if not self._controllers:  # an expert may remember earlier episodes
            each = [np.random.default_rng(seed) for seed in rngs[0].integers(2**62, size=len(self.theta))]
            self._controllers = [self.world.controller(*pair) for pair in zip(self.theta, each, strict=True)]

    def act(self, obs: Obs) -> Array:
        pairs = zip(self._controllers, obs.astype(float), strict=True)
        return scaled(self.space, np.stack([np.asarray(controller(row), float) for controller, row in pairs]))


def scaled(space: gymnasium.Space, action: Array) -> Array:
    """Actions [N, A] or [N] in the simulator's units as those of Trials [N, A], clipped."""
    if isinstance(space, gymnasium.spaces.Discrete):
        return action.reshape(-1, 1) - space.start
    assert isinstance(space, gymnasium.spaces.Box)
    return np.clip(2 * (action - space.low) / (space.high - space.low) - 1, -1, 1)


def thetas(world: World, n: int, seed: int) -> Array:
    """Draws [N, D] from p(theta)."""
    rng = np.random.default_rng([seed, 0])
    return np.stack([np.asarray(world.sample_theta(rng), float) for _ in range(n)])


def roll_out(world: World, agent: Agent, theta: Array, seed: int) -> Rollout:
    """Trials of an agent, one under each theta [N, D]."""
    return run_trials(BatchEnv(task(world), len(theta)), agent, world.episodes, seed, theta)


def demonstrations(world: World, n: int, seed: int) -> Rollout:
    """Trials of the expert as they are logged, each under a fresh theta."""
    theta = thetas(world, n, seed)
    made = roll_out(world, WorldExpert(world, theta), theta, seed)
    return made._replace(trials=world.logged(made.trials))


def explorer(world: World, n: int, rng: np.random.Generator) -> Callable[[Agent | None], Trials]:
    """A function that rolls out an agent, or uniformly random actions, in n trials under fresh thetas."""
    random = RandomAgent(task(world).action_space)

    def explore(agent: Agent | None) -> Trials:
        seed = int(rng.integers(2**31))
        return roll_out(world, agent or random, thetas(world, n, seed), seed).trials

    return explore


class LinearFilter(Agent):
    """A reference: the linear-Gaussian filter of theta, and the expert at its mean.

    The next observation's columns `evidence` are W [1, s, a] + C [theta, theta a] + N(0, Sigma), fitted by least
    squares to n trials of known thetas, half by the expert and half by one given a wrong theta; theta is Gaussian.
    """

    def __init__(self, world: World, n: int, seed: int) -> None:
        self.world, self.space, self.columns = world, task(world).facts.space, list(world.evidence)
        theta = thetas(world, n, seed)
        assumed = np.where(np.arange(n)[:, None] % 2, theta, np.roll(theta, 1, 0))
        trials = roll_out(world, WorldExpert(world, assumed), theta, seed).trials
        obs, action = trials.obs[:, :, :-1][trials.mask], trials.action[trials.mask]
        products = _ones(action)[:, :, None] * theta[np.nonzero(trials.mask)[0]][:, None]
        inputs = np.concatenate([_inputs(obs, action), products.reshape(len(obs), -1)], 1)
        target = trials.obs[:, :, 1:][trials.mask].astype(float)[:, self.columns]
        fit = np.linalg.lstsq(inputs, target, rcond=None)[0]
        left, effects = target - inputs @ fit, products[0].size
        self.weight, self.effect = fit[:-effects], fit[-effects:].reshape(-1, theta.shape[1], len(self.columns))
        self.precision = np.linalg.inv(np.atleast_2d(left.T @ left / len(left)))
        self.prior = np.linalg.inv(np.atleast_2d(np.cov(theta.T))), theta.mean(0)

    def begin(self, n: int) -> None:
        self._precision = np.tile(self.prior[0], (n, 1, 1))
        self._total = np.tile(self.prior[0] @ self.prior[1], (n, 1))

    def act(self, obs: Obs) -> Array:
        mean = np.linalg.solve(self._precision, self._total[..., None])[..., 0]
        pairs = zip(obs.astype(float), mean, strict=True)
        return scaled(self.space, np.stack([np.asarray(self.world.expert(*pair), float) for pair in pairs]))

    def observe(self, obs: Obs, action: Array, next_obs: Obs, alive: Mask) -> None:
        rest = next_obs[:, self.columns] - _inputs(obs, action) @ self.weight
        effect = np.tensordot(_ones(action), self.effect, 1) * alive[:, None, None]  # [N, D, K]
        gain = effect @ self.precision
        self._total += (gain @ rest[..., None])[..., 0]
        self._precision += gain @ effect.swapaxes(1, 2)


def _ones(action: Array) -> Array:
    """[N, A] -> [N, 1 + A]."""
    return np.concatenate([np.ones((len(action), 1)), action.astype(float)], 1)


def _inputs(obs: Obs, action: Array) -> Array:
    return np.concatenate([_ones(action), obs.astype(float)], 1)
