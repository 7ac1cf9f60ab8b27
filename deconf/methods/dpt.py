"""Tier 3: the Decision-Pretrained Transformer, DPT (Lee et al., 2023, arXiv 2306.14892), for imitation.

A transformer reads a context, transitions of a trial in which somebody explored, and then a query: an observation that
may be from anywhere in that trial, under the same theta. It predicts the expert's action there. The theory of the paper
says what it learns: posterior sampling, where the posterior is that of the context. Actions of the context are not the
expert's, and so no evidence of theta. In deployment the context is the agent's own transitions of the trial so far, and
the query is the present observation; no weight changes. It knows what `dagger` knows: theta-blind roll-outs, and the
expert's action at each of their steps. `dagger` predicts the label at the end of a history; here a label is predicted
from contexts of any length, before or after it.

It departs from the paper as follows. There are no rewards in the context: an imitator sees none. A transition has the
change of the observation in place of the next one. The query comes last, not first, so that the context's keys and
values are computed once. Contexts are in order of time, with rotary positions; the authors shuffle theirs. The paper
collects contexts and queries once, before training, queries from a distribution that covers the states that matter.
Random actions do not come near these states on control tasks. So roll-outs are collected in rounds, the first with
random actions, later ones with the agent's own; and half of the queries stand where their context ends, as in
deployment. Where theta switches within an episode, the other half have labels of another theta than their context.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from deconfounded.deconf.core.adam import Adam
from deconfounded.deconf.core.agents import Checkpoint
from deconfounded.deconf.core.data import Batch, Draws, Rngs, as_generators, joined_trials, take, take_steps
from deconfounded.deconf.core.monitor import Monitor
from deconfounded.deconf.core.nets import Scales
from deconfounded.deconf.core.sizes import Configuration
from deconfounded.deconf.core.transformer import Transformer, check_heads, normed, rotated, rotation
from deconfounded.deconf.equations import imitation_loss
from deconfounded.deconf.given import Given
from deconfounded.deconf.method import uses
from deconfounded.deconf.methods.dagger import Query, by_round, labelled
from deconfounded.deconf.methods.naive_transformer import TransformerAgent
from deconfounded.envs.support.errors import InputError


@dataclass(frozen=True)
class DptConfig(Configuration):
    """Hyperparameters for each seed. Each round labels fresh roll-outs of the current agent."""

    width: int = 64
    layers: int = 2
    heads: int = 4
    rounds: int = 16
    updates: int = 800  # in all; later rounds, with more labels, get more of them
    batch: int = 8  # trials
    shortest: float = 1 / 16  # least share of these trials that is their context: see Batch.beginnings
    queries: int = 64  # of each context
    anywhere: float = 0.5  # share of queries from anywhere in the trial; others are where their context ends
    learning_rate: float = 2e-3
    drifts: bool = False  # theta changes between episodes: the context is emptied at each
    device: str = "cpu"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_heads(self.width, self.heads)


class InContext(Transformer):
    """A transformer of a context and of queries, which read a beginning of it and themselves."""

    def answers(self, context: Tensor, queries: Tensor, seen: Tensor) -> Tensor:
        """Features [S, B, K, W] of queries [S, B, K, I], which read the first seen [S, B, K] of context [S, B, T, I].

        Each stands at the position after the last transition that it reads, as in deployment.
        """
        length, count = context.shape[2], queries.shape[2]
        at = torch.arange(length, device=seen.device)
        own = torch.eye(count, dtype=torch.bool, device=seen.device).expand(*seen.shape, count)
        mask = torch.cat([at < seen[..., None], own], -1).flatten(0, 1)[:, None]
        turn = rotation(at, self.width // self.heads)
        turned = [x.flatten(0, 1)[:, None] for x in rotation(seen, self.width // self.heads)]
        x = self.embed(torch.cat([context, queries], 2))
        for i in range(self.depth):
            qkv = self.projected(i, x)
            before, after = qkv[..., :length, :], qkv[..., length:, :]
            (read, key), value = rotated(before[:2], turn), before[2]
            ask, own_key = rotated(after[:2], (turned[0], turned[1]))
            keys, values = torch.cat([key, own_key], -2), torch.cat([value, after[2]], -2)
            mixed = [F.scaled_dot_product_attention(read, key, value, is_causal=True)] if i + 1 < self.depth else []
            mixed.append(F.scaled_dot_product_attention(ask, keys, values, mask))
            x = x[:, :, -count:] if i + 1 == self.depth else x  # nobody reads the context's last layer
            x = self.after_attention(i, x, torch.cat(mixed, -2))
        return normed(x)


class DptAgent(TransformerAgent):
    """A policy of the present observation, the query, and of the latest `window` transitions of the trial."""

    net_kind: ClassVar[type[Transformer]] = InContext
    net: InContext
    forgets = False

    def shape(self) -> dict[str, Any]:
        return {**super().shape(), "forgets": self.forgets}

    @classmethod
    def blank(cls, shape: dict[str, Any], scales: Scales, draws: Draws) -> "DptAgent":
        agent = cls.new(shape, scales, draws)
        agent.forgets = bool(shape["forgets"])
        return agent

    def transitions(self, steps: Batch) -> Tensor:
        """Tokens [..., I] of a context: observation, action, change, and 1."""
        change = self.scales.change(steps.next_obs - steps.obs)
        parts = [self.scales.obs(steps.obs), self.scales.encode(steps.action), change, torch.ones_like(change[..., :1])]
        return torch.cat(parts, -1)

    def queries(self, obs: Tensor) -> Tensor:
        """Tokens [..., I] of queries: an observation, and zeros."""
        signature = self.scales.signature
        return F.pad(self.scales.obs(obs), (0, signature.action_features + signature.obs + 1))

    def reset(self, rngs: Sequence[np.random.Generator]) -> None:
        super().reset(rngs)
        if self.forgets:
            for cache in self._caches:
                cache.clear()

    def choose(self, obs: Tensor) -> Tensor:
        """Act on the query. The next token overwrites it in the cache, which has not advanced."""
        return self.act_on(self.queries(obs), self.scales.obs(obs))

    def remember(self, step: Batch) -> None:
        parts = zip(self.transitions(step), step.mask, self._layers, self._caches, strict=True)
        for transition, mask, layers, cache in parts:
            self.net.write(transition, layers, cache)
            cache.advance(mask)

    def loss(self, batch: Batch, label: Tensor) -> Tensor:
        """The imitation loss [S] of labels [S, B, T, A] at each step, after all transitions before it."""
        every = torch.arange(batch.mask.shape[2], device=label.device).expand(batch.mask.shape)
        return self.query_loss(batch, label, batch, every, every)

    def query_loss(self, batch: Batch, label: Tensor, context: Batch, index: Tensor, seen: Tensor) -> Tensor:
        """The imitation loss [S] of labels [S, B, T, A] at steps index [S, B, K] of trials.

        It is given the first seen [S, B, K] transitions of a context [S, B, N] of the same trials.
        """
        steps = index + batch.mask.shape[2] * torch.arange(len(batch), device=index.device)[:, None]
        obs, mask, target = (take_steps(x, steps.flatten(1)) for x in (batch.obs, batch.mask, label))
        queries = self.queries(obs).unflatten(1, index.shape[1:])
        features = self.net.answers(self.transitions(context), queries, seen).flatten(1, 2)
        log_policy = self.policy.log_prob(torch.cat([features, self.scales.obs(obs)], -1), target)
        return imitation_loss(log_policy, mask)


def draw_queries(mask: Tensor, longest: int, config: DptConfig, draws: Draws) -> tuple[Tensor, Tensor]:
    """Steps of queries [S, B, K] in trials of mask [S, B, T], and how many transitions each reads, up to `longest`."""
    steps = mask.sum(-1, keepdim=True).long()
    readable = steps.clamp(max=longest)
    last, latest = (steps - 1).clamp(min=0), (readable - 1).clamp(min=0)  # a trial may have no step
    where, first, second = draws.uniform(3, mask.shape[1], config.queries).unbind(1)
    anywhere, at_end = (first * steps).long().clamp(max=last), (first * readable).long().clamp(max=latest)
    seen = (second * (readable + 1)).long().clamp(max=readable)
    return torch.where(where < config.anywhere, torch.stack([anywhere, seen]), at_end).unbind(0)  # type: ignore[return-value]


def train(query: Query, config: DptConfig, rng: Rngs, monitor: Monitor | None = None) -> DptAgent:
    """In rounds, label roll-outs and train on all labels so far."""
    rngs, monitor = as_generators(rng), monitor or Monitor()
    draws = Draws(rngs, config.device)
    asked = len(rngs), config.drifts, config.device
    signature, data, label = labelled(query, None, *asked)
    shape = {"width": config.width, "layers": config.layers, "heads": config.heads, "forgets": config.drifts}
    scales = Scales(signature, data, label, data.mask)
    agent = DptAgent.blank({**shape, "window": data.mask.shape[2]}, scales, draws)
    updates = by_round(config.updates, config.rounds)
    optimizer, begin, done = Adam([agent.net, agent.policy], config.learning_rate, sum(updates)), 0, 0
    checkpoint = Checkpoint(monitor, rngs, **agent.parts(), optimizer=optimizer, draws=draws)
    if before := checkpoint.load():
        begin, data, label = before["round"], Batch(*before["data"]), before["label"]
        done = sum(updates[:begin])
    for i in range(begin, config.rounds):
        if i > 0:
            _, more, new = labelled(query, agent, *asked)
            if (longest := more.mask.shape[2]) > (window := agent.shape()["window"]):
                raise InputError(f"trials of a later round had {longest} steps; they must be at most {window}")
            data, label = data.joined(more), joined_trials(label, new)
        for _ in range(updates[i]):
            longest = data.beginnings(done, config.shortest).mask.shape[2]
            own = data.trials(index := draws.integers(len(data), config.batch))
            where = draw_queries(own.mask, longest, config, draws)
            loss = agent.query_loss(own, take(label, index), own[:, :, :longest], *where)
            optimizer.step(loss)
            done += 1
            monitor.update(done, sum(updates), {"imitation": loss.mean().item()}, agent)
        checkpoint.save(round=i + 1, data=data.tensors, label=label)
    return agent


@uses(
    "queries",
    cost=10,
    on_control=DptConfig(),
    on_bandit=DptConfig(width=32, rounds=4, batch=32, shortest=1.0),
    smoke={"updates": 60, "rounds": 4},
    smoke_bandit={"updates": 200, "rounds": 4},
)
def fit(given: Given) -> DptAgent:
    """Train on labelled roll-outs."""
    return train(given.query, given.config, given.rngs, given.monitor)
