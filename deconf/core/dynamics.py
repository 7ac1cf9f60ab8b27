"""Networks for the dynamics p_psi(s' | s, a, theta_hat)."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from deconfounded.deconf.core.data import Draws
from deconfounded.deconf.core.layers import Mlp, affine
from deconfounded.deconf.core.nets import Inputs, gaussian_log_prob, per_seed


class DynamicsHead(nn.Module):
    """p_psi(s' | s, a, theta_hat): Bernoulli, or Gaussian with mean s + change and a learned std for each coordinate.

    `inputs` may be shared with other networks.
    """

    def __init__(self, latent: int, width: int, inputs: Inputs, draws: Draws) -> None:
        super().__init__()
        self.inputs, self.change = inputs, inputs.scales.change
        self.signature = inputs.signature
        self.net = Mlp(inputs.obs_width + inputs.action_width + latent, width, self.signature.obs, draws)
        self.log_std = nn.Parameter(torch.zeros(len(draws), self.signature.obs, device=draws.device))

    def forward(self, obs: Tensor, action: Tensor, theta_hat: Tensor | None = None) -> Tensor:
        """Logits, or means of the scaled change: [S, ..., 1, O]; of K models [S, ..., K, O]."""
        inputs = [self.inputs.obs(obs), self.inputs.action(action)]
        return self.net(torch.cat(inputs if theta_hat is None else [*inputs, theta_hat], -1))[..., None, :]

    def mean(self, obs: Tensor, action: Tensor, theta_hat: Tensor) -> Tensor:
        """The mean of the scaled change [S, ..., O]."""
        out = self(obs, action, theta_hat)[..., 0, :]
        return self.change(torch.sigmoid(out) - obs) if self.signature.binary else out

    def log_prob(self, obs: Tensor, action: Tensor, next_obs: Tensor, theta_hat: Tensor | None = None) -> Tensor:
        """log p_psi [S, ..., 1 or K] of next observations [S, ..., O], in units of the scaled change if Gaussian."""
        out = self(obs, action, theta_hat)
        if self.signature.binary:
            target = next_obs[..., None, :].expand_as(out)
            return -F.binary_cross_entropy_with_logits(out, target, reduction="none").sum(-1)
        std = per_seed(self.log_std.exp(), out).expand_as(out)
        return gaussian_log_prob(self.change(next_obs - obs)[..., None, :].expand_as(out), out, std)

    def sample(self, obs: Tensor, action: Tensor, theta_hat: Tensor, draws: Draws) -> Tensor:
        """Draw s' ~ p_psi [S, N, O]."""
        out = self(obs, action, theta_hat)[..., 0, :]
        if self.signature.binary:
            return (draws.uniform(*out.shape[1:]) < torch.sigmoid(out)).float()
        change = out + torch.exp(per_seed(self.log_std, out)) * draws.normal(*out.shape[1:])
        return obs + self.change.inverse(change)


class LinearDynamicsHead(DynamicsHead):
    """p_psi(s' | s, a, theta_hat) whose mean is linear in theta_hat: s + f(s, a) + sum_d g_d(s, a) theta_hat_d.

    theta_hat is any function of theta, so that these are the first D terms of an expansion of any effect of theta.
    An MLP of theta_hat in place of the sum leaves latents in which the smaller effects are bent round the larger ones,
    so that a policy cannot tell them apart: of five latents (`loaded_drone`) a linear map of theta_hat has R2 .64, and
    .79 with the sum.
    """

    def __init__(self, latent: int, width: int, inputs: Inputs, draws: Draws) -> None:
        super().__init__(0, width, inputs, draws)
        self.gains = Mlp(inputs.obs_width + inputs.action_width, width, self.signature.obs * latent, draws)

    def parts(self, obs: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """f [S, ..., O] and g [S, ..., O, D]."""
        inputs = torch.cat([self.inputs.obs(obs), self.inputs.action(action)], -1)
        return self.net(inputs), self.gains(inputs).unflatten(-1, (self.signature.obs, -1))

    def forward(self, obs: Tensor, action: Tensor, theta_hat: Tensor | None = None) -> Tensor:
        assert theta_hat is not None
        expected, gains = self.parts(obs, action)
        return (expected + (gains * theta_hat[..., None, :]).sum(-1))[..., None, :]


class CodedDynamicsHead(LinearDynamicsHead):
    """K models of the dynamics that differ by a code e_k [D] each: s + f(s, a) + sum_d g_d(s, a) e_kd.

    Models with an output layer each differ by more than theta's effect while they are learned, so that the same one
    fits every trial best, and no other learns any more. Here f and g are common to all.
    """

    def __init__(self, models: int, code: int, width: int, inputs: Inputs, draws: Draws) -> None:
        super().__init__(code, width, inputs, draws)
        self.codes = nn.Parameter(draws.normal(code, models))

    def forward(self, obs: Tensor, action: Tensor, theta_hat: Tensor | None = None) -> Tensor:
        expected, gains = self.parts(obs, action)
        rows = gains.flatten(1, -2)
        none = rows.new_zeros(len(rows), 1, self.codes.shape[-1])
        effect = affine(none, rows, self.codes).reshape(*gains.shape[:-1], -1)
        return expected[..., None, :] + effect.transpose(-1, -2)
