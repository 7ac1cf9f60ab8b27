"""Networks of S seeds side by side: layers, Adam, scaling to unit size, and heads for actions and observations.

S seeds train in one program: every parameter and every tensor has a leading axis of S. Seeds share nothing, so that a
seed's numbers are the same, bit for bit, whatever runs beside it.
"""

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from deconfounded.deconf.core.data import Batch, Draws, Signature
from deconfounded.envs.support.errors import InputError

ONEDNN_ABOVE = 16**3  # multiplications: torch hands larger products to oneDNN


def prepare_torch() -> None:
    """Set one thread, since the networks are small, and oneDNN for float32 products where it keeps float32.

    On AMD, MKL does not use AVX-512, and oneDNN takes half the time. The setting that selects oneDNN also allows it
    bfloat16, which it uses where there is AMX: there, and on processors without AVX-512, torch's default stays.
    """
    torch.set_num_threads(1)
    capabilities = torch.cpu.get_capabilities()
    if capabilities.get("avx512_f") and not capabilities.get("amx_bf16"):
        torch.backends.mkldnn.matmul.fp32_precision = "bf16"  # type: ignore[attr-defined]


prepare_torch()


def per_seed(statistic: Tensor, like: Tensor) -> Tensor:
    """[S, F] -> [S, 1, ..., 1, F], to broadcast against tensors [S, ..., F]."""
    return statistic.reshape(len(statistic), *[1] * (like.dim() - 2), -1)


def affine(bias: Tensor, rows: Tensor, weight: Tensor) -> Tensor:
    """bias [S, 1 or R, O] + rows [S, R, I] weight [S, I, O], with the same bits for a seed however many are stacked."""
    seeds, inputs, outputs = weight.shape
    # A stack of small products can exceed ONEDNN_ABOVE, and MKL has another path for vectors: bits would differ.
    if seeds > 1 and (rows.shape[1] * inputs * outputs <= ONEDNN_ABOVE or min(inputs, outputs) == 1):
        by_seed = zip(bias.split(1), rows.split(1), weight.split(1), strict=True)
        return torch.cat([torch.baddbmm(*operands) for operands in by_seed])
    return torch.baddbmm(bias, rows, weight)


class Linear(nn.Module):
    """S linear maps side by side: [S, ..., I] -> [S, ..., O]."""

    def __init__(self, inputs: int, outputs: int, draws: Draws) -> None:
        super().__init__()
        bound = inputs**-0.5
        self.weight = nn.Parameter((2 * draws.uniform(inputs, outputs) - 1) * bound)
        self.bias = nn.Parameter((2 * draws.uniform(1, outputs) - 1) * bound)

    def forward(self, x: Tensor) -> Tensor:
        out = affine(self.bias, x.reshape(len(x), -1, x.shape[-1]), self.weight)
        return out.reshape(*x.shape[:-1], out.shape[-1])


def mlp(inputs: int, width: int, outputs: int, draws: Draws) -> nn.Sequential:
    """An MLP with two hidden layers and ReLU."""
    return nn.Sequential(
        Linear(inputs, width, draws),
        nn.ReLU(),
        Linear(width, width, draws),
        nn.ReLU(),
        Linear(width, outputs, draws),
    )


class Adam:
    """Adam over stacked parameters, each seed's gradient clipped to norm 1; with `updates`, cosine decay."""

    def __init__(self, modules: Iterable[nn.Module], learning_rate: float, updates: int | None = None) -> None:
        modules = list(modules)
        self.parameters = list(dict.fromkeys(p for module in modules for p in module.parameters()))  # some are shared
        self._trained = ", ".join(type(module).__name__ for module in modules)
        self._adam = torch.optim.Adam(self.parameters, learning_rate)
        self._schedule = torch.optim.lr_scheduler.CosineAnnealingLR(self._adam, updates) if updates else None

    def state_dict(self) -> dict[str, Any]:
        """States of Adam and of the schedule."""
        schedule = {} if self._schedule is None else self._schedule.state_dict()
        return {"adam": self._adam.state_dict(), "schedule": schedule}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore both."""
        self._adam.load_state_dict(state["adam"])
        if self._schedule is not None:
            self._schedule.load_state_dict(state["schedule"])

    def step(self, loss: Tensor) -> None:
        """Take one step on losses [S]. Raises InputError, which names the update, where parameters would become NaN."""
        self._adam.zero_grad()
        loss.sum().backward()
        with torch.no_grad():
            # Parameter by parameter: a sum over a stack of them has another order for one seed than for several.
            squares = torch.as_tensor(
                sum(p.grad.flatten(1).square().sum(1) for p in self.parameters if p.grad is not None)
            )
            if not math.isfinite(sum(loss.flatten().tolist())) or math.isnan(sum(squares.flatten().tolist())):
                self._fail(loss)
            scale = (1 / (squares.sqrt() + 1e-6)).clamp(max=1)
            for p in self.parameters:
                if p.grad is not None:
                    p.grad *= scale.reshape(-1, *[1] * (p.dim() - 1))
        self._adam.step()
        if self._schedule is not None:
            self._schedule.step()

    def _fail(self, loss: Tensor) -> None:
        update = 1 + max((int(state["step"]) for state in self._adam.state.values()), default=0)
        value = next((x for x in loss.flatten().tolist() if not math.isfinite(x)), None)
        what = "its gradient was NaN" if value is None else f"it was {value}"
        raise InputError(
            f"the loss of {self._trained} failed in update {update}: {what}; a lower learning rate may help, or data of"
            " about unit size"
        )


def moments(x: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and variance [S, F] of x [S, ..., F] where mask [S, ...] is 1."""
    flat, weight = x.flatten(1, -2), mask.flatten(1)[..., None]
    count = weight.sum(1)
    mean = (flat * weight).sum(1) / count
    return mean, ((flat - mean[:, None]).square() * weight).sum(1) / count


