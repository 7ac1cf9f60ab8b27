"""Hidden physical parameters and their distributions.

A task lists them as `Task.latents`. Drawn values reach the physics in `Physics.set_theta` (envs/physics.py),
which has the task's `apply_latent` edit the compiled model (envs/edits.py).
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from deconfounded.envs.streams import Array
from deconfounded.envs.support.errors import InputError


def folded(u: Array) -> Array:
    """Quantiles [...] of a walk that is reflected at 0 and 1, from those of one that is not."""
    u = np.abs(u) % 2
    return np.minimum(u, 2 - u)


@dataclass(frozen=True)
class Latent:
    """One hidden physical parameter and its distribution p(theta).

    distribution: `uniform` =U(low, high), `loguniform` =exp U(log low, log high), or `categorical`: the integers
    low..high, equally likely. drift: where it is not 0, the latent's quantile u = cdf(theta) walks at random from each
    episode of a trial to the next: u' = u + N(0, drift^2), reflected at 0 and 1, so that every episode's theta has the
    distribution. switch: the probability that the latent is drawn anew after a step of an episode. Raises InputError
    for bounds that do not fit the distribution, and for an invalid drift or switch.
    """

    name: str
    unit: str
    low: float
    high: float
    distribution: Literal["uniform", "loguniform", "categorical"] = "uniform"
    drift: float = 0.0
    switch: float = 0.0

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not isinstance(self.unit, str):
            raise InputError(f"name and unit of a latent were {self.name!r} and {self.unit!r}; they must be texts")
        for part in ("low", "high", "drift", "switch"):
            if isinstance(value := getattr(self, part), bool) or not isinstance(value, int | float | np.number):
                raise InputError(f"{part} of latent {self.name} was {value!r}; it must be a number")
        rules = {
            "uniform": ("low < high", True),
            "loguniform": ("0 < low < high", self.low > 0),
            "categorical": ("whole numbers low < high", self.low % 1 == 0 == self.high % 1),
        }
        if not isinstance(self.distribution, str) or self.distribution not in rules:
            right = f"one of {', '.join(rules)}"
            raise InputError(f"distribution of {self.name} was {self.distribution!r}; it must be {right}")
        right, holds = rules[self.distribution]
        if not (holds and -np.inf < self.low < self.high < np.inf):
            raise InputError(f"{self.name} was {self.low:g} to {self.high:g}, {self.distribution}; it must be {right}")
        if not 0 <= self.drift <= 1 or (self.drift and self.distribution == "categorical"):
            right = "from 0 to 1, and 0 of a categorical latent"
            raise InputError(f"drift of {self.name} was {self.drift:g}; it must be {right}")
        if not 0 <= self.switch < 1:
            raise InputError(f"switch of {self.name} was {self.switch:g}; it must be from 0 to below 1, for each step")

    def ppf(self, u: Array) -> Array:
        """Quantiles: u in [0, 1) of any shape -> theta of the same shape."""
        if self.distribution == "uniform":
            return self.low + np.asarray(u) * (self.high - self.low)
        if self.distribution == "loguniform":
            return self.low * (self.high / self.low) ** np.asarray(u)
        return np.floor(self.low + np.asarray(u) * (self.high - self.low + 1))

    def cdf(self, theta: Array) -> Array:
        """Cumulative distribution [...] at theta [...], the inverse of ppf; of a categorical latent the lower edge."""
        if self.distribution == "uniform":
            return (theta - self.low) / (self.high - self.low)
        if self.distribution == "loguniform":
            return np.log(theta / self.low) / np.log(self.high / self.low)
        return (theta - self.low) / (self.high - self.low + 1)

    def grid(self, k: int) -> Array:
        """Equally likely values [K]: the mid-quantiles, or every category."""
        if self.distribution == "categorical":
            return np.arange(self.low, self.high + 1)
        return self.ppf((np.arange(k) + 0.5) / k)

    def encode(self, theta: Array) -> Array:
        """Features [..., F] of theta [...]: one-hot if categorical, else 2 cdf - 1 in [-1, 1]."""
        if self.distribution == "categorical":
            return (np.asarray(theta)[..., None] == self.grid(0)).astype(float)
        return (2 * self.cdf(np.asarray(theta)) - 1)[..., None]

    def drifted(self, theta: Array, normal: Array) -> Array:
        """Theta [...] of a trial's next episode, by standard normal draws of the same shape."""
        if not self.drift:  # of the same bits, beside a latent that drifts
            return theta
        return self.ppf(folded(self.cdf(theta) + self.drift * normal)).clip(self.low, self.high)

    def transition(self, k: int) -> Array:
        """Transition matrix [K, K] of `grid(k)`: P(bin of value j in the next episode | value i).

        The walk's density is a sum over its images, u' + 2 m and -u' + 2 m. Rows and columns sum to 1.
        """
        k = self.features if self.distribution == "categorical" else k
        if not self.drift:
            return np.eye(k)
        from scipy.special import ndtr  # takes half of what importing the environments would

        u, edges = (np.arange(k) + 0.5) / k, np.arange(k + 1) / k
        images = 2.0 * np.arange(-3, 4)[:, None, None]
        ahead = ndtr((edges + images - u[:, None]) / self.drift)
        behind = ndtr((images - edges - u[:, None]) / self.drift)
        return np.diff(ahead, axis=-1).sum(0) - np.diff(behind, axis=-1).sum(0)

    def switched(self, theta: Array, u: Array) -> Array:
        """Theta [...] of the next step, by draws u from U(0, 1) of the same shape.

        Where u is below `switch`, theta is drawn anew: u / switch, uniform too, is its quantile.
        """
        if not self.switch:
            return theta
        anew = u < self.switch
        return np.where(anew, self.ppf(np.where(anew, u / self.switch, 0)), theta)

    def switching(self, k: int) -> Array:
        """Transition matrix [K, K] of `grid(k)`: P(bin of value j at the next step | value i)."""
        k = self.features if self.distribution == "categorical" else k
        return (1 - self.switch) * np.eye(k) + self.switch / k

    @property
    def features(self) -> int:
        """F, the width of `encode`."""
        return int(self.high - self.low) + 1 if self.distribution == "categorical" else 1
