"""Theta of a task, all of its latents together: its distribution, changes, grid and features.

envs/latent.py states a single latent. Latents are independent, unless a task says otherwise. Shape letters are those of
envs/task.py.
"""

from functools import reduce
from typing import ClassVar

import numpy as np

from deconfounded.envs.latent import Latent
from deconfounded.envs.streams import Array, Streams
from deconfounded.envs.support.errors import InputError


class ThetaModel:
    """What a task says of theta [L]: p(theta), how it drifts and switches, its grid, and features of it."""

    name: ClassVar[str]
    latents: ClassVar[tuple[Latent, ...]]
    horizon: ClassVar[int]

    def sample_theta(self, rng: Streams) -> Array:
        """Draws theta [N, L] ~ p(theta); rng has a generator for each environment."""
        u = self.quantile(rng.random((rng.groups, len(self.latents))))
        return np.stack([lat.ppf(u[:, i]) for i, lat in enumerate(self.latents)], -1)

    def quantile(self, u: Array) -> Array:
        """Uniform numbers [N, L] -> the quantiles of p(theta) at which theta is drawn; the same, unless restricted."""
        return u

    @property
    def draws_by_latents(self) -> bool:
        """Whether theta is drawn from its latents' ranges, and not by a `sample_theta` of the task's own."""
        return type(self).sample_theta is ThetaModel.sample_theta

    @property
    def drifts(self) -> bool:
        """Whether theta changes between the episodes of a trial."""
        return any(lat.drift for lat in self.latents)

    def drifted(self, theta: Array, rng: Streams) -> Array:
        """Theta [N, L] of a trial's next episode; rng has a generator for each environment."""
        normal = rng.standard_normal((rng.groups, len(self.latents)))
        return np.stack([lat.drifted(theta[:, i], normal[:, i]) for i, lat in enumerate(self.latents)], -1)

    @property
    def switches(self) -> bool:
        """Whether theta changes within episodes."""
        return any(lat.switch for lat in self.latents)

    def theta_path(self, theta: Array, rng: Streams) -> Array:
        """Theta [N, T + 1, L] at each step of an episode that starts with theta [N, L], and after its last step.

        It does not depend on what happens in the episode: one that ends early is waited out.
        """
        u, path = rng.random((rng.groups, self.horizon, len(self.latents))), [theta]
        for t in range(self.horizon):
            pairs = enumerate(self.latents)
            path.append(np.stack([lat.switched(path[-1][:, i], u[:, t, i]) for i, lat in pairs], -1))
        return np.stack(path, 1)

    def theta_grid(self, k: int) -> Array:
        """A grid of equally likely thetas [K, L]. Of a single latent it has k values, K = k.

        Of L latents it has all combinations of m values of each, K = m^L, with m = floor(k^(2 / (L + 1))), at least 2;
        K may be more than k: of two latents, k = 21 makes 7 x 7. A categorical latent has all of its values, for any k.
        """
        axes = np.meshgrid(*(lat.grid(self._values_each(k)) for lat in self.latents), indexing="ij")
        return np.stack([axis.ravel() for axis in axes], -1)

    def _values_each(self, k: int) -> int:
        return max(2, int(k ** (2 / (len(self.latents) + 1)) + 1e-9)) if len(self.latents) > 1 else k

    def transition(self, k: int) -> Array:
        """Transition matrix [K, K] on `theta_grid(k)`: P(theta of the next episode | theta of this episode)."""
        return reduce(np.kron, (lat.transition(self._values_each(k)) for lat in self.latents))

    def switching(self, k: int) -> Array:
        """Transition matrix [K, K] on `theta_grid(k)`: P(theta of the next step | theta of this step)."""
        return reduce(np.kron, (lat.switching(self._values_each(k)) for lat in self.latents))

    def encode_theta(self, theta: Array) -> Array:
        """Features [..., F] of theta [..., L], of about unit size, for experts and oracles alone."""
        return np.concatenate([lat.encode(theta[..., i]) for i, lat in enumerate(self.latents)], -1)

    @property
    def theta_width(self) -> int:
        """F, the width of `encode_theta`."""
        return sum(latent.features for latent in self.latents)

    def check_theta(self, theta: object, n: int) -> Array:
        """Any array-like -> [N, L]. Raises InputError for a wrong shape or a value out of bounds."""
        try:
            array = np.asarray(theta)
            if array.dtype.kind not in "iuf":
                raise TypeError
            if array.shape[-1:] != (width := (len(self.latents),)) and (array.shape, width) != ((), (1,)):
                raise ValueError
            array = np.broadcast_to(array.astype(float), (n, *width)).copy()
        except (TypeError, ValueError):
            right = f"{len(self.latents)} number(s), or one row for each of the {n} environment(s)"
            raise InputError(f"theta of {self.name} was {theta!r}; it must be {right}") from None
        self._check_bounds(array)
        return array

    def _check_bounds(self, theta: Array) -> None:
        """Raises InputError for a theta [N, L] that cannot be drawn."""
        for column, lat in zip(theta.T, self.latents, strict=True):
            whole = lat.distribution == "categorical"
            bad = column[~((column >= lat.low) & (column <= lat.high)) | whole & (column != np.floor(column))]
            if bad.size:
                right = f"a {'whole ' * whole}number from {lat.low:g} to {lat.high:g} {lat.unit}".rstrip()
                raise InputError(f"{lat.name} of {self.name} was {bad[0]:g}; it must be {right}")
