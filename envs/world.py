"""Worlds: classes that make other people's Gymnasium environments for a hidden theta, and what is known of them."""

import inspect
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any, Protocol

import gymnasium
import numpy as np
from gymnasium import spaces

from deconfounded.envs.latent import Latent
from deconfounded.envs.streams import Array
from deconfounded.envs.support.errors import InputError, error_line
from deconfounded.envs.support.numbers import check_number

DRAWS = 2000  # of theta, by which its distribution is known


class World(Protocol):
    """A family of environments with a hidden theta; a trial is `episodes` episodes of at most `steps` steps each.

    Two attributes are optional. noise: of the expert, the standard deviation of its actions in the environment's units,
    or the share of actions that are uniformly random if they are discrete. names: of theta's numbers.
    """

    episodes: int
    steps: int

    def make(self, theta: Array) -> gymnasium.Env[Any, Any]:
        """An environment with theta [L], of flat Box observations, and of Box actions of one axis or Discrete ones."""

    def sample_theta(self, rng: np.random.Generator) -> Array:
        """A draw [L] from p(theta)."""

    def expert(self, obs: Array, theta: Array) -> Any:
        """The expert's action without noise, in the environment's units, on an observation [O]."""


@dataclass(frozen=True)
class DrawnLatent(Latent):
    """A column of theta whose distribution is known by draws alone: `values`, sorted; low and high are its extremes."""

    values: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        """No bounds are stated, and none are checked."""

    def ppf(self, u: Array) -> Array:
        return np.asarray(self.values)[(np.asarray(u) * len(self.values)).astype(int).clip(0, len(self.values) - 1)]

    def cdf(self, theta: Array) -> Array:
        """The share of draws below theta [...], and half of those that are equal; between draws it is linear."""
        distinct, count = np.unique(self.values, return_counts=True)
        return np.interp(theta, distinct, (count.cumsum() - count / 2) / count.sum())


@dataclass(frozen=True)
class Facts:
    """A world, and what is known of it: amounts, draws of theta [DRAWS, L], O, and the environments' own actions."""

    world: World
    episodes: int
    steps: int
    noise: float
    draws: Array
    latents: tuple[Latent, ...]
    observations: int
    space: spaces.Box | spaces.Discrete


@cache
def facts(cls: type[World]) -> Facts:
    """The facts of a world. Raises InputError, in one line, for whatever does not fit."""
    name = cls.__name__
    with part(name, f"{name}()"):
        world = cls()
    for amount in ("episodes", "steps"):
        check_number(f"{amount} of {name}", getattr(world, amount))
    noise = getattr(world, "noise", 0.0)
    if isinstance(noise, bool) or not isinstance(noise, int | float | np.number) or not 0 <= noise < np.inf:
        raise InputError(f"noise of {name} was {noise!r}; it must be a number from 0 up")
    first = drawn(name, world, np.random.default_rng(0))
    draws = np.stack([drawn(name, world, rng, len(first)) for rng in np.random.default_rng(0).spawn(DRAWS)])
    names = _names(name, world, len(first))
    columns = [(text, np.sort(column).tolist()) for text, column in zip(names, draws.T, strict=True)]
    latents = tuple(DrawnLatent(text, "", x[0], x[-1], values=tuple(x)) for text, x in columns)
    env = made(name, world, draws[0])
    observations, space = env.observation_space.shape[0], env.action_space  # type: ignore[index]
    with part(name, "close"):
        env.close()
    assert isinstance(space, spaces.Box | spaces.Discrete)
    if isinstance(space, spaces.Discrete) and noise > 1:
        raise InputError(f"noise of {name} was {noise!r}; of discrete actions it is a share, from 0 to 1")
    amounts = int(world.episodes), int(world.steps), float(noise)  # of plain types, as json has them
    return Facts(world, *amounts, draws, latents, observations, space)


