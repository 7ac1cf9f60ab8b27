"""Networks of S seeds side by side: scaling to unit size, and heads for actions and observations.

Every parameter and every tensor has a leading axis of S.
"""

import math
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from deconfounded.deconf.core.data import Batch, Draws, Signature, extent
from deconfounded.deconf.core.layers import Linear, Mlp
from deconfounded.deconf.core.sizes import HEAVY


def per_seed(statistic: Tensor, like: Tensor) -> Tensor:
    """[S, F] -> [S, 1, ..., 1, F], to broadcast against tensors [S, ..., F]."""
    seeds, features = statistic.shape
    return statistic if seeds == 1 else statistic.view(seeds, *(1,) * (like.dim() - 2), features)


def moments(x: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and variance [S, F] of x [S, ..., F] where mask [S, ...] is 1."""
    flat, weight = x.flatten(1, -2), mask.flatten(1)[..., None]
    count = weight.sum(1).clamp(min=1)  # a seed may have drawn trials without a step
    mean = (flat * weight).sum(1) / count
    return mean, ((flat - mean[:, None]).square() * weight).sum(1) / count


def medians(x: Tensor, kept: Tensor) -> Tensor:
    """Medians [S, F] of x [S, N, F] where kept [S, N]; 0 of a seed that has no step."""
    return torch.stack(
        [rows[steps].median(0).values if steps.any() else rows[0] * 0 for rows, steps in zip(x, kept, strict=True)]
    )


class Scaler(nn.Module):
    """Standardises by mean and std of data [S, ..., F] where mask is 1; columns that hardly vary keep their scale.

    The rounded mean of a constant is not quite that constant, so that its std is not 0: it is known by its range.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, data: Tensor, mask: Tensor) -> None:
        super().__init__()
        mean, variance = moments(data, mask)
        std, size = variance.sqrt(), data.abs().flatten(1, -2).amax(1)
        low, high = extent(data.flatten(1, -2)[:, :, None], mask.flatten(1)[..., None])
        varies = (std > (1e-5 * size).clamp(max=1e-6)) & (high > low)[:, 0]
        self.register_buffer("mean", mean)
        self.register_buffer("std", torch.where(varies, std, torch.ones_like(std)))

    def forward(self, x: Tensor) -> Tensor:
        return (x - per_seed(self.mean, x)) / per_seed(self.std, x)

    def inverse(self, x: Tensor) -> Tensor:
        """The reverse of `forward`."""
        return x * per_seed(self.std, x) + per_seed(self.mean, x)


class LabelScaler(Scaler):
    """Standardises labels; those with heavy tails by arcsinh about their median first, in units of their usual size.

    Else a few large labels, of a bolus or a brake, set the unit, in which all others are a spike.
    """

    median: Tensor
    size: Tensor
    heavy: Tensor

    def __init__(self, data: Tensor, mask: Tensor) -> None:
        flat, kept = data.flatten(1, -2), mask.flatten(1) > 0
        mean, variance = moments(data, mask)
        fourth, _ = moments((data - per_seed(mean, data)).square().square(), mask)
        median = medians(flat, kept)
        usual = 1.48 * medians((flat - median[:, None]).abs(), kept)
        super().__init__(data, mask)
        self.register_buffer("median", median)
        self.register_buffer("size", torch.where(usual > 1e-6, usual, self.std))
        self.register_buffer("heavy", (fourth > (3 + HEAVY) * variance.square()) & (variance > 1e-12))
        bent = Scaler(self._bend(data), mask)
        self.mean, self.std = (torch.where(self.heavy, x, y) for x, y in ((bent.mean, self.mean), (bent.std, self.std)))

    def _bend(self, x: Tensor) -> Tensor:
        return torch.asinh((x - per_seed(self.median, x)) / per_seed(self.size, x))

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(torch.where(per_seed(self.heavy, x), self._bend(x), x))

    def inverse(self, x: Tensor) -> Tensor:
        flat = super().inverse(x)
        if not self.heavy.any():
            return flat
        raw = per_seed(self.median, x) + per_seed(self.size, x) * torch.sinh(flat)
        return torch.where(per_seed(self.heavy, x), raw, flat)


class Scales(nn.Module):
    """The kind of data, and how networks standardise it: observations, their changes in a step, actions and labels.

    `action` is for actions that a network reads, `label` for those that it imitates: an expert's are often a small part
    of the range that exploration covers.
    """

    def __init__(self, signature: Signature, data: Batch, label: Tensor, label_mask: Tensor) -> None:
        super().__init__()
        self.signature = signature
        self.obs, self.change = Scaler(data.obs, data.mask), Scaler(data.next_obs - data.obs, data.mask)
        self.action, self.label = Scaler(data.action, data.mask), LabelScaler(label, label_mask)

    @staticmethod
    def of(signature: Signature, expert: Batch, explored: Batch | None = None) -> "Scales":
        """Those of expert trials, and of exploration: changes of random actions alone can be far smaller, and theta is
        then learned poorly."""
        return Scales(signature, explored.joined(expert) if explored else expert, expert.action, expert.mask)

    @staticmethod
    def plain(signature: Signature, seeds: int) -> "Scales":
        """Those that change nothing."""
        obs, action = (torch.zeros(seeds, 1, 2, n) for n in (signature.obs, signature.action))
        mask = torch.ones(seeds, 1, 2)
        return Scales(signature, Batch(obs, action, obs, mask), action, mask)

    def encode(self, action: Tensor) -> Tensor:
        """Actions [S, ..., A] as a network's input [S, ..., action_features]: standardised, or one-hot if discrete."""
        return self.signature.encode_action(action if self.signature.actions else self.action(action))


