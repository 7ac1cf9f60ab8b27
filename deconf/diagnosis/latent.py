"""A latent that explains an expert's trials: inferred from the dynamics alone, or from actions and dynamics.

Likelihoods are trimmed means over held-out trials, so that no single one, a fall say, decides.
"""

import copy
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from deconfounded.deconf.core.adam import Adam
from deconfounded.deconf.core.agents import ramp
from deconfounded.deconf.core.data import Batch, Draws, Signature
from deconfounded.deconf.core.dynamics import DynamicsHead
from deconfounded.deconf.core.latent_agent import DeconfoundedAgent
from deconfounded.deconf.core.latent_model import LatentModel, final_belief
from deconfounded.deconf.core.models import new_model
from deconfounded.deconf.core.monitor import Monitor
from deconfounded.deconf.core.nets import ActionHead, Scales
from deconfounded.deconf.diagnosis.held_out import Best, typical
from deconfounded.deconf.diagnosis.learned_env import LatentPolicy, valid_range
from deconfounded.deconf.equations import masked_mean
from deconfounded.deconf.methods import deconfounded_offline
from deconfounded.deconf.methods.deconfounded import DeconfoundedConfig
from deconfounded.deconf.methods.deconfounded_offline import OfflineConfig
from deconfounded.deconf.methods.memoryless_bc import MemorylessConfig
from deconfounded.envs.support.errors import InputError
from deconfounded.experts.trials import Trials

REFERENCE = 256  # observations at which a policy's actions are compared
OTHERS = 16  # trials at most, with whose latents that of a trial is compared: of two values, half of them have the same
MIN_COVERAGE = 0.02  # share of exploration's steps that are in the range of the dynamics

LogProb = Callable[[Batch, Tensor], Tensor]
"""Log-likelihoods [1, B, T] of steps given latents [1, B, T, D]."""


class Explanation(NamedTuple):
    """Dynamics and a policy, both given latents, and the latents [1, N, D] of the trials of training.

    Nats a step, None without exploration. latent_gain: log-likelihood of held-out expert actions at odd steps, given
    the latent inferred from even steps, less that of a policy that was trained with other trials' latents, and has as
    much to overfit, each at its best. log_likelihood: the former alone. action_evidence: the former less that given
    other trials' latents; exploration_evidence, expert_evidence: as much of next observations, in exploration and in
    expert trials. shared: see `shared_with`.
    """

    dynamics: DynamicsHead
    policy: ActionHead
    latents: Tensor
    latent_gain: float | None = None
    log_likelihood: float | None = None
    action_evidence: float | None = None
    exploration_evidence: float | None = None
    expert_evidence: float | None = None
    shared: float | None = None


def from_expert_trials(trials: Trials, config: OfflineConfig, draws: Draws, monitor: Monitor) -> Explanation:
    """Explain actions and dynamics of expert trials by one latent, Eq. (7)."""
    data = Batch.of(trials, 1)
    model, _, policy = deconfounded_offline.explain(data, Signature.of(trials), config, draws, monitor)
    return Explanation(model.dynamics, policy, model.sample(final_belief(model, data), draws))


