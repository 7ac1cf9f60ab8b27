"""q_phi(theta_hat | tau): two beliefs behind one interface.

A belief keeps a memory of a history and reads a Gaussian over theta_hat from it (`posterior`). Memories come for all
prefixes of a batch of trials at once (`forward`), or one transition at a time (`start`, `update`), alike.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from deconf.nets import Batch, Scaler, Signature, Whitener, mlp


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
        self.prior_std.copy_(theta_hat.std(0, correction=0).clamp(min=0.05))

    @abstractmethod
    def forward(self, batch: Batch) -> Tensor:
        """Memories [B, T + 1, M] after 0, 1, ..., T transitions, episodes joined end to end."""

    @abstractmethod
    def start(self, n: int) -> Tensor:
        """The memory [N, M] of n histories without a transition."""

    @abstractmethod
    def update(self, memory: Tensor, step: Batch) -> Tensor:
        """Memory after one more transition each (step without a time axis); kept where its mask is 0."""

    @abstractmethod
    def posterior(self, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and std [..., D] of q_phi given memories [..., M]."""


class EvidenceBelief(Belief):
    """The order-free belief: a sum of evidence over transitions, read by a small network.

    Given theta the dynamics are Markov, so that p(theta | tau) depends on the *set* of transitions alone: log p(theta |
    tau) is a sum with one term for each. So is the memory: one cumulative sum, no recurrence. The network reads the
    sum divided by the count and by its square root, and the logarithm of the count, so that its inputs keep their
    size however long the trial. Without a transition, q is the prior.

    The evidence is whitened, so that its sum wanders about 0 and theta shows as a drift. Left as it comes, its common
    part grows with the count and drowns what theta changes: Eq. (6) then stays for long on the plateau where the latent
    is ignored.
    """

    def __init__(self, latent: int, width: int, signature: Signature, obs: Scaler, change: Scaler) -> None:
        super().__init__(latent)
        self.signature, self.obs, self.change, self.width = signature, obs, change, width // 4
        self.evidence = mlp(2 * signature.obs + signature.action_features, width, self.width)
        self.whiten = Whitener(self.width)
        self.out = mlp(2 * self.width + 1, width, 2 * latent)

    def _terms(self, batch: Batch) -> Tensor:
        """What each transition adds to the memory, [..., M]: its evidence and a one; zero where the mask is."""
        keep = batch.mask.bool()
        real = batch[keep]
        change = self.change(real.next_obs - real.obs)
        inputs = [self.obs(real.obs), self.signature.encode_action(real.action), change]
        evidence = self.whiten(self.evidence(torch.cat(inputs, -1)))
        terms = torch.cat([evidence, torch.ones_like(evidence[:, :1])], -1)
        return terms.new_zeros(*keep.shape, self.width + 1).masked_scatter(keep[..., None], terms)

    def forward(self, batch: Batch) -> Tensor:
        terms = self._terms(batch)
        return torch.cat([torch.zeros_like(terms[:, :1]), terms], 1).cumsum(1)

    def start(self, n: int) -> Tensor:
        return self.prior_mean.new_zeros(n, self.width + 1)

    def update(self, memory: Tensor, step: Batch) -> Tensor:
        return memory + self._terms(step)

    def posterior(self, memory: Tensor) -> tuple[Tensor, Tensor]:
        total, count = memory[..., :-1], memory[..., -1:]
        n = 1 + count
        mean, raw = self.out(torch.cat([total / n, total / n.sqrt(), n.log() - 2], -1)).chunk(2, -1)
        std = (F.softplus(raw) + 1e-6).sqrt()
        none = count == 0
        return torch.where(none, self.prior_mean, mean), torch.where(none, self.prior_std, std)


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
        return self.embed_action.weight.new_zeros(n, self.width)

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

    def forward(self, batch: Batch) -> Tensor:
        return self.memory(batch, self.start(len(batch)))

    def start(self, n: int) -> Tensor:
        return self.memory.start(n)

    def update(self, memory: Tensor, step: Batch) -> Tensor:
        return self.memory.update(memory, step)

    def posterior(self, memory: Tensor) -> tuple[Tensor, Tensor]:
        mean, raw = self.out(memory).chunk(2, -1)
        return mean, (F.softplus(raw) + 1e-6).sqrt()
