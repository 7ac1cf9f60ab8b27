"""Naive behavioural cloning by a causal transformer over the whole trial, a stronger sequence model than naive_rnn's.

Its optimum is naive_rnn's, the conditional policy, Eq. (2). In training each action is predicted from the whole history
before it, without truncation. A token is an observation, and the action and the next observation of the step before.
Positions are rotary (Su et al., 2021), and so relative: deployment may be longer than training, and reads the latest
`window` tokens, as many as a trial of training has.
"""

from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from deconfounded.deconf.core.adam import Adam
from deconfounded.deconf.core.agents import LearnedAgent
from deconfounded.deconf.core.data import Batch, Draws, Rngs, Source, stacked
from deconfounded.deconf.core.monitor import Monitor
from deconfounded.deconf.core.nets import ActionHead, Scales
from deconfounded.deconf.core.sizes import Configuration
from deconfounded.deconf.core.transformer import Cache, Transformer, check_heads
from deconfounded.deconf.equations import imitation_loss
from deconfounded.deconf.given import Given
from deconfounded.deconf.method import uses
from deconfounded.deconf.methods.sequence_bc import train_sequence


@dataclass(frozen=True)
class TransformerConfig(Configuration):
    """Hyperparameters for each seed; batch counts trials, shortest is the least share of them that an update reads."""

    width: int = 64
    layers: int = 2
    heads: int = 4
    updates: int = 600
    batch: int = 16
    shortest: float = 1 / 8
    learning_rate: float = 2e-3
    device: str = "cpu"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_heads(self.width, self.heads)