def from_dynamics(
    expert: tuple[Trials, Trials],
    exploration: tuple[Trials, Trials],
    per_theta: int,
    exploring: DeconfoundedConfig,
    cloning: MemorylessConfig,
    draws: Draws,
    monitor: Monitor,
) -> Explanation:
    """Explain the dynamics by a latent, and clone a policy given it. Of both pairs, the second is held out.

    The dynamics are learned from exploration: expert trials hold nearly one action for each observation and latent, so
    that the effects of the two cannot be separated. (Trained on both, a model of `swapped_lander` ignored the engine.)
    per_theta: how many successive trials may be under one theta. Raises InputError if exploration hardly covers the
    range of the expert's observations.
    """
    train, held_out, explored, explored_held_out = (Batch.of(x, 1) for x in (*expert, *exploration))
    explored, explored_held_out = (in_range(train, x) for x in (explored, explored_held_out))
    scales = Scales(Signature.of(expert[0], exploration[0]), explored, train.action, train.mask)
    model = _train_dynamics(explored, scales, exploring, draws, monitor)

    def log_next(head: DynamicsHead) -> LogProb:
        return lambda x, latent: head.log_prob(x.obs, x.action, x.next_obs, latent)[..., 0]

    odd, latents = odd_steps(explored_held_out), _latents(model, explored_held_out, draws)
    evidence = _evidence(log_next(_refitted(model, explored, draws)), odd, latents, per_theta)
    dynamics, belief = _refitted(model, train, draws), _belief(model, train)
    odd, latents = odd_steps(held_out), _latents(model, held_out, draws)
    (policy, own), (_, other) = (
        _train_policy(model, train, x, odd, latents, cloning, draws) for x in (belief, belief.roll(per_theta, 1))
    )
    gain, likely = typical(own - other, odd), typical(own, odd)
    in_actions = _evidence(_log_action(model, policy), odd, latents, per_theta)
    in_trials = _evidence(log_next(dynamics), odd, latents, per_theta)
    latents = model.for_cloning(belief, draws)
    shared = shared_with(explored.joined(explored_held_out), train, model, LatentPolicy(dynamics, policy, latents))
    return Explanation(dynamics, policy, latents, gain, likely, in_actions, evidence, in_trials, shared)


@torch.no_grad()
def shared_with(explored: Batch, expert: Batch, model: LatentModel, policy: LatentPolicy) -> float:
    """The share, 0 to 1, of what a latent that lasts through expert trials makes a policy do that exploration has too.

    By covariances, over trials, of the policy's actions given latents of the two halves of a trial, at observations of
    the expert. What is in the system lasts through both kinds of trials. Where a trial went, which a latent shows too
    where the model fits poorly, lasts in those of the expert, which goes there on purpose.
    """
    draws = Draws([np.random.default_rng(0)], "cpu")  # of its own: other figures do not depend on it
    obs = expert.steps(expert.draw_steps(REFERENCE, draws)).obs[:, None]

    def lasting(data: Batch) -> float:
        acted = []
        for half in halves(data):
            latents = model.for_cloning(final_belief(model, half), draws)[:, :, None]
            shape = (1, latents.shape[1], REFERENCE, -1)
            action = policy.point(obs.expand(*shape), latents.expand(*shape))
            acted.append(action - action.mean(1, keepdim=True))
        return float((acted[0] * acted[1]).mean())

    whole = lasting(expert)
    return min(max(lasting(explored) / whole, 0.0), 1.0) if whole > 0 else 0.0  # of nothing, no share is known


def halves(data: Batch) -> tuple[Batch, Batch]:
    """The first half of the steps of each trial, and the second."""
    early = data.mask.cumsum(-1) <= data.mask.sum(-1, keepdim=True) / 2
    return tuple(replace(data, mask=data.mask * part) for part in (early, ~early))  # type: ignore[return-value]


def odd_steps(batch: Batch) -> Batch:
    """Every other step, from the second on."""
    return replace(batch, mask=batch.mask * (torch.arange(batch.mask.shape[2]) % 2))


def _belief(model: LatentModel, batch: Batch) -> Tensor:
    """Beliefs [1, B, P] about each trial from its even steps: half of them, as in training."""
    return final_belief(model, replace(batch, mask=batch.mask - odd_steps(batch).mask))


def _latents(model: LatentModel, batch: Batch, draws: Draws) -> Tensor:
    """The latent [1, B, D] of each trial, inferred from its even steps."""
    return model.for_cloning(_belief(model, batch), draws)


def each_step(batch: Batch, latents: Tensor) -> Tensor:
    """Each trial's latent [1, B, D] at each of its steps."""
    return latents[:, :, None].expand(-1, -1, batch.mask.shape[2], -1)


