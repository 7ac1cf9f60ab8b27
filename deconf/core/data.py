"""Random numbers and trials of S seeds side by side, as tensors with a leading axis of S."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from deconfounded.envs.streams import Array, Mask
from deconfounded.envs.support.errors import InputError
from deconfounded.experts.trials import Trials, check_trials, of_steps

Rngs = np.random.Generator | Sequence[np.random.Generator]
"""One generator for each seed; a single one stands for one seed."""

Source = Trials | Callable[[], Trials]
"""Trials, or a function that draws fresh ones; in as many equal groups as there are seeds."""


def as_generators(rng: Rngs) -> list[np.random.Generator]:
    """The list of generators, one a seed. Raises InputError for anything else, such as a number, and for none."""
    rngs = [rng] if isinstance(rng, np.random.Generator) else rng
    if not isinstance(rngs, Sequence) or not rngs or not all(isinstance(item, np.random.Generator) for item in rngs):
        raise InputError(f"random numbers were to come from {rng!r}; give np.random.default_rng(0), or a list of such")
    return list(rngs)


def trials_of(source: Source) -> Trials:
    """The trials of a source: the same each time, or fresh ones. Raises InputError for anything else, None, say."""
    trials = source() if callable(source) else source
    if not isinstance(trials, Trials):
        raise InputError(f"trials were {trials!r}; they must be Trials, or a function that returns Trials")
    return trials


def trials_and(what: str, given: Any) -> tuple[Trials, Any]:
    """The trials that a function returned, with an array beside them. Raises InputError for anything else.

    what: the array, for the error.
    """
    if not isinstance(given, Sequence) or len(given) != 2 or not isinstance(given[0], Trials):
        raise InputError(f"roll-outs were {type(given).__name__}; they must be Trials and {what}, as a tuple")
    return given[0], given[1]


def stacked(of_seeds: list[Tensor]) -> Tensor:
    """Tensors of each seed as one, [S, ...]."""
    return of_seeds[0][None] if len(of_seeds) == 1 else torch.stack(of_seeds)


class Draws:
    """S independent streams of random numbers: row s of every draw comes from generator s alone."""

    def __init__(self, rngs: Sequence[np.random.Generator], device: str | torch.device) -> None:
        self.device = torch.device(device)
        self._streams = [torch.Generator(device).manual_seed(int(rng.integers(2**31))) for rng in rngs]

    def __len__(self) -> int:
        return len(self._streams)

    def state_dict(self) -> dict[str, Tensor]:
        """The generators' states."""
        return {str(i): stream.get_state() for i, stream in enumerate(self._streams)}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore the generators' states."""
        for i, stream in enumerate(self._streams):
            stream.set_state(state[str(i)].cpu())  # checkpoints may be on a GPU

    def uniform(self, *shape: int) -> Tensor:
        """U(0, 1) [S, *shape]."""
        return stacked([torch.rand(shape, generator=g, device=self.device) for g in self._streams])

    def normal(self, *shape: int) -> Tensor:
        """N(0, 1) [S, *shape]."""
        return stacked([torch.randn(shape, generator=g, device=self.device) for g in self._streams])

    def integers(self, high: int, *shape: int) -> Tensor:
        """Uniform integers 0 .. high - 1, [S, *shape]."""
        return stacked([torch.randint(high, shape, generator=g, device=self.device) for g in self._streams])


