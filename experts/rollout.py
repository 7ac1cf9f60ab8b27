"""Roll-outs: trials, the data that imitators learn from; agents, which act in them; and the loop that runs them."""

from __future__ import annotations  # as what only type checkers import is no name at run time

import hashlib
import io
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from deconfounded.envs.streams import Array, Mask, Obs, Streams, generators, unseeded
from deconfounded.envs.support.errors import InputError
from deconfounded.envs.support.files import write_atomically
from deconfounded.envs.support.numbers import check_number, is_seed
from deconfounded.envs.support.spaces import action_sizes
from deconfounded.experts.arrays import LARGEST, check_rounding, numbers, padded, size

if TYPE_CHECKING:
    from deconfounded.envs.batch import BatchEnv
    from deconfounded.envs.task import Task
    from deconfounded.experts.policy import Expert


@dataclass(frozen=True, eq=False)
class Trials:
    """B trials of E episodes of T steps each, without theta. Arrays are read-only.

    obs [B, E, T + 1, O] float32; action [B, E, T, A] float32; mask [B, E, T] bool, whether step t took place (False
    once an episode has ended early); actions: the number of discrete actions, or 0 for actions in [-1, 1].
    What is given for steps that did not take place is replaced: by the observation before them, and by actions of 0.
    Raises InputError for shapes that do not fit each other, NaN, invalid actions, and values that float32 would lose.
    """

    obs: NDArray[np.float32]
    action: NDArray[np.float32]
    mask: Mask
    actions: int = 0

    def __post_init__(self) -> None:
        given = {name: numbers(name, getattr(self, name)) for name in ("obs", "action", "mask")}
        obs, action, mask = given.values()
        if mask.dtype != bool and not np.isin(mask, (0, 1)).all():
            raise InputError("mask of Trials held numbers other than 0 and 1; it must be bool")
        if not isinstance(self.actions, int | np.integer) or isinstance(self.actions, bool) or self.actions < 0:
            raise InputError(f"actions of Trials was {self.actions!r}; it must be how many there are, or 0")
        b, e, t = mask.shape if mask.ndim == 3 else (0, 0, 0)
        fit = obs.shape[:-1] == (b, e, t + 1) and action.shape[:-1] == (b, e, t)
        if not fit or 0 in (obs.shape[-1], action.shape[-1]):
            raise InputError(
                f"Trials of obs {obs.shape}, action {action.shape}, mask {mask.shape}; they must be"
                " [B, E, T + 1, O], [B, E, T, A] and [B, E, T]"
            )
        with np.errstate(over="ignore"):  # infinity is refused
            action = action.astype(np.float32)
        if not mask.any():
            raise InputError("Trials held no step that took place; their mask must be True somewhere")
        mask = mask.astype(bool)
        if not mask.all():
            obs, action = padded(obs, mask), np.where(mask[..., None], action, 0)
        if not (np.isfinite(obs).all() and np.isfinite(action).all()):
            raise InputError("Trials held NaN or infinity; every observation and action must be finite")
        if (far := size(obs)) > LARGEST:
            raise InputError(f"Trials held an observation of {far:g}; they must be at most {LARGEST:g} in size")
        if self.actions and not np.isin(action, np.arange(self.actions)).all():
            raise InputError(f"Trials held an action that is not one of 0..{self.actions - 1}")
        if not self.actions and (far := size(action)) > 1:
            raise InputError(f"Trials held an action of size {far:.9g}; actions must be in [-1, 1], or `actions` given")
        if not np.can_cast(obs.dtype, np.float32):
            check_rounding(obs, mask)
        for name, array, dtype in (("obs", obs, np.float32), ("action", action, np.float32), ("mask", mask, bool)):
            kept = np.array(array, dtype)
            kept.setflags(write=False)
            object.__setattr__(self, name, kept)

    def __len__(self) -> int:
        return len(self.mask)

    @property
    def sha256(self) -> str:
        """SHA-256 of shapes and contents, whatever file they are in."""
        digest = hashlib.sha256(f"{self.obs.shape} {self.action.shape} {self.actions}".encode())
        for array in (self.obs, self.action, self.mask):
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    @staticmethod
    def from_minari(source: Path | str) -> Trials:
        """The trials of a Minari data set's folder, without their thetas; other formats: `experts.datasets.read`."""
        from deconfounded.experts.datasets.logs import trials_of
        from deconfounded.experts.datasets.minari_sets import read_minari
        from deconfounded.experts.datasets.rows import Roles

        return trials_of([[read_minari(source)]], Roles())[0]

    def save(self, file: Path | str, made_of: str = "") -> None:
        """Write an .npz file atomically. made_of: identity of the data, which `load` compares."""
        buffer, arrays = io.BytesIO(), {"obs": self.obs, "action": self.action, "mask": self.mask}
        np.savez_compressed(buffer, **arrays, actions=self.actions, made_of=made_of)  # type: ignore[arg-type]
        write_atomically(Path(file), buffer.getvalue())

    @staticmethod
    def load(file: Path | str, made_of: str | None = None) -> Trials:
        """Read what `save` wrote. Raises InputError if the file is missing or damaged, or its `made_of` differs."""
        try:
            with np.load(file, allow_pickle=False) as data:
                if missing := {"obs", "action", "mask", "actions", "made_of"} - {*data}:
                    raise InputError(f"it lacks {min(missing)}; Trials.save writes such a file")
                if made_of not in (None, str(data["made_of"])):
                    raise InputError("it was made of something else")
                return Trials(data["obs"], data["action"], data["mask"], int(data["actions"]))
        except (InputError, OSError) as error:
            why = " ".join(str(error).split())
        except Exception:  # a damaged zip file raises many types of errors, and another kind of file still others
            why = "it is damaged, or no .npz file of Trials.save"
        raise InputError(f"no trials could be read from {file}: {why}")


