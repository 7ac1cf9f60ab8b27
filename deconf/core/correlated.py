"""Gaussians over latents whose dimensions are correlated, as parameters that a network gives."""

import torch
from torch import Tensor, nn
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

    def network(self, inputs: int, width: int, draws: Draws) -> Mlp:
        """A network [..., I] -> [..., P] for `about`, whose output is 0 before training."""
        net = Mlp(inputs, width, self.parameters, draws)
        for parameter in net[-1].parameters():
            nn.init.zeros_(parameter)
        return net

    def about(self, mean: Tensor, raw: Tensor) -> Tensor:
        """Parameters [..., P] by a network's output [..., P]: what is added to the mean, stds before a softplus, A."""
        added, std, lower = self.split(raw)
        return torch.cat([mean + added, F.softplus(std) + LEAST, lower], -1)

    def split(self, belief: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Mean, stds and A."""
        d = self.latent
        return belief[..., :d], belief[..., d : 2 * d], belief[..., 2 * d :]

    def triangle(self, lower: Tensor) -> Tensor:
        """1 + A [..., D, D]."""
        d = self.latent
        row, column = torch.tril_indices(d, d, -1, device=lower.device)
        matrix = torch.eye(d, device=lower.device).expand(*lower.shape[:-1], d, d).clone()
        matrix[..., row, column] = lower
        return matrix

    def sample(self, belief: Tensor, draws: Draws) -> Tensor:
        """theta_hat [S, ..., D] from beliefs [S, ..., P]."""
        mean, std, lower = self.split(belief)
        noise = (std * draws.normal(*mean.shape[1:]))[..., None]
        drawn = torch.linalg.solve_triangular(self.triangle(lower), noise, upper=False, unitriangular=True)
        return mean + drawn[..., 0]

    def log_expected(self, belief: Tensor, precision: Tensor, weighted: Tensor) -> Tensor:
        """log E exp(b^T theta_hat - theta_hat^T P theta_hat / 2) [...], in closed form: P [..., D, D], b [..., D].

        That is the log-likelihood of evidence that is quadratic in theta_hat under the belief, but for a constant. P
        and b are in double precision.
        """
        mean, std, lower = self.split(belief)
        root = torch.linalg.solve_triangular(  # theta_hat = mean + root e, e normal
            self.triangle(lower).double(), torch.diag_embed(std.double()), upper=False, unitriangular=True
        )
        column = mean.double()[..., None]
        slope = weighted[..., None] - precision @ column
        at_mean = ((weighted[..., None] + slope) * column).sum((-1, -2)) / 2
        return (at_mean + log_expected_of_normal(root.mT @ precision @ root, root.mT @ slope)).float()


def log_expected_of_normal(precision: Tensor, weighted: Tensor) -> Tensor:
    """log E exp(b^T e - e^T P e / 2) [...] of a standard normal e [D]: P [..., D, D], b [..., D, 1]."""
    lower = posterior_root(precision)
    half = torch.linalg.solve_triangular(lower, weighted, upper=False)
    return half.square().sum((-1, -2)) / 2 - lower.diagonal(dim1=-2, dim2=-1).log().sum(-1)


def posterior_root(precision: Tensor) -> Tensor:
    """The Cholesky factor [..., D, D] of 1 + P: of the precision of a posterior whose prior is a standard normal.

    P is a sum in single precision, or a difference of two. Where its rounding exceeds the prior, as much is added to
    that matrix, and to no other of the stack, as it needs to have a root. A matrix that is not finite has none: its
    root is not finite either.
    """
    unit = torch.eye(precision.shape[-1], dtype=precision.dtype, device=precision.device)
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
