"""The paper's equations as pure functions, each implemented here alone.

theta: hidden latent; theta_hat: learned latent; tau_:t = (s_0, a_0, ..., s_t): history. K counts values of theta.
Arrays and tensors may have more axes in front; losses average over the last one, where `mask` is 1. Eq. (4) is the
bandit: envs/tasks/bandit.py.
"""

from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from deconfounded.envs.streams import Array

if TYPE_CHECKING:  # exact policies, which have arrays alone, go without torch
    from torch import Tensor

Values = TypeVar("Values", Array, "Tensor")


def imitation_objective(log_expert: Array, taken: NDArray[np.bool_]) -> Array:
    """Eq. (1): sum over a rollout of log pi_exp(a_t | s_t, theta) of the imitator's own actions.

    log_expert [..., T], taken [..., T] (False after an episode's end) -> [...], to maximise. (The paper prints a minus
    sign inside the objective that it maximises.)
    """
    return np.where(taken, log_expert, 0).sum(-1)


def posterior_policy(log_belief: Array, policy: Array) -> Array:
    """Eq. (2) and (5), left: E over theta of pi_exp(a | s, theta); [..., K] and [..., K, A] -> [..., A]."""
    return (np.exp(log_belief)[..., None] * policy).sum(-2)


def belief_update(log_belief: Values, log_dynamics: Values, log_policy: Values | None = None) -> Values:
    """One step of p_int, Eq. (5) and (8), or, given the expert's log-probabilities too, of p_cond, Eq. (3) and (9).

    log_belief [..., K], log p(s_{t+1} | s_t, a_t, theta) [..., K], log pi_exp(a_t | s_t, theta) [..., K] ->
    normalised log-belief [..., K]. Sums over several steps update by all of them.
    """
    joint = log_belief + log_dynamics if log_policy is None else log_belief + log_dynamics + log_policy
    if isinstance(joint, np.ndarray):
        return joint - np.logaddexp.reduce(joint, axis=-1, keepdims=True)
    return joint - joint.logsumexp(-1, keepdim=True)


def gaussian_kl(mean: "Tensor", std: "Tensor", prior_mean: "Tensor", prior_std: "Tensor") -> "Tensor":
    """KL( N(mean, std^2) || N(prior_mean, prior_std^2) ), summed over the last axis: [..., D] -> [...]."""
    ratio = std / prior_std
    return 0.5 * (((mean - prior_mean) / prior_std) ** 2 + ratio**2 - 1 - 2 * ratio.log()).sum(-1)


def masked_mean(x: "Tensor", mask: "Tensor") -> "Tensor":
    """The mean over the last axis of entries [..., M] whose mask is 1; 0 where there is none."""
    return (x * mask).sum(-1) / mask.sum(-1).clamp(min=1)


def inference_loss(log_next: "Tensor", kl: "Tensor", beta: float, mask: "Tensor") -> "Tensor":
    """The negative of Eq. (6), averaged over steps.

    log_next: log p_psi(s_{t+1} | s_t, a_t, theta_hat) for theta_hat ~ q_phi(. | tau_:t), and kl: of q_phi(. | tau_:t)
    from the prior; all [..., M].
    """
    return -masked_mean(log_next - beta * kl, mask)


def offline_loss(log_next: "Tensor", log_policy: "Tensor", kl: "Tensor", beta: float, mask: "Tensor") -> "Tensor":
    """The negative of Eq. (7), averaged over trajectories.

    log_next, log_policy, mask [..., B, T]: of steps, for theta_hat ~ q_phi_off(. | tau_e); kl [..., B]: of
    q_phi_off(. | tau_e) from the prior.
    """
    return -(((log_next + log_policy) * mask).sum(-1) - beta * kl).mean(-1)


def imitation_loss(log_policy: "Tensor", mask: "Tensor") -> "Tensor":
    """The last line of Algorithm 1: the mean over steps of -log pi_eta(a | s, ...) [..., M]."""
    return -masked_mean(log_policy, mask)


def marginal_loss(log_prior: "Tensor", log_next: "Tensor", mask: "Tensor") -> "Tensor":
    """Footnote 4: -log sum_k p(k) prod_t p_psi(s_{t+1} | s_t, a_t, k), divided by the number of steps.

    log_prior [..., K], log_next [..., B, T, K], mask [..., B, T] -> [...].
    """
    total = (log_next * mask[..., None]).sum(-2)
    marginal = (log_prior[..., None, :] + total).logsumexp(-1)
    return -marginal.sum(-1) / mask.sum((-2, -1)).clamp(min=1)


def reparametrise(mean: "Tensor", std: "Tensor", noise: "Tensor") -> "Tensor":
    """theta_hat ~ N(mean, std^2), differentiable, from noise ~ N(0, 1); [..., D]."""
    return mean + std * noise
