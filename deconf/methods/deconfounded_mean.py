"""Tier 2 as in the authors' released code (vuoristo/deconfounding), where it departs from Algorithms 1 and 2.

The data is as much as that of `deconfounded`; five things differ. The agent itself explores, without random actions
and without latents of other trials. The policy is trained and deployed on the mean of the running
belief: theta_hat is sampled in the model's training alone, and expert actions are cloned given the belief at that step,
not the belief after the whole trial. The KL divergence is from the belief of the step before, not from the prior. The
latent of a step predicts several transitions, not one. The reconstruction loss is the squared error.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from deconfounded.deconf.core.adam import Adam
from deconfounded.deconf.core.agents import Checkpoint
from deconfounded.deconf.core.data import Batch, Draws, Rngs, Signature, as_generators, take_steps, trials_of
from deconfounded.deconf.core.latent_agent import DeconfoundedAgent
from deconfounded.deconf.core.models import VariationalModel
from deconfounded.deconf.core.monitor import Monitor
from deconfounded.deconf.core.nets import ActionHead, Scaler, Scales
from deconfounded.deconf.core.sizes import Configuration
from deconfounded.deconf.equations import gaussian_kl, imitation_loss, masked_mean, reparametrise
from deconfounded.deconf.given import Given
from deconfounded.deconf.method import uses
from deconfounded.deconf.methods.deconfounded import Explore
from deconfounded.envs.support.errors import InputError
from deconfounded.experts.trials import Trials


@dataclass(frozen=True)
class MeanConfig(Configuration):
    """Hyperparameters for each seed. Each round explores, then updates the model, then the policy."""

    model: Literal["evidence", "gru"] = "gru"
    width: int = 64
    latent: int = 8
    beta: float = 1.0  # weight of the KL divergence from the previous belief, against the mean squared error of a step
    ahead: int = 10  # transitions that a latent predicts
    rounds: int = 8
    inference_updates: int = 60  # a round
    inference_batch: int = 16  # trials
    shortest: float = 1 / 16  # least share of these trials that an update reads: see Batch.beginnings
    inference_steps: int = 2048  # pairs of a latent and a transition that it predicts
    inference_rate: float = 1e-3
    imitation_updates: int = 250  # a round
    final_updates: int = 2000  # of the policy, after the last round
    imitation_batch: int = 1024  # steps
    imitation_rate: float = 2e-3
    device: str = "cpu"


class MeanAgent(DeconfoundedAgent):
    """A policy of the observation and of the belief's mean."""

    model: VariationalModel

    @staticmethod
    def new(kind: str, latent: int, width: int, scales: Scales, draws: Draws) -> "MeanAgent":
        """An untrained agent. Raises InputError for a model without a mean."""
        if kind not in ("evidence", "gru"):
            raise InputError(f"model was {kind!r}; it must be evidence or gru")
        model = VariationalModel(kind, latent, width, scales, draws)
        return MeanAgent(model, ActionHead(scales.signature.obs + latent, width, scales, draws))

    def latent(self) -> Tensor:
        return self.model.mean(self.model.belief(self._memory))

    def choose(self, obs: Tensor) -> Tensor:
        return self.policy.sample(torch.cat([_scaler(self.model)(obs), self.latent()], -1), self._draws)

    @torch.no_grad()
    def held_out_loss(self, batch: Batch) -> Tensor:
        """The imitation loss [S] on the expert's trials, given the running belief's mean."""
        return self.imitation(batch, running_mean(self.model, batch), None, self._draws)

    def imitation(self, batch: Batch, mean: Tensor, steps: int | None, draws: Draws) -> Tensor:
        """The imitation loss [S] on steps of expert trials [S, B, T], under means [S, B, T, D]."""
        index = batch.draw_steps(steps, draws)
        pairs = batch.steps(index)
        features = torch.cat([_scaler(self.model)(pairs.obs), take_steps(mean, index)], -1)
        return imitation_loss(self.policy.log_prob(features, pairs.action), pairs.mask)


def _scaler(model: VariationalModel) -> Scaler:
    """The scaler of observations: the policy shares no embedding with the encoder, as in the released code."""
    return model.inputs.scales.obs


