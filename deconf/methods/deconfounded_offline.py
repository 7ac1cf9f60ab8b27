"""Tier 1 (appendix C, Algorithm 3): deconfounded imitation from expert demonstrations alone.

An offline encoder reads whole expert trials, actions included (in training, a random subset of their steps), and a
decoder of two factors, dynamics and policy, explains both by one latent, Eq. (7). The encoder takes actions for
evidence, but the dynamics do not. They are linear in the latent, so that the evidence of a transition in them is exact
(footnote 4), as in Tier 2; an online encoder is trained, by Eq. (6), only where observations are 0 or 1. The belief in
the course of a trial is trained on trials that are rolled out in the learned dynamics under actions that are blind to
the latent, whose latents are known. The agent is deployed as in Tier 2, by Algorithm 2.
"""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from deconfounded.deconf.core.adam import Adam
from deconfounded.deconf.core.agents import ramp
from deconfounded.deconf.core.data import Batch, Draws, Rngs, Signature, as_generators, extent, take
from deconfounded.deconf.core.drift import choose_kept, split_episodes
from deconfounded.deconf.core.dynamics import LinearDynamicsHead
from deconfounded.deconf.core.latent_agent import DeconfoundedAgent
from deconfounded.deconf.core.latent_model import final_belief
from deconfounded.deconf.core.linear_model import ExactLinearModel, LinearModel
from deconfounded.deconf.core.models import VariationalModel
from deconfounded.deconf.core.monitor import Monitor
from deconfounded.deconf.core.nets import ActionHead, Scales
from deconfounded.deconf.core.online import OnlineBelief
from deconfounded.deconf.core.sizes import LARGE_LATENT, Configuration
from deconfounded.deconf.equations import gaussian_kl, offline_loss
from deconfounded.deconf.given import Given
from deconfounded.deconf.method import uses
from deconfounded.experts.trials import Trials

LAST = 512  # least synthetic trials for the belief in the course of a trial


@dataclass(frozen=True)
class OfflineConfig(Configuration):
    """Hyperparameters for each seed. Eq. (7) trains first; updates by Eq. (6) do not change its networks.

    beta to synthetic: of synthetic trials; of observations that are not 0 or 1, online_updates and synthetic alone.
    """

    width: int = 64
    latent: int = 4
    offline_beta: float = 1.0  # of Eq. (7), whose likelihood is summed over the trial
    offline_updates: int = 2000
    offline_batch: int = 32  # trials
    offline_steps: int = 128  # random steps of each, on which Eq. (7) is estimated
    beta: float = 1e-3  # of Eq. (6), a step
    warm_up: float = 0.5  # share of online updates over which this beta rises to its value
    online_updates: int = 2000  # of the online encoder; of the belief in the course of a trial
    online_batch: int = 16  # synthetic trials
    shortest: float = 1 / 16  # least share of these trials that an update reads
    online_steps: int = 1024  # whose next observation is predicted, of these trials
    refresh: int = 50  # updates between syntheses
    synthetic: int = 128  # trials of a synthesis
    random_share: float = 0.1  # of synthetic actions that are uniformly random
    learning_rate: float = 4e-3
    drifts: bool = False  # theta changes between the episodes of a trial: see deconf/core/drift.py
    device: str = "cpu"


