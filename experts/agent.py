"""Agents: what acts in trials. A method gives one; the expert and random actions are agents too."""

from __future__ import annotations  # as what only type checkers import is no name at run time

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from deconfounded.envs.streams import Array, Mask, Obs, Streams
from deconfounded.envs.support.errors import InputError
from deconfounded.envs.support.spaces import action_sizes

if TYPE_CHECKING:
    from deconfounded.envs.batch import BatchEnv
    from deconfounded.experts.policy import Expert

State = tuple[dict[str, Any], dict[str, NDArray[Any]]]  # settings that json can hold, and arrays


class Agent(ABC):
    """A policy that acts in N trials side by side, from its own history alone."""

    def begin(self, n: int) -> None:  # noqa: B027 (agents without memory need nothing here)
        """Start n new trials, each under a theta of its own: reset all memory."""

    def reset(self, rngs: Sequence[np.random.Generator]) -> None:  # noqa: B027 (nor those without random numbers)
        """Start an episode of the present trials under the same theta. rngs: one for each of equal groups of trials."""

    @abstractmethod
    def act(self, obs: Obs) -> Array:
        """Observation [N, O] -> action [N, A]."""

    def observe(self, obs: Obs, action: Array, next_obs: Obs, alive: Mask) -> None:  # noqa: B027 (as begin)
        """Take in a transition of each trial; where `alive` [N] is False, the episode had ended before it."""

    def features(self) -> NDArray[np.float32] | None:
        """Features [N, F] of the agent's memory, for probes of theta in it; None for agents without memory."""
        return None

    def state(self) -> State:
        """Settings and arrays, for `from_state`. Raises InputError for an agent that cannot be saved."""
        raise InputError(f"{type(self).__name__} cannot be saved; give it `state` and `from_state`")

    @classmethod
    def from_state(cls, settings: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> Agent:
        """The agent whose `state` this is."""
        raise InputError(f"{cls.__name__} cannot be loaded; give it `state` and `from_state`")


class AgentWrapper(Agent):
    """An agent that passes on what it is asked to another; subclasses change a part of it, as gymnasium's wrappers do.

    Features and state are not passed on.
    """

    def __init__(self, agent: Agent) -> None:
        self.agent = agent

    def begin(self, n: int) -> None:
        self.agent.begin(n)

    def reset(self, rngs: Sequence[np.random.Generator]) -> None:
        self.agent.reset(rngs)

    def act(self, obs: Obs) -> Array:
        return self.agent.act(obs)

    def observe(self, obs: Obs, action: Array, next_obs: Obs, alive: Mask) -> None:
        self.agent.observe(obs, action, next_obs, alive)


class _Drawing(Agent):
    """An agent that draws random numbers."""

    def reset(self, rngs: Sequence[np.random.Generator]) -> None:
        self._rng = Streams(rngs)


class ExpertAgent(_Drawing):
    """The expert as an agent. theta [N, L]: what it acts by; None: that of the environment."""

    def __init__(self, env: BatchEnv, expert: Expert, theta: Array | None = None) -> None:
        self.env, self.expert, self.theta = env, expert, theta

    def act(self, obs: Obs) -> Array:
        return self.expert.act(obs, self.env.theta if self.theta is None else self.theta, self._rng)


class RandomAgent(_Drawing):
    """An agent with uniform actions: the zero of every score."""

    def __init__(self, space: spaces.Box | spaces.Discrete) -> None:
        self.space = space

    def act(self, obs: Obs) -> Array:
        width, n_actions = action_sizes(self.space)
        draws = self._rng.random((len(obs), width))
        return np.floor(draws * n_actions) if n_actions else 2 * draws - 1
