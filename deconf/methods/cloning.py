"""Behavioural cloning without memory: blind BC, pi(a | s), and oracle BC, pi(a | s, theta)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from deconfounded.deconf.core.agents import LearnedAgent
from deconfounded.deconf.core.data import Batch, Draws, Rngs, Signature, listed, take_steps
from deconfounded.deconf.core.monitor import Monitor
from deconfounded.deconf.core.nets import ActionHead, Adam, Scaler
from deconfounded.deconf.core.sizes import Configuration
from deconfounded.deconf.equations import imitation_loss
from deconfounded.envs.streams import Array
from deconfounded.envs.support.errors import InputError
from deconfounded.experts.rollout import Trials


@dataclass(frozen=True)
class CloningConfig(Configuration):
    """Widths and amounts, for each seed; batch counts steps."""

    width: int = 64
    updates: int = 2000
    batch: int = 1024
    learning_rate: float = 2e-3
    device: str = "cpu"


class MemorylessAgent(LearnedAgent):
    """Acts on the observation, and on the features of theta that `side` returns, if it is an oracle."""

    def __init__(self, policy: ActionHead, scaler: Scaler, side: Callable[[], Array] | None) -> None:
        super().__init__(policy)
        self.scaler, self.side = scaler, side

    @classmethod
    def blank(cls, shape: dict[str, Any], signature: Signature, obs: Scaler, draws: Draws) -> MemorylessAgent:
        """An oracle is told by whoever deploys it: `side` is theirs to set."""
        return cls(ActionHead(signature.obs + shape["theta"], shape["width"], signature, draws), obs, None)

    def shape(self) -> dict[str, Any]:
        _, inputs, width = next(self.policy.parameters()).shape
        return {"width": width, "theta": inputs - self.policy.signature.obs}

    def parts(self) -> dict[str, nn.Module]:
        return {"policy": self.policy, "scaler": self.scaler}

    def choose(self, obs: Tensor) -> Tensor:
        features = self.scaler(obs)
        if self.shape()["theta"] and self.side is None:
            raise InputError("an oracle acts on theta, and was told none; set its `side`")
        if self.side is not None:
            theta = torch.as_tensor(self.side()).to(features).reshape(*features.shape[:2], -1)
            features = torch.cat([features, theta], -1)
        return self.policy.sample(features, self._draws)


def train(
    trials: Trials,
    config: CloningConfig,
    rng: Rngs,
    theta: Array | None = None,
    side: Callable[[], Array] | None = None,
    monitor: Monitor | None = None,
) -> MemorylessAgent:
    """Clone the expert step by step; trials are in as many equal groups as there are generators in rng.

    theta [B, E, F]: features of each episode's theta, for the oracle, whose agent then asks `side` for those [N, F] of
    the environments it acts in. Without both: blind BC.
    """
    rngs, signature, monitor = listed(rng), Signature.of(trials), monitor or Monitor()
    data, draws = Batch.of(trials, len(rngs), config.device), Draws(rngs, config.device)
    scaler = Scaler(data.obs, data.mask)
    features = scaler(data.obs)
    if theta is not None:
        each = torch.as_tensor(theta).to(features).reshape(*features.shape[:2], *theta.shape[1:])
        features = torch.cat([features, each.repeat_interleave(trials.mask.shape[2], 2)], -1)
    policy = ActionHead(features.shape[-1], config.width, signature, draws)
    agent = MemorylessAgent(policy, scaler, side)
    optimizer = Adam([policy], config.learning_rate, config.updates)
    for update in range(config.updates):
        index = data.draw_steps(config.batch, draws)
        log_policy = policy.log_prob(take_steps(features, index), take_steps(data.action, index))
        loss = imitation_loss(log_policy, torch.ones_like(log_policy))
        optimizer.step(loss)
        monitor.update(update + 1, config.updates, {"imitation": loss.mean().item()}, agent)
    return agent


AMOUNTS: dict[str, Any] = {
    **{"cost": 1, "on_control": CloningConfig(), "on_bandit": CloningConfig(updates=500)},
    **{"smoke": {"updates": 400}, "smoke_bandit": {"updates": 400}},
}
