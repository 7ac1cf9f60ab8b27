"""The learned environment: rollouts of policies in learned dynamics, under latents inferred from the data."""

import math
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from deconfounded.deconf.core.agents import LearnedAgent
from deconfounded.deconf.core.data import Batch, Draws, extent, take
from deconfounded.deconf.core.dynamics import DynamicsHead
from deconfounded.deconf.core.nets import ActionHead, sample_index
from deconfounded.deconf.core.termination import TerminationModel
from deconfounded.deconf.equations import belief_update


class Actor(Protocol):
    """Acts in n trials of each seed, side by side."""

    def begin(self, n: int, rngs: Sequence[np.random.Generator]) -> None: ...
    def choose(self, obs: Tensor) -> Tensor: ...  # [S, N, O] -> [S, N, A]
    def remember(self, step: Batch) -> None: ...


class LatentPolicy:
    """The latent-conditional policy, an actor that is given the latents [S, N, D] of its trials, right or wrong."""

    def __init__(self, dynamics: DynamicsHead, policy: ActionHead, theta_hat: Tensor) -> None:
        self.dynamics, self.policy, self.theta_hat = dynamics, policy, theta_hat

    def begin(self, n: int, rngs: Sequence[np.random.Generator]) -> None:
        """Start trials; there is no memory."""
        self._draws = Draws(rngs, "cpu")

    def features(self, obs: Tensor, latent: Tensor) -> Tensor:
        """Features for the policy."""
        return torch.cat([self.dynamics.inputs.obs(obs), latent], -1)

    def choose(self, obs: Tensor) -> Tensor:
        return self.policy.sample(self.features(obs, self.theta_hat), self._draws)

    def remember(self, step: Batch) -> None:
        pass

    def next_obs(self, obs: Tensor, action: Tensor, draws: Draws) -> Tensor:
        """A draw of the next observations [S, N, O], under the latents of the trials."""
        return self.dynamics.sample(obs, action, self.theta_hat, draws)

    def point(self, obs: Tensor, latent: Tensor) -> Tensor:
        """The mean action [..., A], or log-probabilities of discrete actions."""
        out = self.policy.net(self.features(obs, latent))
        if self.policy.signature.actions:
            return torch.log_softmax(out, -1)
        return self.policy.scaler.inverse(out.chunk(2, -1)[0]).clamp(-1, 1)


class PosteriorSampler(LatentPolicy):
    """Posterior sampling over K candidate latents [S, K, D], under a belief from the dynamics alone, Eq. (5)."""

    def begin(self, n: int, rngs: Sequence[np.random.Generator]) -> None:
        super().begin(n, rngs)
        k = self.theta_hat.shape[1]
        self.log_belief = self.theta_hat.new_full((len(self.theta_hat), n, k), -math.log(k))

    def log_next(self, step: Batch) -> Tensor:
        """log p(s' | s, a, theta_hat_k) [..., K] of steps [S, ...]."""
        shape = (*step.mask.shape, self.theta_hat.shape[1])
        latent = self.theta_hat.reshape(len(self.theta_hat), *[1] * (step.mask.dim() - 1), *self.theta_hat.shape[1:])
        obs, action, next_obs = (x[..., None, :].expand(*shape, -1) for x in step.tensors[:3])
        return self.dynamics.log_prob(obs, action, next_obs, latent.expand(*shape, -1))[..., 0]

    def choose(self, obs: Tensor) -> Tensor:
        latent = take(self.theta_hat, sample_index(self.log_belief.exp(), self._draws))
        return self.policy.sample(self.features(obs, latent), self._draws)

    def remember(self, step: Batch) -> None:
        self.log_belief = belief_update(self.log_belief, self.log_next(step) * step.mask[..., None])


class AgentActor:
    """A learned agent as an actor; its memory outlives episodes."""

    def __init__(self, agent: LearnedAgent) -> None:
        self.agent = agent

    def begin(self, n: int, rngs: Sequence[np.random.Generator]) -> None:
        self.agent.begin(len(rngs) * n)
        self.agent.reset(rngs)

    def choose(self, obs: Tensor) -> Tensor:
        return self.agent.choose(obs)

    def remember(self, step: Batch) -> None:
        self.agent.remember(step)


def observed_range(*data: Batch) -> tuple[Tensor, Tensor]:
    """Least and largest observation [S, 1, O] of trials [S, B, T]."""
    extents = [extent(obs, batch.mask) for batch in data for obs in (batch.obs, batch.next_obs)]
    low, high = (torch.stack(values) for values in zip(*extents, strict=True))
    return low.amin(0), high.amax(0)


