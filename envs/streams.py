"""Random numbers for a batch of rows in groups, with an independent generator for each group."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.floating[Any]]
Mask = NDArray[np.bool_]
Obs = NDArray[np.float32]


class Streams:
    """Random numbers for rows in equal consecutive groups, each of which draws from its own generator.

    The number of rows in a size must be a multiple of `groups`: size (groups, K) is one row for each generator.
    """

    def __init__(self, rngs: Sequence[np.random.Generator]) -> None:
        self.rngs = list(rngs)
        self.groups = len(self.rngs)

    def random(self, size: tuple[int, ...]) -> Array:
        """Draws from U(0, 1) of a given size, whose first axis is rows: an equal group of them from each generator."""
        out = np.empty(size)
        for rng, rows in zip(self.rngs, out.reshape(self.groups, size[0] // self.groups, *size[1:]), strict=True):
            rng.random(out=rows)
        return out

    def standard_normal(self, size: tuple[int, ...]) -> Array:
        """Draws from N(0, 1) of a given size, whose first axis is rows: an equal group of them from each generator."""
        out = np.empty(size)
        for rng, rows in zip(self.rngs, out.reshape(self.groups, size[0] // self.groups, *size[1:]), strict=True):
            rng.standard_normal(out=rows)
        return out

    def uniform(self, low: ArrayLike, high: ArrayLike) -> Array:
        """Draws from U(low, high) with bounds [K], a row for each generator: K columns [K, groups], to be unpacked."""
        low, high = np.asarray(low, float), np.asarray(high, float)
        span = high - low
        return (low + span * self.random((self.groups, len(span)))).T


def unseeded(rng: np.random.Generator) -> np.random.Generator:
    """A generator in the same state that does not hold the seed from which this state came."""
    copy = np.random.Generator(type(rng.bit_generator)(0))
    copy.bit_generator.state = rng.bit_generator.state
    return copy


def generators(seed: int | None) -> list[np.random.Generator]:
    """Four generators of one environment: for theta, start, noise and theta's switches. None: fresh entropy."""
    return [np.random.Generator(np.random.PCG64(child)) for child in np.random.SeedSequence(seed).spawn(4)]