@dataclass(frozen=True)
class Signature:
    """The kind of data: O, A, the number of discrete actions (0: continuous), and whether observations are 0 or 1."""

    obs: int
    action: int
    actions: int
    binary: bool

    @staticmethod
    def of(trials: Trials, *more: Trials) -> "Signature":
        """The signature of trials. Observations that are all 0 or 1 are modelled as Bernoulli, others as Gaussian.

        more: exploration, whose observations may be others than an expert's.
        """
        check_trials("training", trials)
        binary = all(np.isin(part.obs, (0, 1)).all() for part in (trials, *more))
        return Signature(trials.obs.shape[-1], trials.action.shape[-1], trials.actions, binary)

    def checked(self, explored: Source) -> Trials:
        """Explored trials. Raises InputError if they are of another kind than demonstrations of this signature."""
        trials = trials_of(explored)
        signature = Signature.of(trials)
        if replace(signature, binary=self.binary) != self:
            raise InputError(f"exploration is {signature}, demonstrations are {self}; they must agree")
        if self.binary and not signature.binary:
            raise InputError(
                "observations of exploration were not all 0 or 1, as they were before; explore more at first"
            )
        return trials

    @property
    def action_features(self) -> int:
        """Width of an action as a network's input: one-hot if discrete."""
        return self.actions or self.action

    def encode_action(self, action: Tensor) -> Tensor:
        """[..., A] -> [..., action_features]."""
        return F.one_hot(action[..., 0].long(), self.actions).float() if self.actions else action

    def randomise(self, action: Tensor, share: float, draws: Draws) -> Tensor:
        """Actions [S, N, A], each replaced by a uniformly random one with probability `share`."""
        uniform = draws.uniform(*action.shape[1:])
        other = (uniform * self.actions).floor() if self.actions else 2 * uniform - 1
        return torch.where(draws.uniform(action.shape[1], 1) < share, other, action)


def take(x: Tensor, index: Tensor) -> Tensor:
    """x [S, M, ...] at each seed's indices [S, K] -> [S, K, ...]."""
    rows = index if len(x) == 1 else index + x.shape[1] * torch.arange(len(x), device=index.device)[:, None]
    return x.flatten(0, 1).index_select(0, rows.flatten()).unflatten(0, index.shape)


def take_steps(x: Tensor, index: Tensor) -> Tensor:
    """x [S, B, T, ...] at indices [S, K] into the B T of each seed -> [S, K, ...]."""
    return take(x.flatten(1, 2), index)


def copied(array: NDArray[Any], device: torch.device) -> Tensor:
    """A copy of an array in single precision, in half of the time that `torch.tensor` takes for a few numbers."""
    return torch.from_numpy(np.array(array, order="C")).to(device=device, dtype=torch.float32)