def valid_range(expert: Batch) -> tuple[Tensor, Tensor]:
    """The range [S, 1, O] in which dynamics are taken to be valid: the data's, and half of it beyond on either side."""
    low, high = observed_range(expert)
    margin = torch.where(high > low, 0.5 * (high - low), 1e-3)
    return low - margin, high + margin


class Rollout(NamedTuple):
    """The last episode of an actor's trials: the mean error of its actions [S], observations after each step
    [S, N, T, O], and the number of steps [S, N]."""

    error: Tensor
    paths: Tensor
    length: Tensor


class LearnedEnv:
    """Learned dynamics under the latents [S, N, D] of a reference policy, which also measures errors of actions.

    expert: trials [S, B, T] whose valid_range holds, and from whose first observations episodes start. data: all
    trials, whose range bounds observations, as a sensor may. Episodes end where termination is more likely than not.
    """

    def __init__(
        self,
        reference: LatentPolicy,
        expert: Batch,
        data: Sequence[Batch],
        episodes: int,
        horizon: int,
        termination: TerminationModel | None,
    ) -> None:
        self.reference, self.horizon, self.termination = reference, horizon, termination
        n, starts = reference.theta_hat.shape[1], expert.obs[:, :, 0]
        draws = Draws([np.random.default_rng(i) for i in range(len(starts))], "cpu")
        self.starts = [take(starts, draws.integers(starts.shape[1], n)) for _ in range(episodes)]  # of all rollouts
        self.valid, self.observed = valid_range(expert), observed_range(*data)
        self.scale = self._scale(expert)

    def _scale(self, expert: Batch) -> Tensor:
        """The mean distance [S, 1] of the reference's actions under two random latents, on expert observations."""
        theta_hat = self.reference.theta_hat
        if self.reference.policy.signature.actions:
            return torch.ones(len(theta_hat), 1)
        n = theta_hat.shape[1]
        draws = Draws([np.random.default_rng(i) for i in range(len(theta_hat))], "cpu")
        obs = expert.steps(expert.draw_steps(16 * n, draws)).obs
        first, second = (take(theta_hat, draws.integers(n, 16 * n)) for _ in range(2))
        distance = (self.reference.point(obs, first) - self.reference.point(obs, second)).abs().sum(-1)
        return distance.mean(1, keepdim=True).clamp(min=1e-3)

    def _action_error(self, obs: Tensor, action: Tensor) -> Tensor:
        """The distance [S, N] of actions [S, N, A] from the reference's, 0 to 1."""
        point = self.reference.point(obs, self.reference.theta_hat)
        if self.reference.policy.signature.actions:
            log_prob = point.gather(-1, action[..., :1].long())[..., 0]
            return 1 - (log_prob - point.amax(-1)).exp()
        return ((action - point).abs().sum(-1) / self.scale).clamp(max=1)

    @torch.no_grad()
    def rollout(self, actor: Actor, rngs: Sequence[np.random.Generator]) -> Rollout:
        """The last episode of an actor's trials.

        After an episode leaves the valid range, its errors count as 1. From there on, or after its termination, its
        observations stay as they are.
        """
        seeds, n, _ = self.reference.theta_hat.shape
        rngs = [np.random.default_rng(rng.integers(2**63)) for rng in rngs]
        draws = Draws(rngs, "cpu")
        actor.begin(n, rngs)
        for obs in self.starts:
            alive, left = torch.ones(seeds, n), torch.zeros(seeds, n)
            total, count, length = (torch.zeros(seeds, n) for _ in range(3))
            path = list[Tensor]()
            for _ in range(self.horizon):
                action = actor.choose(obs)
                total += alive * self._action_error(obs, action) + left
                count += alive + left
                length += alive
                next_obs = self.reference.next_obs(obs, action, draws)
                actor.remember(Batch(obs, action, next_obs, alive))  # before clamping, as log_next models it
                obs = torch.where(alive[..., None] > 0, next_obs.clamp(*self.observed), obs)
                inside = ((obs >= self.valid[0]) & (obs <= self.valid[1])).all(-1)
                left = torch.maximum(left, alive * ~inside)
                alive = alive * inside
                if self.termination is not None:
                    alive = alive * (self.termination.logit(obs) <= 0)
                path.append(obs)
        return Rollout((total / count).mean(1), torch.stack(path, 2), length)
