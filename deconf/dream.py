"""What cloning will cost, seen in learned dynamics: agents act there under latents drawn from the data."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from deconfounded.deconf.agents import LearnedAgent
from deconfounded.deconf.data import Batch, Draws, take
from deconfounded.deconf.deconfounded import DeconfoundedAgent, final_belief
from deconfounded.deconf.models import VariationalModel
from deconfounded.deconf.nets import ActionHead
from deconfounded.experts.demos import Trials


def dream(
    trials: Trials,
    held: Batch,
    hindsight: VariationalModel,
    agent: DeconfoundedAgent,
    recurrent: LearnedAgent,
    n: int,
    rngs: list[np.random.Generator],
) -> tuple[Tensor, Tensor]:
    """Predicted scores [S] of the naive clone and of the latent-conditional agent, in the learned dynamics.

    A step counts by how far its action is from the knowing expert's, in units of how far another latent's expert's is;
    where it leaves the range that experts keep to, the episode is lost. 1 is the expert who knows the latent, 0 the one
    who holds another one for true.
    """
    draws = Draws(rngs, "cpu")
    latents = hindsight.sample(final_belief(hindsight, held), draws)
    chosen = draws.below(latents.shape[1], n)
    theta_hat, told = take(latents, chosen), take(latents, draws.below(latents.shape[1], n))
    starts = torch.tensor(trials.obs[:, :, 0]).reshape(1, -1, held.obs.shape[-1]).expand(len(draws), -1, -1)
    world = World(trials, held, hindsight, agent.policy, theta_hat, starts)

    def knows(latent: Tensor) -> Callable[[Tensor], Tensor]:
        return lambda obs: agent.policy.sample(torch.cat([agent.model.inputs.obs(obs), latent], -1), world.draws)

    lost = [world.lost(knows(latent), None, rngs) for latent in (theta_hat, told)]
    lost += [world.lost(one.choose, one, rngs) for one in (recurrent, agent)]
    one, zero, naive, deconfounded = lost
    spread = (zero - one).clamp(min=1e-3)
    return 1 - (naive - one) / spread, 1 - (deconfounded - one) / spread


class World:
    """The learned dynamics under latents [S, N, D], and the expert who knows them, as a judge."""

    def __init__(
        self,
        trials: Trials,
        held: Batch,
        model: VariationalModel,
        policy: ActionHead,
        theta_hat: Tensor,
        starts: Tensor,
    ) -> None:
        self.episodes, self.horizon = trials.mask.shape[1:]
        self.model, self.policy, self.theta_hat, self.starts = model, policy, theta_hat, starts
        padding = held.mask[..., None] == 0
        self.low = held.obs.masked_fill(padding, torch.inf).amin((1, 2))[:, None]
        self.high = held.obs.masked_fill(padding, -torch.inf).amax((1, 2))[:, None]
        margin = 0.1 * (self.high - self.low)
        self.low, self.high = self.low - margin, self.high + margin
        self.scale = self._scale(held)
        self.draws = Draws([], "cpu")

    def _point(self, obs: Tensor, latent: Tensor) -> Tensor:
        """The expert's mean action, or its log-probabilities."""
        out = self.policy.net(torch.cat([self.model.inputs.obs(obs), latent], -1))
        return torch.log_softmax(out, -1) if self.policy.signature.actions else out.chunk(2, -1)[0].clamp(-1, 1)

    def _scale(self, held: Batch) -> Tensor:
        """How far the actions of two latents' experts are apart where experts go: [S, 1]."""
        if self.policy.signature.actions:
            return torch.ones(len(self.theta_hat), 1)
        n = self.theta_hat.shape[1]
        obs = held.obs[:, :, :: max(1, held.obs.shape[2] // 16)].flatten(1, 2)[:, : 16 * n]
        k = obs.shape[1]
        one = self.theta_hat[:, torch.arange(k) % n]
        other = self.theta_hat[:, (torch.arange(k) * 7 + 3) % n]
        apart = (self._point(obs, one) - self._point(obs, other)).abs().sum(-1)
        return apart.mean(1, keepdim=True).clamp(min=1e-3)

    def _off(self, obs: Tensor, action: Tensor) -> Tensor:
        """How far an action [S, N, A] is from the knowing expert's, 0 to 1."""
        point = self._point(obs, self.theta_hat)
        if self.policy.signature.actions:
            likely = point.gather(-1, action[..., :1].long())[..., 0]
            return 1 - (likely - point.amax(-1)).exp()
        return ((action - point).abs().sum(-1) / self.scale).clamp(max=1)

    def lost(
        self, choose: Callable[[Tensor], Tensor], agent: LearnedAgent | None, rngs: list[np.random.Generator]
    ) -> Tensor:
        """Mean distance [S] in the last of the trial's episodes, of an actor [S, N, O] -> [S, N, A] and its memory."""
        seeds, n, _ = self.theta_hat.shape
        rngs = [np.random.default_rng(one.integers(2**63)) for one in rngs]
        self.draws = Draws(rngs, "cpu")
        if agent is not None:
            agent.begin(seeds * n)
        total = torch.zeros(seeds, n)
        for _ in range(self.episodes):
            if agent is not None:
                agent.reset(rngs)
            obs = take(self.starts, self.draws.below(self.starts.shape[1], n))
            there, total = torch.ones(seeds, n), torch.zeros(seeds, n)
            for _ in range(self.horizon):
                action = choose(obs)
                total += torch.where(there > 0, self._off(obs, action), 1.0) / self.horizon
                next_obs = self.model.dynamics.sample(obs, action, self.theta_hat, self.draws)
                if agent is not None:
                    agent.remember(Batch(obs, action, next_obs, there))
                inside = ((next_obs >= self.low) & (next_obs <= self.high)).all(-1)
                there = there * inside
                obs = torch.where(there[..., None] > 0, next_obs, obs)
        return total.mean(1)
