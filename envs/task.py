"""The task contract: one hidden-physics problem, stated once over a batch axis.

Shape letters, used in the whole project:

    N environments   S state         O observation   A action   L latents
    B trials         E episodes      T steps         K grid values of theta
    Z noise draws a step             D dimensions of a learned latent

A *trial* is E episodes in a row under one hidden theta, or under one that drifts from each to the next. A discrete
action is one integer column, so that actions are always [N, A]. A task holds no state of its own: states, thetas and
random streams are passed in.
"""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, ClassVar, Protocol

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from deconfounded.envs.latent import Latent
from deconfounded.envs.streams import Array, Streams
from deconfounded.envs.support.errors import InputError

ASSETS = Path(__file__).resolve().parents[1] / "assets"


def action_sizes(space: spaces.Space[Any]) -> tuple[int, int]:
    """A, the columns of an action, which are one if it is discrete; and the number of discrete actions, else 0."""
    return (space.shape or (1,))[0], int(space.n) if isinstance(space, spaces.Discrete) else 0


class Painter(Protocol):
    """State [S] and the action [A] that led to it -> picture [H, W, 3]."""

    def __call__(self, state: Array, action: Array) -> NDArray[np.uint8]: ...


class Simulator:
    """The noise-free part of p(s'|s, a, theta) for n environments, each with its own theta."""

    def __init__(self, task: Task, n: int) -> None:
        self.task, self.theta = task, np.tile([lat.low for lat in task.latents], (n, 1)).astype(float)

    def set_theta(self, i: int, theta: Array) -> None:
        """Give environment i the latents theta [L]."""
        self.theta[i] = theta

    def outcome(self, state: Array, action: Array, rows: NDArray[np.int64] | None = None) -> Array:
        """State [M, S], action [M, A] -> what the noise acts on [M, ...], one control step later.

        rows [M]: the environment, and so the theta, of each row; None: all, in order.
        """
        return self.task.outcome(state, action, self.theta if rows is None else self.theta[rows])