def explain(
    data: Batch,
    signature: Signature,
    config: OfflineConfig,
    draws: Draws,
    monitor: Monitor,
    times: int = 1,
) -> tuple[VariationalModel, VariationalModel, ActionHead]:
    """Eq. (7): an offline model and a policy that explain expert trials by one latent, and an untrained online model.

    The two models share their dynamics. The offline one takes actions, too, for evidence. Batches are `times` as large.
    """
    scales = Scales.of(signature, data)
    sizes = (config.latent, config.width, scales, draws)
    offline, online = VariationalModel("evidence", *sizes), VariationalModel("innovations", *sizes)
    offline.dynamics = online.dynamics
    policy = ActionHead(online.inputs.obs_width + config.latent, config.width, scales, draws)
    total = config.offline_updates + (config.online_updates if signature.binary else 0)
    optimizer = Adam([offline, policy], config.learning_rate, config.offline_updates)
    for update in range(config.offline_updates):
        batch = data.draw_trials(config.offline_batch * times, draws)
        steps = batch.mask.shape[2]
        index = draws.uniform(steps).argsort(-1)[:, : config.offline_steps]
        subset = Batch(*(take(x.transpose(1, 2), index).transpose(1, 2) for x in batch.tensors))
        belief = offline.belief(offline.final_memory(subset))
        mean, std = belief.chunk(2, -1)
        theta_hat = offline.sample(belief, draws)[:, :, None].expand(-1, -1, index.shape[1], -1)
        log_next = offline.dynamics.log_prob(subset.obs, subset.action, subset.next_obs, theta_hat)[..., 0]
        log_policy = policy.log_prob(torch.cat([online.inputs.obs(subset.obs), theta_hat], -1), subset.action)
        kl = gaussian_kl(mean, std, *offline.encoder.prior(mean))
        weight = subset.mask * (steps / index.shape[1])  # an unbiased estimate of the sum over all steps
        loss = offline_loss(log_next, log_policy, kl, config.offline_beta, weight)
        loss = loss + offline.innovation_loss(subset.flat(), theta_hat.flatten(1, 2))
        optimizer.step(loss)
        monitor.update(update + 1, total, {"offline": loss.mean().item()})
    return offline, online, policy


def train(trials: Trials, config: OfflineConfig, rng: Rngs, monitor: Monitor | None = None) -> DeconfoundedAgent:
    """Train by Algorithm 3 on expert trials, which are in as many equal groups as there are generators in rng."""
    rngs, signature, monitor = as_generators(rng), Signature.of(trials), monitor or Monitor()
    episodes = trials.mask.shape[1]
    trials, times = (split_episodes(trials), episodes) if config.drifts else (trials, 1)
    data, draws = Batch.of(trials, len(rngs), config.device), Draws(rngs, config.device)
    offline, encoder, policy = explain(data, signature, config, draws, monitor, times)
    latents = offline.sample(final_belief(offline, data), draws)
    online = encoder if signature.binary else exact(encoder, draws)
    starts = torch.tensor(starts_of(trials), device=config.device).reshape(len(rngs), -1, signature.obs)
    synthesis = Synthesis(online, policy, latents, data, starts, trials.mask.shape[2], config.random_share, draws)
    in_course = OnlineBelief(online, config.width, draws)
    agent = DeconfoundedAgent(online, policy, in_course)
    if isinstance(online, LinearModel):
        online.scale_to(latents)
    else:
        online.encoder.set_prior(latents)
        total = config.offline_updates + config.online_updates
        optimizer = Adam([online.encoder], config.learning_rate, config.online_updates)
        for update in range(config.online_updates):
            if update % config.refresh == 0:
                synthetic, _ = synthesis(config.synthetic)
            batch = synthetic.beginnings(update, config.shortest).draw_trials(config.online_batch * times, draws)
            warm = ramp(update, config.warm_up * config.online_updates)
            inference = online.learn(optimizer, batch, config.online_steps, config.beta * warm, draws)
            monitor.update(config.offline_updates + update + 1, total, {"inference": inference}, agent)
    synthetic, drawn = synthesis(max(LAST, config.synthetic))
    in_course.fit(online, synthetic, config.online_updates, draws, drawn)
    if config.drifts:
        choose_kept(online, data[:, : 64 * episodes], episodes, draws)
    return agent


def starts_of(trials: Trials) -> NDArray[np.float32]:
    """First observations [B, E, O]; of an episode that did not take place, those of one of its trial that did."""
    took_place = trials.mask.any(2)
    index = np.where(took_place, np.arange(took_place.shape[1]), took_place.argmax(1)[:, None])
    return np.take_along_axis(trials.obs[:, :, 0], index[..., None], 1)


