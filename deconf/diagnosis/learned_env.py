"""What cloning will cost, seen in learned dynamics: actors go about there under latents drawn from the data."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from deconfounded.deconf.core.agents import LearnedAgent
from deconfounded.deconf.core.data import Batch, Draws, extent, take
from deconfounded.deconf.core.models import VariationalModel
from deconfounded.deconf.core.nets import ActionHead, sample_index
from deconfounded.deconf.core.termination import TerminationModel
from deconfounded.deconf.equations import belief_update


class Actor(Protocol):
    """Acts in n trials of each seed, side by side."""

    def begin(self, n: int, rngs: Sequence[np.random.Generator]) -> None: ...
    def choose(self, obs: Tensor) -> Tensor: ...  # [S, N, O] -> [S, N, A]
    def remember(self, step: Batch) -> None: ...


class Expert:
    """A latent-conditional policy: of latents [S, N, D], one a trial, that it holds for true."""

    def __init__(self, model: VariationalModel, policy: ActionHead, theta_hat: Tensor) -> None:
        self.model, self.policy, self.theta_hat = model, policy, theta_hat

    def begin(self, n: int, rngs: Sequence[np.random.Generator]) -> None:
        """It remembers nothing."""
        self._draws = Draws(rngs, "cpu")

    def features(self, obs: Tensor, latent: Tensor) -> Tensor:
        """What the policy reads."""
        return torch.cat([self.model.inputs.obs(obs), latent], -1)

    def choose(self, obs: Tensor) -> Tensor:
        return self.policy.sample(self.features(obs, self.theta_hat), self._draws)

    def remember(self, step: Batch) -> None:
        pass

    def point(self, obs: Tensor, latent: Tensor) -> Tensor:
        """The mean action [..., A], or log-probabilities of discrete ones."""
        out = self.policy.net(self.features(obs, latent))
        return torch.log_softmax(out, -1) if self.policy.signature.actions else out.chunk(2, -1)[0].clamp(-1, 1)


class Filter(Expert):
    """Eq. (5) over K latents of the data [S, K, D]: posterior sampling under a belief that reads dynamics alone."""

    def begin(self, n: int, rngs: Sequence[np.random.Generator]) -> None:
        super().begin(n, rngs)
        k = self.theta_hat.shape[1]
        self.log_belief = self.theta_hat.new_full((len(self.theta_hat), n, k), -math.log(k))

    def log_next(self, step: Batch) -> Tensor:
        """log p(s' | s, a, theta_hat_k) [..., K] of steps [S, ...]."""
        every, latent = self._every(step)
        return self.model.dynamics.log_prob(every.obs, every.action, every.next_obs, latent)[..., 0]

    def _every(self, step: Batch) -> tuple[Batch, Tensor]:
        """Each step under each latent."""
        shape = (*step.mask.shape, self.theta_hat.shape[1])
        latent = self.theta_hat.reshape(len(self.theta_hat), *[1] * (step.mask.dim() - 1), *self.theta_hat.shape[1:])
        obs, action, next_obs = (x[..., None, :].expand(*shape, -1) for x in step.tensors[:3])
        return Batch(obs, action, next_obs, step.mask), latent.expand(*shape, -1)

    def choose(self, obs: Tensor) -> Tensor:
        drawn = take(self.theta_hat, sample_index(self.log_belief.exp(), self._draws))
        return self.policy.sample(self.features(obs, drawn), self._draws)

    def remember(self, step: Batch) -> None:
        self.log_belief = belief_update(self.log_belief, self.log_next(step) * step.mask[..., None])


class Clone:
    """A learned agent, as an actor; its memory goes on over episodes."""

    def __init__(self, agent: LearnedAgent) -> None:
        self.agent = agent

    def begin(self, n: int, rngs: Sequence[np.random.Generator]) -> None:
        self.agent.begin(len(rngs) * n)
        self.agent.reset(rngs)

    def choose(self, obs: Tensor) -> Tensor:
        return self.agent.choose(obs)

    def remember(self, step: Batch) -> None:
        self.agent.remember(step)


def farther(rivals: Tensor, known: Tensor, draws: Draws) -> Tensor:
    """For each of known ones [S, N] of latents [S, K, D], another, of the half that is farther from it."""
    half = max(1, rivals.shape[1] // 2)
    far = torch.cdist(rivals, rivals).argsort(-1, descending=True)[..., :half]
    return take(far, known).gather(-1, draws.integers(half, known.shape[1])[..., None])[..., 0]


def seen_range(*data: Batch) -> tuple[Tensor, Tensor]:
    """Least and largest observation [S, 1, O] of trials [S, B, T]."""
    ends = [extent(obs, batch.mask) for batch in data for obs in (batch.obs, batch.next_obs)]
    low, high = (torch.stack(values) for values in zip(*ends, strict=True))
    return low.amin(0), high.amax(0)


def known_range(held: Batch) -> tuple[Tensor, Tensor]:
    """Least and largest observation [S, 1, O] for which dynamics are to hold: the data, and half its range beyond."""
    low, high = seen_range(held)
    margin = (0.5 * (high - low)).clamp(min=1e-3)
    return low - margin, high + margin


class World:
    """Learned dynamics under latents [S, N, D], and the expert who knows them, as a judge.

    held: expert trials [S, B, T], in whose known_range the dynamics hold, and from whose starts episodes begin; all
    trials that there are say what is ever observed, beyond which no dream goes: a sensor may reach no further. ends:
    where an episode is over before its horizon, more likely than not.
    """

    def __init__(
        self,
        judge: Expert,
        held: Batch,
        every: Sequence[Batch],
        episodes: int,
        horizon: int,
        ends: TerminationModel | None,
    ) -> None:
        self.judge, self.horizon, self.ends = judge, horizon, ends
        n, starts = judge.theta_hat.shape[1], held.obs[:, :, 0]
        draws = Draws([np.random.default_rng(i) for i in range(len(starts))], "cpu")
        self.starts = [
            take(starts, draws.integers(starts.shape[1], n)) for _ in range(episodes)
        ]  # the same for everyone
        self.known, self.seen = known_range(held), seen_range(*every)
        self.scale = self._scale(held)

    def _scale(self, held: Batch) -> Tensor:
        """How far the actions of two latents' experts are apart where experts go: [S, 1]."""
        theta_hat = self.judge.theta_hat
        if self.judge.policy.signature.actions:
            return torch.ones(len(theta_hat), 1)
        n = theta_hat.shape[1]
        draws = Draws([np.random.default_rng(i) for i in range(len(theta_hat))], "cpu")
        obs = held.steps(held.draw_steps(16 * n, draws)).obs
        one, other = (take(theta_hat, draws.integers(n, 16 * n)) for _ in range(2))
        apart = (self.judge.point(obs, one) - self.judge.point(obs, other)).abs().sum(-1)
        return apart.mean(1, keepdim=True).clamp(min=1e-3)

    def _off(self, obs: Tensor, action: Tensor) -> Tensor:
        """How far an action [S, N, A] is from the knowing expert's, 0 to 1."""
        point = self.judge.point(obs, self.judge.theta_hat)
        if self.judge.policy.signature.actions:
            likely = point.gather(-1, action[..., :1].long())[..., 0]
            return 1 - (likely - point.amax(-1)).exp()
        return ((action - point).abs().sum(-1) / self.scale).clamp(max=1)

    @torch.no_grad()
    def visit(self, actor: Actor, rngs: Sequence[np.random.Generator]) -> tuple[Tensor, Tensor]:
        """An actor's last episode: how far its actions are from the judge's [S], and its observations [S, N, T, O].

        The first is a mean over steps, 0 to 1; where that range is left, the rest of the episode counts as 1. Then, and
        when it is over, observations stay as they are.
        """
        seeds, n, _ = self.judge.theta_hat.shape
        rngs = [np.random.default_rng(rng.integers(2**63)) for rng in rngs]
        draws = Draws(rngs, "cpu")
        actor.begin(n, rngs)
        for obs in self.starts:
            there, lost = torch.ones(seeds, n), torch.zeros(seeds, n)
            total, count, went = torch.zeros(seeds, n), torch.zeros(seeds, n), list[Tensor]()
            for _ in range(self.horizon):
                action = actor.choose(obs)
                total += there * self._off(obs, action) + lost
                count += there + lost
                next_obs = self.judge.model.dynamics.sample(obs, action, self.judge.theta_hat, draws)
                actor.remember(Batch(obs, action, next_obs, there))  # as drawn: of that, log_next is the likelihood
                obs = torch.where(there[..., None] > 0, next_obs.clamp(*self.seen), obs)
                inside = ((obs >= self.known[0]) & (obs <= self.known[1])).all(-1)
                lost = torch.maximum(lost, there * ~inside)
                there = there * inside
                if self.ends is not None:
                    there = there * (self.ends.logit(obs) <= 0)
                went.append(obs)
        return (total / count).mean(1), torch.stack(went, 2)
