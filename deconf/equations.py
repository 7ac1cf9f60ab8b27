"""The paper's equations as pure functions.

theta: hidden latent; theta_hat: learned latent; tau_:t = (s_0, a_0, ..., s_t): history. K counts values of theta.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from envs.task import Array


def belief_update(log_belief: Array, log_dynamics: Array, log_policy: Array | None = None) -> Array:
    """One step of p_int, Eq. (5) and (8), or, given the expert's log-probabilities too, of p_cond, Eq. (3) and (9).

    log_belief [N, K], log p(s_{t+1} | s_t, a_t, theta) [N, K], log pi_exp(a_t | s_t, theta) [N, K] -> normalised
    log-belief [N, K].
    """
    joint = log_belief + log_dynamics if log_policy is None else log_belief + log_dynamics + log_policy
    return joint - np.logaddexp.reduce(joint, axis=-1, keepdims=True)


def gaussian_kl(mean: Tensor, std: Tensor, prior_mean: Tensor, prior_std: Tensor) -> Tensor:
    """KL( N(mean, std^2) || N(prior_mean, prior_std^2) ), summed over the last axis: [..., D] -> [...]."""
    ratio = std / prior_std
    return 0.5 * (((mean - prior_mean) / prior_std) ** 2 + ratio**2 - 1 - 2 * ratio.log()).sum(-1)


def inference_loss(log_next: Tensor, kl: Tensor, beta: float) -> Tensor:
    """Eq. (6) with its sign turned, averaged over steps.

    log_next: log p_psi(s_{t+1} | s_t, a_t, theta_hat) for theta_hat ~ q_phi(. | tau_:t), and kl: of q_phi(. | tau_:t)
    from the prior, both [M].
    """
    return -(log_next - beta * kl).mean()


def imitation_loss(log_policy: Tensor) -> Tensor:
    """The last line of Algorithm 1: minus log pi_eta(a | s, ...) [M], averaged over steps."""
    return -log_policy.mean()


def reparametrise(mean: Tensor, std: Tensor, rng: torch.Generator) -> Tensor:
    """theta_hat ~ N(mean, std^2), differentiable; [..., D]."""
    return mean + std * torch.randn(mean.shape, generator=rng, device=rng.device).to(mean)