def extent(x: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    """Least and largest value [S, 1, F] of x [S, B, T, F] where mask [S, B, T] is not 0."""
    padding = mask[..., None] == 0
    low, high = x.masked_fill(padding, torch.inf).amin((1, 2)), x.masked_fill(padding, -torch.inf).amax((1, 2))
    return low[:, None], high[:, None]


def joined(array: NDArray[Any], mask: Mask, seeds: int, device: str | torch.device = "cpu") -> Tensor:
    """What arrays [B, E, T, F] say of steps, as `Batch` has these [S, B / S, E T, F]: padding last."""
    took_place = mask.reshape(len(mask), -1)
    order = np.argsort(~took_place, axis=1, kind="stable")
    flat = np.take_along_axis(array.reshape(*took_place.shape, -1), order[..., None], 1).astype(np.float32, copy=False)
    return torch.as_tensor(flat.reshape(seeds, -1, *flat.shape[1:]), device=device)


def joined_trials(left: Tensor, right: Tensor) -> Tensor:
    """What is of the steps of trials [S, B, T, ...] and of others, with zeros at the end of the shorter ones."""
    steps = max(left.shape[2], right.shape[2])
    padded = (torch.cat([x, x.new_zeros(*x.shape[:2], steps - x.shape[2], *x.shape[3:])], 2) for x in (left, right))
    return torch.cat(list(padded), 1)


def joined_theta(trials: Trials, theta: Array, seeds: int, device: str | torch.device = "cpu") -> Tensor:
    """The theta [S, B, T, F] of each step of `Batch.of`, given that of episodes [B, E, F] or of steps [B, E, T, F].

    Raises InputError for theta of another shape, or that is not finite.
    """
    theta, steps = np.asarray(theta, float), trials.mask.shape
    if theta.ndim not in (3, 4) or theta.shape[: theta.ndim - 1] != steps[: theta.ndim - 1]:
        right = f"{(*steps[:2], 'F')} of episodes, or {(*steps, 'F')} of steps".replace("'", "")
        raise InputError(f"theta of trials had shape {theta.shape}; it must be {right}")
    if not np.isfinite(theta).all():
        raise InputError("theta of trials held NaN or infinity; it must be finite")
    return joined(of_steps(theta, trials.mask.shape[2]), trials.mask, seeds, device)


@dataclass
class Batch:
    """Trials of S seeds as tensors: the steps that took place, episodes joined end to end and padded at the end.

    obs, next_obs [S, B, T, O]; action [S, B, T, A]; mask [S, B, T], 1 for a step and 0 for padding.
    """

    obs: Tensor
    action: Tensor
    next_obs: Tensor
    mask: Tensor

    @staticmethod
    def of(trials: Trials, seeds: int, device: str | torch.device = "cpu") -> "Batch":
        """Join the episodes of each trial; trials are in `seeds` equal groups, one after another."""
        check_trials("training", trials)
        if len(trials) % seeds:
            right = "it must be a multiple of the number of seeds"
            raise InputError(f"{len(trials)} trials were given for {seeds} seeds; {right}")
        obs, action, next_obs, mask = (
            joined(array, trials.mask, seeds, device)
            for array in (trials.obs[:, :, :-1], trials.action, trials.obs[:, :, 1:], trials.mask[..., None])
        )
        return Batch(obs, action, next_obs, mask[..., 0])

    @staticmethod
    def step(obs: Tensor, action: NDArray[np.float32] | Array, next_obs: Tensor, alive: NDArray[np.bool_]) -> "Batch":
        """One transition each of S x N trials, without a time axis; obs, next_obs [S, N, O], the others in rows."""
        rows, mask = copied(action, obs.device), copied(alive, obs.device)
        return Batch(obs, rows.view(*obs.shape[:2], -1), next_obs, mask.view(obs.shape[:2]))

    def flat(self) -> "Batch":
        """All steps [S, B T] without a time axis, padding too."""
        return Batch(*(x.flatten(1, 2) for x in self.tensors))

    @property
    def tensors(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """obs, action, next_obs and mask."""
        return self.obs, self.action, self.next_obs, self.mask

    def __getitem__(self, index: slice | Tensor | tuple[slice | Tensor | int | None, ...]) -> "Batch":
        return Batch(*(x[index] for x in self.tensors))

    def trials(self, index: Tensor) -> "Batch":
        """Trials index[s] of each seed s, [S, K]."""
        return Batch(*(take(x, index) for x in self.tensors))

    def steps(self, index: Tensor) -> "Batch":
        """Steps index[s] [S, K] of each seed s, indices as in `draw_steps`; without a time axis."""
        return Batch(*(take_steps(x, index) for x in self.tensors))

    @cached_property
    def _step_count(self) -> Tensor:
        return self.mask.flatten(1).cumsum(1, dtype=torch.int64)

    def joined(self, other: "Batch") -> "Batch":
        """The trials of both batches, padded to the same length."""
        return Batch(*(joined_trials(*pair) for pair in zip(self.tensors, other.tensors, strict=True)))

    def beginnings(self, update: int, shortest: float) -> "Batch":
        """The first n steps of every trial; over updates 0, 1, 2, ... n is log-uniform between a share of them and all.

        In deployment beliefs are about beginnings of trials, and most is learned there. Long sequences are needed, but
        not in every update, where they would take most of the time. n follows the golden ratio's multiples, modulo 1,
        and is the same for all seeds: a random number would make seeds depend on each other.
        """
        golden = (5**0.5 - 1) / 2
        return self[:, :, : max(1, round(self.mask.shape[2] * shortest ** (golden * update % 1)))]

    def draw_trials(self, k: int | None, draws: Draws) -> "Batch":
        """k trials of each seed, uniformly, with replacement; None: all."""
        return self if k is None else self.trials(draws.integers(len(self), k))

    def draw_steps(self, k: int | None, draws: Draws) -> Tensor:
        """k steps that took place, uniformly, as indices [S, k] into the B T of each seed; None: all, padding too."""
        if k is None:
            return torch.arange(self.mask[0].numel(), device=self.mask.device).expand(len(self.mask), -1)
        cumulative = self._step_count
        count = cumulative[:, -1:]
        nth = (draws.uniform(k).double() * count).long().clamp(max=count - 1) + 1
        return torch.searchsorted(cumulative, nth)

    def __len__(self) -> int:
        return self.mask.shape[1]
