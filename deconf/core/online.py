"""The belief in the course of a trial about the latent that the whole trial will give."""

import torch
from torch import Tensor, nn

from deconfounded.deconf.core.adam import Adam
from deconfounded.deconf.core.correlated import Correlated
from deconfounded.deconf.core.data import Batch, Draws, take
from deconfounded.deconf.core.latent_model import LatentModel
from deconfounded.deconf.core.nets import per_seed

MEMORIES, PER_TRIAL = 32768, 64  # on which the network is trained, about; at most so many of a trial of exploration
BATCH, RATE = 1024, 3e-3  # memories an update; learning rate


class OnlineBelief(nn.Module):
    """q(theta_hat_H | tau_:t), a Gaussian: a second network that reads the memory of a model.

    The policy is cloned given latents of whole trials, theta_hat_H, and deployed on what beginnings tell of them. The
    model's own belief is not trained for that. The linear model's is to predict evidence. By Eq. (6) with a beta far
    below 1, a belief's std says little of how far its mean is from theta_hat_H (ten times as far and more, early in a
    trial), and its mean may lie where no trial's latent is. This network is trained on exploration to give the density
    of theta_hat_H, inferred on the whole trial. It gives what is to be added to the mean of the model's belief, and the
    covariance: a *belief* is that of `Correlated`, deviations from the mean in units of the stds of theta_hat_H.
    """

    unit: Tensor  # stds of theta_hat_H [S, D]

    def __init__(self, model: LatentModel, width: int, draws: Draws) -> None:
        super().__init__()
        self.gaussian = Correlated(model.latent)
        self.register_buffer("unit", torch.ones_like(model.latent_stds()))
        self.net = self.gaussian.network(model.read_width, width, draws)

    def forward(self, model: LatentModel, memory: Tensor) -> Tensor:
        """Memories [S, ..., M] -> beliefs [S, ..., P]."""
        with torch.no_grad():
            read, mean = model.read(memory)
        added, std, lower = self.gaussian.split(self.net(read))
        return self.gaussian.joined(mean + per_seed(self.unit, mean) * added, std, lower)

    def apart(self, read: Tensor) -> Tensor:
        """Beliefs [S, ..., P] about how far theta_hat is from the mean of the model's belief, in units of its stds."""
        return self.gaussian.about(read.new_zeros(()), self.net(read))

    def mean(self, belief: Tensor) -> Tensor:
        """The mean [..., D] of theta_hat."""
        return self.gaussian.split(belief)[0]

    def mode(self, belief: Tensor) -> Tensor:
        """The likeliest theta_hat [..., D]: the mean."""
        return self.mean(belief)

    def sample(self, belief: Tensor, draws: Draws) -> Tensor:
        """theta_hat [S, ..., D] from beliefs [S, ..., P]."""
        mean, std, lower = self.gaussian.split(belief)
        return mean + per_seed(self.unit, mean) * self.gaussian.deviation(std, lower, draws)

    def fit(
        self, model: LatentModel, explored: Batch, updates: int, draws: Draws, latents: Tensor | None = None
    ) -> None:
        """Train on trials [S, B, T] of exploration. latents [S, B, D]: theirs; None: those inferred on whole trials."""
        self.unit.copy_(model.latent_stds())
        memory, theta_hat = memories(model, explored, draws, latents)
        with torch.no_grad():
            read, mean = model.read(memory)
            apart = (theta_hat - mean) / per_seed(self.unit, mean)
        optimizer = Adam([self], RATE, updates)
        for _ in range(updates):
            index = draws.integers(memory.shape[1], BATCH)
            optimizer.step(-self.gaussian.log_prob(self.apart(take(read, index)), take(apart, index)).mean(-1))


def online_belief(model: LatentModel, draws: Draws) -> OnlineBelief | None:
    """The untrained second network of a model, if its memory is for one to read."""
    return OnlineBelief(model, model.width, draws) if model.read_width else None


@torch.no_grad()
def memories(
    model: LatentModel, trials: Batch, draws: Draws, latents: Tensor | None = None, part: int = 64
) -> tuple[Tensor, Tensor]:
    """Memories [S, K, M] before random steps of trials [S, B, T], and the latents [S, K, D] of these steps.

    Latents are those of the trials [S, B, D], as given or as inferred on the whole trial. Of each trial as many steps,
    at most PER_TRIAL, more of the first ones: the density of step t goes by 1 / sqrt(t).
    """
    each = max(1, min(PER_TRIAL, MEMORIES // len(trials)))
    step = (draws.uniform(len(trials), each).square() * trials.mask.sum(2, keepdim=True)).long()
    read, theta_hat = [], []
    for i in torch.arange(len(trials), device=step.device).split(part):
        batch = trials[:, i]
        memory, final = model.course(batch)
        read.append(_chosen(memory, step[:, i]))
        if latents is None:
            theta_hat.append(_chosen(model.mean(model.belief(final)), step[:, i]))
        else:
            theta_hat.append(_chosen(latents[:, i, None], step[:, i]))
    return torch.cat(read, 1), torch.cat(theta_hat, 1)


def _chosen(values: Tensor, step: Tensor) -> Tensor:
    """Values [S, B, T, F] of steps [S, B, K], as [S, B K, F]; of a single value, T = 1, that one for all steps."""
    _, trials, steps, _ = values.shape
    trial = torch.arange(trials, device=step.device)[:, None]
    return take(values.flatten(1, 2), (step.clamp(max=steps - 1) + steps * trial).flatten(1))
