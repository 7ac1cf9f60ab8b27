"""Latent-variable models of the dynamics, which infer theta_hat from a history. They are trained on exploration.

Variational: q_phi(theta_hat | tau) and p_psi(s' | s, a, theta_hat), trained on Eq. (6). Discrete: K models of the
dynamics, and exact Bayesian inference over which one it is (footnote 4).
"""

import math
from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from deconfounded.deconf.core.adam import Adam
from deconfounded.deconf.core.beliefs import Belief, EvidenceBelief, ForgettingBelief, InnovationBelief
from deconfounded.deconf.core.data import Batch, Draws, take
from deconfounded.deconf.core.dynamics import DynamicsHead, LinearDynamicsHead
from deconfounded.deconf.core.gru import GruBelief
from deconfounded.deconf.core.nets import Inputs, Scales, per_seed, sample_index
from deconfounded.deconf.equations import belief_update, gaussian_kl, inference_loss, marginal_loss, reparametrise
from deconfounded.envs.support.errors import InputError

BELIEFS = {
    "innovations": InnovationBelief,
    "evidence": EvidenceBelief,
    "forgetting": ForgettingBelief,
    "gru": GruBelief,
}


class LatentModel(nn.Module, ABC):
    """A model that infers theta_hat [D]. A *belief* is the parameters [P] of a distribution over theta_hat.

    `kept` [S]: the share of the memory that outlives an episode, 1 unless theta drifts.
    """

    kind: str
    latent: int
    width: int
    inputs: Inputs
    kept: Tensor

    def __init__(self, draws: Draws) -> None:
        super().__init__()
        self.register_buffer("kept", torch.ones(len(draws), device=draws.device))

    def forget(self, memory: Tensor) -> Tensor:
        """The memory [S, N, M] with which the next episode of a trial begins."""
        return torch.lerp(self.start(memory.shape[1]), memory, per_seed(self.kept[:, None], memory))

    @abstractmethod
    def start(self, n: int) -> Tensor:
        """The memory [S, N, M] of n histories without a transition, for each seed."""

    @abstractmethod
    def update(self, memory: Tensor, step: Batch) -> Tensor:
        """Memory after one more transition (step: no time axis); unchanged where its mask is 0."""

    @abstractmethod
    def final_memory(self, batch: Batch) -> Tensor:
        """The memory [S, B, M] after whole trials; [S, B T, M], one a step, if the latent may change within."""

    @abstractmethod
    def belief(self, memory: Tensor) -> Tensor:
        """[..., M] -> [..., P]."""

    @abstractmethod
    def sample(self, belief: Tensor, draws: Draws) -> Tensor:
        """theta_hat [S, ..., D] from beliefs [S, ..., P]."""

    @abstractmethod
    def mode(self, belief: Tensor) -> Tensor:
        """The likeliest theta_hat [..., D]."""

    @abstractmethod
    def mean(self, belief: Tensor) -> Tensor:
        """The mean [..., D] of theta_hat: of one-hot values their probabilities."""

    @abstractmethod
    def log_next(self, memory: Tensor, step: Batch, draws: Draws) -> Tensor:
        """log p_psi(s' | s, a, theta_hat) [S, N] of a step (no time axis), under the belief of the memory [S, N, M]."""

    @abstractmethod
    def loss(self, batch: Batch, steps: int | None, beta: float, draws: Draws) -> Tensor:
        """The loss [S] on trials [S, B, T]. steps: how many of them are predicted; None: all."""

    def set_prior(self, belief: Tensor, draws: Draws) -> None:
        """Fit p(theta_hat) to beliefs [S, B, P] of whole trials."""

    def learn(self, optimizer: Adam, batch: Batch, steps: int | None, beta: float, draws: Draws) -> float:
        """One update on `loss`; returns its mean over seeds."""
        loss = self.loss(batch, steps, beta, draws)
        optimizer.step(loss)
        return loss.mean().item()