class TransformerAgent(LearnedAgent):
    """A policy of the latest `window` tokens of the trial, across resets."""

    net_kind: ClassVar[type[Transformer]] = Transformer

    def __init__(self, net: Transformer, policy: ActionHead, scales: Scales) -> None:
        super().__init__(policy)
        self.net, self.scales = net, scales

    @classmethod
    def new(cls, shape: dict[str, Any], scales: Scales, draws: Draws) -> Self:
        """An untrained agent."""
        signature, width = scales.signature, shape["width"]
        inputs = 2 * signature.obs + signature.action_features + 1
        net = cls.net_kind(inputs, width, shape["layers"], shape["heads"], shape["window"], draws)
        return cls(net, ActionHead(width + signature.obs, width, scales, draws), scales)

    @classmethod
    def blank(cls, shape: dict[str, Any], scales: Scales, draws: Draws) -> "TransformerAgent":
        return cls.new(shape, scales, draws)

    def shape(self) -> dict[str, Any]:
        net = self.net
        return {"width": net.width, "layers": net.depth, "heads": net.heads, "window": net.window}

    def parts(self) -> dict[str, nn.Module]:
        return {"net": self.net, "policy": self.policy, "scales": self.scales}

    def before(self, step: Batch) -> Tensor:
        """The part of a token on the step before it [..., O + F + 1]: zeros where there was none."""
        parts = [self.scales.encode(step.action), self.scales.obs(step.next_obs), step.mask[..., None]]
        return torch.cat(parts, -1) * step.mask[..., None]

    def tokens(self, batch: Batch) -> Tensor:
        """Tokens [S, B, T, I] of trials."""
        before = F.pad(self.before(batch)[:, :, :-1], (0, 0, 1, 0))
        return torch.cat([self.scales.obs(batch.obs), before], -1)

    def begin(self, n: int) -> None:
        super().begin(n)
        net = self.net
        sizes = (net.depth, self._n, net.heads, net.window, net.width // net.heads, self.device)
        self._caches = [Cache(*sizes) for _ in range(self.seeds)]
        self._layers = [net.layers(seed) for seed in range(self.seeds)]
        signature = self.policy.signature
        width = signature.action_features + signature.obs + 1
        self._before = torch.zeros(self.seeds, self._n, width, device=self.device)
        self._features = torch.zeros(self.seeds, self._n, net.width, device=self.device)
        self._has_read = False

    def choose(self, obs: Tensor) -> Tensor:
        """Act on the next token. It stays in the cache if the step takes place, and is overwritten otherwise."""
        scaled = self.scales.obs(obs)
        return self.act_on(self._next_tokens(scaled), scaled)

    def _next_tokens(self, scaled: Tensor) -> Tensor:
        return torch.cat([scaled, self._before], -1)

    def act_on(self, tokens: Tensor, scaled: Tensor) -> Tensor:
        """Action [S, N, A], given each trial's next token [S, N, I] and its scaled observation [S, N, O]."""
        self._read(tokens)
        return self.policy.sample(torch.cat([self._features, scaled], -1), self._draws)

    def _read(self, tokens: Tensor) -> None:
        steps = zip(tokens, self._layers, self._caches, strict=True)
        self._features, self._has_read = stacked([self.net.step(*of_seed) for of_seed in steps]), True

    def remember(self, step: Batch) -> None:
        if not self._has_read:
            self._read(self._next_tokens(self.scales.obs(step.obs)))
        self._has_read = False
        for cache, mask in zip(self._caches, step.mask, strict=True):
            cache.advance(mask)
        self._before = torch.where(step.mask[..., None] > 0, self.before(step), self._before)

    def remembered(self) -> NDArray[np.float32]:
        return self._features.flatten(0, 1).cpu().numpy()

    def loss(self, batch: Batch, label: Tensor) -> Tensor:
        """The imitation loss [S] of labels [S, B, T, A] on whole trials; no step attends to the padding at the end."""
        features = torch.cat([self.net(self.tokens(batch)), self.scales.obs(batch.obs)], -1)
        return imitation_loss(self.policy.log_prob(features, label).flatten(1), batch.mask.flatten(1))

    @torch.no_grad()
    def held_out_loss(self, batch: Batch) -> Tensor:
        """The imitation loss [S] on the expert's trials; in parts, to save memory."""
        parts = [batch[:, i : i + 32] for i in range(0, len(batch), 32)]
        counts = torch.stack([part.mask.flatten(1).sum(1) for part in parts])
        losses = torch.stack([self.loss(part, part.action) for part in parts])
        return (losses * counts).sum(0) / counts.sum(0)


class TransformerTrainer:
    """Trains by maximum likelihood, an update a batch, on beginnings of trials, where most is learned."""

    def __init__(self, agent: TransformerAgent, config: TransformerConfig, monitor: Monitor) -> None:
        self.agent, self.config, self.monitor = agent, config, monitor
        self.done, self.total = 0, config.updates
        self.optimizer = Adam([agent.net, agent.policy], config.learning_rate, config.updates)

    def learn(self, batch: Batch, label: Tensor) -> None:
        """Take one update."""
        part = batch.beginnings(self.done, self.config.shortest)
        loss = self.agent.loss(part, label[:, :, : part.mask.shape[2]])
        self.optimizer.step(loss)
        self.done += 1
        self.monitor.update(self.done, self.total, {"imitation": loss.mean().item()}, self.agent)


def train(trials: Source, config: TransformerConfig, rng: Rngs, monitor: Monitor | None = None) -> TransformerAgent:
    """Clone the expert's trials, which are in as many equal groups as there are generators in rng."""

    def new_agent(scales: Scales, draws: Draws) -> TransformerAgent:
        shape = {"width": config.width, "layers": config.layers, "heads": config.heads, "window": 1}
        return TransformerAgent.new(shape, scales, draws)

    def new_trainer(agent: TransformerAgent, steps: int, monitor: Monitor) -> TransformerTrainer:
        agent.net.window = steps
        return TransformerTrainer(agent, config, monitor)

    return train_sequence(trials, config, rng, new_agent, new_trainer, monitor)


@uses(
    "demonstrations",
    version=2,
    cost=30,
    on_control=TransformerConfig(layers=4),
    on_bandit=TransformerConfig(width=32, layers=4, updates=1500, batch=64, shortest=1.0, learning_rate=3e-3),
    smoke={"updates": 10},
    smoke_bandit={"updates": 200},
)
def fit(given: Given) -> TransformerAgent:
    """Clone the demonstrations."""
    return train(given.source, given.config, given.rngs, given.monitor)
