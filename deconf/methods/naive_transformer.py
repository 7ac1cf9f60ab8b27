"""Naive behavioural cloning by a causal transformer over the whole trial: does a stronger sequence model cure delusion?

Its optimum is naive_rnn's, the conditional policy, Eq. (2). Nothing is truncated in training: each action is predicted
from all that came before it in the trial. A token is an observation, and the action and the next observation of the
step before it. Positions are rotary (Su et al., 2021), and so relative: deployment goes on for longer than training,
with the latest `window` tokens, as many as a trial of training has.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from deconfounded.deconf.core.agents import LearnedAgent
from deconfounded.deconf.core.data import Batch, Draws, Rngs, Signature, Source
from deconfounded.deconf.core.monitor import Monitor
from deconfounded.deconf.core.nets import ActionHead, Adam, Linear, Scaler
from deconfounded.deconf.core.sizes import Configuration
from deconfounded.deconf.equations import imitation_loss
from deconfounded.deconf.given import Given
from deconfounded.deconf.method import uses
from deconfounded.deconf.methods.clones import clone


@dataclass(frozen=True)
class TransformerConfig(Configuration):
    """Widths and amounts, for each seed; batch counts trials, shortest is the least share of them an update reads."""

    width: int = 64
    layers: int = 2
    heads: int = 4
    updates: int = 600
    batch: int = 16
    shortest: float = 1 / 8
    learning_rate: float = 2e-3
    device: str = "cpu"


def normed(x: Tensor) -> Tensor:
    """Layer normalisation without parameters: what follows is linear, and has them."""
    return F.layer_norm(x, x.shape[-1:])


def rotated(x: Tensor, position: Tensor) -> Tensor:
    """Rotary position: x [..., H, T, D] turned, pair by pair of its D, by angles that grow with position [..., 1, T].

    So the product of two depends on how far they are apart; its waves are 6 to some thousand steps long.
    """
    half = x.shape[-1] // 2
    speed = 1000.0 ** -(torch.arange(half, device=x.device) / half)
    angle = position[..., None].float() * speed
    (one, other), cos, sin = x.chunk(2, -1), angle.cos(), angle.sin()
    return torch.cat([one * cos - other * sin, one * sin + other * cos], -1)


class Cache:
    """Keys and values [N, H, window, D] of each layer's latest tokens in N trials; number i is at i modulo window.

    Of one seed: how far it is filled decides how sums are taken, and is no business of other seeds.
    """

    def __init__(self, layers: int, n: int, heads: int, window: int, width: int, device: torch.device) -> None:
        self.kept = [[torch.zeros(n, heads, window, width, device=device) for _ in range(2)] for _ in range(layers)]
        self.count = torch.zeros(n, dtype=torch.int64, device=device)  # of tokens that are there to stay
        self.window, self.rows = window, torch.arange(n, device=device)

    def attend(self, layer: int, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """Write each trial's next token, and look at it and those before it; all [N, H, 1, D]."""
        position = self.count[:, None, None]
        filled = min(int(self.count.max()) + 1, self.window)
        for kept, new in zip(self.kept[layer], (rotated(key, position), value), strict=True):
            kept[self.rows, :, self.count % self.window] = new[:, :, 0]
        keys, values = (kept[:, :, :filled] for kept in self.kept[layer])
        real = torch.arange(filled, device=key.device) <= self.count[:, None]
        return F.scaled_dot_product_attention(rotated(query, position), keys, values, real[:, None, None])


class Transformer(nn.Module):
    """Pre-norm blocks of causal attention and an MLP: tokens [S, B, T, I] -> features [S, B, T, W]."""

    def __init__(self, inputs: int, width: int, layers: int, heads: int, window: int, draws: Draws) -> None:
        super().__init__()
        self.width, self.heads, self.window, self.depth = width, heads, window, layers
        self.embed = Linear(inputs, width, draws)
        self.attend = nn.ModuleList(Linear(width, 3 * width, draws) for _ in range(layers))
        self.mix = nn.ModuleList(Linear(width, width, draws) for _ in range(layers))
        self.widen = nn.ModuleList(Linear(width, 4 * width, draws) for _ in range(layers))
        self.narrow = nn.ModuleList(Linear(4 * width, width, draws) for _ in range(layers))

    def forward(self, tokens: Tensor, caches: list[Cache] | None = None) -> Tensor:
        """With caches, one for each seed, tokens [S, N, 1, I] are each trial's next, and are kept in them."""
        x = self.embed(tokens)
        for i in range(self.depth):
            x = x + self.mix[i](self._attention(i, self.attend[i](normed(x)), caches))
            x = x + self.narrow[i](F.gelu(self.widen[i](normed(x))))
        return normed(x)

    def _attention(self, layer: int, projected: Tensor, caches: list[Cache] | None) -> Tensor:
        """[S, B, T, 3 W] -> [S, B, T, W]."""
        each = projected.unflatten(-1, (3, self.heads, -1)).permute(3, 0, 1, 4, 2, 5)  # [3, S, B, H, T, D]
        if caches is None:
            position = torch.arange(projected.shape[2], device=projected.device)[None]
            query, key, value = (x.flatten(0, 1) for x in each)
            query, key = rotated(query, position), rotated(key, position)
            mixed = F.scaled_dot_product_attention(query, key, value, is_causal=True)
            mixed = mixed.unflatten(0, projected.shape[:2])
        else:
            mixed = torch.stack([cache.attend(layer, *each[:, s].unbind()) for s, cache in enumerate(caches)])
        return mixed.transpose(2, 3).flatten(3)