class Scaler(nn.Module):
    """Standardises by mean and std of data [S, ..., F] where mask is 1; columns that hardly vary keep their scale."""

    mean: Tensor
    std: Tensor

    def __init__(self, data: Tensor, mask: Tensor) -> None:
        super().__init__()
        mean, variance = moments(data, mask)
        std = variance.sqrt()
        self.register_buffer("mean", mean)
        self.register_buffer("std", torch.where(std > 1e-6, std, torch.ones_like(std)))

    def forward(self, x: Tensor) -> Tensor:
        return (x - per_seed(self.mean, x)) / per_seed(self.std, x)


def scalers(data: Batch) -> tuple[Scaler, Scaler]:
    """Scalers of the observations, and of their changes in a step."""
    return Scaler(data.obs, data.mask), Scaler(data.next_obs - data.obs, data.mask)


class Inputs(nn.Module):
    """Preprocessing of networks' inputs: observations standardised, discrete actions one-hot."""

    def __init__(self, signature: Signature, obs: Scaler) -> None:
        super().__init__()
        self.signature, self.scaler = signature, obs
        self.obs_width, self.action_width = signature.obs, signature.action_features

    def obs(self, obs: Tensor) -> Tensor:
        """[S, ..., O] -> [S, ..., obs_width]."""
        return self.scaler(obs)

    def action(self, action: Tensor) -> Tensor:
        """[S, ..., A] -> [S, ..., action_width]."""
        return self.signature.encode_action(action)


class Embedding(Inputs):
    """The paper's preprocessing (appendix D): an MLP for observations and a linear map for actions, to 32 each."""

    def __init__(self, width: int, signature: Signature, obs: Scaler, draws: Draws) -> None:
        super().__init__(signature, obs)
        self.obs_width = self.action_width = 32
        self.embed_obs = mlp(signature.obs, width, 32, draws)
        self.embed_action = Linear(signature.action_features, 32, draws)

    def obs(self, obs: Tensor) -> Tensor:
        if self.signature.binary and self.signature.obs == 1:  # of one bit there are two embeddings: computed once
            zero, one = self.embed_obs(self.scaler(obs.new_tensor([[0.0], [1.0]]).expand(len(obs), 2, 1))).unbind(1)
            return torch.lerp(per_seed(zero, obs), per_seed(one, obs), obs)
        return self.embed_obs(self.scaler(obs))

    def action(self, action: Tensor) -> Tensor:
        return self.embed_action(self.signature.encode_action(action))


class Whitener(nn.Module):
    """Standardises features: by each batch's moments in the first updates, by running moments afterwards.

    Batch normalisation (Ioffe and Szegedy, 2015) that ends early: it is needed at the start of training alone, and the
    moments of exploration and of expert trials differ.
    """

    mean: Tensor
    variance: Tensor

    def __init__(self, features: int, draws: Draws, updates: int = 300, momentum: float = 0.05) -> None:
        super().__init__()
        self.updates_left, self.momentum = updates, momentum
        self.register_buffer("mean", torch.zeros(len(draws), features, device=draws.device))
        self.register_buffer("variance", torch.ones(len(draws), features, device=draws.device))

    def get_extra_state(self) -> Tensor:
        return torch.tensor(self.updates_left)

    def set_extra_state(self, state: Tensor) -> None:
        self.updates_left = int(state)

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        """x [S, ..., F]; moments are taken where mask [S, ...] is 1."""
        mean, variance = self.mean, self.variance
        if self.training and self.updates_left > 0:
            self.updates_left -= 1
            mean, variance = moments(x, mask)
            self.mean.lerp_(mean.detach(), self.momentum)
            self.variance.lerp_(variance.detach(), self.momentum)
        return (x - per_seed(mean, x)) * per_seed(torch.rsqrt(variance + 1e-5), x)


