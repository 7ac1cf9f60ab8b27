"""Tier 1 (appendix C, Algorithm 3): deconfounded imitation from expert demonstrations alone.

An offline encoder reads whole expert trials, actions and all (in training so many drawn steps of each), and a decoder
in two factors, dynamics and policy, explains both by one latent, Eq. (7). The encoder is deluded by actions, but the
dynamics are not: they make synthetic trajectories under actions that are blind to the latent, and an online encoder is
trained on these, Eq. (6). It is deployed as in Tier 2, by Algorithm 2.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from deconfounded.deconf.core.agents import ramp
from deconfounded.deconf.core.data import Batch, Draws, Rngs, Signature, extent, listed, take
from deconfounded.deconf.core.drift import apart, choose_kept
from deconfounded.deconf.core.models import VariationalModel, final_belief
from deconfounded.deconf.core.monitor import Monitor
from deconfounded.deconf.core.nets import ActionHead, Adam, scalers
from deconfounded.deconf.core.sizes import SPACIOUS, Configuration
from deconfounded.deconf.equations import gaussian_kl, offline_loss
from deconfounded.deconf.given import Given
from deconfounded.deconf.method import uses
from deconfounded.deconf.methods.deconfounded import DeconfoundedAgent
from deconfounded.experts.rollout import Trials


@dataclass(frozen=True)
class OfflineConfig(Configuration):
    """Widths and amounts, for each seed. First Eq. (7), then Eq. (6): nothing of the second acts back on the first."""

    width: int = 64
    latent: int = 4
    offline_beta: float = 1.0  # of Eq. (7), whose likelihood is summed over the trial
    offline_updates: int = 2000
    offline_batch: int = 32  # trials
    offline_steps: int = 256  # of each, that are read, and stand for all of them in Eq. (7)'s likelihood
    beta: float = 1e-3  # of Eq. (6), a step
    warm_up: float = 0.5  # share of online updates over which this beta rises to its value
    online_updates: int = 2000
    online_batch: int = 16  # synthetic trials
    shortest: float = 1 / 16  # share of these trials that an update reads, at least
    online_steps: int = 1024  # of them, whose next observation is predicted
    refresh: int = 50  # updates between syntheses
    synthetic: int = 128  # trials a synthesis
    random_share: float = 0.1  # of synthetic actions that are uniformly random
    learning_rate: float = 4e-3
    drifts: bool = False  # theta changes between the episodes of a trial: see deconf/core/drift.py
    device: str = "cpu"


def explain(
    data: Batch, signature: Signature, config: OfflineConfig, draws: Draws, monitor: Monitor, times: int = 1
) -> tuple[VariationalModel, VariationalModel, ActionHead]:
    """Eq. (7): an offline model and a policy that explain expert trials by one latent, and an online model to train.

    The online one's dynamics are the offline one's, and its prior that of the latents. Batches are `times` as large.
    """
    obs, change = scalers(data)
    sizes = ("evidence", config.latent, config.width, signature, obs, change, draws)
    offline, online = VariationalModel(*sizes), VariationalModel(*sizes)
    online.dynamics = offline.dynamics
    policy = ActionHead(online.inputs.obs_width + config.latent, config.width, signature, draws)
    total = config.offline_updates + config.online_updates
    optimizer = Adam([offline, policy], config.learning_rate, config.offline_updates)
    for update in range(config.offline_updates):
        batch = data.draw_trials(config.offline_batch * times, draws)
        steps = batch.mask.shape[2]
        index = draws.uniform(steps).argsort(-1)[:, : config.offline_steps]
        some = Batch(*(take(x.transpose(1, 2), index).transpose(1, 2) for x in batch.tensors))
        belief = offline.belief(offline.last(some))
        mean, std = belief.chunk(2, -1)
        theta_hat = offline.sample(belief, draws)[:, :, None].expand(-1, -1, index.shape[1], -1)
        log_next = offline.dynamics.log_prob(some.obs, some.action, some.next_obs, theta_hat)[..., 0]
        log_policy = policy.log_prob(torch.cat([online.inputs.obs(some.obs), theta_hat], -1), some.action)
        kl = gaussian_kl(mean, std, *offline.encoder.prior(mean))
        weight = some.mask * (steps / index.shape[1])  # so that their sum is that of all, on average
        loss = offline_loss(log_next, log_policy, kl, config.offline_beta, weight)
        optimizer.step(loss)
        monitor.update(update + 1, total, {"offline": loss.mean().item()})
    return offline.eval(), online, policy


def train(trials: Trials, config: OfflineConfig, rng: Rngs, monitor: Monitor | None = None) -> DeconfoundedAgent:
    """Algorithm 3. trials: of the expert, without theta, in as many equal groups as there are generators in rng."""
    rngs, signature, monitor, each = listed(rng), Signature.of(trials), monitor or Monitor(), trials.mask.shape[1]
    trials, times = (apart(trials), each) if config.drifts else (trials, 1)  # single episodes: so many times as many
    data, draws = Batch.of(trials, len(rngs), config.device), Draws(rngs, config.device)
    offline, online, policy = explain(data, signature, config, draws, monitor, times)
    latents = offline.sample(final_belief(offline, data), draws)
    online.encoder.set_prior(latents)
    starts = torch.tensor(trials.obs[:, :, 0], device=config.device).reshape(len(rngs), -1, signature.obs)
    horizon = trials.mask.shape[2]
    online.eval()
    agent = DeconfoundedAgent(online, policy)
    total = config.offline_updates + config.online_updates
    optimizer = Adam([online.encoder], config.learning_rate, config.online_updates)
    for update in range(config.online_updates):
        if update % config.refresh == 0:
            synthetic = synthesise(online, policy, latents, data, starts, horizon, config, draws)
        batch = synthetic.beginnings(update, config.shortest).draw_trials(config.online_batch * times, draws)
        warm = ramp(update, config.warm_up * config.online_updates)
        inference = online.learn(optimizer, batch, config.online_steps, config.beta * warm, draws)
        monitor.update(config.offline_updates + update + 1, total, {"inference": inference}, agent)
    if config.drifts:
        choose_kept(online, data[:, : 64 * each], each, draws)
    return agent


@torch.no_grad()
def synthesise(
    model: VariationalModel,
    policy: ActionHead,
    latents: Tensor,
    expert: Batch,
    starts: Tensor,
    horizon: int,
    config: OfflineConfig,
    draws: Draws,
) -> Batch:
    """Trials of the learned dynamics: a latent [S, B, D] a trial, and another, blind to it, for each episode's actions.

    They are as long as the expert's, in episodes of at most `horizon` steps from starts [S, K, O]. Where one leaves the
    range of observations in which the expert acted, another begins: the dynamics were not learned there, and what they
    would say of the latent is noise.
    """
    n, (low, high) = config.synthetic, extent(expert.obs, expert.mask)
    theta_hat = take(latents, draws.below(latents.shape[1], n))
    obs, other = starts[:, :1], latents[:, :1]  # replaced at once
    over = torch.ones(len(draws), n, 1, dtype=torch.bool, device=draws.device)
    steps: list[tuple[Tensor, Tensor, Tensor]] = []
    for t in range(expert.mask.shape[2]):
        over = over | (t % horizon == 0)
        obs = torch.where(over, take(starts, draws.below(starts.shape[1], n)), obs)
        other = torch.where(over, take(latents, draws.below(latents.shape[1], n)), other)
        action = policy.sample(torch.cat([model.inputs.obs(obs), other], -1), draws)
        action = policy.signature.randomise(action, config.random_share, draws)
        next_obs = model.dynamics.sample(obs, action, theta_hat, draws)
        steps.append((obs, action, next_obs))
        obs, over = next_obs, ((next_obs < low) | (next_obs > high)).any(-1, keepdim=True)
    obs, action, next_obs = (torch.stack(column, 2) for column in zip(*steps, strict=True))
    return Batch(obs, action, next_obs, torch.ones(len(draws), n, len(steps), device=draws.device))


@uses(
    "demonstrations",
    cost=7,
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
    many=lambda config: {"latent": SPACIOUS, "learning_rate": 2e-3},
)
def fit(given: Given) -> DeconfoundedAgent:
    """Algorithm 3."""
    return train(given.demonstrations, given.config, given.rngs, given.monitor)
