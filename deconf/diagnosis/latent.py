"""A latent that explains an expert's trials: as what the world answers tells it, or as actions and answers do."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from deconfounded.deconf.core.agents import ramp
from deconfounded.deconf.core.data import Batch, Draws, Signature, take
from deconfounded.deconf.core.models import VariationalModel, final_belief
from deconfounded.deconf.core.monitor import Monitor
from deconfounded.deconf.core.nets import ActionHead, Adam, scalers
from deconfounded.deconf.diagnosis.learned_env import known_range
from deconfounded.deconf.equations import masked_mean
from deconfounded.deconf.methods import deconfounded_offline
from deconfounded.deconf.methods.cloning import CloningConfig
from deconfounded.deconf.methods.deconfounded import DeconfoundedAgent, DeconfoundedConfig
from deconfounded.deconf.methods.deconfounded_offline import OfflineConfig
from deconfounded.envs.support.errors import InputError
from deconfounded.experts.rollout import Trials

LEAST = 0.02  # share of exploring steps that are where the expert goes


class Explanation(NamedTuple):
    """A model that infers latents, a policy given them, and the latents [1, N, D] of the trials it was learned on.

    actions: log-likelihood of half of the expert's held-out actions (`odd`), given latents of the other half, nats a
    step.
    acted: how much less it is given another trial's; explored, shown: the same of what the world answered, in
    exploration, and where the expert went. None without exploration.
    """

    model: VariationalModel
    policy: ActionHead
    latents: Tensor
    actions: float | None = None
    acted: float | None = None
    explored: float | None = None
    shown: float | None = None


def alone(shown: Trials, how: OfflineConfig, draws: Draws, monitor: Monitor) -> Explanation:
    """Of expert trials: a latent that explains actions and answers, Eq. (7)."""
    data = Batch.of(shown, 1)
    model, _, policy = deconfounded_offline.explain(data, Signature.of(shown), how, draws, monitor)
    return Explanation(model, policy, model.sample(final_belief(model, data), draws))


def by_world(
    expert: tuple[Trials, Trials],
    explored: tuple[Trials, Trials],
    each: int,
    exploring: DeconfoundedConfig,
    cloning: CloningConfig,
    draws: Draws,
    monitor: Monitor,
) -> Explanation:
    """A latent that explains what the world answers, Eq. (6), and a policy given it; of each, the second is held out.

    Not on expert trials: these hold nearly one action for each observation and latent, so that what an action does and
    what the latent does cannot be told apart. (On `swapped_lander`, of both, it learned that the engine does nothing.)
    each: how many trials of either, side by side, may be of one theta. Raises InputError if exploration hardly comes to
    where the expert goes.
    """
    shown, held, tried, rest = (Batch.of(some, 1) for some in (*expert, *explored))
    tried, rest = (near(shown, some) for some in (tried, rest))
    model = _dynamics(tried, Signature.of(expert[0]), exploring, draws, monitor)
    _refit_noise(model, tried, draws)

    def answers(some: Batch, latent: Tensor) -> Tensor:
        return model.dynamics.log_prob(some.obs, some.action, some.next_obs, latent)[..., 0]

    def actions(some: Batch, latent: Tensor) -> Tensor:
        return policy.log_prob(torch.cat([model.inputs.obs(some.obs), latent], -1), some.action)

    _, met = _told(answers, model, rest, each, draws)
    _refit_noise(model, shown, draws)
    policy = _conditional(model, shown, cloning, draws)
    likely, acted = _told(actions, model, held, each, draws)
    _, told = _told(answers, model, held, each, draws)
    return Explanation(model, policy, model.sample(_belief(model, shown), draws), likely, acted, met, told)


def mean(x: Tensor, batch: Batch) -> float:
    """Over all steps [1, B, T] that took place."""
    return float(masked_mean(x.flatten(1), batch.mask.flatten(1)))


def odd(batch: Batch) -> Batch:
    """Every other step, beginning with the second."""
    return replace(batch, mask=batch.mask * (torch.arange(batch.mask.shape[2]) % 2))


def _belief(model: VariationalModel, batch: Batch) -> Tensor:
    """Of each trial [1, B, P], told by the other steps: half of them, as where it was learned."""
    return final_belief(model, replace(batch, mask=batch.mask - odd(batch).mask))


def _along(batch: Batch, latents: Tensor) -> Tensor:
    """Each trial's latent [1, B, D] at each of its steps."""
    return latents[:, :, None].expand(-1, -1, batch.mask.shape[2], -1)


