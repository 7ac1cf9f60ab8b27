"""The belief in the course of a trial about the latent that the whole trial will give."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from deconfounded.deconf.core.adam import Adam
from deconfounded.deconf.core.beliefs import EvidenceBelief
from deconfounded.deconf.core.data import Batch, Draws, take
from deconfounded.deconf.core.layers import Mlp
from deconfounded.deconf.core.models import LatentModel, VariationalModel
from deconfounded.deconf.core.nets import gaussian_log_prob, per_seed

MEMORIES, PER_TRIAL = 32768, 64  # on which the network is trained, about; at most so many of a trial of exploration
BATCH, RATE, LEAST = 1024, 3e-3, 0.05  # memories an update; learning rate; least std, in units of the prior's


class OnlineBelief(nn.Module):
    """q(theta_hat_H | tau_:t), a Gaussian: a second network that reads the memory of a model's encoder.

    The policy is cloned given latents of whole trials, theta_hat_H, and deployed on what beginnings tell of them. Eq.
    (6) with a beta far below 1 does not train q_phi for that: its std says little of how far its mean is from
    theta_hat_H (ten times as far and more, early in a trial), and its mean may lie where no trial's latent is. This
    network is trained on exploration to give the density of theta_hat_H, inferred by q_phi on the whole trial. It gives
    what is to be added to q_phi's mean (nothing, at first), and the covariance: latents of different thetas lie near a
    surface in the latent space, which samples with independent dimensions would leave.

    A *belief* is mean [D], conditional stds s [D] and strictly lower triangular A [D (D - 1) / 2], such that (1 + A)
    (theta_hat - mean) is normal with stds s: the modified Cholesky decomposition (Pourahmadi, 1999), in units of the
    prior's stds.
    """

    unit: Tensor  # the prior's stds [S, D]

    def __init__(self, encoder: EvidenceBelief, width: int, draws: Draws) -> None:
        super().__init__()
        self.latent = latent = encoder.prior_std.shape[-1]
        self.register_buffer("unit", torch.ones_like(encoder.prior_std))
        self.net = Mlp(encoder.read_width, width, 2 * latent + latent * (latent - 1) // 2, draws)
        for parameter in self.net[-1].parameters():
            nn.init.zeros_(parameter)

    def forward(self, encoder: EvidenceBelief, memory: Tensor) -> Tensor:
        """Memories [S, ..., M] -> beliefs [S, ..., P]."""
        added, raw, lower = self._split(self.net(encoder.read(memory)))
        with torch.no_grad():
            mean, _ = encoder.posterior(memory)
        return torch.cat([mean + per_seed(self.unit, mean) * added, F.softplus(raw) + LEAST, lower], -1)

    def _split(self, belief: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        d = self.latent
        return belief[..., :d], belief[..., d : 2 * d], belief[..., 2 * d :]

    def _triangle(self, lower: Tensor) -> Tensor:
        """1 + A [..., D, D]."""
        d = self.latent
        row, column = torch.tril_indices(d, d, -1, device=lower.device)
        matrix = torch.eye(d, device=lower.device).expand(*lower.shape[:-1], d, d).clone()
        matrix[..., row, column] = lower
        return matrix

    def mean(self, belief: Tensor) -> Tensor:
        """The mean [..., D] of theta_hat."""
        return self._split(belief)[0]

    def mode(self, belief: Tensor) -> Tensor:
        """The likeliest theta_hat [..., D]: the mean."""
        return self.mean(belief)

    def sample(self, belief: Tensor, draws: Draws) -> Tensor:
        """theta_hat [S, ..., D] from beliefs [S, ..., P]."""
        mean, std, lower = self._split(belief)
        noise = (std * draws.normal(*mean.shape[1:]))[..., None]
        drawn = torch.linalg.solve_triangular(self._triangle(lower), noise, upper=False, unitriangular=True)
        return mean + per_seed(self.unit, mean) * drawn[..., 0]

    def uncorrelated(self, belief: Tensor, theta_hat: Tensor) -> Tensor:
        """(1 + A) (theta_hat - mean) [S, ..., D], in units of the prior's stds: independent, with stds s."""
        mean, _, lower = self._split(belief)
        apart = ((theta_hat - mean) / per_seed(self.unit, mean))[..., None]
        return (self._triangle(lower) @ apart)[..., 0]

    def log_prob(self, belief: Tensor, theta_hat: Tensor) -> Tensor:
        """The log density [S, ...] of theta_hat [S, ..., D], in units of the prior's stds."""
        _, std, _ = self._split(belief)
        return gaussian_log_prob(torch.zeros_like(std), self.uncorrelated(belief, theta_hat), std)

    def fit(
        self, model: LatentModel, explored: Batch, updates: int, draws: Draws, latents: Tensor | None = None
    ) -> None:
        """Train on trials [S, B, T] of exploration. latents [S, B, D]: theirs; None: those inferred on whole trials."""
        encoder = reader(model)
        self.unit.copy_(encoder.prior_std)
        memory, theta_hat = memories(model, explored, draws, latents)
        optimizer = Adam([self], RATE, updates)
        for _ in range(updates):
            index = draws.integers(memory.shape[1], BATCH)
            belief = self(encoder, take(memory, index))
            optimizer.step(-self.log_prob(belief, take(theta_hat, index)).mean(-1))


def reader(model: LatentModel) -> EvidenceBelief:
    """The encoder of a model, whose memory the second network reads."""
    assert isinstance(model, VariationalModel)
    assert isinstance(model.encoder, EvidenceBelief)
    return model.encoder


def online_belief(model: LatentModel, draws: Draws) -> OnlineBelief | None:
    """The untrained second network of a model, if its belief has one."""
    if not (isinstance(model, VariationalModel) and model.encoder.linear):
        return None
    return OnlineBelief(reader(model), model.width, draws)


@torch.no_grad()
def memories(
    model: LatentModel, trials: Batch, draws: Draws, latents: Tensor | None = None, part: int = 64
) -> tuple[Tensor, Tensor]:
    """Memories [S, K, M] before random steps of trials [S, B, T], and the latents [S, K, D] of these steps.

    Latents are those of the trials [S, B, D], as given or as inferred on the whole trial. Of each trial as many steps,
    at most PER_TRIAL, more of the first ones: the density of step t goes by 1 / sqrt(t).
    """
    encoder = reader(model)
    each = max(1, min(PER_TRIAL, MEMORIES // len(trials)))
    step = (draws.uniform(len(trials), each).square() * trials.mask.sum(2, keepdim=True)).long()
    read, theta_hat = [], []
    for i in torch.arange(len(trials), device=step.device).split(part):
        batch = trials[:, i]
        memory = encoder(batch)
        read.append(_chosen(memory, step[:, i]))
        if latents is None:
            final = encoder.hindsight(batch, memory)  # one a trial, or one a step
            theta_hat.append(_chosen(model.mean(model.belief(final)), step[:, i]))
        else:
            theta_hat.append(_chosen(latents[:, i, None], step[:, i]))
    return torch.cat(read, 1), torch.cat(theta_hat, 1)


def _chosen(values: Tensor, step: Tensor) -> Tensor:
    """Values [S, B, T, F] of steps [S, B, K], as [S, B K, F]; of a single value, T = 1, that one for all steps."""
    _, trials, steps, _ = values.shape
    trial = torch.arange(trials, device=step.device)[:, None]
    return take(values.flatten(1, 2), (step.clamp(max=steps - 1) + steps * trial).flatten(1))
