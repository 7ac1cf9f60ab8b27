"""Gaussians over latents whose dimensions are correlated, as parameters that a network gives."""

import math
from functools import cache
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from deconfounded.deconf.core.data import Draws
from deconfounded.deconf.core.layers import Mlp

LEAST = 0.05  # least conditional std
ROUNDING, TRIES = 1e-5, 12  # of sums in single precision, relative to the largest; tenfold at each further try


class Correlated:
    """Gaussians over theta_hat [D], each by its parameters [P]: mean [D], conditional stds s [D], A [D (D - 1) / 2].

    A is strictly lower triangular, and (1 + A) (theta_hat - mean) is normal with independent stds s: the modified
    Cholesky decomposition (Pourahmadi, 1999). Latents of different thetas lie near a surface in the latent space, which
    samples with independent dimensions would leave.
    """

    def __init__(self, latent: int) -> None:
        self.latent, self.parameters = latent, 2 * latent + latent * (latent - 1) // 2
        row, column = torch.tril_indices(latent, latent, -1)
        self._below = latent * row + column  # where A's entries are in a flat matrix

    def network(self, inputs: int, width: int, draws: Draws) -> Mlp:
        """A network [..., I] -> [..., P] for `about`, whose output is 0 before training."""
        net = Mlp(inputs, width, self.parameters, draws)
        for parameter in net[-1].parameters():
            nn.init.zeros_(parameter)
        return net

    def about(self, mean: Tensor, raw: Tensor) -> Tensor:
        """Parameters [..., P] by a network's output [..., P]: what is added to the mean, stds before a softplus, A."""
        added, std, lower = self.split(raw)
        return self.joined(mean + added, std, lower)

    def joined(self, mean: Tensor, raw: Tensor, lower: Tensor) -> Tensor:
        """Parameters [..., P] by the mean, stds before a softplus, and A."""
        return torch.cat([mean, F.softplus(raw) + LEAST, lower], -1)

    def split(self, belief: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Mean, stds and A."""
        d = self.latent
        return belief.split_with_sizes([d, d, self.parameters - 2 * d], -1)  # type: ignore[return-value]

    def triangle(self, lower: Tensor) -> Tensor:
        """1 + A [..., D, D]."""
        d = self.latent
        unit = identity(d, lower.dtype, lower.device)
        flat = unit.view(-1).expand(*lower.shape[:-1], d * d).clone(memory_format=torch.contiguous_format)
        return flat.index_copy_(-1, self._below.to(lower.device), lower).unflatten(-1, (d, d))

    def sample(self, belief: Tensor, draws: Draws) -> Tensor:
        """theta_hat [S, ..., D] from beliefs [S, ..., P]."""
        mean, std, lower = self.split(belief)
        return mean + self.deviation(std, lower, draws)

    def deviation(self, std: Tensor, lower: Tensor, draws: Draws) -> Tensor:
        """theta_hat - mean [S, ..., D], drawn; of stds and A."""
        noise = (std * draws.normal(*std.shape[1:]))[..., None]
        drawn = torch.linalg.solve_triangular(self.triangle(lower), noise, upper=False, unitriangular=True)
        return drawn[..., 0]

    def log_prob(self, belief: Tensor, theta_hat: Tensor) -> Tensor:
        """The log density [...] of theta_hat [..., D] under beliefs [..., P], differentiable in these."""
        return LogProb.apply(self, belief, theta_hat)

    def log_expected(self, belief: Tensor, precision: Tensor, weighted: Tensor) -> Tensor:
        """log E exp(b^T theta_hat - theta_hat^T P theta_hat / 2) [...], in closed form: P [..., D, D], b [..., D].

        That is the log-likelihood of evidence that is quadratic in theta_hat under the belief, but for a constant. It
        is differentiable in the belief. P and b are in double precision.
        """
        return LogExpected.apply(self, belief, precision, weighted)

    def log_prob_gradient(self, triangle: Tensor, std: Tensor, mean: Tensor, square: Tensor, product: Tensor) -> Tensor:
        """The gradient [..., P] of log N(theta_hat) in the belief, or its mean over theta_hat.

        e = (1 + A) (theta_hat - m) / s is standard normal. mean and square [..., D]: of e and e^2; product [..., D, D]:
        of e (theta_hat - m)^T.
        """
        by_mean = (triangle.mT @ (mean / std)[..., None])[..., 0]
        by_lower = -(product / std[..., None]).flatten(-2).index_select(-1, self._below.to(std.device))
        return torch.cat([by_mean, (square - 1) / std, by_lower], -1)


class LogProb(torch.autograd.Function):
    """`Correlated.log_prob`."""

    @staticmethod
    def forward(ctx: Any, gaussian: Correlated, belief: Tensor, theta_hat: Tensor) -> Tensor:
        mean, std, lower = gaussian.split(belief)
        triangle, apart = gaussian.triangle(lower), theta_hat - mean
        e = (triangle @ apart[..., None])[..., 0] / std
        ctx.gaussian = gaussian
        ctx.save_for_backward(triangle, std, apart, e)
        return -(e.square() / 2 + std.log() + math.log(2 * math.pi) / 2).sum(-1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[None, Tensor, None]:
        triangle, std, apart, e = ctx.saved_tensors
        product = e[..., None] * apart[..., None, :]
        return None, grads[0][..., None] * ctx.gaussian.log_prob_gradient(triangle, std, e, e.square(), product), None


class LogExpected(torch.autograd.Function):
    """`Correlated.log_expected`. Its gradient is that of log N(theta_hat), averaged over the posterior of theta_hat.

    That is Fisher's identity: d/dx log E f(theta_hat) = E_post d/dx log p(theta_hat; x).
    """

    @staticmethod
    def forward(ctx: Any, gaussian: Correlated, belief: Tensor, precision: Tensor, weighted: Tensor) -> Tensor:
        mean, std, lower = gaussian.split(belief.double())
        triangle = gaussian.triangle(lower)
        root = torch.linalg.solve_triangular(triangle, torch.diag_embed(std), upper=False, unitriangular=True)
        column = mean[..., None]  # theta_hat = mean + root e, e normal
        slope = weighted[..., None] - precision @ column
        at_mean = ((weighted[..., None] + slope) * column).sum((-1, -2)) / 2
        log_expected, factor, half = expect_of_normal(root.mT @ precision @ root, root.mT @ slope)
        ctx.gaussian = gaussian
        ctx.save_for_backward(triangle, std, root, factor, half)
        return (at_mean + log_expected).float()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[None, Tensor, None, None]:
        triangle, std, root, factor, half = ctx.saved_tensors
        mean, second = posterior_moments(factor, half)
        square = second.diagonal(dim1=-2, dim2=-1)
        by_belief = ctx.gaussian.log_prob_gradient(triangle, std, mean, square, second @ root.mT)
        return None, grads[0][..., None] * by_belief.float(), None, None


class LogExpectedOfNormal(torch.autograd.Function):
    """`log_expected_of_normal`."""

    @staticmethod
    def forward(ctx: Any, precision: Tensor, weighted: Tensor) -> Tensor:
        log_expected, factor, half = expect_of_normal(precision, weighted)
        ctx.save_for_backward(factor, half)
        return log_expected

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor]:
        mean, second = posterior_moments(*ctx.saved_tensors)
        grad = grads[0][..., None]
        return grad[..., None] * second / -2, (grad * mean)[..., None]


def log_expected_of_normal(precision: Tensor, weighted: Tensor) -> Tensor:
    """log E exp(b^T e - e^T P e / 2) [...] of a standard normal e [D]: P [..., D, D], b [..., D, 1].

    It is differentiable in both: its gradient is E[e] in b, and -E[e e^T] / 2 in P, of the posterior.
    """
    return LogExpectedOfNormal.apply(precision, weighted)


def expect_of_normal(precision: Tensor, weighted: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """What `log_expected_of_normal` gives, the root L of 1 + P, and L^-1 b [..., D, 1]."""
    factor = posterior_root(precision)
    half = torch.linalg.solve_triangular(factor, weighted, upper=False)
    return half.square().sum((-1, -2)) / 2 - factor.diagonal(dim1=-2, dim2=-1).log().sum(-1), factor, half


def posterior_moments(factor: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    """E[e] [..., D] and E[e e^T] [..., D, D] of the posterior of `expect_of_normal`."""
    root = inverse(factor)
    mean = root.mT @ half
    return mean[..., 0], root.mT @ root + mean * mean.mT


@cache
def identity(size: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """The unit matrix [size, size], made once. Not to be written to."""
    with torch.inference_mode(False):  # or no gradient could pass it
        return torch.eye(size, dtype=dtype, device=device)


def inverse(factor: Tensor) -> Tensor:
    """L^-1 of lower triangular matrices L [..., D, D]: (L L^T)^-1 is its square, and L^-1 b is of use too."""
    unit = identity(factor.shape[-1], factor.dtype, factor.device)
    return torch.linalg.solve_triangular(factor, unit, upper=False)


def posterior_root(precision: Tensor) -> Tensor:
    """The Cholesky factor [..., D, D] of 1 + P: of the precision of a posterior whose prior is a standard normal.

    P is a sum in single precision, or a difference of two. Where its rounding exceeds the prior, as much is added to
    that matrix, and to no other of the stack, as it needs to have a root. A matrix that is not finite has none: its
    root is not finite either.
    """
    unit = identity(precision.shape[-1], precision.dtype, precision.device)
    lower, failed = torch.linalg.cholesky_ex(precision + unit)
    if not failed.any():
        return lower  # type: ignore[no-any-return]
    with torch.no_grad():
        amount = ROUNDING * precision.diagonal(dim1=-2, dim2=-1).abs().sum(-1)
        added = torch.zeros_like(amount)
        for i in range(TRIES):
            added = torch.where(failed > 0, amount * 10**i, added)
            failed = torch.linalg.cholesky_ex(precision + (1 + added[..., None, None]) * unit).info
            if not failed.any():
                break
    return torch.linalg.cholesky_ex(precision + (1 + added[..., None, None]) * unit).L  # type: ignore[no-any-return]
