"""Memoryless behavioural cloning: blind BC, pi(a | s), and oracle BC, pi(a | s, theta)."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from deconfounded.deconf.core.adam import Adam
from deconfounded.deconf.core.agents import LearnedAgent
from deconfounded.deconf.core.data import Batch, Draws, Rngs, Signature, as_generators, joined_theta, take_steps
from deconfounded.deconf.core.monitor import Monitor
from deconfounded.deconf.core.nets import ActionHead, Scales
from deconfounded.deconf.core.sizes import Configuration
from deconfounded.deconf.equations import imitation_loss
from deconfounded.envs.streams import Array
from deconfounded.envs.support.errors import InputError
from deconfounded.experts.trials import Trials


@dataclass(frozen=True)
class MemorylessConfig(Configuration):
    """Hyperparameters for each seed; batch counts steps."""

    width: int = 64
    updates: int = 2000
    batch: int = 1024
    learning_rate: float = 2e-3
    device: str = "cpu"


class MemorylessAgent(LearnedAgent):
    """A policy of the observation and, for the oracle, of the encoded theta that `side` returns."""

    def __init__(self, policy: ActionHead, scales: Scales, side: Callable[[], Array] | None) -> None:
        super().__init__(policy)
        self.scales, self.side = scales, side

    @classmethod
    def blank(cls, shape: dict[str, Any], scales: Scales, draws: Draws) -> "MemorylessAgent":
        """An untrained agent. An oracle's `side` has to be set before it is deployed."""
        return cls(ActionHead(scales.signature.obs + shape["theta"], shape["width"], scales, draws), scales, None)

    def shape(self) -> dict[str, Any]:
        _, inputs, width = next(self.policy.parameters()).shape
        return {"width": width, "theta": inputs - self.policy.signature.obs}

    def parts(self) -> dict[str, nn.Module]:
        return {"policy": self.policy, "scales": self.scales}

    def choose(self, obs: Tensor) -> Tensor:
        features = self.scales.obs(obs)
        if self.shape()["theta"] and self.side is None:
            raise InputError("an oracle acts on theta, and had none; set its `side`")
        if self.side is not None:
            theta = torch.as_tensor(self.side()).to(features).reshape(*features.shape[:2], -1)
            features = torch.cat([features, theta], -1)
        return self.policy.sample(features, self._draws)


def train(
    trials: Trials,
    config: MemorylessConfig,
    rng: Rngs,
    theta: Array | None = None,
    side: Callable[[], Array] | None = None,
    monitor: Monitor | None = None,
) -> MemorylessAgent:
    """Clone the expert's action at each step; trials are in as many equal groups as there are generators in rng.

    For the oracle alone: theta [B, E, F], the encoded theta of each episode, or [B, E, T, F], of each step, and `side`,
    which returns that of the environments that the agent acts in [N, F].
    """
    rngs, signature, monitor = as_generators(rng), Signature.of(trials), monitor or Monitor()
    data, draws = Batch.of(trials, len(rngs), config.device), Draws(rngs, config.device)
    scales = Scales.of(signature, data)
    features = scales.obs(data.obs)
    if theta is not None:
        features = torch.cat([features, joined_theta(trials, theta, len(rngs), config.device)], -1)
    policy = ActionHead(features.shape[-1], config.width, scales, draws)
    agent = MemorylessAgent(policy, scales, side)
    optimizer = Adam([policy], config.learning_rate, config.updates)
    for update in range(config.updates):
        index = data.draw_steps(config.batch, draws)
        log_policy = policy.log_prob(take_steps(features, index), take_steps(data.action, index))
        loss = imitation_loss(log_policy, torch.ones_like(log_policy))
        optimizer.step(loss)
        monitor.update(update + 1, config.updates, {"imitation": loss.mean().item()}, agent)
    return agent


PRESETS: dict[str, Any] = {
    **{"cost": 1, "on_control": MemorylessConfig(), "on_bandit": MemorylessConfig(updates=500)},
    **{"smoke": {"updates": 400}, "smoke_bandit": {"updates": 400}},
}
