"""Agents that infer a latent and act on it: Algorithm 2 of the paper, and its explorers in training."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from deconfounded.deconf.core.agents import LearnedAgent
from deconfounded.deconf.core.data import Batch, Draws, take
from deconfounded.deconf.core.deployment import Latents, Way, acted_on
from deconfounded.deconf.core.latent_model import LatentModel, final_belief
from deconfounded.deconf.core.models import new_model
from deconfounded.deconf.core.nets import ActionHead, Scales
from deconfounded.deconf.core.online import OnlineBelief, online_belief
from deconfounded.deconf.equations import imitation_loss


class DeconfoundedAgent(LearnedAgent):
    """Algorithm 2, posterior sampling.

    online: its belief in the course of a trial; None: that is the model's own. `way`: how it takes theta_hat from its
    belief (`core/deployment.py`).
    """

    way: Way = "step"

    def __init__(self, model: LatentModel, policy: ActionHead, online: OnlineBelief | None = None) -> None:
        super().__init__(policy)
        self.model, self.online = model, online

    @staticmethod
    def new(kind: str, latent: int, width: int, scales: Scales, draws: Draws) -> "DeconfoundedAgent":
        """An untrained agent. Raises InputError for an unknown kind of model."""
        model = new_model(kind, latent, width, scales, draws)
        policy = ActionHead(model.inputs.obs_width + latent, width, scales, draws)
        return DeconfoundedAgent(model, policy, online_belief(model, draws))

    @classmethod
    def blank(cls, shape: dict[str, Any], scales: Scales, draws: Draws) -> "DeconfoundedAgent":
        sizes = (shape["model"], shape["latent"], shape["width"])
        agent = cls.new(*sizes, scales, draws)
        agent.way = shape["way"]
        return agent

    def shape(self) -> dict[str, Any]:
        model = self.model
        return {"model": model.kind, "latent": model.latent, "width": model.width, "way": self.way}

    def parts(self) -> dict[str, nn.Module]:
        own: dict[str, nn.Module] = {"model": self.model, "policy": self.policy}
        return own | {"online": self.online} if self.online else own

    def begin(self, n: int) -> None:
        super().begin(n)
        self._memory = self.model.start(self._n)

    def reset(self, rngs: Sequence[np.random.Generator]) -> None:
        super().reset(rngs)
        self._latent: Tensor | None = None
        self._memory = self.model.forget(self._memory)

    def belief(self) -> tuple[Latents[Tensor, Draws], Tensor]:
        """What gives latents, and the belief [S, N, P] given the trial so far."""
        if self.online is None:
            return self.model, self.model.belief(self._memory)
        return self.online, self.online(self.model, self._memory)

    def latent(self) -> Tensor:
        """The theta_hat [S, N, D] for the next action."""
        latents, belief = self.belief()
        self._latent = acted_on(latents, self.way, belief, self._draws, self._latent)
        return self._latent

    def choose(self, obs: Tensor) -> Tensor:
        return self.policy.sample(torch.cat([self.model.inputs.obs(obs), self.latent()], -1), self._draws)

    def remember(self, step: Batch) -> None:
        self._memory = self.model.update(self._memory, step)

    def loss(self, batch: Batch, belief: Tensor, steps: int | None, draws: Draws) -> Tensor:
        """The imitation loss [S] on steps of expert trials; theta_hat_H is that of `final_belief`, by `for_cloning`."""
        index = batch.draw_steps(steps, draws)
        pairs = batch.steps(index)
        steps_each = batch.mask.shape[1:].numel() // belief.shape[1]  # of a belief: a trial's, or one
        theta_hat = self.model.for_cloning(take(belief, index // steps_each), draws)
        with torch.no_grad():
            inputs = self.model.inputs.obs(pairs.obs)
        return imitation_loss(self.policy.log_prob(torch.cat([inputs, theta_hat], -1), pairs.action), pairs.mask)

    @torch.no_grad()
    def held_out_loss(self, batch: Batch) -> Tensor:
        """The imitation loss [S] on the expert's trials, given theta_hat_H."""
        return self.loss(batch, final_belief(self.model, batch), None, self._draws)

    @torch.no_grad()
    def remembered(self) -> NDArray[np.float32]:
        latents, belief = self.belief()
        mean = latents.mean(belief)
        return mean.flatten(0, 1).cpu().numpy()


class Explorer(DeconfoundedAgent):
    """The exploration policy: the current imitator, with a share of random actions; it sees no theta.

    In every other trial, counted over all calls of `begin`, its latent is drawn once an episode from those inferred on
    expert trials (samples of the prior) instead of from the belief, so that each expert's behaviour is rolled out under
    each theta.
    """

    def __init__(self, agent: DeconfoundedAgent, latents: Tensor, random_share: float) -> None:
        super().__init__(agent.model, agent.policy, agent.online)
        self.latents, self.random_share = latents, random_share
        self._before = 0  # trials of each seed, before those that act now

    def begin(self, n: int) -> None:
        self._before += self._n
        super().begin(n)

    def reset(self, rngs: Sequence[np.random.Generator]) -> None:
        super().reset(rngs)
        self._blind = (self._before + torch.arange(self._n, device=self.device))[:, None] % 2 == 0
        self._drawn = take(self.latents, self._draws.integers(self.latents.shape[1], self._n))

    def latent(self) -> Tensor:
        return torch.where(self._blind, self._drawn, super().latent())

    def choose(self, obs: Tensor) -> Tensor:
        return self.policy.signature.randomise(super().choose(obs), self.random_share, self._draws)