class VariationalModel(LatentModel):
    """The paper's model: a belief is a Gaussian, and Eq. (6) trains q_phi and p_psi together."""

    def __init__(self, kind: str, latent: int, width: int, scales: Scales, draws: Draws) -> None:
        super().__init__(draws)
        self.kind, self.latent, self.width = kind, latent, width
        self.encoder: Belief = BELIEFS[kind](latent, width, scales, draws)  # type: ignore[abstract]
        self.inputs = self.encoder.inputs
        head = LinearDynamicsHead if self.encoder.linear else DynamicsHead
        self.dynamics = head(latent, width, self.inputs, draws)

    def start(self, n: int) -> Tensor:
        return self.encoder.start(n)

    def update(self, memory: Tensor, step: Batch) -> Tensor:
        return self.encoder.update(memory, step)

    def final_memory(self, batch: Batch) -> Tensor:
        return self.encoder.hindsight(batch, self.encoder(batch)).flatten(1, 2)

    def belief(self, memory: Tensor) -> Tensor:
        return torch.cat(self.encoder.posterior(memory), -1)

    def sample(self, belief: Tensor, draws: Draws) -> Tensor:
        mean, std = belief.chunk(2, -1)
        return reparametrise(mean, std, draws.normal(*mean.shape[1:]))

    def mode(self, belief: Tensor) -> Tensor:
        return self.mean(belief)

    def mean(self, belief: Tensor) -> Tensor:
        return belief.chunk(2, -1)[0]

    def log_next(self, memory: Tensor, step: Batch, draws: Draws) -> Tensor:
        theta_hat = self.sample(self.belief(memory), draws)
        return self.dynamics.log_prob(step.obs, step.action, step.next_obs, theta_hat)[..., 0]

    def loss(self, batch: Batch, steps: int | None, beta: float, draws: Draws) -> Tensor:
        index = batch.draw_steps(steps, draws)
        transitions = batch.steps(index)
        memories = self.encoder(batch)[:, :, :-1].flatten(1, 2)
        mean, std = self.encoder.posterior(take(memories, index))
        theta_hat = reparametrise(mean, std, draws.normal(*mean.shape[1:]))
        bound = self.negative_elbo(transitions, mean, std, theta_hat, beta)
        return bound + self.innovation_loss(transitions, theta_hat)

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


class DiscreteModel(LatentModel):
    """A mixture of K models: theta_hat is one-hot, and p_psi(s' | s, a, k) maximises the exact marginal likelihood.

    The memory is the log-belief, updated by Bayes' rule: Eq. (5) with a learned model, without encoder or bound.
    p(k) is uniform, so that each k stands for an equal share of p(theta); a fitted prior lets one k take over.
    """

    kind = "discrete"

    def __init__(self, latent: int, width: int, scales: Scales, draws: Draws) -> None:
        super().__init__(draws)
        self.latent, self.width, self.inputs = latent, width, Inputs(scales)
        self.dynamics = DynamicsHead(0, width, self.inputs, draws, copies=latent)

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

    def forget(self, memory: Tensor) -> Tensor:
        return super().forget(memory).log_softmax(-1)

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
    """An untrained model: of BELIEFS, or `discrete`. Raises InputError for another kind."""
    if kind == "discrete":
        return DiscreteModel(latent, width, scales, draws)
    if kind not in BELIEFS:
        raise InputError(f"model was {kind!r}; it must be one of {', '.join(BELIEFS)}, discrete")
    return VariationalModel(kind, latent, width, scales, draws)


@torch.no_grad()
def final_belief(model: LatentModel, trials: Batch, part: int = 64) -> Tensor:
    """Beliefs q_phi(theta_hat_H | tau) after whole trials, [S, B, P]; in parts of so many, to save memory.

    [S, B T, P], one a step, if the latent may change within a trial.
    """
    indices = torch.arange(len(trials), device=trials.mask.device).split(part)
    return torch.cat([model.belief(model.final_memory(trials[:, i])) for i in indices], 1)
