"""q_phi(theta_hat | tau): the interface of a belief, and those whose memory is a sum over transitions.

A belief keeps a memory of a history and reads a Gaussian over theta_hat from it (`posterior`). Memories come for all
prefixes of a batch of trials at once (`forward`), or one transition at a time (`start`, `update`), alike.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from deconfounded.deconf.core.data import Batch, Draws
from deconfounded.deconf.core.layers import Mlp
from deconfounded.deconf.core.nets import Inputs, Scales, Whitener, per_seed
from deconfounded.deconf.equations import masked_mean

MAX_PRODUCTS = 16  # of actions and changes, as inputs of the evidence network


class Belief(nn.Module, ABC):
    """q_phi(theta_hat | tau) and the prior p(theta_hat), a diagonal Gaussian: N(0, 1) until `set_prior`."""

    inputs: Inputs
    linear: ClassVar[bool] = False  # in innovations; if so, dynamics are linear in theta_hat, and online.py is used
    prior_mean: Tensor
    prior_std: Tensor

    def __init__(self, latent: int, draws: Draws) -> None:
        super().__init__()
        self.register_buffer("prior_mean", torch.zeros(len(draws), latent, device=draws.device))
        self.register_buffer("prior_std", torch.ones(len(draws), latent, device=draws.device))

    def set_prior(self, theta_hat: Tensor) -> None:
        """Fit the prior to latents [S, B, D] inferred on whole trials (empirical Bayes).

        With N(0, 1) instead, early samples cover more of the latent space than the data does.
        """
        self.prior_mean.copy_(theta_hat.mean(1))
        self.prior_std.copy_(theta_hat.std(1, correction=0).clamp(min=0.05))

    def prior(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and std, broadcast against [S, ..., D]."""
        return per_seed(self.prior_mean, like), per_seed(self.prior_std, like)

    @abstractmethod
    def forward(self, batch: Batch) -> Tensor:
        """Memories [S, B, T + 1, M] after 0, 1, ..., T transitions, episodes joined end to end."""

    @abstractmethod
    def start(self, n: int) -> Tensor:
        """The memory [S, N, M] of n histories without a transition, for each seed."""

    @abstractmethod
    def update(self, memory: Tensor, step: Batch) -> Tensor:
        """Memory after one more transition (step: no time axis); unchanged where its mask is 0."""

    def innovation_loss(self, steps: Batch, change: Callable[[], Tensor] | None = None) -> Tensor:
        """The loss [S] on steps [S, K] of what the belief needs beside its objective; 0 unless it reads innovations.

        change: gives the scaled changes [S, K, O] that are to be expected; None: those of the steps.
        """
        return self.prior_mean.new_zeros(len(self.prior_mean))

    @abstractmethod
    def posterior(self, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and std [..., D] of q_phi given memories [..., M]."""

    def hindsight(self, batch: Batch, memories: Tensor) -> Tensor:
        """Memories [S, B, K, M] from which the latents of whole trials [S, B, T] are inferred.

        K is 1, or T, a memory a step, where the latent may change within a trial. memories: those of `forward`.
        """
        return memories[:, :, -1:]


class EvidenceBelief(Belief):
    """The order-free belief: a sum of evidence over transitions, read by a small network.

    Given theta the dynamics are Markov, so that p(theta | tau) depends on the *set* of transitions alone: log p(theta |
    tau) is a sum with a term for each. So is the memory: a cumulative sum, without recurrence. The network reads the
    sum divided by the count and by its square root, and the logarithm of the count, so that its inputs keep their
    scale for trials of any length. Without a transition, q is the prior. A trial that is longer than those of training
    counts as one of that length with the same mean evidence, so that inputs stay in the range of training.

    The evidence is whitened at first, so that its sum is a random walk about 0 and theta shows as its drift. Otherwise
    its common part grows with the count, and Eq. (6) stays for long on the plateau where the latent is ignored. It
    stays there too where theta shows only in the product of action and change (a motor that turns the other way). Where
    these products are few, they are inputs of the network.

    The network reads *innovations*: changes of the observation, less those that a theta-blind model of the dynamics
    expects (`innovation_loss`). What theta does to a step is often small beside what the state and the action do; the
    network would have to subtract these before it sees theta. Innovations are part of the sum as they are, too: of what
    theta adds to a change, their mean is a sufficient statistic.
    """

    longest: Tensor

    def __init__(self, latent: int, width: int, scales: Scales, draws: Draws) -> None:
        super().__init__(latent, draws)
        self.inputs, self.change = Inputs(scales), scales.change
        signature = scales.signature
        products = signature.obs * signature.action_features
        self.products = products if products <= MAX_PRODUCTS else 0
        inputs = signature.obs + signature.action_features
        self.expected = Mlp(inputs, width, signature.obs, draws)
        self.evidence = self._evidence_network(width, inputs, draws)
        self.width, self.features = width, width // 4 + signature.obs + self.products
        self.whiten = Whitener(self.features, draws)
        self.read_width = 2 * self.features + 1
        self.out = Mlp(self.read_width, width, 2 * latent, draws)
        self.register_buffer("longest", torch.tensor(0.0, device=draws.device))

    def _evidence_network(self, width: int, inputs: int, draws: Draws) -> Mlp:
        """The network whose outputs are summed. inputs: the width of an observation and an action."""
        return Mlp(inputs + self.inputs.signature.obs + self.products, width, width // 4, draws)

    def _evidence(self, given: list[Tensor], innovation: Tensor, direct: list[Tensor]) -> Tensor:
        """The evidence [..., width // 4] of transitions. given: observation and action; direct: what is summed too."""
        return self.evidence(torch.cat([*given, *direct], -1))  # type: ignore[no-any-return]

    def _innovation(self, batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
        """Scaled observations and actions of transitions, and the scaled change [..., O] less its expectation."""
        inputs = self.inputs.obs(batch.obs), self.inputs.action(batch.action)
        return *inputs, self.change(batch.next_obs - batch.obs) - self.expected(torch.cat(inputs, -1))

    def innovation_loss(self, steps: Batch, change: Callable[[], Tensor] | None = None) -> Tensor:
        expected = self.expected(torch.cat([self.inputs.obs(steps.obs), self.inputs.action(steps.action)], -1))
        changes = change() if change else self.change(steps.next_obs - steps.obs)
        return masked_mean((changes - expected).square().sum(-1), steps.mask)

    def _terms(self, batch: Batch) -> Tensor:
        """Increments of the memory [..., M], one a transition: its evidence and a count of 1; 0 where the mask is 0."""
        with torch.no_grad():
            obs, action, innovation = self._innovation(batch)
            direct = [innovation]
            if self.products:
                direct.append((action[..., None] * innovation[..., None, :]).flatten(-2))
        evidence = self._evidence([obs, action], innovation, direct)
        evidence = self.whiten(torch.cat([evidence, *direct], -1), batch.mask)
        mask = batch.mask[..., None]
        return torch.cat([evidence * mask, mask], -1)

    def _lengthen(self, batch: Batch) -> None:
        """Keep, in training, the length of the longest trial so far: with padding, as it is the same for all seeds."""
        if self.training and torch.is_grad_enabled():
            self.longest.clamp_(min=batch.mask.shape[2])

    def forward(self, batch: Batch) -> Tensor:
        terms = self._terms(batch)
        self._lengthen(batch)
        return torch.cat([torch.zeros_like(terms[:, :, :1]), terms], 2).cumsum(2)

    def start(self, n: int) -> Tensor:
        return self.prior_mean.new_zeros(len(self.prior_mean), n, self.features + 1)

    def update(self, memory: Tensor, step: Batch) -> Tensor:
        return memory + self._terms(step)

    def _rescaled(self, total: Tensor, longest: Tensor) -> Tensor:
        """What is read [..., 2 F + 1] of a sum of evidence and its count [..., F + 1], at most `longest` unless 0."""
        evidence, n = total.split([self.features, 1], -1)
        scale = torch.where(longest > 0, longest / n, 1.0).clamp(max=1)
        evidence, n = evidence * scale, 1 + n * scale
        return torch.cat([evidence / n, evidence / n.sqrt(), n.log() - 2], -1)

    def read(self, memory: Tensor) -> Tensor:
        """What networks read [..., read_width] of memories [..., M]."""
        return self._rescaled(memory, self.longest)

    def posterior(self, memory: Tensor) -> tuple[Tensor, Tensor]:
        return self.posterior_of(self.read(memory), memory)

    def posterior_of(self, read: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """`posterior`, given what `read` gives too."""
        mean, raw = self.out(read).chunk(2, -1)
        std = (F.softplus(raw) + 1e-6).sqrt()
        prior_mean, prior_std = self.prior(mean)
        empty = memory[..., self.features : self.features + 1] == 0
        return torch.where(empty, prior_mean, mean), torch.where(empty, prior_std, std)


class InnovationBelief(EvidenceBelief):
    """The order-free belief whose evidence is linear in innovations, sum_t G(s_t, a_t) (s'_t - E[s' | s_t, a_t]).

    That is the linear part of the evidence of a linear-Gaussian effect of theta, s' = f(s, a) + g(s, a) theta + noise,
    with gains G = g^T Sigma^-1, which are learned; the precision is taken for a function of the count. Evidence that
    depends on states otherwise tells of theta by where a trial went: a controller that is wrong about theta drifts to
    one side. This holds of exploration, but not of the expert's trials, so that their latents differ from those by
    which an agent acts.
    """

    linear = True

    def _evidence_network(self, width: int, inputs: int, draws: Draws) -> Mlp:
        return Mlp(inputs, width, width // 4 * self.inputs.signature.obs, draws)

    def _evidence(self, given: list[Tensor], innovation: Tensor, direct: list[Tensor]) -> Tensor:
        gains = self.evidence(torch.cat(given, -1)).unflatten(-1, (-1, innovation.shape[-1]))
        return (gains * innovation[..., None, :]).sum(-1)


class ForgettingBelief(InnovationBelief):
    """A belief about a latent that may change at any step, or may not: sums that forget beside the one that does not.

    Besides the sum of all evidence it keeps sums in which a step counts KEPT^age, so that evidence of a former latent
    fades. The network reads all of them, and learns which to trust for what.
    """

    KEPT = (31 / 32, 7 / 8)
    lost: Tensor

    def __init__(self, latent: int, width: int, scales: Scales, draws: Draws) -> None:
        super().__init__(latent, width, scales, draws)
        self.sums = 1 + len(self.KEPT)
        self.read_width *= self.sums
        self.out = Mlp(self.read_width, width, 2 * latent, draws)
        lost = torch.tensor([0.0, *(1 - kept for kept in self.KEPT)], device=draws.device)
        self.register_buffer("lost", lost[:, None], persistent=False)  # of each sum, at a step

    def forward(self, batch: Batch) -> Tensor:
        terms = self._terms(batch)
        self._lengthen(batch)
        sums = [terms.cumsum(2), *(faded_sum(terms, kept) for kept in self.KEPT)]
        return F.pad(torch.cat(sums, -1), (0, 0, 1, 0))

    def hindsight(self, batch: Batch, memories: Tensor) -> Tensor:
        """Of each step, what is evidence of the latent at that step: before it and after it."""
        terms = self._terms(batch)
        sums = [terms.sum(2, keepdim=True).expand_as(terms)]
        for kept in self.KEPT:
            after = faded_sum(terms.flip(2), kept).flip(2)
            sums.append(after + kept * F.pad(faded_sum(terms, kept), (0, 0, 1, -1)))
        return torch.cat(sums, -1)

    def start(self, n: int) -> Tensor:
        return self.prior_mean.new_zeros(len(self.prior_mean), n, self.sums * (self.features + 1))

    def update(self, memory: Tensor, step: Batch) -> Tensor:
        sums, terms, mask = memory.unflatten(-1, (self.sums, -1)), self._terms(step), step.mask[..., None, None]
        return (sums * (1 - self.lost * mask) + terms[..., None, :]).flatten(-2)

    def read(self, memory: Tensor) -> Tensor:
        longest = torch.cat([self.longest[None, None], 1 / self.lost[1:]])
        return self._rescaled(memory.unflatten(-1, (self.sums, -1)), longest).flatten(-2)


def faded_sum(x: Tensor, kept: float) -> Tensor:
    """y[t] = x[t] + kept y[t - 1], of x [S, B, T, F] along T, by doubling the window until kept^window is < 1e-4."""
    window, y = 1, x
    while window < x.shape[2] and kept**window > 1e-4:
        y = y + kept**window * F.pad(y, (0, 0, window, -window))
        window *= 2
    return y