class ActionHead(nn.Module):
    """A distribution over actions given features: categorical, or Gaussian with mean and std from the network."""

    def __init__(self, features: int, width: int, signature: Signature, draws: Draws) -> None:
        super().__init__()
        self.signature = signature
        self.net = mlp(features, width, signature.actions or 2 * signature.action, draws)

    def _gaussian(self, features: Tensor) -> tuple[Tensor, Tensor]:
        mean, raw = self.net(features).chunk(2, -1)
        return mean, F.softplus(raw) + 0.01

    def log_prob(self, features: Tensor, action: Tensor) -> Tensor:
        """log pi(a | features) [S, ...] of actions [S, ..., A]."""
        if self.signature.actions:
            return F.log_softmax(self.net(features), -1).gather(-1, action[..., :1].long())[..., 0]
        mean, std = self._gaussian(features)
        return torch.distributions.Normal(mean, std, validate_args=False).log_prob(action).sum(-1)

    def sample(self, features: Tensor, draws: Draws) -> Tensor:
        """Draw actions [S, N, A]; continuous actions are clipped to [-1, 1]."""
        if self.signature.actions:
            return sample_index(F.softmax(self.net(features), -1), draws)[..., None].float()
        mean, std = self._gaussian(features)
        return (mean + std * draws.normal(*mean.shape[1:])).clamp(-1, 1)


def sample_index(probs: Tensor, draws: Draws) -> Tensor:
    """Draw an index [S, ...] from each row of probabilities [S, ..., K]."""
    cumulative = probs.cumsum(-1)
    u = draws.uniform(*probs.shape[1:-1], 1) * cumulative[..., -1:]
    return (u > cumulative).sum(-1).clamp(max=probs.shape[-1] - 1)


class DynamicsHead(nn.Module):
    """p_psi(s' | s, a, theta_hat): Bernoulli, or Gaussian with mean s + change and a learned std for each coordinate.

    `inputs` may be shared with other networks. copies: the number of models of the dynamics, in one network.
    """

    def __init__(self, latent: int, width: int, inputs: Inputs, change: Scaler, draws: Draws, copies: int = 1) -> None:
        super().__init__()
        self.inputs, self.change, self.copies = inputs, change, copies
        self.signature = inputs.signature
        self.net = mlp(inputs.obs_width + inputs.action_width + latent, width, copies * self.signature.obs, draws)
        self.log_std = nn.Parameter(torch.zeros(len(draws), self.signature.obs, device=draws.device))

    def forward(self, obs: Tensor, action: Tensor, theta_hat: Tensor | None = None) -> Tensor:
        """Logits, or means of the scaled change: [S, ..., copies, O]."""
        inputs = [self.inputs.obs(obs), self.inputs.action(action)]
        out = self.net(torch.cat(inputs if theta_hat is None else [*inputs, theta_hat], -1))
        return out.unflatten(-1, (self.copies, self.signature.obs))

    def log_prob(self, obs: Tensor, action: Tensor, next_obs: Tensor, theta_hat: Tensor | None = None) -> Tensor:
        """log p_psi [S, ..., copies] of next observations [S, ..., O], in units of the scaled change if Gaussian."""
        out = self(obs, action, theta_hat)
        if self.signature.binary:
            target = next_obs[..., None, :].expand_as(out)
            return -F.binary_cross_entropy_with_logits(out, target, reduction="none").sum(-1)
        log_std = per_seed(self.log_std, out)
        z = (self.change(next_obs - obs)[..., None, :] - out) * torch.exp(-log_std)
        return (-0.5 * z**2 - log_std).sum(-1) - 0.5 * z.shape[-1] * float(np.log(2 * np.pi))

    def sample(self, obs: Tensor, action: Tensor, theta_hat: Tensor, draws: Draws) -> Tensor:
        """Draw s' ~ p_psi [S, N, O]."""
        out = self(obs, action, theta_hat)[..., 0, :]
        if self.signature.binary:
            return (draws.uniform(*out.shape[1:]) < torch.sigmoid(out)).float()
        change = out + torch.exp(per_seed(self.log_std, out)) * draws.normal(*out.shape[1:])
        return obs + change * per_seed(self.change.std, out) + per_seed(self.change.mean, out)
