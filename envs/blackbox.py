"""Black-box tasks: Gymnasium environments of other people, with a hidden context and without likelihoods.

A *world* makes such an environment for a theta (envs/world.py); `task_of` turns it into a task.
"""

import contextlib
import inspect
import re
import weakref
from typing import Any, ClassVar, Generic, TypeVar

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from deconfounded.envs.latent import Latent
from deconfounded.envs.streams import Array, Mask, Streams
from deconfounded.envs.support.errors import InputError
from deconfounded.envs.task import Renderer, Simulator, Task
from deconfounded.envs.world import Facts, World, as_numbers, bounds, drawn, facts, made, part

LARGEST = float(np.finfo(np.float32).max)  # of an observation
LEAST_PART = 4  # draws that a theta of a grid stands for, at least
LEAST_NOISE = 0.01  # of an expert, as Eq. (1) needs a density: a share of half the action range, or of actions
PARTS = ("make", "sample_theta", "expert", "episodes", "steps")
SHAPE = "make(theta), sample_theta(rng), expert(obs, theta), episodes and steps"


class GymSimulator(Simulator):
    """A Gymnasium environment for each row, made anew when its theta is.

    They are a list: gymnasium's vector environments step all rows or none, and cannot exchange the environment of one
    row for that of another theta. Processes would not pay either, as jobs share out the cores already.
    """

    def __init__(self, task: "BlackBox", n: int) -> None:
        super().__init__(task, n)
        self.box = task
        self._envs: list[gymnasium.Env[Any, Any] | None] = [None] * n
        weakref.finalize(self, _close_all, self._envs)  # simulators may hold processes, sockets and windows

    def close(self) -> None:
        _close_all(self._envs)

    def __getstate__(self) -> dict[str, Any]:
        raise InputError(f"environments of {self.box.name} cannot be copied; make others")

    def set_theta(self, i: int, theta: Array) -> None:
        super().set_theta(i, theta)
        old, self._envs[i] = self._envs[i], None
        _close(old)

    def start(self, rows: NDArray[np.int64], start: Array, noise: Array) -> Array:
        """Reset by the seed in `start`, and go on with the random numbers of the seed in `noise`."""
        states = []
        for i, first, then in zip(rows.tolist(), start[:, 0], noise[:, 0, 0], strict=True):
            if (env := self._envs[i]) is None:
                env = self._envs[i] = self.box.make(self.theta[i])
            with part(self.box.name, "reset"):
                obs, _ = self._values("reset", env.reset(seed=int(first)), "obs, info")
                bits = env.unwrapped.np_random.bit_generator
                bits.state = type(bits)(int(then)).state  # in place, as parts of the environment may hold the generator
            states.append(self._state("reset", obs, 0.0, False, False))
        return np.stack(states)

    def outcome(self, state: Array, action: Array, rows: NDArray[np.int64] | None = None) -> Array:
        """The next state [M, S], after a step of each row's environment, whatever `state`: it holds its own."""
        after = np.zeros_like(state)
        for k, i in enumerate(range(len(self._envs)) if rows is None else rows.tolist()):
            if (env := self._envs[i]) is None:
                raise InputError(f"step of {self.box.name} was called after close; reset once")
            with part(self.box.name, "step"):
                values = "obs, reward, terminated, truncated, info"
                obs, reward, over, cut, _ = self._values("step", env.step(self.box.in_units(action[k])), values)
                try:
                    paid = float(reward)
                except (TypeError, ValueError):
                    raise InputError(
                        f"step of {self.box.name} gave the reward {reward!r}; it must be a number"
                    ) from None
                for name, flag in (("terminated", over), ("truncated", cut)):
                    if np.size(flag) != 1 or np.asarray(flag).dtype.kind not in "biu":
                        raise InputError(f"step of {self.box.name} gave {name} {flag!r}; it must be True or False")
                after[k] = self._state("step", obs, paid, over, cut)
        return after

    def _values(self, where: str, values: object, names: str) -> tuple[Any, ...]:
        """What an environment returned, of the names of Gymnasium's interface."""
        if not isinstance(values, tuple) or len(values) != len(names.split(", ")):
            what = f"{len(values)} values" if isinstance(values, tuple) else f"a {type(values).__name__}"
            raise InputError(f"{where} of {self.box.name} returned {what}; it must return {names}, as gymnasium.Env")
        return values

    def _state(self, where: str, obs: object, reward: float, over: bool, cut: bool) -> Array:
        row, width = np.asarray(obs, float), len(self.box.observation)
        if row.shape != (width,) or not (np.abs(row) <= LARGEST).all():
            what = f"{row.tolist()}" if row.shape == (width,) else f"shape {row.shape}"
            right = f"{width} finite numbers, as float32 has them"
            raise InputError(f"{where} of {self.box.name} gave an observation of {what}; it must be {right}")
        return np.append(row, (reward, over, cut))