class Inputs(nn.Module):
    """Preprocessing of networks' inputs: observations and actions standardised, discrete actions one-hot."""

    def __init__(self, scales: Scales) -> None:
        super().__init__()
        self.signature, self.scales = scales.signature, scales
        self.obs_width, self.action_width = self.signature.obs, self.signature.action_features

    def obs(self, obs: Tensor) -> Tensor:
        """[S, ..., O] -> [S, ..., obs_width]."""
        return self.scales.obs(obs)

    def action(self, action: Tensor) -> Tensor:
        """[S, ..., A] -> [S, ..., action_width]."""
        return self.scales.encode(action)


class Embedding(Inputs):
    """The paper's preprocessing (appendix D): an MLP for observations and a linear map for actions, to 32 each."""

    def __init__(self, width: int, scales: Scales, draws: Draws) -> None:
        super().__init__(scales)
        signature = scales.signature
        self.obs_width = self.action_width = 32
        self.embed_obs = Mlp(signature.obs, width, 32, draws)
        self.embed_action = Linear(signature.action_features, 32, draws)

    def obs(self, obs: Tensor) -> Tensor:
        if self.signature.binary and self.signature.obs == 1:  # of one bit there are two embeddings: computed once
            zero, one = self.embed_obs(self.scales.obs(obs.new_tensor([[0.0], [1.0]]).expand(len(obs), 2, 1))).unbind(1)
            return torch.lerp(per_seed(zero, obs), per_seed(one, obs), obs)
        return self.embed_obs(self.scales.obs(obs))

    def action(self, action: Tensor) -> Tensor:
        return self.embed_action(self.scales.encode(action))


class Whitener(nn.Module):
    """Standardises features: by each batch's moments in the first updates, by running moments afterwards.

    Batch normalisation (Ioffe and Szegedy, 2015) that ends early: it is needed at the start of training alone, and the
    moments of exploration and of expert trials differ.
    """

    mean: Tensor
    variance: Tensor

    updates_left = 300
    momentum = 0.05

    def __init__(self, features: int, draws: Draws) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(len(draws), features, device=draws.device))
        self.register_buffer("variance", torch.ones(len(draws), features, device=draws.device))

    def get_extra_state(self) -> Tensor:
        return torch.tensor(self.updates_left)

    def set_extra_state(self, state: Tensor) -> None:
        self.updates_left = int(state)

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        """x [S, ..., F]; moments are taken where mask [S, ...] is 1."""
        mean, variance = self.mean, self.variance
        if self.training and torch.is_grad_enabled() and self.updates_left > 0:
            self.updates_left -= 1
            mean, variance = moments(x, mask)
            self.mean.lerp_(mean.detach(), self.momentum)
            self.variance.lerp_(variance.detach(), self.momentum)
        return (x - per_seed(mean, x)) * per_seed(torch.rsqrt(variance + 1e-5), x)


class GaussianLogProb(torch.autograd.Function):
    """log N(x; mean, std^2), summed over the last axis, differentiable in mean and std; all [..., D]."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, mean: Tensor, std: Tensor) -> Tensor:
        z = (x - mean).div_(std)
        ctx.save_for_backward(z, std)
        return torch.addcmul(std.log(), z, z, value=0.5).add_(0.5 * math.log(2 * math.pi)).sum(-1).neg_()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[None, Tensor, Tensor]:
        z, std = ctx.saved_tensors
        by_mean = grads[0][..., None] * (z / std)
        return None, by_mean, torch.addcmul(-grads[0][..., None] / std, by_mean, z)


def gaussian_log_prob(x: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    """log N(x; mean, std^2) of x [..., D], summed over the last axis."""
    return GaussianLogProb.apply(x, mean, std)


class ActionHead(nn.Module):
    """A distribution over actions given features: categorical, or Gaussian with mean and std from the network.

    Gaussians are of standardised labels, and so are their log-densities, so that units of actions do not matter.
    """

    def __init__(self, features: int, width: int, scales: Scales, draws: Draws) -> None:
        super().__init__()
        self.signature, self.scaler = scales.signature, scales.label
        signature = scales.signature
        self.net = Mlp(features, width, signature.actions or 2 * signature.action, draws)

    def _gaussian(self, features: Tensor) -> tuple[Tensor, Tensor]:
        mean, raw = self.net(features).chunk(2, -1)
        return mean, F.softplus(raw) + 0.01

    def log_prob(self, features: Tensor, action: Tensor) -> Tensor:
        """log pi(a | features) [S, ...] of actions [S, ..., A]."""
        if self.signature.actions:
            return F.log_softmax(self.net(features), -1).gather(-1, action[..., :1].long())[..., 0]
        return gaussian_log_prob(self.scaler(action), *self._gaussian(features))

    def sample(self, features: Tensor, draws: Draws) -> Tensor:
        """Draw actions [S, N, A]; continuous actions are clipped to [-1, 1]."""
        if self.signature.actions:
            return sample_index(F.softmax(self.net(features), -1), draws)[..., None].float()
        mean, std = self._gaussian(features)
        return self.scaler.inverse(mean + std * draws.normal(*mean.shape[1:])).clamp(-1, 1)


def sample_index(probs: Tensor, draws: Draws) -> Tensor:
    """Draw an index [S, ...] from each row of probabilities [S, ..., K]."""
    cumulative = probs.cumsum(-1)
    u = draws.uniform(*probs.shape[1:-1], 1) * cumulative[..., -1:]
    return (u > cumulative).sum(-1).clamp(max=probs.shape[-1] - 1)