def inference_loss(model: VariationalModel, batch: Batch, config: MeanConfig, draws: Draws) -> Tensor:
    """The loss [S] on trials [S, B, T]: the mean squared error, summed over steps ahead, and the KL of each belief.

    It is estimated on `inference_steps` random pairs of a latent and a transition that it predicts.
    """
    memories = model.encoder(batch)[:, :, :-1]
    mean, std = model.encoder.posterior(memories)  # before each step, [S, B, T, D]
    start = model.encoder.prior(mean[:, :, :1])
    before = [torch.cat([s.expand_as(x[:, :, :1]), x[:, :, :-1]], 2) for s, x in zip(start, (mean, std), strict=True)]
    kl = masked_mean(gaussian_kl(mean, std, *before).flatten(1), batch.mask.flatten(1))
    theta_hat = reparametrise(mean, std, draws.normal(*mean.shape[1:]))
    ahead = min(config.ahead, batch.mask.shape[2])
    offset = draws.integers(ahead, config.inference_steps)
    index = batch.draw_steps(config.inference_steps, draws)  # of the latents
    steps = batch.mask.shape[2]
    inside = index % steps + offset < steps
    target = batch.steps(torch.where(inside, index + offset, index))
    mask = target.mask * inside
    latents = take_steps(theta_hat, index)
    out = model.dynamics(target.obs, target.action, latents)[..., 0, :]
    if model.inputs.signature.binary:
        error = (torch.sigmoid(out) - target.next_obs).square().mean(-1)
    else:
        error = (out - model.dynamics.change(target.next_obs - target.obs)).square().mean(-1)
    return ahead * masked_mean(error, mask) + config.beta * kl + model.innovation_loss(target, latents)


@torch.no_grad()
def running_mean(model: VariationalModel, trials: Batch, part: int = 64) -> Tensor:
    """The belief's mean before each step, [S, B, T, D]; in parts of so many trials, to save memory."""
    indices = torch.arange(len(trials), device=trials.mask.device).split(part)
    return torch.cat([model.encoder.posterior(model.encoder(trials[:, i])[:, :, :-1])[0] for i in indices], 1)


def train(trials: Trials, explore: Explore, config: MeanConfig, rng: Rngs, monitor: Monitor | None = None) -> MeanAgent:
    """Train in rounds of exploration, inference and imitation; explore is called once a round.

    trials: of the expert, without theta, in as many equal groups as there are generators in rng. Raises InputError if
    exploration and trials do not fit each other.
    """
    rngs, device, monitor = as_generators(rng), config.device, monitor or Monitor()
    signature = Signature.of(trials, first := trials_of(lambda: explore(None)))
    expert, explored = (Batch.of(x, len(rngs), device) for x in (trials, signature.checked(first)))
    draws = Draws(rngs, device)
    scales = Scales.of(signature, expert, explored)
    agent = MeanAgent.new(config.model, config.latent, config.width, scales, draws)
    model, policy = agent.model, agent.policy
    assert isinstance(model, VariationalModel)
    inferences = config.rounds * config.inference_updates
    total = inferences + config.rounds * config.imitation_updates + config.final_updates
    inference = Adam([model], config.inference_rate, inferences)
    imitation = Adam([policy], config.imitation_rate)
    checkpoint = Checkpoint(
        monitor, rngs, model=model, policy=policy, inference=inference, imitation=imitation, draws=draws
    )
    begin, done = 0, 0
    if before := checkpoint.load():
        begin, explored, mean = before["round"], Batch(*before["seen"]), before["mean"]
        done = begin * (config.inference_updates + config.imitation_updates)

    def imitate(updates: int, optimizer: Adam, done: int) -> int:
        """Take that many updates of eta; returns the number of all updates so far."""
        for _ in range(updates):
            loss = agent.imitation(expert, mean, config.imitation_batch, draws)
            optimizer.step(loss)
            done += 1
            monitor.update(done, total, {"imitation": loss.mean().item()}, agent)
        return done

    for i in range(begin, config.rounds):
        if i > 0:
            explored = explored.joined(Batch.of(signature.checked(explore(agent)), len(rngs), device))
        for j in range(config.inference_updates):
            beginnings = explored.beginnings(i * config.inference_updates + j, config.shortest)
            loss = inference_loss(model, beginnings.draw_trials(config.inference_batch, draws), config, draws)
            inference.step(loss)
            done += 1
            monitor.update(done, total, {"inference": loss.mean().item()}, agent)
        mean = running_mean(model, expert)
        done = imitate(config.imitation_updates, imitation, done)
        checkpoint.save(round=i + 1, seen=explored.tensors, mean=mean)
    final = Adam([policy], config.imitation_rate, config.final_updates)
    imitate(config.final_updates, final, done)
    return agent


@uses(
    *("demonstrations", "exploration"),
    version=3,
    cost=8,
    on_control=MeanConfig(model="evidence"),
    on_bandit=MeanConfig(
        model="evidence",
        latent=5,
        beta=0.01,
        ahead=1,
        rounds=2,
        inference_updates=600,
        inference_batch=64,
        shortest=1.0,
        inference_steps=6400,
        inference_rate=3e-3,
        imitation_updates=800,
        final_updates=3200,
        imitation_rate=3e-3,
    ),
    smoke={"rounds": 2, "imitation_updates": 100, "final_updates": 400, "inference_updates": 20},
    smoke_bandit={"rounds": 1, "imitation_updates": 400, "final_updates": 800, "inference_updates": 400},
)
def fit(given: Given) -> MeanAgent:
    """Train in rounds of exploration, inference and imitation."""
    return train(given.demonstrations, given.explore, given.config, given.rngs, given.monitor)
