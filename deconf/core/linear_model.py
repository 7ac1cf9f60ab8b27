"""A model whose dynamics are linear in theta_hat: evidence adds up, and likelihoods are exact (`LinearModel`)."""

import math
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from deconfounded.deconf.core.correlated import Correlated, inverse, log_expected_of_normal, posterior_root
from deconfounded.deconf.core.data import Batch, Draws, take
from deconfounded.deconf.core.dynamics import LinearDynamicsHead
from deconfounded.deconf.core.latent_model import LatentModel
from deconfounded.deconf.core.layers import by_seed
from deconfounded.deconf.core.nets import Inputs, Scales, per_seed

READ = 256  # memories an update, from each of which the evidence that follows is predicted
HALVES = 8  # of a trial an update, from each of which the evidence of the other half is predicted
ERROR = 0.1  # variance of the error of f and G in a step, relative to that of theta's effect there
ALIKE = 40  # steps in whose sum the error of f, alike in all of them, is as large as the noise


class LinearModel(LatentModel):
    """Bayesian linear regression on learned features (ALPaCA; Harrison, Sharma and Pavone, 2018), and a belief of it.

    Dynamics are s_next - s = f(s, a) + G(s, a) theta_hat + noise, and p(theta_hat) is a standard normal. The
    log-likelihood of a trial is then b^T theta_hat - theta_hat^T P theta_hat / 2, but for a constant. P and b are sums
    over its steps, of G^T G and of G^T (s_next - s - f), in units of the noise: they are the memory. f, G and the noise
    maximise the exact marginal likelihood of trials and their beginnings: theta_hat is integrated out, by exact
    inference (footnote 4 of the paper) in place of Eq. (6). Eq. (6) draws theta_hat from a network. The error of what
    it draws makes G too small, and f learns theta's effect wherever the state tells of theta, as it does if a
    controller that is wrong about theta drifts to one side.

    The noise of a column has a variance that is learned, s^2, and ERROR of that of theta's effect in the step, |G|^2:
    f and G are never exact, so that a step of one column is worth at most 1 / ERROR readings of theta. Without that, G
    grows without bound where f is poor and s^2, which is the same everywhere, too small: an angle that wraps, a
    contact, the end of a lane. Such a step then outweighs all others of its trial.

    The posterior of this regression is not the belief. f is never exact; its errors add up over a trial, depend on
    where the behaviour goes, and the latents of an expert's trials are then not those of an agent's. And latents of
    different thetas lie near a surface, not all over the prior. So the belief is a Gaussian with covariance that a
    network makes of the posterior's mean and stds. It is trained to predict, in closed form, the evidence of the steps
    that follow. In a sum of n steps an error of f that is alike in all of them has n / ALIKE of the noise's variance,
    so that this evidence is tempered. Policies are cloned on the mean given whole trials: its uncertainty is of what f
    does not explain, not of theta. What beginnings of a trial tell of that mean is for a second network (`online.py`).
    """

    kind = "linear"
    share_power = 3  # evidence is strong: of an episode's, what a drift of theta leaves is a hundredth or so
    stds: Tensor
    error: Tensor

    def __init__(self, latent: int, width: int, scales: Scales, draws: Draws) -> None:
        super().__init__(draws)
        self.latent, self.width, self.inputs = latent, width, Inputs(scales)
        self.dynamics: LinearDynamicsHead = LinearDynamicsHead(latent, width, self.inputs, draws)
        self.gaussian, self.read_width = Correlated(latent), 2 * latent + 1
        self.register_buffer("stds", torch.ones(len(draws), latent, device=draws.device))
        self.register_buffer("error", torch.full((len(draws), 1), ERROR, device=draws.device))
        self.reader = self.gaussian.network(self.read_width, width, draws)

    def _effects(self, batch: Batch) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Arguments of `weigh`."""
        expected, gains = self.dynamics.parts(batch.obs, batch.action)
        innovation = self.dynamics.change(batch.next_obs - batch.obs) - expected
        noise, error = (per_seed(x, expected) for x in ((2 * self.dynamics.log_std).exp(), self.error))
        return gains, innovation, noise.expand_as(innovation), error, batch.mask[..., None]

    @torch.no_grad()
    def _terms(self, batch: Batch) -> Tensor:
        """Increments of the memory [..., M], one a transition: products of (G, s_next - s - f), log s, a count of 1."""
        return weigh(*self._effects(batch))[0]

    def _sums(self, memory: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """P [..., D, D], b [..., D] and the squares of innovations [...], in double precision."""
        sums = memory[..., :-2].double().unflatten(-1, (self.latent + 1, -1))
        return sums[..., :-1, :-1], sums[..., :-1, -1], sums[..., -1, -1]

    def start(self, n: int) -> Tensor:
        return self.kept.new_zeros(len(self.kept), n, (self.latent + 1) ** 2 + 2)

    def update(self, memory: Tensor, step: Batch) -> Tensor:
        return memory + self._terms(step)

    def course(self, batch: Batch) -> tuple[Tensor, Tensor]:
        memories = F.pad(self._terms(batch).cumsum(2), (0, 0, 1, 0))
        return memories, memories[:, :, -1:]

    def final_memory(self, batch: Batch) -> Tensor:
        return self._terms(batch).sum(2)

    def _posterior(self, memory: Tensor) -> Tensor:
        """Mean and logarithmic stds of the posterior, and the logarithm of the count. Memories have no gradient."""
        precision, weighted, _ = self._sums(memory)
        root = inverse(posterior_root(precision))
        mean = (root.mT @ (root @ weighted[..., None]))[..., 0].float()
        std = root.square().sum(-2).sqrt().float()
        return torch.cat([mean, std.log(), (1 + memory[..., -1:]).log() - 2], -1)

    def belief(self, memory: Tensor) -> Tensor:
        return self._belief_of(self._posterior(memory))

    def _belief_of(self, posterior: Tensor) -> Tensor:
        return self.gaussian.about(posterior[..., : self.latent], self.reader(posterior))

    def read(self, memory: Tensor) -> tuple[Tensor, Tensor]:
        posterior = self._posterior(memory)
        return posterior, posterior[..., : self.latent] + self.mean(self.reader(posterior))  # that of `belief`

    def for_cloning(self, belief: Tensor, draws: Draws) -> Tensor:
        return self.mean(belief)

    def set_prior(self, belief: Tensor, draws: Draws) -> None:
        self.scale_to(self.mean(belief))

    def scale_to(self, latents: Tensor) -> None:
        """Take the stds of latents [S, B, D] for `latent_stds`."""
        self.stds.copy_(latents.std(1, correction=0).clamp(min=0.05))

    def latent_stds(self) -> Tensor:
        return self.stds

    def sample(self, belief: Tensor, draws: Draws) -> Tensor:
        return self.gaussian.sample(belief, draws)

    def mean(self, belief: Tensor) -> Tensor:
        return self.gaussian.split(belief)[0]

    def log_next(self, memory: Tensor, step: Batch, draws: Draws) -> Tensor:
        terms = self._terms(step)
        constant = step.mask * self.dynamics.log_std.shape[-1] * math.log(2 * math.pi) / 2
        return self.log_expected(memory, terms) - self._sums(terms)[2].float() / 2 - terms[..., -2] - constant

    def log_expected(self, memory: Tensor, terms: Tensor) -> Tensor:
        """log E exp(b^T theta_hat - theta_hat^T P theta_hat / 2) [...] of the evidence in terms, given a memory."""
        precision, weighted, _ = self._sums(terms)
        return self.gaussian.log_expected(self.belief(memory), precision, weighted)

    def loss(self, batch: Batch, steps: int | None, beta: float, draws: Draws) -> Tensor:
        terms, total = Evidence.apply(*self._effects(batch))
        with torch.no_grad():
            sums = terms.cumsum(2)
            index = batch.draw_steps(READ, draws)
            before = take((sums - terms).flatten(1, 2), index)
            after = take(sums[:, :, -1], index // terms.shape[2]) - before
        return self.surprise(total) + self.prediction_loss(before, after)

    def loss_on_sets(self, batch: Batch, steps: int | None, beta: float, draws: Draws) -> Tensor:
        terms, total = Evidence.apply(*self._effects(batch))
        with torch.no_grad():
            half = (draws.uniform(len(batch), HALVES, terms.shape[2]) < 0.5).float()
            before, after = products(half, terms), products(1 - half, terms)
        return self.surprise(total) + self.prediction_loss(before.flatten(1, 2), after.flatten(1, 2))

    def surprise(self, memory: Tensor) -> Tensor:
        """-log p [S] of trials with memories [S, B, M], theta_hat integrated out: a mean over steps.

        Without its constant, log(2 pi) / 2 for each number of an observation.
        """
        precision, weighted, squares = self._sums(memory)
        total = squares / 2 - log_expected_of_normal(precision, weighted[..., None]) + memory[..., -2]
        return (total.sum(-1) / memory[..., -1].sum(-1).clamp(min=1)).float()

    def prediction_loss(self, before: Tensor, after: Tensor) -> Tensor:
        """-log p [S] of the evidence in memories `after` under the beliefs of `before`, both [S, N, M]: by step."""
        after = after / (1 + after[..., -1:] / ALIKE)
        precision, weighted, _ = self._sums(after)
        log_likelihood = self.gaussian.log_expected(self.belief(before), precision, weighted)
        return -log_likelihood.sum(-1) / after[..., -1].sum(-1).clamp(min=1)


class ExactLinearModel(LinearModel):
    """The same dynamics, believed in: what a memory predicts is by the posterior itself, and by no network."""

    def log_expected(self, memory: Tensor, terms: Tensor) -> Tensor:
        sums = self._sums(memory), self._sums(memory + terms)
        before, after = (log_expected_of_normal(precision, weighted[..., None]) for precision, weighted, _ in sums)
        return (after - before).float()


def weigh(gains: Tensor, innovation: Tensor, noise: Tensor, error: Tensor, mask: Tensor) -> tuple[Tensor, ...]:
    """Increments of the memory [..., M]; (G, innovation) [..., O, D + 1] in units of the noise; variances [..., O].

    gains: G [..., O, D]. innovation: s_next - s - f, and noise: its variance s^2, both [..., O]. error: ERROR. mask:
    [..., 1].
    """
    variance = noise + error * gains.square().sum(-1)
    both = torch.cat([gains, innovation[..., None]], -1) * (mask * variance.rsqrt())[..., None]
    log_std = mask * variance.log().sum(-1, keepdim=True) / 2
    return torch.cat([products(both.mT, both).flatten(-2), log_std, mask], -1), both, variance


class Evidence(torch.autograd.Function):
    """`weigh`: the increments [S, B, T, M], and with a gradient their sums over trials [S, B, M].

    What a sum sends back is the same for all steps of a trial: one matrix product a trial, in place of one a step.
    """

    @staticmethod
    def forward(ctx: Any, *effects: Tensor) -> tuple[Tensor, Tensor]:
        terms, both, variance = weigh(*effects)
        gains, _, _, error, mask = effects
        ctx.mark_non_differentiable(terms)
        ctx.save_for_backward(gains, error, mask, both, variance)
        return terms, terms.sum(2)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        gains, error, mask, both, variance = ctx.saved_tensors
        by_product, by_log_std, _ = grads[1].split([both.shape[-1] ** 2, 1, 1], -1)
        by_product = by_product.unflatten(-1, (both.shape[-1], -1))
        by_both = products(both.flatten(2, 3), by_product + by_product.mT).view_as(both)
        by_variance = (mask * by_log_std[..., None] - (by_both * both).sum(-1)) / (2 * variance)
        by_both *= (mask * variance.rsqrt())[..., None]
        by_gains = by_both[..., :-1] + (2 * error * by_variance)[..., None] * gains
        return by_gains, by_both[..., -1], by_variance, None, None


def products(a: Tensor, b: Tensor) -> Tensor:
    """a @ b, of stacks [S, ..., N, K] and [S, ..., K, M], seed by seed. Without a gradient."""
    return by_seed(a, b, torch.matmul)