def _close(env: gymnasium.Env[Any, Any] | None) -> None:
    """Close an environment, if there is one; what it raises on closing is of no use to anybody."""
    with contextlib.suppress(Exception):
        if env is not None:
            env.close()


def _close_all(made: list[gymnasium.Env[Any, Any] | None]) -> None:
    """Close environments, and leave None in their places."""
    for i, env in enumerate(made):
        made[i] = None
        _close(env)


Value = TypeVar("Value")


class Fact(Generic[Value]):
    """An attribute of a task that is read from its `facts`, unless the instance has its own (`Task.changed`)."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __get__(self, task: "BlackBox", owner: type | None = None) -> Value:
        return getattr(task.facts, self.name) if task is not None else self  # type: ignore[return-value]


class BlackBox(Task):
    """The task of a world. The state [S] is the observation, and a step's reward, `terminated` and `truncated`."""

    world: ClassVar[type[World]]
    has_likelihood = False
    is_bandit = False

    @property
    def facts(self) -> Facts:
        """What is known of the world from its attributes, draws of theta, and one environment."""
        return facts(self.world)

    horizon = Fact[int]("steps")  # type: ignore[assignment]
    episodes = Fact[int]("episodes")  # type: ignore[assignment]
    latents = Fact[tuple[Latent, ...]]("latents")  # type: ignore[assignment]

    @property
    def observation(self) -> dict[str, tuple[float, float]]:  # type: ignore[override]
        """Without bounds, as many simulators do not keep to those that they state."""
        return dict.fromkeys((f"obs_{i}" for i in range(self.facts.observations)), (-np.inf, np.inf))

    @property
    def action_space(self) -> spaces.Box | spaces.Discrete:  # type: ignore[override]
        """In [-1, 1], or from 0 up."""
        space = self.facts.space
        return spaces.Discrete(space.n) if isinstance(space, spaces.Discrete) else spaces.Box(-1.0, 1.0, space.shape)

    @property
    def expert_noise(self) -> Any:  # type: ignore[override]
        """Standard deviation [A] where actions are in [-1, 1]; the share of random ones where they are discrete."""
        space, noise = self.facts.space, self.facts.noise
        scale = 1.0 if isinstance(space, spaces.Discrete) else np.subtract(*bounds(space)[::-1]) / 2
        return np.maximum(noise / scale, LEAST_NOISE)

    def make(self, theta: Array) -> gymnasium.Env[Any, Any]:
        """The world's environment of theta [L]. Raises InputError if it cannot be used."""
        env = made(self.name, self.facts.world, theta)
        theirs = (env.observation_space.shape, env.action_space)
        if theirs != (right := ((self.facts.observations,), self.facts.space)):
            raise InputError(f"make of {self.name} gave spaces {theirs} for {theta}, and {right} for another theta")
        return env

    def raw(self, action: Array) -> Any:
        """An agent's action [A] in the environment's units. Raises InputError for one that is not of `action_space`."""
        return self.in_units(self.check_action(np.asarray(action)[None], 1)[0])

    def in_units(self, action: Array) -> Any:
        """As `raw`, of an action that has been checked."""
        space = self.facts.space
        if isinstance(space, spaces.Discrete):
            return int(action[0]) + int(space.start)
        low, high = bounds(space)
        scaled = low + (action + 1) / 2 * (high - low)
        whole = np.issubdtype(space.dtype, np.integer)
        return (np.rint(scaled) if whole else scaled).clip(space.low, space.high).astype(space.dtype)

    def simulator(self, n: int) -> GymSimulator:
        return GymSimulator(self, n)

    def init_state(self, rng: Streams) -> Array:
        """The seed [N, 1] by which each environment is reset; `GymSimulator.start` gives the state."""
        return np.floor(rng.random((rng.groups, 1)) * 2**31)

    def sample_noise(self, rng: Streams) -> Array:
        """The seed of the noise of each episode [N, T, 1], the same in all of its steps."""
        seed = np.floor(rng.random((rng.groups, 1)) * 2**31)
        return np.broadcast_to(seed[:, None], (rng.groups, self.horizon, 1))

    def outcome(self, state: Array, action: Array, theta: Array) -> Array:
        raise InputError(f"{self.name} is a black box: only its simulator can be asked what follows")

    def apply_noise(self, outcome: Array, noise: Array) -> Array:
        """The outcome, which has its noise already."""
        return outcome

    def log_prob(self, next_state: Array, outcome: Array) -> Array:
        raise InputError(f"{self.name} is a black box: its likelihood is not known")

    def observe(self, state: Array) -> Array:
        return state[:, :-3]

    def reward(self, state: Array, action: Array, next_state: Array, theta: Array) -> Array:
        return next_state[:, -3]

    def terminated(self, state: Array) -> Mask:
        return state[:, -2] > 0

    def truncated(self, state: Array) -> Mask:
        return state[:, -1] > 0

    def renderer(self, theta: Array) -> Renderer:
        raise InputError(f"{self.name} is a black box: there are no pictures of its states")

    def sample_theta(self, rng: Streams) -> Array:
        return np.stack([drawn(self.name, self.facts.world, generator) for generator in rng.rngs])

    def theta_grid(self, k: int) -> Array:
        """Draws of theta [K, L] that stand for about as many draws each, however theta's numbers depend on each other.

        If k thetas or fewer occur, they are all there, each as often as its share asks for. Else draws are parted by
        the first number, each part by the second, and so on, as often as `Task.theta_grid` has values; of each part the
        middle is taken.
        """
        draws = self.facts.draws
        if draws.shape[1] == 1:
            return super().theta_grid(k)
        distinct, counts = np.unique(draws, axis=0, return_counts=True)
        if len(distinct) <= k:
            unit = max(counts.min(), len(draws) / k)  # a rare theta would else take thousands of the others beside it
            return np.repeat(distinct, np.maximum(1, np.rint(counts / unit)).astype(int), 0)
        each, parts, parted = self._values_each(k), [np.arange(len(draws))], 0
        while parted < draws.shape[1] and len(parts) * each <= len(draws) / LEAST_PART:
            in_order = (part[draws[part, parted].argsort(kind="stable")] for part in parts)
            parts, parted = [piece for part in in_order for piece in np.array_split(part, each)], parted + 1
        quantiles = np.stack([lat.cdf(draws[:, i]) for i, lat in enumerate(self.latents[:parted])], -1)
        off = [np.square(quantiles[part] - np.median(quantiles[part], 0)).sum(-1) for part in parts]
        return draws[[part[of.argmin()] for part, of in zip(parts, off, strict=True)]]

    def _check_bounds(self, theta: Array) -> None:
        if not np.isfinite(theta).all():
            raise InputError(f"theta of {self.name} was {theta.tolist()}; it must be finite")

    def _acted(self, obs: Array, theta: Array) -> Array:
        """The expert's actions [N, A] without noise, in [-1, 1] or from 0 up."""
        space, rows = self.facts.space, []
        for seen, hidden in zip(obs, theta, strict=True):
            with part(self.name, "expert"):
                given = self.facts.world.expert(seen.astype(float), hidden.copy())
                rows.append(as_numbers(given, f"expert of {self.name}").reshape(-1))
            right = () if isinstance(space, spaces.Discrete) else space.shape
            if rows[-1].size != np.prod(right) or not np.isfinite(rows[-1]).all():
                wrong = f"{given if given is None else rows[-1].tolist()} for an observation"
                raise InputError(f"expert of {self.name} gave {wrong}; it must be of shape {right}, finite, of {space}")
        action = np.reshape(rows, (len(obs), self.action_width))
        if not isinstance(space, spaces.Discrete):
            low, high = bounds(space)
            return np.clip(2 * (action - low) / (high - low) - 1, -1, 1)
        if not np.isin(action, space.start + np.arange(space.n)).all():
            wrong = action[~np.isin(action, space.start + np.arange(space.n))][0]
            raise InputError(f"expert of {self.name} gave the action {wrong:g}; it must be one of {space}")
        return action - space.start

    def expert_mean(self, obs: Array, theta: Array) -> Array:
        """Mean actions [N, A], in [-1, 1], where actions are continuous."""
        return self._acted(obs, theta)

    def expert_probs(self, obs: Array, theta: Array) -> Array:
        chosen = self._acted(obs, theta)[:, 0].astype(int)
        return (1 - self.expert_noise) * np.eye(self.n_actions)[chosen] + self.expert_noise / self.n_actions


def task_of(cls: type) -> type[BlackBox]:
    """The class of a world's task, called as the world is. Raises InputError if parts of a world are missing."""
    missing = [name for name in PARTS if getattr(cls, name, None) is None]
    missing += [name for name in getattr(cls, "__abstractmethods__", ()) if name not in missing]
    if missing:
        raise InputError(f"world {cls.__name__} lacks {', '.join(missing)}; a world has {SHAPE}")
    name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", cls.__name__).lower()
    text = inspect.getdoc(cls) if cls.__doc__ else ""
    return type(cls.__name__, (BlackBox,), {"world": cls, "name": name, "__module__": cls.__module__, "__doc__": text})
