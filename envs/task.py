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
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal, Protocol

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from scipy.special import ndtr

from deconfounded.envs.streams import Array, Streams

ASSETS = Path(__file__).resolve().parents[1] / "assets"


class InputError(ValueError):
    """Bad input from outside: one line that says what was given and what would be right."""


@dataclass(frozen=True)
class Latent:
    """One hidden physical parameter and its distribution p(theta).

    distribution: `uniform` =U(low, high), `loguniform` =exp U(log low, log high), or `categorical`: the integers
    low..high, equally likely. drift: where it is not 0, the latent's quantile u = cdf(theta) walks at random from each
    episode of a trial to the next: u' = u + N(0, drift^2), reflected at 0 and 1, so that every episode's theta has the
    distribution. Raises InputError for bounds that do not fit the distribution, and for a drift that is none.
    """

    name: str
    unit: str
    low: float
    high: float
    distribution: Literal["uniform", "loguniform", "categorical"] = "uniform"
    drift: float = 0.0

    def __post_init__(self) -> None:
        rules = {
            "uniform": ("low < high", True),
            "loguniform": ("0 < low < high", self.low > 0),
            "categorical": ("whole numbers low < high", self.low % 1 == 0 == self.high % 1),
        }
        if self.distribution not in rules:
            raise InputError(
                f"distribution of {self.name} was {self.distribution!r}; it must be one of {', '.join(rules)}"
            )
        right, holds = rules[self.distribution]
        if not (holds and -np.inf < self.low < self.high < np.inf):
            raise InputError(f"{self.name} was {self.low:g} to {self.high:g}, {self.distribution}; it must be {right}")
        if not 0 <= self.drift <= 1 or (self.drift and self.distribution == "categorical"):
            raise InputError(
                f"drift of {self.name} was {self.drift:g}; it must be from 0 to 1, and 0 of a categorical latent"
            )

    def ppf(self, u: Array) -> Array:
        """Quantiles: u in [0, 1) of any shape -> theta of the same shape."""
        if self.distribution == "uniform":
            return self.low + np.asarray(u) * (self.high - self.low)
        if self.distribution == "loguniform":
            return self.low * (self.high / self.low) ** np.asarray(u)
        return np.floor(self.low + np.asarray(u) * (self.high - self.low + 1))

    def cdf(self, theta: Array) -> Array:
        """The inverse of ppf; for a categorical latent the lower edge of its bin."""
        if self.distribution == "uniform":
            return (theta - self.low) / (self.high - self.low)
        if self.distribution == "loguniform":
            return np.log(theta / self.low) / np.log(self.high / self.low)
        return (theta - self.low) / (self.high - self.low + 1)

    def grid(self, k: int) -> Array:
        """[K] equally likely values: the mid-quantiles, or every category."""
        if self.distribution == "categorical":
            return np.arange(self.low, self.high + 1)
        return self.ppf((np.arange(k) + 0.5) / k)

    def encode(self, theta: Array) -> Array:
        """theta [...] -> features [..., F]: one-hot if categorical, else 2 cdf - 1 in [-1, 1]."""
        if self.distribution == "categorical":
            return (np.asarray(theta)[..., None] == self.grid(0)).astype(float)
        return (2 * self.cdf(np.asarray(theta)) - 1)[..., None]

    def drifted(self, theta: Array, normal: Array) -> Array:
        """theta [...] of the next episode of a trial, by standard normal draws of the same shape."""
        u = np.abs(self.cdf(theta) + self.drift * normal) % 2  # unfolded, the reflected walk is periodic
        return self.ppf(np.minimum(u, 2 - u)).clip(self.low, self.high)

    def transition(self, k: int) -> Array:
        """P(value j in the next episode | value i) [K, K] of `grid(k)`, from each value to the bins of all.

        The walk's density is a sum over its images, u' + 2 m and -u' + 2 m. Rows and columns sum to one.
        """
        k = self.features if self.distribution == "categorical" else k
        if not self.drift:
            return np.eye(k)
        u, edges = (np.arange(k) + 0.5) / k, np.arange(k + 1) / k
        images = 2.0 * np.arange(-3, 4)[:, None, None]
        ahead = ndtr((edges + images - u[:, None]) / self.drift)
        behind = ndtr((images - edges - u[:, None]) / self.drift)
        return np.diff(ahead, axis=-1).sum(0) - np.diff(behind, axis=-1).sum(0)

    @property
    def features(self) -> int:
        """F, the width of `encode`."""
        return int(self.high - self.low) + 1 if self.distribution == "categorical" else 1


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
        width = 1 if isinstance(self.action_space, spaces.Discrete) else self.action_space.shape[0]
        try:
            array = np.asarray(action)
            if array.dtype.kind not in "biuf":
                raise TypeError
            array = array.astype(float)
        except (TypeError, ValueError):
            raise InputError(f"action of {self.name} was {action!r}; it must be numbers") from None
        if array.shape != (n, width):
            raise InputError(f"action of {self.name} had shape {array.shape}; it must be ({n}, {width})")
        if ignored is not None:
            array[ignored] = 0
        if not np.isfinite(array).all():
            raise InputError(f"action of {self.name} held NaN or infinity; every entry must be a finite number")
        if isinstance(self.action_space, spaces.Discrete):
            if ((array != np.floor(array)) | (array < 0) | (array >= self.action_space.n)).any():
                last = int(self.action_space.n) - 1
                raise InputError(f"action of {self.name} was {array.ravel()}; each must be a whole number 0..{last}")
            return array
        return np.clip(array, self.action_space.low, self.action_space.high)
