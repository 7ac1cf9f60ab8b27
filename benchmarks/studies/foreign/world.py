"""A world: a simulator of others with a hidden theta, and its expert. Roll-outs of agents in it, and their scores."""

from abc import ABC, abstractmethod
from collections.abc import Callable

import gymnasium
import numpy as np
from gymnasium import spaces

from deconfounded.deconf.core.data import Rngs, as_generators
from deconfounded.envs.streams import Array, Obs
from deconfounded.experts.rollout import Agent, Rollout, Trials

Controller = Callable[[Array], Array]
"""Maps an observation [O] to an action in the simulator's units."""


class World(ABC):
    """A simulator with a hidden theta, which is constant for a trial of `episodes` episodes of at most `steps` steps.

    noise: standard deviation of the expert's actions, in the simulator's units.
    """

    episodes = 2
    steps = 60
    noise = 0.0

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


class Units:
    """Actions of Trials, in [-1, 1] or a number from 0 up, and those of an action space."""

    def __init__(self, space: spaces.Space) -> None:
        self.actions = 0
        if isinstance(space, spaces.Discrete):
            self.actions, self.start, self.width = int(space.n), int(space.start), 1
        else:
            assert isinstance(space, spaces.Box)
            assert space.shape is not None
            self.low, self.high, self.width = space.low, space.high, space.shape[0]
            self.dtype = space.dtype

    def raw(self, action: Array) -> Array:
        """Actions [N, A] of Trials in the simulator's units: [N, A], or [N] if discrete."""
        if self.actions:
            return action[:, 0].astype(int) + self.start
        return (self.low + (np.clip(action, -1, 1) + 1) / 2 * (self.high - self.low)).astype(self.dtype)

    def scaled(self, action: Array) -> Array:
        """The inverse of `raw`; actions out of range are clipped."""
        if self.actions:
            return np.asarray(action, float).reshape(-1, 1) - self.start
        return np.clip(2 * (np.asarray(action, float) - self.low) / (self.high - self.low) - 1, -1, 1)


class WorldExpert(Agent):
    """The expert in N trials. theta [N, D]: what it acts by."""

    def __init__(self, world: World, units: Units, theta: Array) -> None:
        self.world, self.units, self.theta = world, units, theta
        self._controllers: list[Controller] = []

    def begin(self, n: int) -> None:
        self._controllers = []

    def reset(self, rngs: list[np.random.Generator]) -> None:  # type: ignore[override]
        if not self._controllers:  # an expert may remember earlier episodes
            spawned = rngs[0].spawn(len(self.theta))
            self._controllers = [self.world.controller(*x) for x in zip(self.theta, spawned, strict=True)]

    def act(self, obs: Obs) -> Array:
        pairs = zip(self._controllers, obs.astype(float), strict=True)
        return self.units.scaled(np.stack([np.asarray(controller(o)) for controller, o in pairs]))


class Uniform(Agent):
    """Uniformly random actions."""

    def __init__(self, units: Units) -> None:
        self.units = units

    def reset(self, rngs: list[np.random.Generator]) -> None:  # type: ignore[override]
        self._rng = rngs[0]

    def act(self, obs: Obs) -> Array:
        draws = self._rng.random((len(obs), self.units.width))
        return np.floor(draws * self.units.actions) if self.units.actions else 2 * draws - 1


def thetas(world: World, n: int, seed: int) -> Array:
    """Draws [N, D] from p(theta)."""
    return np.stack([np.asarray(world.sample_theta(rng), float) for rng in np.random.default_rng([seed, 0]).spawn(n)])


def units_of(world: World) -> Units:
    """The units of its actions."""
    env = world.make(thetas(world, 1, 0)[0])
    space = env.action_space
    env.close()
    return Units(space)


def roll_out(world: World, agent: Agent, theta: Array, seed: int) -> Rollout:
    """Trials of an agent, one under each theta [N, D]; the seed is that of simulators and of the agent."""
    n, envs = len(theta), [world.make(row) for row in theta]
    units, (width,) = Units(envs[0].action_space), envs[0].observation_space.shape or (1,)
    obs = np.zeros((n, world.episodes, world.steps + 1, width), np.float32)
    action = np.zeros((n, world.episodes, world.steps, units.width), np.float32)
    mask, returns = np.zeros((n, world.episodes, world.steps), bool), np.zeros((n, world.episodes))
    agent.begin(n)
    for e in range(world.episodes):
        now = np.stack([env.reset(seed=s)[0] for env, s in zip(envs, _seeds(seed, e, n), strict=True)])
        now = now.astype(np.float32)
        agent.reset([np.random.default_rng([seed, 1, e])])
        obs[:, e], alive = now[:, None], np.ones(n, bool)
        for t in range(world.steps):
            chosen, then = np.asarray(agent.act(now)), now.copy()
            raw, acting = units.raw(chosen), alive.copy()
            for i in np.flatnonzero(acting):
                then[i], reward, terminated, truncated, _ = envs[i].step(raw[i])
                returns[i, e] += float(reward)
                alive[i] = not (terminated or truncated)
            agent.observe(now, chosen, then, acting)
            obs[:, e, t + 1 :], mask[:, e, t] = then[:, None], acting
            action[:, e, t] = np.where(acting[:, None], chosen, 0)
            now = then
            if not alive.any():
                break
    for env in envs:
        env.close()
    return Rollout(Trials(obs, action, mask, units.actions), returns, theta[:, None].repeat(world.episodes, 1))


def _seeds(seed: int, episode: int, n: int) -> list[int]:
    return np.random.SeedSequence([seed, 2, episode]).generate_state(n).tolist()


def demonstrations(world: World, n: int, seed: int) -> Rollout:
    """Trials of the expert, each under a fresh theta."""
    theta = thetas(world, n, seed)
    made = roll_out(world, WorldExpert(world, units_of(world), theta), theta, seed)
    return made._replace(trials=world.logged(made.trials))


def explorer(world: World, n: int, rng: Rngs) -> Callable[[Agent | None], Trials]:
    """A function that rolls out an agent, or uniformly random actions, in n trials under fresh thetas."""
    (generator,), units = as_generators(rng), units_of(world)

    def explore(agent: Agent | None) -> Trials:
        seed = int(generator.integers(2**31))
        return roll_out(world, agent or Uniform(units), thetas(world, n, seed), seed).trials

    return explore


class Scorer:
    """Scores of agents by returns in n trials: 0 of an expert told another theta, 1 of the expert."""

    def __init__(self, world: World, n: int, seed: int) -> None:
        self.world, self.seed, self.theta, units = world, seed, thetas(world, n, seed), units_of(world)
        other = np.roll(self.theta, 1, 0)
        self.expert, self.other = (self.returns(WorldExpert(world, units, told)) for told in (self.theta, other))

    def returns(self, agent: Agent) -> Array:
        """The returns [N, E]."""
        return roll_out(self.world, agent, self.theta, self.seed).returns

    def __call__(self, agent: Agent) -> float:
        """The score in the last episode."""
        expert, other, returns = (x[:, -1].mean() for x in (self.expert, self.other, self.returns(agent)))
        return float((returns - other) / (expert - other))
