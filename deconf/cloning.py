"""Behavioural cloning without memory: blind BC, pi(a | s), and oracle BC, pi(a | s, theta)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from deconf.equations import imitation_loss
from deconf.nets import ActionHead, Batch, Progress, Scaler, Signature, no_progress, seeded, torch_generator
from envs.task import Array
from experts.demos import Agent, Trials


@dataclass(frozen=True)
class CloningConfig:
    """Widths and amounts; batch counts steps."""

    width: int = 64
    updates: int = 4000
    batch: int = 1024
    learning_rate: float = 1e-3
    device: str = "cpu"


class MemorylessAgent(Agent):
    """Acts on the observation, and on the features of theta that `side` returns, if it is an oracle."""

    def __init__(self, policy: ActionHead, scaler: Scaler, side: Callable[[], Array] | None) -> None:
        self.policy, self.scaler, self.side = policy, scaler, side

    def begin(self, n: int, rng: np.random.Generator) -> None:
        self._rng = torch_generator(rng, self.scaler.mean.device)

    @torch.no_grad()
    def act(self, obs: NDArray[np.float32]) -> Array:
        features = self.scaler(obs)
        if self.side is not None:
            features = torch.cat([features, torch.as_tensor(self.side()).to(features)], -1)
        return self.policy.sample(features, self._rng).double().cpu().numpy()


def fit(
    trials: Trials,
    config: CloningConfig,
    rng: np.random.Generator,
    theta: Array | None = None,
    side: Callable[[], Array] | None = None,
    progress: Progress = no_progress,
) -> MemorylessAgent:
    """Clone the expert step by step.

    theta [B, F]: features of each trial's theta, for the oracle, whose agent then asks `side` for those [N, F] of the
    environments it acts in. Without both: blind BC.
    """
    data = Batch.of(trials, config.device)
    keep = data.mask.bool()
    obs, action = data.obs[keep], data.action[keep]
    scaler = Scaler(obs)
    features = scaler(obs)
    if theta is not None:
        per_step = torch.as_tensor(theta).to(features)[:, None].expand(-1, keep.shape[1], -1)
        features = torch.cat([features, per_step[keep]], -1)
    with seeded(rng):
        policy = ActionHead(features.shape[-1], config.width, Signature.of(trials)).to(config.device)
    optimizer = torch.optim.Adam(policy.parameters(), config.learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, config.updates)
    generator = torch_generator(rng, config.device)
    for update in range(config.updates):
        index = torch.randint(len(obs), (config.batch,), generator=generator, device=config.device)
        log_policy = policy.log_prob(features[index], action[index])
        loss = imitation_loss(log_policy)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        progress(update + 1, config.updates, {"imitation": loss.item()})
    return MemorylessAgent(policy, scaler, side)
