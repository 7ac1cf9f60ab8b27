"""Naive behavioural cloning with memory: an RNN pi(a_t | s_1, a_1, ..., s_t), fitted to expert trials by likelihood.

At its optimum it is the conditional policy, Eq. (2), which takes its own past actions as evidence of theta. A fair
opponent: it is trained on whole trials, its memory is carried over the resets, and its history encoder is that of the
paper's belief.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from deconf.beliefs import GruMemory
from deconf.equations import imitation_loss
from deconf.nets import ActionHead, Batch, Progress, Scaler, Signature, no_progress, seeded, torch_generator
from envs.task import Array
from experts.demos import Agent, Trials


@dataclass(frozen=True)
class NaiveConfig:
    """Widths and amounts; batch counts trials, chunk the steps of truncated backpropagation through time."""

    width: int = 64
    updates: int = 2000
    batch: int = 64
    chunk: int = 50
    learning_rate: float = 1e-3
    device: str = "cpu"


class RnnAgent(Agent):
    """Acts on the observation and on a memory of its own transitions."""

    def __init__(self, memory: GruMemory, policy: ActionHead) -> None:
        self.memory, self.policy = memory, policy

    def begin(self, n: int, rng: np.random.Generator) -> None:
        self._state = self.memory.start(n)
        self._rng = torch_generator(rng, self._state.device)

    @torch.no_grad()
    def act(self, obs: NDArray[np.float32]) -> Array:
        features = torch.cat([self._state, self.memory.obs(obs)], -1)
        return self.policy.sample(features, self._rng).double().cpu().numpy()

    @torch.no_grad()
    def observe(
        self, obs: NDArray[np.float32], action: Array, next_obs: NDArray[np.float32], alive: NDArray[np.bool_]
    ) -> None:
        self._state = self.memory.update(self._state, Batch.step(obs, action, next_obs, alive, self._state.device))


def fit(trials: Trials, config: NaiveConfig, rng: np.random.Generator, progress: Progress = no_progress) -> RnnAgent:
    """Clone the expert's trials; chunks of a trial are seen in order, the memory passed on between them."""
    data, signature = Batch.of(trials, config.device), Signature.of(trials)
    with seeded(rng):
        memory = GruMemory(config.width, signature, Scaler(data.obs[data.mask.bool()])).to(config.device)
        policy = ActionHead(config.width + signature.obs, config.width, signature).to(config.device)
    optimizer = torch.optim.Adam([*memory.parameters(), *policy.parameters()], config.learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, config.updates)
    generator = torch_generator(rng, config.device)
    update = 0
    while update < config.updates:
        batch = data[torch.randint(len(data), (config.batch,), generator=generator, device=config.device)]
        state: Tensor = memory.start(config.batch)
        for begin in range(0, int(batch.mask.sum(1).max()), config.chunk):
            chunk = batch[:, begin : begin + config.chunk]
            states = memory(chunk, state)
            features = torch.cat([states[:, :-1], memory.obs(chunk.obs)], -1)
            loss = imitation_loss(policy.log_prob(features, chunk.action)[chunk.mask.bool()])
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_([*memory.parameters(), *policy.parameters()], 1.0)
            optimizer.step()
            schedule.step()
            state = states[:, -1].detach()
            update += 1
            progress(update, config.updates, {"imitation": loss.item()})
            if update == config.updates:
                break
    return RnnAgent(memory, policy)