class Task(ABC):
    """A family of MDPs M_theta with theta ~ p(theta), an observation that hides theta, and a reward for scoring.

    Transitions have two parts: a deterministic *outcome* (the next state of a physics engine, or the probability
    of a pay-out) and noise that acts on it, so that p(s'|s, a, theta) has a closed form. Sensors may tell of theta,
    too: their readings are part of the state, and have a likelihood of their own (`sense`, `log_sense`).
    """

    name: ClassVar[str]
    reference: ClassVar[str] = ""  # what `get` knows it by in any process: its name, or where it is from
    version: ClassVar[int] = 0
    tier: ClassVar[int | None] = 2  # of the paper, that identifies the interventional policy; None: none does
    latents: ClassVar[tuple[Latent, ...]]
    horizon: ClassVar[int]
    episodes: ClassVar[int] = 5  # of one trial
    control_dt: ClassVar[float] = 1.0  # s
    moves_state: ClassVar[bool] = True  # False: theta acts through reward and readings alone, not through outcomes
    expert_noise: ClassVar[float] = 0.0  # std of the expert's action around its mean; the action range is [-1, 1]
    action_space: ClassVar[spaces.Box | spaces.Discrete]
    observation: ClassVar[dict[str, tuple[float, float]]]  # name -> bounds, in the order of `observe`

    @abstractmethod
    def init_state(self, rng: Streams) -> Array:
        """Start states [N, S] ~ p(s_0), independent of theta; rng has a generator for each environment."""

    @abstractmethod
    def sample_noise(self, rng: Streams) -> Array:
        """The unit noise of whole episodes [N, T, Z]; rng has a generator for each environment."""

    @abstractmethod
    def outcome(self, state: Array, action: Array, theta: Array) -> Array:
        """The noise-free outcome [N, ...] of one control step; state [N, S], action [N, A], theta [N, L]."""

    @abstractmethod
    def apply_noise(self, outcome: Array, noise: Array) -> Array:
        """Outcome [N, ...] and unit noise [N, Z] -> next state [N, S]."""

    @abstractmethod
    def log_prob(self, next_state: Array, outcome: Array) -> Array:
        """log p(s'|s, a, theta) [...] of next states [..., S] whose noise-free outcome is given."""

    def sense(self, state: Array, theta: Array, noise: Array) -> Array:
        """State [N, S] after noise, theta [N, L], unit noise [N, Z] -> the state with what its sensors read.

        By default there are none. At the start of an episode nothing is read yet, as `init_state` knows no theta.
        """
        return state

    def log_sense(self, state: Array, theta: Array) -> Array:
        """log p [...] of the readings in states [..., S], given what else is in them and theta [..., L]."""
        return np.zeros(np.broadcast_shapes(state.shape[:-1], theta.shape[:-1]))

    @abstractmethod
    def observe(self, state: Array) -> Array:
        """State [N, S] -> observation [N, O], in the units of `observation`."""

    @abstractmethod
    def reward(self, state: Array, action: Array, next_state: Array, theta: Array) -> Array:
        """[N], at most one a step. Imitators never see it: it scores them."""

    def terminated(self, state: Array) -> NDArray[np.bool_]:
        """[N] whether the episode ends in this state; by default never."""
        return np.zeros(len(state), bool)

    def simulator(self, n: int) -> Simulator:
        """n environments, each with its own theta."""
        return Simulator(self, n)

    def expert_probs(self, obs: Array, theta: Array) -> Array | None:
        """[N, actions] of a closed-form expert; None where the expert is a network under assets/experts."""
        return None

    @abstractmethod
    def painter(self, theta: Array) -> Painter:
        """Draws one environment of that theta [L]. Raises InputError where no picture can be made."""

    @property
    def home(self) -> Path:
        """The folder of its MJCF and of its expert's weights: assets/, or where the file of a task from outside is."""
        cls = next(cls for cls in type(self).__mro__ if "name" in vars(cls))
        return ASSETS if cls.__module__.startswith(__package__) else Path(inspect.getfile(cls)).resolve().parent

    @property
    def observation_space(self) -> spaces.Box:
        """Finite bounds, which `observe` clips to."""
        low, high = np.array(list(self.observation.values()), np.float32).T
        return spaces.Box(low, high)

    @property
    def n_actions(self) -> int:
        """The number of discrete actions; 0 if actions are continuous."""
        return action_sizes(self.action_space)[1]

    @property
    def action_width(self) -> int:
        """A, the columns of an action: one if it is discrete."""
        return action_sizes(self.action_space)[0]

    @property
    def theta_width(self) -> int:
        """F, the width of `encode_theta`."""
        return sum(latent.features for latent in self.latents)

    @property
    def gym_id(self) -> str:
        """deconf/SlipperyCartpole-v0, say."""
        return f"deconf/{self.name.title().replace('_', '')}-v{self.version}"

    def sample_theta(self, rng: Streams) -> Array:
        """theta [N, L] ~ p(theta); rng has a generator for each environment."""
        u = rng.random((rng.groups, len(self.latents)))
        return np.stack([lat.ppf(u[:, i]) for i, lat in enumerate(self.latents)], -1)

    @property
    def drifts(self) -> bool:
        """Whether theta changes between the episodes of a trial."""
        return any(lat.drift for lat in self.latents)

    def drifted(self, theta: Array, rng: Streams) -> Array:
        """theta [N, L] of a trial's next episode; rng has a generator for each environment."""
        normal = rng.standard_normal((rng.groups, len(self.latents)))
        return np.stack([lat.drifted(theta[:, i], normal[:, i]) for i, lat in enumerate(self.latents)], -1)

    def theta_grid(self, k: int) -> Array:
        """[K, L] equally likely thetas: k values of one latent; of L, k^(2 / (L + 1)) each, and all their combinations.

        Of two latents, 21 makes 7 x 7. A categorical latent has all of its values, whatever k.
        """
        axes = np.meshgrid(*(lat.grid(self._each(k)) for lat in self.latents), indexing="ij")
        return np.stack([axis.ravel() for axis in axes], -1)

    def _each(self, k: int) -> int:
        return max(2, int(k ** (2 / (len(self.latents) + 1)))) if len(self.latents) > 1 else k

    def transition(self, k: int) -> Array:
        """P(theta of the next episode | of this one) [K, K] on `theta_grid(k)`."""
        found: Array = np.ones((1, 1))
        for lat in self.latents:
            found = np.kron(found, lat.transition(self._each(k)))
        return found

    def encode_theta(self, theta: Array) -> Array:
        """theta [..., L] -> features [..., F] of about unit size, for experts and oracles alone."""
        return np.concatenate([lat.encode(theta[..., i]) for i, lat in enumerate(self.latents)], -1)

    def check_theta(self, theta: object, n: int) -> Array:
        """Any array-like -> [N, L]. Raises InputError for a wrong shape or a value out of bounds."""
        try:
            array = np.asarray(theta)
            if array.dtype.kind not in "iuf":
                raise TypeError
            array = np.broadcast_to(array.astype(float), (n, len(self.latents))).copy()
        except (TypeError, ValueError):
            raise InputError(
                f"theta of {self.name} was {theta!r}; it must be {len(self.latents)} number(s), or one row for each"
                f" of the {n} environment(s)"
            ) from None
        for i, lat in enumerate(self.latents):
            bad = ~((array[:, i] >= lat.low) & (array[:, i] <= lat.high))
            if lat.distribution == "categorical":
                bad |= array[:, i] != np.floor(array[:, i])
            if bad.any():
                kind = "a whole number" if lat.distribution == "categorical" else "a number"
                raise InputError(
                    f"{lat.name} of {self.name} was {array[bad, i][0]:g}; it must be {kind} from {lat.low:g} to"
                    f" {lat.high:g} {lat.unit}".rstrip()
                )
        return array

    def check_action(self, action: object, n: int, ignored: NDArray[np.bool_] | None = None) -> Array:
        """Any array-like -> [N, A] float. Raises InputError for a wrong shape, NaN, or an arm that does not exist.

        ignored [N]: rows that nothing will come of, and that may hold any number.
        """
        try:
            array = np.asarray(action)
            if array.dtype.kind not in "biuf":
                raise TypeError
            array = array.astype(float)
        except (TypeError, ValueError):
            raise InputError(f"action of {self.name} was {action!r}; it must be numbers") from None
        if array.shape != (n, self.action_width):
            wanted = (n, self.action_width)
            raise InputError(f"action of {self.name} had shape {array.shape}; it must be {wanted}")
        if ignored is not None:
            array[ignored] = 0
        if not np.isfinite(array).all():
            raise InputError(f"action of {self.name} held NaN or infinity; every entry must be a finite number")
        if isinstance(self.action_space, spaces.Box):
            return np.clip(array, self.action_space.low, self.action_space.high)
        if ((array != np.floor(array)) | (array < 0) | (array >= self.n_actions)).any():
            last = self.n_actions - 1
            raise InputError(f"action of {self.name} was {array.ravel()}; each must be a whole number 0..{last}")
        return array