def _dynamics(
    explored: Batch, signature: Signature, how: DeconfoundedConfig, draws: Draws, monitor: Monitor
) -> VariationalModel:
    """Eq. (6), of sets: half of a trial's steps, drawn at random, tell the latent that predicts the other half.

    Not the beginning, with what comes next to predict, as in deployment: a latent of single episodes, learned so, told
    how late in its episode a step is, and dreams begun with it were of no use.
    """
    model = VariationalModel("evidence", how.latent, how.width, signature, *scalers(explored), draws)
    optimizer = Adam([model], how.inference_rate, how.inference_updates)
    for update in range(how.inference_updates):
        batch = explored.draw_trials(how.inference_batch, draws)
        batch = batch[:, :, draws.uniform(batch.mask.shape[2])[0].argsort()].beginnings(update, how.shortest)
        half = draws.uniform(*batch.mask.shape[1:]) < 0.5
        known, rest = (replace(batch, mask=batch.mask * part) for part in (half, ~half))
        model.train()
        belief = model.belief(model.last(known))
        index = rest.draw_steps(how.inference_steps, draws)
        real, trial = rest.steps(index), index // batch.mask.shape[2]
        theta_hat, centre, std = (take(x, trial) for x in (model.sample(belief, draws), *belief.chunk(2, -1)))
        beta = how.beta * ramp(update, how.warm_up * how.inference_updates)
        loss = model.bound(real, centre, std, theta_hat, beta)
        model.eval()
        optimizer.step(loss)
        monitor.update(update + 1, how.inference_updates, {"inference": loss.mean().item()})
    return model


def near(data: Batch, explored: Batch) -> Batch:
    """Explored trials without their steps from outside of the range in which dynamics are to hold."""
    low, high = known_range(data)
    inside = ((explored.obs >= low[:, None]) & (explored.obs <= high[:, None])).all(-1) * explored.mask
    some = inside[0].sum(-1) > 0
    if (share := float(inside.sum() / explored.mask.sum())) < LEAST or some.sum() < 2:
        raise InputError(
            f"exploration was where the expert goes for {share:.1%} of its steps; {LEAST:.0%} are needed, in several"
            " trials: explore by a behaviour that stays nearer"
        )
    return replace(explored, mask=inside)[:, some.nonzero()[:, 0]]


@torch.no_grad()
def _refit_noise(model: VariationalModel, data: Batch, draws: Draws) -> None:
    """Noise of the size it has in these trials: what is learned last, and falls and the like swell it."""
    head, latents = model.dynamics, _along(data, model.sample(_belief(model, data), draws))
    if not model.inputs.signature.binary:
        off = head.change(data.next_obs - data.obs) - head(data.obs, data.action, latents)[..., 0, :]
        square = masked_mean(off.square().flatten(1, 2).mT, data.mask.flatten(1)[:, None])
        head.log_std.copy_(0.5 * square.clamp(min=1e-12).log())


@torch.no_grad()
def _told(
    log_prob: Callable[[Batch, Tensor], Tensor], model: VariationalModel, data: Batch, each: int, draws: Draws
) -> tuple[float, float]:
    """How likely trials' odd steps are given latents inferred from the others, nats a step; and how much more so than
    given that of the trial `each` on.

    log_prob: of steps [1, B, T], given latents [1, B, T, D].
    """
    rest, latents = odd(data), model.sample(_belief(model, data), draws)
    own, other = (mean(log_prob(rest, _along(rest, latent)), rest) for latent in (latents, latents.roll(each, 1)))
    return own, own - other


def _conditional(model: VariationalModel, data: Batch, how: CloningConfig, draws: Draws) -> ActionHead:
    """A policy, cloned given the latents that a model infers from the trials."""
    policy = ActionHead(model.inputs.obs_width + model.latent, how.width, model.inputs.signature, draws)
    agent, belief = DeconfoundedAgent(model, policy), _belief(model, data)
    optimizer = Adam([policy], how.learning_rate, how.updates)
    for _ in range(how.updates):
        optimizer.step(agent.loss(data, belief, how.batch, draws))
    return policy
