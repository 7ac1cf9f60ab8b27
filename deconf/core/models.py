"""Latent-variable models of the dynamics, which infer theta_hat from a history. They are trained on exploration.

Linear, in linear_model.py: dynamics linear in theta_hat. Variational: q_phi(theta_hat | tau) and p_psi(s' | s, a,
theta_hat), trained on Eq. (6). Discrete: K models of the dynamics, and exact Bayesian inference over which one it is
(footnote 4).
"""

import math
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn import functional as F

from deconfounded.deconf.core.beliefs import Belief, EvidenceBelief, ForgettingBelief, InnovationBelief
from deconfounded.deconf.core.data import Batch, Draws, take
from deconfounded.deconf.core.dynamics import CodedDynamicsHead, DynamicsHead, LinearDynamicsHead
from deconfounded.deconf.core.gru import GruBelief
from deconfounded.deconf.core.latent_model import LatentModel
from deconfounded.deconf.core.linear_model import LinearModel
from deconfounded.deconf.core.nets import Inputs, Scales, sample_index
from deconfounded.deconf.equations import belief_update, gaussian_kl, inference_loss, marginal_loss, reparametrise
from deconfounded.envs.support.errors import InputError

BELIEFS = {
    "innovations": InnovationBelief,
    "evidence": EvidenceBelief,
    "forgetting": ForgettingBelief,
    "gru": GruBelief,
}


class VariationalModel(LatentModel):
    """The paper's model: a belief is a Gaussian, and Eq. (6) trains q_phi and p_psi together."""

    def __init__(self, kind: str, latent: int, width: int, scales: Scales, draws: Draws) -> None:
        super().__init__(draws)
        self.kind, self.latent, self.width = kind, latent, width
        self.encoder: Belief = BELIEFS[kind](latent, width, scales, draws)  # type: ignore[abstract]
        self.inputs = self.encoder.inputs
        self.read_width = self.encoder.read_width if isinstance(self.encoder, InnovationBelief) else 0
        head = LinearDynamicsHead if self.encoder.linear else DynamicsHead
        self.dynamics = head(latent, width, self.inputs, draws)

    def start(self, n: int) -> Tensor:
        return self.encoder.start(n)

    def update(self, memory: Tensor, step: Batch) -> Tensor:
        return self.encoder.update(memory, step)

    def course(self, batch: Batch) -> tuple[Tensor, Tensor]:
        memories = self.encoder(batch)
        return memories, self.encoder.hindsight(batch, memories)

    def final_memory(self, batch: Batch) -> Tensor:
        return self.course(batch)[1].flatten(1, 2)

    def belief(self, memory: Tensor) -> Tensor:
        return torch.cat(self.encoder.posterior(memory), -1)

    def sample(self, belief: Tensor, draws: Draws) -> Tensor:
        mean, std = belief.chunk(2, -1)
        return reparametrise(mean, std, draws.normal(*mean.shape[1:]))

    def mean(self, belief: Tensor) -> Tensor:
        return belief.chunk(2, -1)[0]

    def loss(self, batch: Batch, steps: int | None, beta: float, draws: Draws) -> Tensor:
        index = batch.draw_steps(steps, draws)
        transitions = batch.steps(index)
        memories = self.encoder(batch)[:, :, :-1].flatten(1, 2)
        mean, std = self.encoder.posterior(take(memories, index))
        theta_hat = reparametrise(mean, std, draws.normal(*mean.shape[1:]))
        bound = self.negative_elbo(transitions, mean, std, theta_hat, beta)
        return bound + self.innovation_loss(transitions, theta_hat)

    def loss_on_sets(self, batch: Batch, steps: int | None, beta: float, draws: Draws) -> Tensor:
        if isinstance(self.encoder, ForgettingBelief):
            return super().loss_on_sets(batch, steps, beta, draws)
        half = draws.uniform(*batch.mask.shape[1:]) < 0.5
        context, rest = (replace(batch, mask=batch.mask * part) for part in (half, ~half))
        belief = self.belief(self.final_memory(context))
        index = rest.draw_steps(steps, draws)
        predicted, trial = rest.steps(index), index // batch.mask.shape[2]
        theta_hat, mean, std = (take(x, trial) for x in (self.sample(belief, draws), *belief.chunk(2, -1)))
        bound = self.negative_elbo(predicted, mean, std, theta_hat, beta)
        return bound + self.innovation_loss(predicted, theta_hat)

    def innovation_loss(self, steps: Batch, theta_hat: Tensor) -> Tensor:
        """The belief's `innovation_loss` [S], of steps [S, K] under latents [S, K, D].

        What is to be expected of a step is E_theta E[s' - s | s, a, theta], the back-door adjustment. The mean of the
        changes themselves is confounded: explorers act by what they believe of theta, so that a and s tell of it. So
        to each change is added what the model says that the latent of another step would have made of it.
        """

        @torch.no_grad()
        def change() -> Tensor:
            own, other = (self.dynamics.mean(steps.obs, steps.action, x) for x in (theta_hat, theta_hat.flip(1)))
            return self.inputs.scales.change(steps.next_obs - steps.obs) - own + other

        return self.encoder.innovation_loss(steps, change)

    def negative_elbo(self, steps: Batch, mean: Tensor, std: Tensor, theta_hat: Tensor, beta: float) -> Tensor:
        """The negative of the bound of Eq. (6) [S], of steps [S, K], beliefs N(mean, std^2) and latents from these."""
        log_next = self.dynamics.log_prob(steps.obs, steps.action, steps.next_obs, theta_hat)[..., 0]
        kl = gaussian_kl(mean, std, *self.encoder.prior(mean))
        return inference_loss(log_next, kl, beta, steps.mask)

    def set_prior(self, belief: Tensor, draws: Draws) -> None:
        self.encoder.set_prior(self.sample(belief, draws))

    def read(self, memory: Tensor) -> tuple[Tensor, Tensor]:
        assert isinstance(self.encoder, InnovationBelief)
        read = self.encoder.read(memory)
        return read, self.encoder.posterior_of(read, memory)[0]

    def latent_stds(self) -> Tensor:
        return self.encoder.prior_std


