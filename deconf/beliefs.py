"""q_phi(theta_hat | tau): two beliefs behind one interface.

A belief turns a history into a Gaussian over theta_hat, for all prefixes of a batch of trials at once (`forward`) or
one transition at a time (`start`, `update`, `posterior`). Both give the same numbers.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from deconf.nets import Batch, Scaler, Signature, mlp


class Belief(nn.Module, ABC):
    """q_phi and the prior p(theta_hat), a Gaussian in each of D dimensions: N(0, 1) until `set_prior`."""

    prior_mean: Tensor
    prior_std: Tensor

    def __init__(self, latent: int) -> None:
        super().__init__()
        self.register_buffer("prior_mean", torch.zeros(latent))
        self.register_buffer("prior_std", torch.ones(latent))

    def set_prior(self, theta_hat: Tensor) -> None:
        """Fit the prior to latents [B, D] inferred on whole trials (empirical Bayes).

        Without it, early samples are spread over more of the latent space than there is data for.
        """
        self.prior_mean.copy_(theta_hat.mean(0))
        self.prior_std.copy_(theta_hat.std(0).clamp(min=0.05))

    @abstractmethod
    def forward(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Mean and std [B, T + 1, D] after 0, 1, ..., T transitions, episodes joined end to end."""

    @abstractmethod
    def start(self, n: int) -> Tensor:
        """The memory [N, M] of n histories without a transition."""

    @abstractmethod
    def update(self, memory: Tensor, step: Batch) -> Tensor:
        """Memory after one more transition each (step without a time axis); kept where its mask is 0."""

    @abstractmethod
    def posterior(self, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and std [N, D]."""


class EvidenceBelief(Belief):
    """The order-free belief: a product of the prior and one Gaussian factor for each transition.

    Given theta the dynamics are Markov, so that p(theta | tau) depends on the set of transitions alone. Each adds
    precision w >= 0 and evidence v to sums; from a prior N(m, 1 / p), q = N((p m + sum v) / (p + sum w),
    1 / (p + sum w)). No recurrence, and its form is safe at any length: more evidence means a narrower belief, not
    another regime of a network.
    """

    def __init__(self, latent: int, width: int, signature: Signature, obs: Scaler, change: Scaler) -> None:
        super().__init__(latent)
        self.signature, self.obs, self.change = signature, obs, change
        self.net = mlp(2 * signature.obs + signature.action_features, width, 2 * latent)

    def evidence(self, batch: Batch) -> Tensor:
        """Evidence v and precision w of each transition, [..., 2 D]; zero where the mask is."""
        keep = batch.mask.bool()
        real = batch[keep]
        change = self.change(real.next_obs - real.obs)
        inputs = [self.obs(real.obs), self.signature.encode_action(real.action), change]
        value, raw = self.net(torch.cat(inputs, -1)).chunk(2, -1)
        evidence = torch.cat([value, F.softplus(raw - 3)], -1)
        return evidence.new_zeros(*keep.shape, evidence.shape[-1]).masked_scatter(keep[..., None], evidence)

    def forward(self, batch: Batch) -> tuple[Tensor, Tensor]:
        sums = self.evidence(batch).cumsum(1)
        return self.posterior(torch.cat([torch.zeros_like(sums[:, :1]), sums], 1))

    def start(self, n: int) -> Tensor:
        return torch.zeros(n, 2 * len(self.prior_mean))

    def update(self, memory: Tensor, step: Batch) -> Tensor:
        return memory + self.evidence(step)

    def posterior(self, memory: Tensor) -> tuple[Tensor, Tensor]:
        value, weight = memory.chunk(2, -1)
        prior = self.prior_std**-2
        return (prior * self.prior_mean + value) / (prior + weight), (prior + weight).rsqrt()


class GruMemory(nn.Module):
    """A GRU over embedded transitions (s, a, s'): the history encoder of appendix D."""

    def __init__(self, width: int, signature: Signature, obs: Scaler) -> None:
        super().__init__()
        self.width, self.signature, self.obs = width, signature, obs
        self.embed_obs = mlp(signature.obs, width, 32)
        self.embed_action = nn.Linear(signature.action_features, 32)
        self.gru = nn.GRU(3 * 32, width, batch_first=True)

    def start(self, n: int) -> Tensor:
        """The memory [N, W] of empty histories."""
        return torch.zeros(n, self.width)

    def forward(self, batch: Batch, memory: Tensor) -> Tensor:
        """Transitions [B, T, ...] after a memory [B, W] -> memories [B, T + 1, W]."""
        before, after = self.embed_obs(self.obs(batch.obs)), self.embed_obs(self.obs(batch.next_obs))
        action = self.embed_action(self.signature.encode_action(batch.action))
        hidden, _ = self.gru(torch.cat([before, action, after], -1), memory[None].contiguous())
        return torch.cat([memory[:, None], hidden], 1)

    def update(self, memory: Tensor, step: Batch) -> Tensor:
        """Memory [N, W] after one more transition each; kept where its mask is 0."""
        after = self(step[:, None], memory)[:, 1]
        return torch.where(step.mask[:, None] > 0, after, memory)


class GruBelief(Belief):
    """The paper's belief: GruMemory, then linear to a mean and a softplus variance."""

    def __init__(self, latent: int, width: int, signature: Signature, obs: Scaler, change: Scaler) -> None:
        super().__init__(latent)
        self.memory = GruMemory(width, signature, obs)
        self.out = nn.Linear(width, 2 * latent)

    def forward(self, batch: Batch) -> tuple[Tensor, Tensor]:
        return self.posterior(self.memory(batch, self.start(len(batch))))

    def start(self, n: int) -> Tensor:
        return self.memory.start(n)

    def update(self, memory: Tensor, step: Batch) -> Tensor:
        return self.memory.update(memory, step)

    def posterior(self, memory: Tensor) -> tuple[Tensor, Tensor]:
        mean, raw = self.out(memory).chunk(2, -1)
        return mean, (F.softplus(raw) + 1e-6).sqrt()
