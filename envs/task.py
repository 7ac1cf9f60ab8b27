"""The task contract: a problem with hidden physics, stated once over a batch axis.

Shape letters in the whole project:

    N environments   S state         O observation   A action   L latents
    B trials         E episodes      T steps         K grid values of theta
    Z noise draws a step             D dimensions of a learned latent

A *trial* is E episodes in a row under the same hidden theta, which may drift from episode to episode, or switch at
random steps. A discrete action is one integer column, so that actions are always [N, A]. A task holds no state of its
own: states, thetas and random streams are passed in.
"""

import copy
from abc import ABC, abstractmethod
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, Protocol, Self

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from deconfounded.envs.latent import Latent
from deconfounded.envs.streams import Array, Mask, Streams
from deconfounded.envs.support import outside
from deconfounded.envs.support.errors import InputError
from deconfounded.envs.support.spaces import action_sizes
from deconfounded.envs.theta import ThetaModel

ASSETS = Path(__file__).resolve().parents[1] / "assets"


class Renderer(Protocol):
    """A function from a state [S] and the action [A] that led to it to a picture [H, W, 3]."""

    def __call__(self, state: Array, action: Array) -> NDArray[np.uint8]: ...


class Simulator:
    """The noise-free part of p(s'|s, a, theta) for n environments, each with its own theta."""

    def __init__(self, task: "Task", n: int) -> None:
        self.task, self.theta = task, np.tile([lat.low for lat in task.latents], (n, 1)).astype(float)

    def set_theta(self, i: int, theta: Array) -> None:
        """Give environment i the latents theta [L]."""
        self.theta[i] = theta

    def start(self, rows: NDArray[np.int64], start: Array, noise: Array) -> Array:
        """Begin episodes in the environments `rows` [M], in states [M, S], with unit noise [M, T, Z]; their states."""
        return start

    def outcome(self, state: Array, action: Array, rows: NDArray[np.int64] | None = None) -> Array:
        """State [M, S], action [M, A] -> the noise-free outcome [M, ...], a control step later.

        rows [M]: the index of each row's environment, and so of its theta; None: all environments, in order.
        """
        return self.task.outcome(state, action, self.theta if rows is None else self.theta[rows])

    def close(self) -> None:
        """Give back what it holds beside memory: by default nothing."""