def _train_dynamics(
    explored: Batch, scales: Scales, config: DeconfoundedConfig, draws: Draws, monitor: Monitor
) -> LatentModel:
    """A model trained on sets: the latent inferred from a random half of a trial's steps predicts the other half.

    The beginning of a trial and the steps after it, as in deployment, are no such halves: a latent of single episodes
    then encodes the time in the episode, and rollouts that start with it are of no use.
    """
    model = new_model(config.model, config.latent, config.width, scales, draws)
    optimizer = Adam([model], config.inference_rate, config.inference_updates)
    for update in range(config.inference_updates):
        batch = explored.draw_trials(config.inference_batch, draws)
        batch = batch[:, :, draws.uniform(batch.mask.shape[2])[0].argsort()].beginnings(update, config.shortest)
        beta = config.beta * ramp(update, config.warm_up * config.inference_updates)
        loss = model.loss_on_sets(batch, config.inference_steps, beta, draws)
        optimizer.step(loss)
        monitor.update(update + 1, config.inference_updates, {"inference": loss.mean().item()})
    return model


def in_range(expert: Batch, explored: Batch) -> Batch:
    """Exploration trials, masked to the range in which the dynamics are valid. Raises InputError if little is left."""
    low, high = valid_range(expert)
    inside = ((explored.obs >= low[:, None]) & (explored.obs <= high[:, None])).all(-1) * explored.mask
    kept = inside[0].sum(-1) > 0
    if (share := float(inside.sum() / explored.mask.sum())) < MIN_COVERAGE or kept.sum() < 2:
        raise InputError(
            f"exploration was where the expert goes for {share:.1%} of its steps; {MIN_COVERAGE:.0%} are needed, in"
            " several trials: explore by a behaviour that stays nearer"
        )
    return replace(explored, mask=inside)[:, kept.nonzero()[:, 0]]


@torch.no_grad()
def _refitted(model: LatentModel, data: Batch, draws: Draws) -> DynamicsHead:
    """Its dynamics, with noise of the residuals' size in these trials: falls and the like inflate that of training."""
    head, latents = copy.deepcopy(model.dynamics), each_step(data, _latents(model, data, draws))
    if not model.inputs.signature.binary:
        residual = head.change(data.next_obs - data.obs) - head(data.obs, data.action, latents)[..., 0, :]
        variance = masked_mean(residual.square().flatten(1, 2).mT, data.mask.flatten(1)[:, None])
        head.log_std.copy_(0.5 * variance.clamp(min=1e-12).log())
    return head


@torch.no_grad()
def _evidence(log_prob: LogProb, data: Batch, latents: Tensor, per_theta: int) -> float:
    """Log-likelihood of steps given the latent [1, B, D] of their trial, less its mean given latents of other trials.

    Nats a step. Trials `per_theta` apart, or more, are under thetas of their own.
    """
    n = latents.shape[1]
    shifts = range(per_theta, max(n - per_theta, per_theta) + 1, per_theta)
    shifts = shifts[:: -(-len(shifts) // OTHERS)]
    own, *mismatched = (log_prob(data, each_step(data, latents.roll(shift, 1))) for shift in (0, *shifts))
    return typical(own - torch.stack(mismatched).mean(0), data)


def _log_action(model: LatentModel, policy: ActionHead) -> LogProb:
    return lambda x, latent: policy.log_prob(torch.cat([model.inputs.obs(x.obs), latent], -1), x.action)


def _train_policy(
    model: LatentModel,
    data: Batch,
    belief: Tensor,
    held_out: Batch,
    latents: Tensor,
    config: MemorylessConfig,
    draws: Draws,
) -> tuple[ActionHead, Tensor]:
    """A policy, cloned given latents of beliefs [1, B, P] about the trials, and log-likelihoods of held-out actions.

    Both as they are when the latter [1, B, T], given latents [1, B, D] of the trials, are highest.
    """
    policy = ActionHead(model.inputs.obs_width + model.latent, config.width, model.inputs.scales, draws)
    agent, best, kept = DeconfoundedAgent(model, policy), Best(held_out), policy.state_dict()
    optimizer = Adam([policy], config.learning_rate, config.updates)
    log_prob, per_step = _log_action(model, policy), each_step(held_out, latents)
    for update in range(config.updates):
        optimizer.step(agent.loss(data, belief, config.batch, draws))
        if best.check(update + 1, config.updates, lambda: log_prob(held_out, per_step)):
            kept = copy.deepcopy(policy.state_dict())
    policy.load_state_dict(kept)
    return policy, best.log_prob