def check_trials(what: str, given: object) -> None:
    """Raises InputError for what is no Trials. what: was given it."""
    if not isinstance(given, Trials):
        right = "Trials: of deconfounded.experts.datasets.read, or of arrays"
        raise InputError(f"{what} was given a {type(given).__name__}; it must be {right}")


def joined(parts: Sequence[Trials]) -> Trials:
    """Concatenate trials of the same shape."""
    obs, action, mask = (np.concatenate([getattr(part, key) for part in parts]) for key in ("obs", "action", "mask"))
    return Trials(obs, action, mask, parts[0].actions)


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


Seeds = int | Sequence[int]  # one for all trials, or one for each of equal groups of them


def thetas(task: Task, n: int, episodes: int, seed: Seeds) -> Array:
    """The theta of the roll-out that `run_trials` makes with these seeds, drawn once more."""
    streams = [generators(env_seed) for env_seed in trial_seeds(n, seed)]
    rng, switches = Streams([each[0] for each in streams]), Streams([each[3] for each in streams])
    theta, hidden = task.sample_theta(rng), []
    for e in range(episodes):
        theta = task.drifted(theta, rng) if task.drifts and e else theta
        if task.switches:
            path = task.theta_path(theta, switches)
            theta = path[:, -1]
        hidden.append(path[:, :-1] if task.switches else theta)
    return np.stack(hidden, 1)


def of_steps(theta: Array, steps: int) -> Array:
    """Theta of each step [B, E, T, L], from a roll-out's theta: of each episode [B, E, L], or of each step already."""
    return np.repeat(theta[:, :, None], steps, 2) if theta.ndim == 3 else theta


def _group_seeds(seed: Seeds) -> list[int]:
    """The seed of each group of trials. Raises InputError for anything else."""
    seeds = list(seed) if isinstance(seed, Sequence | np.ndarray) and not isinstance(seed, str | bytes) else [seed]
    if not seeds or not all(is_seed(first) for first in seeds):
        raise InputError(f"seed was {seed!r}; it must be a whole number from 0 up, or one for each group of trials")
    return [int(group) for group in seeds]


def trial_seeds(n: int, seed: int | Sequence[int]) -> list[int]:
    """The environments' seeds for n trials, in equal groups. Raises InputError where n is no multiple of the seeds."""
    seeds = _group_seeds(seed)
    if n % len(seeds):
        raise InputError(f"{n} trials were to share {len(seeds)} seeds; it must be as many for each")
    return [first + i for first in seeds for i in range(n // len(seeds))]


class Rollout(NamedTuple):
    """A roll-out, N trials of E episodes: the trials, their returns [N, E], and their theta.

    theta is [N, E, L], that of each episode; or, where it switches, [N, E, T, L], that of each step, after an episode's
    early end too. Learners are handed `trials` alone; returns and theta are for scoring, and theta for methods that
    declare it.
    """

    trials: Trials
    returns: Array
    theta: Array


def run_trials(env: BatchEnv, agent: Agent, episodes: int, seed: Seeds, theta: Array | None = None) -> Rollout:
    """Run an agent in N trials of `episodes` episodes each.

    seed: of the environments and, independently, of the agent; or a seed for each of equal consecutive groups of
    trials, each of which is the same, bit for bit, as it is alone. Trial i of a group has the seed `seed + i`: groups
    whose seeds are near each other share trials. theta [N, L]: None: drawn from p(theta). Raises InputError for an
    agent that reads other environments than `env`.
    """
    task, n = env.task, env.n
    check_number("episodes", episodes)
    if getattr(agent, "env", env) is not env and isinstance(agent.env, type(env)):  # type: ignore[attr-defined]
        raise InputError(f"{type(agent).__name__} reads the state or theta of other environments than it was to act in")
    each, seeds = trial_seeds(n, seed), _group_seeds(seed)
    obs = np.zeros((n, episodes, task.horizon + 1, len(task.observation)), np.float32)
    mask = np.zeros((n, episodes, task.horizon), bool)
    returns = np.zeros((n, episodes))
    hidden = []
    action = np.zeros((n, episodes, task.horizon, task.action_width), np.float32)
    for e in range(episodes):
        if e == 0:
            now = env.reset(each, None if theta is None else {"theta": theta})
            agent.begin(n)
        else:
            now = env.reset(options={"keep_theta": True})
        hidden.append(env.path[:, :-1].copy() if task.switches else env.theta.copy())
        agent.reset([unseeded(np.random.default_rng([first, 1, e])) for first in seeds])  # not the environments' seeds
        obs[:, e, 0] = now
        for t in range(task.horizon):
            alive = env.alive
            chosen = agent.act(now)
            then, reward, _, _ = env.step(chosen)
            if not task.n_actions:
                chosen = np.clip(chosen, -1, 1)  # as the environments did
            agent.observe(now, chosen, then, alive)
            obs[:, e, t + 1] = np.where(alive[:, None], then, obs[:, e, t])
            action[:, e, t] = np.where(alive[:, None], chosen, 0)
            mask[:, e, t] = alive
            returns[:, e] += reward
            now = then
            if not env.alive.any():
                obs[:, e, t + 2 :] = obs[:, e, t + 1 : t + 2]
                break
    return Rollout(Trials(obs, action, mask, task.n_actions), returns, np.stack(hidden, 1))
