"""What every method is built from: networks, action and observation heads, and scaling to unit size."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from envs.task import Array
from experts.demos import Trials

Progress = Callable[[int, int, dict[str, float]], None]
"""Called as training goes: updates done, updates in all, losses by name."""

T = TypeVar("T", bound=nn.Module)


def no_progress(done: int, total: int, losses: dict[str, float]) -> None:
    """Report nothing."""


@contextmanager
def seeded(rng: np.random.Generator) -> Iterator[None]:
    """Initialise networks from rng and leave torch's global generator as it was."""
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(int(rng.integers(2**31)))  # of the CPU, where networks are made
        yield


def torch_generator(rng: np.random.Generator, device: str | torch.device = "cpu") -> torch.Generator:
    """A torch generator drawn from a numpy one."""
    return torch.Generator(device).manual_seed(int(rng.integers(2**31)))


def mlp(inputs: int, width: int, outputs: int) -> nn.Sequential:
    """Two hidden layers with ReLU."""
    return nn.Sequential(
        nn.Linear(inputs, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU(), nn.Linear(width, outputs)
    )


@dataclass(frozen=True)
class Signature:
    """The kind of data: O, A, the number of discrete actions (0: continuous), and whether observations are 0 or 1."""

    obs: int
    action: int
    actions: int
    binary: bool

    @staticmethod
    def of(trials: Trials) -> Signature:
        """Read off data. Observations that hold only 0 and 1 are modelled as Bernoulli, others as Gaussian."""
        binary = bool(np.isin(trials.obs, (0, 1)).all())
        return Signature(trials.obs.shape[-1], trials.action.shape[-1], trials.actions, binary)

    @property
    def action_features(self) -> int:
        """Width of an action as a network's input: one-hot if discrete."""
        return self.actions or self.action

    def encode_action(self, action: Tensor) -> Tensor:
        """[..., A] -> [..., action_features]."""
        return F.one_hot(action[..., 0].long(), self.actions).float() if self.actions else action


class Scaler(nn.Module):
    """(x - mean) / std, fitted to data once; columns that hardly vary keep their size."""

    mean: Tensor
    std: Tensor

    def __init__(self, data: Tensor) -> None:
        super().__init__()
        std = data.std(0)
        self.register_buffer("mean", data.mean(0))
        self.register_buffer("std", torch.where(std > 1e-6, std, torch.ones_like(std)))

    def forward(self, x: Tensor | NDArray[np.float32]) -> Tensor:
        return (torch.as_tensor(x, device=self.mean.device) - self.mean) / self.std


class Whitener(nn.Module):
    """Features to mean 0 and standard deviation 1: by a batch's own while training, by their running means after.

    Batch normalisation (Ioffe and Szegedy, 2015) without learned scales.
    """

    mean: Tensor
    variance: Tensor

    def __init__(self, features: int, momentum: float = 0.05) -> None:
        super().__init__()
        self.momentum = momentum
        self.register_buffer("mean", torch.zeros(features))
        self.register_buffer("variance", torch.ones(features))

    def forward(self, x: Tensor) -> Tensor:
        """[M, F] -> [M, F]."""
        mean, variance = self.mean, self.variance
        if self.training:
            mean, variance = x.mean(0), x.var(0, correction=0)
            self.mean.lerp_(mean.detach(), self.momentum)
            self.variance.lerp_(variance.detach(), self.momentum)
        return (x - mean) * torch.rsqrt(variance + 1e-5)


class ActionHead(nn.Module):
    """Features -> a distribution over actions: categorical, or Gaussian with a learned std for each input."""

    def __init__(self, features: int, width: int, signature: Signature) -> None:
        super().__init__()
        self.signature = signature
        self.net = mlp(features, width, signature.actions or 2 * signature.action)

    def _gaussian(self, features: Tensor) -> tuple[Tensor, Tensor]:
        mean, raw = self.net(features).chunk(2, -1)
        return mean, F.softplus(raw) + 0.01

    def log_prob(self, features: Tensor, action: Tensor) -> Tensor:
        """log pi(a | features) [...] of actions [..., A]."""
        if self.signature.actions:
            return F.log_softmax(self.net(features), -1).gather(-1, action[..., :1].long())[..., 0]
        mean, std = self._gaussian(features)
        return torch.distributions.Normal(mean, std, validate_args=False).log_prob(action).sum(-1)

    def sample(self, features: Tensor, rng: torch.Generator) -> Tensor:
        """Action [N, A]; continuous ones are clipped to [-1, 1]."""
        if self.signature.actions:
            return torch.multinomial(F.softmax(self.net(features), -1), 1, generator=rng).float()
        mean, std = self._gaussian(features)
        return (mean + std * torch.randn(mean.shape, generator=rng, device=rng.device)).clamp(-1, 1)


class DynamicsHead(nn.Module):
    """p_psi(s' | s, a, theta_hat): Bernoulli, or Gaussian about s + change, with one std a coordinate."""

    def __init__(self, latent: int, width: int, signature: Signature, obs: Scaler, change: Scaler) -> None:
        super().__init__()
        self.signature, self.obs, self.change = signature, obs, change
        self.net = mlp(signature.obs + signature.action_features + latent, width, signature.obs)
        self.log_std = nn.Parameter(torch.zeros(signature.obs))

    def log_prob(self, obs: Tensor, action: Tensor, next_obs: Tensor, theta_hat: Tensor) -> Tensor:
        """log p_psi [...] of next observations [..., O], in units of the scaled change if Gaussian."""
        inputs = [self.obs(obs), self.signature.encode_action(action), theta_hat]
        out = self.net(torch.cat(inputs, -1))
        if self.signature.binary:
            return -F.binary_cross_entropy_with_logits(out, next_obs, reduction="none").sum(-1)
        z = (self.change(next_obs - obs) - out) * torch.exp(-self.log_std)
        return (-0.5 * z**2 - self.log_std).sum(-1) - 0.5 * z.shape[-1] * float(np.log(2 * np.pi))


@dataclass
class Batch:
    """Trials as tensors: the steps that took place, episodes joined end to end, padded at the end of a trial.

    obs, next_obs [B, T, O]; action [B, T, A]; mask [B, T], 1 for a step and 0 for padding.
    """

    obs: Tensor
    action: Tensor
    next_obs: Tensor
    mask: Tensor

    @staticmethod
    def of(trials: Trials, device: str | torch.device = "cpu") -> Batch:
        """Join the episodes of each trial."""
        mask = trials.mask.reshape(len(trials), -1)
        order = np.argsort(~mask, axis=1, kind="stable")[:, : mask.sum(1).max()]

        def join(array: NDArray[np.float32]) -> Tensor:
            flat = array.reshape(*mask.shape, -1)
            return torch.as_tensor(np.take_along_axis(flat, order[..., None], 1), device=device)

        steps = join(mask.astype(np.float32))[..., 0]
        return Batch(join(trials.obs[:, :, :-1]), join(trials.action), join(trials.obs[:, :, 1:]), steps)

    @staticmethod
    def step(
        obs: NDArray[np.float32],
        action: Array,
        next_obs: NDArray[np.float32],
        alive: NDArray[np.bool_],
        device: torch.device,
    ) -> Batch:
        """One transition each of N trials, without a time axis."""
        return Batch(*(torch.as_tensor(x, dtype=torch.float32, device=device) for x in (obs, action, next_obs, alive)))

    def __getitem__(self, index: slice | Tensor | tuple[slice | Tensor | None, ...]) -> Batch:
        return Batch(self.obs[index], self.action[index], self.next_obs[index], self.mask[index])

    def __len__(self) -> int:
        return len(self.mask)