class Task(ThetaModel, ABC):
    """A family of MDPs M_theta with theta ~ p(theta), an observation that hides theta, and a reward for scoring.

    Transitions have two parts: a deterministic *outcome* (the next state of a physics engine, or the probability
    of a pay-out) and noise that acts on it, so that p(s'|s, a, theta) has a closed form. Sensors may depend on theta,
    too: their readings are part of the state, and have a likelihood of their own (`sense`, `log_sense`). How theta
    is drawn, drifts and switches follows from the latents (`ThetaModel`, envs/theta.py).
    """

    name: ClassVar[str]
    reference: ClassVar[str] = ""  # argument of `get` in any process: its name, or path/file.py:Class
    version: ClassVar[int] = 0
    tier: ClassVar[int | None] = 2  # of the paper, at which the interventional policy is identified; None: at none
    latents: ClassVar[tuple[Latent, ...]]
    horizon: ClassVar[int]
    episodes: ClassVar[int] = 5  # of one trial
    control_dt: ClassVar[float] = 1.0  # s
    moves_state: ClassVar[bool] = True  # False: theta acts through reward and readings alone
    has_likelihood: ClassVar[bool] = True  # False: a black box (envs/blackbox.py), of which there is no exact reference
    expert_noise: ClassVar[float] = 0.0  # std of the expert's action around its mean; the action range is [-1, 1]
    action_space: ClassVar[spaces.Box | spaces.Discrete]
    observation: ClassVar[dict[str, tuple[float, float]]]  # name -> bounds, in the order of `observe`

    @abstractmethod
    def init_state(self, rng: Streams) -> Array:
        """Initial states [N, S] ~ p(s_0), independent of theta; rng has a generator for each environment."""

    @abstractmethod
    def sample_noise(self, rng: Streams) -> Array:
        """Unit noise [N, T, Z] of whole episodes; rng has a generator for each environment."""

    @abstractmethod
    def outcome(self, state: Array, action: Array, theta: Array) -> Array:
        """State [N, S], action [N, A], theta [N, L] -> the noise-free outcome [N, ...] of a control step."""

    @abstractmethod
    def apply_noise(self, outcome: Array, noise: Array) -> Array:
        """Outcome [N, ...] and unit noise [N, Z] -> next state [N, S]."""

    @abstractmethod
    def log_prob(self, next_state: Array, outcome: Array) -> Array:
        """Log density log p(s'|s, a, theta) [...] of next states [..., S], given their noise-free outcome."""

    def sense(self, state: Array, theta: Array, noise: Array) -> Array:
        """State [N, S] after noise, theta [N, L], unit noise [N, Z] -> the state with its sensors' readings.

        By default there are no sensors. The first state of an episode has no readings, as `init_state` gets no theta.
        """
        return state

    def log_sense(self, state: Array, theta: Array) -> Array:
        """Log density [...] of the readings in states [..., S], given the rest of the state and theta [..., L]."""
        return np.zeros(np.broadcast_shapes(state.shape[:-1], theta.shape[:-1]))

    @abstractmethod
    def observe(self, state: Array) -> Array:
        """State [N, S] -> observation [N, O], in the units of `observation`."""

    @abstractmethod
    def reward(self, state: Array, action: Array, next_state: Array, theta: Array) -> Array:
        """Reward [N] of a step, at most 1. It is for scoring: imitators never see it."""

    def terminated(self, state: Array) -> Mask:
        """Whether the episode ends in a state [N, S] -> [N]; by default never."""
        return np.zeros(len(state), bool)

    def truncated(self, state: Array) -> Mask:
        """Whether the episode is cut off in a state [N, S] before its horizon -> [N]; by default never."""
        return np.zeros(len(state), bool)

    def simulator(self, n: int) -> Simulator:
        """A simulator of n environments, each with its own theta."""
        return Simulator(self, n)

    def expert_probs(self, obs: Array, theta: Array) -> Array | None:
        """Action probabilities [N, actions] of a closed-form expert; None where the expert is a network."""
        return None

    def expert_mean(self, obs: Array, theta: Array) -> Array | None:
        """Mean actions [N, A] of a closed-form expert, where actions are numbers; None where it is a network."""
        return None

    @property
    def has_closed_expert(self) -> bool:
        """Whether the task states its expert, which then has no weights."""
        return self.n_actions > 0 or type(self).expert_mean is not Task.expert_mean

    @abstractmethod
    def renderer(self, theta: Array) -> Renderer:
        """A renderer of an environment with theta [L]. Raises InputError where no picture can be made."""

    @property
    def home(self) -> Path:
        """The folder of its MJCF and its expert's weights: assets/, or that of the file of a task from outside."""
        cls = next(cls for cls in type(self).__mro__ if "name" in vars(cls))
        if cls.__module__.startswith(__package__):
            return ASSETS
        if (file := outside.source(cls)) is None:  # as of a class in a notebook
            right = "it must be in a .py file, or state `spec` and be given an --expert"
            raise InputError(f"task {self.name} has no folder for its model and its expert; {right}")
        return file.parent

    @property
    def observation_space(self) -> spaces.Box:
        """The box of observations; environments clip them to its finite bounds."""
        low, high = np.array(list(self.observation.values()), np.float32).T
        return spaces.Box(low, high)

    @property
    def n_actions(self) -> int:
        """The number of discrete actions; 0 if actions are continuous."""
        return action_sizes(self.action_space)[1]

    @property
    def is_bandit(self) -> bool:
        """Whether presets spend the bandit's amounts on it, which are many trials of few bits, or those of control."""
        return self.n_actions > 0

    @property
    def action_width(self) -> int:
        """A, the columns of an action: one if it is discrete."""
        return action_sizes(self.action_space)[0]

    @property
    def gym_id(self) -> str:
        """Gymnasium's id of the task, such as deconf/SlipperyCartpole-v1."""
        return f"deconf/{self.name.title().replace('_', '')}-v{self.version}"

    @property
    def tier_name(self) -> str:
        """The tier as tables have it: its number, or none."""
        return "none" if self.tier is None else str(self.tier)

    def without_switches(self) -> Self:
        """The same task, with a theta that holds still within episodes."""
        if not self.switches:
            return self
        return self.changed(latents=tuple(replace(latent, switch=0.0) for latent in self.latents))

    def changed(self, **attributes: Any) -> Self:
        """A copy of the task with other attributes; it shares what was computed of the rest, such as the model."""
        other = copy.copy(self)
        other.__dict__.update(attributes)
        return other

    def seen_theta(self, obs: Array, theta: Array) -> Array:
        """Features [N, F'] of theta [N, L] that experts are given at observations [N, O]; by default all."""
        return self.encode_theta(theta)

    @property
    def seen_width(self) -> int:
        """F', the width of `seen_theta`."""
        return self.theta_width

    def acting_theta(self, theta: Array, state: Array) -> Array:
        """Those of the latents [N, L] that act on a step from states [N, S]; by default all."""
        return theta

    def check_action(self, action: object, n: int, ignored: Mask | None = None) -> Array:
        """Any array-like -> [N, A] float. Raises InputError for a wrong shape, NaN, or an arm that does not exist.

        ignored [N]: rows that are not used, and that may hold any number.
        """
        try:
            array = np.asarray(action)
            if array.dtype.kind not in "biuf":
                raise TypeError
            array = array.astype(float)
        except (TypeError, ValueError, RuntimeError):  # the latter of a tensor with a gradient
            raise InputError(f"action of {self.name} was {action!r}; it must be numbers") from None
        if array.shape != (right := (n, self.action_width)):
            raise InputError(f"action of {self.name} had shape {array.shape}; it must be {right}")
        if ignored is not None:
            array[ignored] = 0
        if not np.isfinite(array).all():
            raise InputError(f"action of {self.name} held NaN or infinity; every entry must be a finite number")
        if isinstance(self.action_space, spaces.Box):
            return array.clip(self.action_space.low, self.action_space.high)
        wrong = (array != np.floor(array)) | (array < 0) | (array >= self.n_actions)
        if wrong.any():
            others = f", and {wrong.sum() - 1} others were as wrong" if wrong.sum() > 1 else ""
            each = f"each must be a whole number 0..{self.n_actions - 1}"
            raise InputError(f"action of {self.name} was {array[wrong][0]:g}{others}; {each}")
        return array