class TransformerAgent(LearnedAgent):
    """Acts on the latest `window` tokens of its trial, over resets."""

    def __init__(self, net: Transformer, policy: ActionHead, obs: Scaler) -> None:
        super().__init__(policy)
        self.net, self.obs = net, obs

    @staticmethod
    def new(shape: dict[str, Any], signature: Signature, obs: Scaler, draws: Draws) -> TransformerAgent:
        """One that knows nothing yet."""
        inputs = 2 * signature.obs + signature.action_features + 1
        net = Transformer(inputs, shape["width"], shape["layers"], shape["heads"], shape["window"], draws)
        return TransformerAgent(net, ActionHead(shape["width"] + signature.obs, shape["width"], signature, draws), obs)

    @classmethod
    def blank(cls, shape: dict[str, Any], signature: Signature, obs: Scaler, draws: Draws) -> TransformerAgent:
        return cls.new(shape, signature, obs, draws)

    def shape(self) -> dict[str, Any]:
        net = self.net
        return {"width": net.width, "layers": net.depth, "heads": net.heads, "window": net.window}

    def parts(self) -> dict[str, nn.Module]:
        return {"net": self.net, "policy": self.policy, "obs": self.obs}

    def before(self, step: Batch) -> Tensor:
        """What a token says of the step before it [..., O + F + 1]: zeros where there was none."""
        told = [self.policy.signature.encode_action(step.action), self.obs(step.next_obs), step.mask[..., None]]
        return torch.cat(told, -1) * step.mask[..., None]

    def tokens(self, batch: Batch) -> Tensor:
        """[S, B, T, I]."""
        before = F.pad(self.before(batch)[:, :, :-1], (0, 0, 1, 0))
        return torch.cat([self.obs(batch.obs), before], -1)

    def begin(self, n: int) -> None:
        super().begin(n)
        net = self.net
        sizes = (net.depth, self._n, net.heads, net.window, net.width // net.heads, self.device)
        self._caches = [Cache(*sizes) for _ in range(self.seeds)]
        signature = self.policy.signature
        told = signature.action_features + signature.obs + 1
        self._before = torch.zeros(self.seeds, self._n, told, device=self.device)
        self._known = torch.zeros(self.seeds, self._n, net.width, device=self.device)

    def choose(self, obs: Tensor) -> Tensor:
        """Its token stays if the step takes place: in a trial that waits for the others, it is written over."""
        scaled = self.obs(obs)
        self._known = self.net(torch.cat([scaled, self._before], -1)[:, :, None], self._caches)[:, :, 0]
        return self.policy.sample(torch.cat([self._known, scaled], -1), self._draws)

    def remember(self, step: Batch) -> None:
        for cache, mask in zip(self._caches, step.mask, strict=True):
            cache.count += mask.long()
        self._before = torch.where(step.mask[..., None] > 0, self.before(step), self._before)

    def features(self) -> NDArray[np.float32]:
        return self._known.flatten(0, 1).cpu().numpy()

    def loss(self, batch: Batch, label: Tensor) -> Tensor:
        """The imitation loss [S] of labels [S, B, T, A] on whole trials; padding is at their ends, and never seen."""
        features = torch.cat([self.net(self.tokens(batch)), self.obs(batch.obs)], -1)
        return imitation_loss(self.policy.log_prob(features, label).flatten(1), batch.mask.flatten(1))

    @torch.no_grad()
    def held_out_loss(self, batch: Batch) -> Tensor:
        """The imitation loss [S] on the expert's trials; so many at a time, for the sake of memory."""
        parts = [batch[:, i : i + 32] for i in range(0, len(batch), 32)]
        counts = torch.stack([part.mask.flatten(1).sum(1) for part in parts])
        losses = torch.stack([self.loss(part, part.action) for part in parts])
        return (losses * counts).sum(0) / counts.sum(0)


class Teacher:
    """Trains by likelihood, an update a batch, on beginnings of trials: most is to be learned early in them."""

    def __init__(self, agent: TransformerAgent, config: TransformerConfig, monitor: Monitor) -> None:
        self.agent, self.config, self.monitor = agent, config, monitor
        self.done, self.total = 0, config.updates
        self.optimizer = Adam([agent.net, agent.policy], config.learning_rate, config.updates)

    def learn(self, batch: Batch, label: Tensor) -> None:
        """One update."""
        part = batch.beginnings(self.done, self.config.shortest)
        loss = self.agent.loss(part, label[:, :, : part.mask.shape[2]])
        self.optimizer.step(loss)
        self.done += 1
        self.monitor.update(self.done, self.total, {"imitation": loss.mean().item()}, self.agent)


def train(trials: Source, config: TransformerConfig, rng: Rngs, monitor: Monitor | None = None) -> TransformerAgent:
    """Clone the expert's trials, which are in as many equal groups as there are generators in rng."""

    def start(signature: Signature, obs: Scaler, draws: Draws) -> TransformerAgent:
        shape = {"width": config.width, "layers": config.layers, "heads": config.heads, "window": 1}
        return TransformerAgent.new(shape, signature, obs, draws)

    def teach(agent: TransformerAgent, steps: int, monitor: Monitor) -> Teacher:
        agent.net.window = steps
        return Teacher(agent, config, monitor)

    return clone(trials, config, rng, start, teach, monitor)


@uses(
    "demonstrations",
    cost=30,
    on_control=TransformerConfig(layers=4),
    on_bandit=TransformerConfig(width=32, layers=4, updates=1500, batch=64, shortest=1.0, learning_rate=3e-3),
    smoke={"updates": 10},
    smoke_bandit={"updates": 200},
)
def fit(given: Given) -> TransformerAgent:
    """Clone the demonstrations."""
    return train(given.source, given.config, given.rngs, given.monitor)