def exact(model: VariationalModel, draws: Draws) -> LinearModel:
    """The model with the same dynamics, which are linear in the latent, and exact inference in them."""
    assert isinstance(model.dynamics, LinearDynamicsHead)
    linear = ExactLinearModel(model.latent, model.width, model.inputs.scales, draws)
    linear.dynamics, linear.inputs = model.dynamics, model.inputs
    return linear


@dataclass(frozen=True)
class Synthesis:
    """Draws rollouts in the learned dynamics, whose actions are blind to the latent.

    Each trial has a latent of [S, B, D], and each episode's actions have another one. They are as long as the expert's
    trials, in episodes of at most `horizon` steps from starts [S, K, O]. An episode ends where it leaves the range of
    the expert's observations: the dynamics were not trained there. A column of at most two values there, a flag for
    example, takes the nearer one, so that it ends no episode.
    """

    model: LinearModel | VariationalModel
    policy: ActionHead
    latents: Tensor
    expert: Batch
    starts: Tensor
    horizon: int
    random_share: float
    draws: Draws

    @torch.no_grad()
    def __call__(self, n: int) -> tuple[Batch, Tensor]:
        """As many trials, and their latents [S, n, D]."""
        model, policy, latents, starts, draws = self.model, self.policy, self.latents, self.starts, self.draws
        low, high = extent(self.expert.obs, self.expert.mask)
        ends = (low[:, None] == self.expert.obs) | (high[:, None] == self.expert.obs)
        flag = (ends | (self.expert.mask[..., None] == 0)).all(2).all(1)[:, None]
        theta_hat = take(latents, draws.integers(latents.shape[1], n))
        obs, action_latent = starts[:, :1], latents[:, :1]  # replaced in the first step
        over = torch.ones(len(draws), n, 1, dtype=torch.bool, device=draws.device)
        steps: list[tuple[Tensor, Tensor, Tensor]] = []
        for t in range(self.expert.mask.shape[2]):
            over = over | (t % self.horizon == 0)
            obs = torch.where(over, take(starts, draws.integers(starts.shape[1], n)), obs)
            action_latent = torch.where(over, take(latents, draws.integers(latents.shape[1], n)), action_latent)
            action = policy.sample(torch.cat([model.inputs.obs(obs), action_latent], -1), draws)
            action = policy.signature.randomise(action, self.random_share, draws)
            next_obs = model.dynamics.sample(obs, action, theta_hat, draws)
            next_obs = torch.where(flag, torch.where(next_obs < (low + high) / 2, low, high), next_obs)
            steps.append((obs, action, next_obs))
            obs, over = next_obs, ((next_obs < low) | (next_obs > high)).any(-1, keepdim=True)
        obs, action, next_obs = (torch.stack(column, 2) for column in zip(*steps, strict=True))
        return Batch(obs, action, next_obs, torch.ones(len(draws), n, len(steps), device=draws.device)), theta_hat


@uses(
    "demonstrations",
    version=6,
    cost=3,
    on_control=OfflineConfig(),
    on_bandit=OfflineConfig(
        latent=5,
        offline_batch=64,
        offline_steps=100,
        beta=5e-3,
        shortest=1.0,
        online_batch=64,
        online_steps=6400,
        synthetic=2000,
        refresh=200,
        random_share=1.0,
        learning_rate=3e-3,
    ),
    smoke={"offline_updates": 300, "online_updates": 300},
    smoke_bandit={"offline_updates": 300, "online_updates": 300},
    large=lambda config: {"latent": LARGE_LATENT, "learning_rate": 2e-3},
)
def fit(given: Given) -> DeconfoundedAgent:
    """Train by Algorithm 3."""
    return train(given.demonstrations, given.config, given.rngs, given.monitor)