class DiscreteModel(LatentModel):
    """A mixture of K models: theta_hat is one-hot, and p_psi(s' | s, a, k) maximises the exact marginal likelihood.

    The models differ by a code of a few numbers (CodedDynamicsHead). The memory is the log-belief, updated by Bayes'
    rule: Eq. (5) with a learned model, without encoder or bound. p(k) is uniform, so that each k stands for an equal
    share of p(theta); a fitted prior lets one k take over.
    """

    kind = "discrete"
    code = 8  # numbers by which models differ

    def __init__(self, latent: int, width: int, scales: Scales, draws: Draws) -> None:
        super().__init__(draws)
        self.latent, self.width, self.inputs = latent, width, Inputs(scales)
        self.dynamics = CodedDynamicsHead(latent, self.code, width, self.inputs, draws)

    def _evidence(self, batch: Batch) -> Tensor:
        log_next = self.dynamics.log_prob(batch.obs, batch.action, batch.next_obs)
        return log_next * batch.mask[..., None]

    def start(self, n: int) -> Tensor:
        scale = self.dynamics.log_std
        return scale.new_full((len(scale), n, self.latent), -math.log(self.latent))

    def update(self, memory: Tensor, step: Batch) -> Tensor:
        return belief_update(memory, self._evidence(step))

    def final_memory(self, batch: Batch) -> Tensor:
        return belief_update(self.start(len(batch)), self._evidence(batch).sum(2))

    def belief(self, memory: Tensor) -> Tensor:
        return memory.exp()

    def sample(self, belief: Tensor, draws: Draws) -> Tensor:
        return F.one_hot(sample_index(belief, draws), self.latent).float()

    def mode(self, belief: Tensor) -> Tensor:
        return F.one_hot(belief.argmax(-1), self.latent).float()

    def mean(self, belief: Tensor) -> Tensor:
        return belief

    def forget(self, memory: Tensor, share: Tensor | None = None) -> Tensor:
        left = super().forget(memory, share)
        return torch.where((left == memory).all(-1, keepdim=True), memory, left.log_softmax(-1))

    def log_next(self, memory: Tensor, step: Batch, draws: Draws) -> Tensor:
        return torch.logsumexp(memory + self._evidence(step), -1)

    def loss(self, batch: Batch, steps: int | None, beta: float, draws: Draws) -> Tensor:
        """The mean loss on histories of n = 1, 2, 4, ... steps: a trial of T steps is split into T / n of them.

        Each takes every (T / n)-th step, and so is under a single theta. With whole long trials alone, the k that is
        best at first claims every trial, and the others never learn.
        """
        log_next, mask = self.dynamics.log_prob(batch.obs, batch.action, batch.next_obs), batch.mask
        doublings = (mask.shape[2] - 1).bit_length()
        padding = 2**doublings - mask.shape[2]
        log_next, mask = F.pad(log_next, (0, 0, 0, padding)), F.pad(mask, (0, padding))
        prior = self.start(1)[:, 0]
        losses = []
        for i in range(doublings + 1):
            histories, real = (x.unflatten(2, (2**i, -1)).transpose(2, 3).flatten(1, 2) for x in (log_next, mask))
            losses.append(marginal_loss(prior, histories, real))
        return torch.stack(losses).mean(0)


def new_model(kind: str, latent: int, width: int, scales: Scales, draws: Draws) -> LatentModel:
    """An untrained model: `linear`, of BELIEFS, or `discrete`. Raises InputError for another kind.

    Of observations that are 0 or 1 `linear` is `evidence`: no change of such a number is normal.
    """
    if kind == "discrete":
        return DiscreteModel(latent, width, scales, draws)
    if kind == "linear" and not scales.signature.binary:
        return LinearModel(latent, width, scales, draws)
    if kind not in ("linear", *BELIEFS):
        raise InputError(f"model was {kind!r}; it must be one of linear, {', '.join(BELIEFS)}, discrete")
    return VariationalModel("evidence" if kind == "linear" else kind, latent, width, scales, draws)