def _names(name: str, world: World, count: int) -> Sequence[str]:
    """What theta's numbers are called."""
    names = getattr(world, "names", ["theta"] if count == 1 else [f"theta_{i}" for i in range(count)])
    distinct = not isinstance(names, str) and isinstance(names, Sequence) and len(set(names)) == count == len(names)
    if not distinct or not all(isinstance(text, str) for text in names):
        raise InputError(f"names of {name} were {names!r}; they must be {count} different texts, as theta has numbers")
    return names


def drawn(name: str, world: World, rng: np.random.Generator, count: int | None = None) -> Array:
    """A draw of theta [L]; count: what L must be."""
    with part(name, "sample_theta"):
        theta = np.asarray(world.sample_theta(rng), float)
    if theta.ndim != 1 or not theta.size or not np.isfinite(theta).all() or count not in (None, len(theta)):
        right = "one axis of finite numbers" if count in (None, theta.size) else f"{count} finite numbers, as at first"
        raise InputError(f"sample_theta of {name} gave {theta.tolist()}; it must be {right}")
    return theta


def made(name: str, world: World, theta: Array) -> gymnasium.Env[Any, Any]:
    """The environment of theta. Raises InputError for one whose observations or actions are of another kind."""
    with part(name, "make"):
        env = world.make(theta.copy())
    if not isinstance(env, gymnasium.Env):
        raise InputError(f"make of {name} gave {env!r}; it must be a gymnasium.Env")
    parameters = inspect.signature(env.unwrapped.reset).parameters.values()
    if not any(parameter.name == "seed" or parameter.kind == parameter.VAR_KEYWORD for parameter in parameters):
        raise InputError(f"reset of {name} takes no seed; it must be reset(seed=None, options=None), as gymnasium.Env")
    seen, acts = (" ".join(str(space).split()) for space in (env.observation_space, env.action_space))
    shape = env.observation_space.shape if isinstance(env.observation_space, spaces.Box) else ()
    if len(shape) != 1 or not shape[0]:
        wrapped = "a Box of one axis: wrap it in gymnasium.wrappers.FlattenObservation"
        right = "of one number or more" if shape == (0,) else wrapped
        raise InputError(f"observation_space of {name} was {seen}; it must be {right}")
    if isinstance(space := env.action_space, spaces.Discrete):
        return env
    if not isinstance(space, spaces.Box) or len(space.shape) != 1 or not space.shape[0]:
        raise InputError(f"action_space of {name} was {acts}; it must be Discrete, or a Box of one axis, not empty")
    with np.errstate(over="ignore"):  # a range of the largest numbers is infinite
        bounded = np.isfinite(space.high - space.low).all() and (space.low < space.high).all()
    if not bounded:
        right = "bounded, as its bounds are scaled to -1 and 1"
        raise InputError(f"action_space of {name} was {acts}; it must be {right}")
    return env


def as_numbers(given: Any, who: str) -> Array:
    """What an expert gave, as an array of numbers. Raises InputError if it is none."""
    try:
        return np.asarray(given, float)
    except (TypeError, ValueError):
        hint = ": of what `predict` of Stable-Baselines3 returns, the first part" if isinstance(given, tuple) else ""
        raise InputError(f"{who} gave a {type(given).__name__}; it must be an array of numbers{hint}") from None


def bounds(space: spaces.Box) -> tuple[Array, Array]:
    """What becomes -1 and 1 [A] of bounded actions; of whole numbers half a number more, so that all are alike."""
    more = 0.5 if np.issubdtype(space.dtype, np.integer) else 0.0
    return space.low.astype(float) - more, space.high.astype(float) + more


@contextmanager
def part(name: str, what: str) -> Iterator[None]:
    """Context in which an error of a world's own code becomes an InputError that names the part."""
    try:
        yield
    except InputError:
        raise
    except (Exception, SystemExit) as error:
        raise InputError(f"{what} of {name}: {error_line(error)}") from error
