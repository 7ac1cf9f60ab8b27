"""A trait of the expert that is constant in a trial, inferred from one half of it by actions, and shown in the other.

Where the dynamics tell nothing, it separates what a memory predicts of a trial as a whole (a goal that only the expert
sees, or an operator's habits) from what passes: pauses, noise that lasts, an expert's own memory.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from deconfounded.deconf.core.adam import Adam
from deconfounded.deconf.core.data import Batch, Draws, Signature, take
from deconfounded.deconf.core.dynamics import DynamicsHead
from deconfounded.deconf.core.layers import Mlp
from deconfounded.deconf.core.nets import ActionHead, Inputs, Scales
from deconfounded.deconf.diagnosis.held_out import typical
from deconfounded.deconf.diagnosis.latent import each_step, halves
from deconfounded.deconf.diagnosis.learned_env import LatentPolicy
from deconfounded.deconf.equations import imitation_loss
from deconfounded.deconf.methods.memoryless_bc import MemorylessConfig

TRAIT, TRIALS, STEPS = 4, 32, 64  # dimensions; trials of an update, and steps of each half of them
NOISE = 0.3  # of traits in training, so that they do not name trials


class Trait(NamedTuple):
    """A policy given a trait, traits [1, B, D] of the trials of training, and its gain in held-out ones.

    scales: those that the policy was trained with, given the trait that the other half of a step's trial shows, since
    halves may show different ones. gain: log-likelihood of the actions of the second half of held-out trials, given the
    trait of the first, over a policy that was trained with traits of other trials, and has as much to overfit; nats a
    step.
    """

    policy: ActionHead
    scales: Scales
    traits: Tensor
    gain: float


class Encoder(nn.Module):
    """The mean of features of a trial's steps, observation and action, as a trait."""

    def __init__(self, width: int, scales: Scales, draws: Draws) -> None:
        super().__init__()
        self.inputs = Inputs(scales)
        self.step = Mlp(self.inputs.obs_width + self.inputs.action_width, width, width, draws)
        self.out = Mlp(width, width, TRAIT, draws)

    def forward(self, steps: Batch) -> Tensor:
        """[S, B, T] -> [S, B, TRAIT]."""
        x = self.step(torch.cat([self.inputs.obs(steps.obs), self.inputs.action(steps.action)], -1))
        weight = steps.mask[..., None]
        return self.out((x * weight).sum(2) / weight.sum(2).clamp(min=1))


def _draw(data: Batch, draws: Draws) -> Batch:
    """Random steps of each trial [S, B, STEPS], those that took place first."""
    order = (draws.uniform(*data.mask.shape[1:]) + 2 * (1 - data.mask)).argsort(-1)[..., :STEPS]
    index = order[..., None]
    obs, action, next_obs = (x.gather(2, index.expand(-1, -1, -1, x.shape[-1])) for x in data.tensors[:3])
    return Batch(obs, action, next_obs, data.mask.gather(2, order))


def fit(train: Batch, held_out: Batch, signature: Signature, config: MemorylessConfig, draws: Draws) -> Trait:
    """Train an encoder on halves of the trials, clone policies given its traits, and measure the gain."""
    scales = Scales.of(signature, train)
    encoder = Encoder(config.width, scales, draws)
    policy, own, other = (ActionHead(signature.obs + TRAIT, config.width, scales, draws) for _ in range(3))

    def log_prob(of: ActionHead, steps: Batch, trait: Tensor) -> Tensor:
        return of.log_prob(torch.cat([scales.obs(steps.obs), trait], -1), steps.action)

    def blurred(trait: Tensor) -> Tensor:
        return trait + NOISE * draws.normal(*trait.shape[1:])

    optimizer = Adam([encoder, policy], config.learning_rate, config.updates)
    for update in range(config.updates):
        parts = [_draw(half, draws) for half in halves(train.draw_trials(TRIALS, draws))]
        context, rest = parts if update % 2 else parts[::-1]
        trait = encoder(context)
        loss = imitation_loss(log_prob(policy, rest, each_step(rest, blurred(trait))).flatten(1), rest.mask.flatten(1))
        optimizer.step(loss + 1e-3 * trait.square().mean((1, 2)))
    with torch.no_grad():
        traits, (early, late) = encoder(train), halves(train)
        of_early, of_late = (each_step(train, encoder(half)) for half in (early, late))
        from_rest = torch.where(early.mask[..., None] > 0, of_late, of_early)
    for clone, given in ((own, from_rest), (other, from_rest.roll(1, 1))):
        optimizer = Adam([clone], config.learning_rate, config.updates)
        for _ in range(config.updates):
            index = train.draw_steps(config.batch, draws)
            steps, trait = train.steps(index), take(given.flatten(1, 2), index)
            optimizer.step(imitation_loss(log_prob(clone, steps, blurred(trait)), steps.mask))
    with torch.no_grad():
        early, late = halves(held_out)
        trait = each_step(late, encoder(early))
        return Trait(own, scales, traits, typical(log_prob(own, late, trait) - log_prob(other, late, trait), late))


class TraitPolicy(LatentPolicy):
    """A policy given traits [S, N, TRAIT], in dynamics under latents [S, N, D]; theta_hat holds both."""

    def __init__(self, dynamics: DynamicsHead, of_trial: Trait, latent: Tensor, trait: Tensor) -> None:
        super().__init__(dynamics, of_trial.policy, torch.cat([latent, trait], -1))
        self.scales = of_trial.scales  # of expert trials; those of the dynamics may be of exploration

    def features(self, obs: Tensor, latent: Tensor) -> Tensor:
        return torch.cat([self.scales.obs(obs), latent[..., -TRAIT:]], -1)

    def next_obs(self, obs: Tensor, action: Tensor, draws: Draws) -> Tensor:
        return self.dynamics.sample(obs, action, self.theta_hat[..., :-TRAIT], draws)
