"""What one split of an expert's trials tells of what the expert sees and its clone does not: figures, no judgement.

An expert that sees more than its clone will leaves three traces. Memory tells its actions better than the present
observation does; one latent explains whole trials, Eq. (7); and what the *world* says of that latent, against what the
expert's own actions say of it, decides whether a recurrent clone finds out or deludes itself. What that would cost is
seen in the learned dynamics, where the naive clone and one that infers the latent from the world act under latents
drawn from the data, and are judged by the expert who knows the latent, as in Eq. (1).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from deconfounded.deconf import cloning, naive_rnn, offline
from deconfounded.deconf.agents import Monitor, ramp
from deconfounded.deconf.cloning import CloningConfig
from deconfounded.deconf.data import Batch, Draws, Signature, take, take_steps
from deconfounded.deconf.deconfounded import DeconfoundedConfig
from deconfounded.deconf.dream import Clone, Expert, Filter, World, known_range
from deconfounded.deconf.equations import imitation_loss, masked_mean
from deconfounded.deconf.models import VariationalModel
from deconfounded.deconf.nets import ActionHead, Adam, scalers
from deconfounded.deconf.offline import OfflineConfig
from deconfounded.deconf.paths import familiar, last_episode, strange
from deconfounded.deconf.recurrent import RecurrentConfig
from deconfounded.experts.demos import Agent, Trials


@dataclass(frozen=True)
class Amounts:
    """Of training, for one split; offline: of Eq. (7); exploring: of Eq. (6).

    rivals: latents that each trial's own is weighed against. dreams: trials of each actor in the learned dynamics.
    """

    held_out: float = 0.25  # share of the trials
    rivals: int = 24
    dreams: int = 192
    cloning: CloningConfig = field(default_factory=lambda: CloningConfig(updates=1500))
    naive: RecurrentConfig = field(default_factory=lambda: RecurrentConfig(updates=1000))
    offline: OfflineConfig = field(default_factory=lambda: OfflineConfig(online_updates=0))
    exploring: DeconfoundedConfig = field(
        default_factory=lambda: DeconfoundedConfig(inference_updates=2000, inference_rate=3e-3)
    )


class Findings(NamedTuple):
    """What was measured. Nats are a step, of held-out trials.

    memory: what memory adds to predicting the expert's action over the present observation. explained: what a latent
    adds that explains the world's answers, and nothing else. explored: how much more likely a trial's own latent makes
    the world's answers in exploration than another trial's does. stakes: how strange the ways of an expert are who
    holds another latent for true, among those of experts who know theirs, in what shows it most; 1: not at all. unlike:
    how strange these are in turn, in the learned dynamics, among those of the data, on the whole. naive, latent:
    predicted scores in the last episode, of a naive clone and of one that infers the latent from the world: 1 comes
    about like the experts who know it, 0 nowhere near. naive_judged, latent_judged: the same as the expert judges their
    actions, Eq. (1): 0 is an expert who holds another latent for true, 1 the one who knows it. Without exploration,
    explained and explored are None, and the latent is one that explains actions too, Eq. (7).
    """

    memory: float
    explored: float | None
    explained: float | None
    stakes: float
    unlike: float
    naive: float
    latent: float
    naive_judged: float
    latent_judged: float


class Part(Monitor):
    """Tells how far a whole has come, of which this training is a part."""

    def __init__(self, tell: Callable[[float], None], begin: float, end: float) -> None:
        super().__init__()
        self.tell, self.begin, self.end = tell, begin, end

    def update(self, done: int, total: int, losses: dict[str, float], agent: Agent | None = None) -> None:
        self.tell(self.begin + (self.end - self.begin) * done / total)


def measure(
    trials: Trials,
    explore: Trials | None,
    amounts: Amounts,
    rng: np.random.Generator,
    tell: Callable[[float], None] = lambda share: None,
) -> Findings:
    """Of one split, drawn at random, of expert trials, and of theta-blind exploration of the same kind.

    tell: is told the share that is done.
    """
    (shown, held), signature, rngs = split(trials, amounts.held_out, rng), Signature.of(trials), [rng]
    blind = cloning.fit(shown, amounts.cloning, rng, monitor=Part(tell, 0, 0.1))
    recurrent = naive_rnn.fit(shown, amounts.naive, rng, Part(tell, 0.1, 0.3))
    data, other = Batch.of(shown, 1), Batch.of(held, 1)
    draws, part, how = Draws(rngs, "cpu"), Part(tell, 0.3, 0.8), amounts.offline
    explored = explained = None
    if explore is None:
        model, _, policy = offline.explain(data, signature, how, draws, part)
    else:
        tried, rest = (_near(data, Batch.of(some, 1)) for some in split(explore, amounts.held_out, rng))
        model = _dynamics(tried, signature, amounts.exploring, draws, part)
        _refit_noise(model, data, draws)
        policy = _conditional(model, data, amounts.cloning, draws)
        explored = _apart(model, rest, draws)
    with torch.no_grad():
        present = blind.policy.log_prob(blind.scaler(other.obs), other.action)
        memory = -float(recurrent.held_out_loss(other)) - _mean(present, other)
        if explore is not None:
            explained = _mean(policy.log_prob(_features(model, other, draws), other.action) - present, other)
        latents = _inferred(model, data, draws)
        known, mistaken, rivals = (
            take(latents, draws.below(latents.shape[1], n)) for n in (amounts.dreams, amounts.dreams, amounts.rivals)
        )
        knower, starts = Expert(model, policy, known), torch.tensor(shown.obs[None, :, :, 0]).flatten(1, 2)
        dreamt = World(knower, data, starts, *trials.mask.shape[1:])
        actors = (knower, Expert(model, policy, mistaken), Clone(recurrent), Filter(model, policy, rivals))
        (one, home), (zero, away), *others = (dreamt.visit(actor, rngs) for actor in actors)
        judged = [float(1 - (off - one) / (zero - one).clamp(min=1e-3)) for off, _ in others]
        naive, latent = (familiar(_oddest(path, home)) for _, path in others)
        unlike = float(strange(home[0], last_episode(data, trials.mask.shape[2])).mean())
    tell(1)
    return Findings(memory, explored, explained, _oddest(away, home), unlike, naive, latent, *judged)


def split(trials: Trials, share: float, rng: np.random.Generator) -> tuple[Trials, Trials]:
    """Trials to learn from, and that share of them that is held out."""
    order, count = rng.permutation(len(trials)), max(1, round(share * len(trials)))
    shown, held = (
        Trials(trials.obs[index], trials.action[index], trials.mask[index], trials.actions)
        for index in (order[count:], order[:count])
    )
    return shown, held


def _mean(x: Tensor, batch: Batch) -> float:
    """Over all steps [1, B, T] that took place."""
    return float(masked_mean(x.flatten(1), batch.mask.flatten(1)))


def _oddest(path: Tensor, home: Tensor) -> float:
    """How strange observations [1, N, T, O] are among those of who knows the latent, in what shows it most."""
    return float(strange(path[0], home[0]).max())


def _inferred(model: VariationalModel, batch: Batch, draws: Draws) -> Tensor:
    """A latent [1, B, D] for each trial."""
    return model.sample(model.belief(model.last(batch)), draws)


def _features(model: VariationalModel, batch: Batch, draws: Draws) -> Tensor:
    """What a latent-conditional policy reads at each step: the observation and the trial's latent, [1, B, T, O + D]."""
    return torch.cat([model.inputs.obs(batch.obs), _along(batch, _inferred(model, batch, draws))], -1)


def _along(batch: Batch, latents: Tensor) -> Tensor:
    """Each trial's latent [1, B, D] at each of its steps."""
    return latents[:, :, None].expand(-1, -1, batch.mask.shape[2], -1)


def _dynamics(
    explored: Batch, signature: Signature, how: DeconfoundedConfig, draws: Draws, monitor: Monitor
) -> VariationalModel:
    """A latent that explains the world's answers and nothing else: Eq. (6).

    Not on expert trials: these hold nearly one action for each observation and latent, so that what an action does and
    what the latent does cannot be told apart. (On `swapped_lander`, of both, it learned that the engine does nothing.)
    """
    model = VariationalModel("evidence", how.latent, how.width, signature, *scalers(explored), draws)
    optimizer = Adam([model], how.inference_rate, how.inference_updates)
    for update in range(how.inference_updates):
        batch = explored.beginnings(update, how.shortest).draw_trials(how.inference_batch, draws)
        beta = how.beta * ramp(update, how.warm_up * how.inference_updates)
        loss = model.learn(optimizer, batch, how.inference_steps, beta, draws)
        monitor.update(update + 1, how.inference_updates, {"inference": loss})
    return model


def _near(data: Batch, explored: Batch) -> Batch:
    """Exploration without its steps from outside of the range in which dynamics are to hold."""
    low, high = known_range(data)
    near = ((explored.obs >= low[:, None]) & (explored.obs <= high[:, None])).all(-1)
    return replace(explored, mask=explored.mask * near)


@torch.no_grad()
def _refit_noise(model: VariationalModel, data: Batch, draws: Draws) -> None:
    """Noise of the size it has where experts go: falls, and what else is seldom there, would swell it."""
    head, latents = model.dynamics, _along(data, _inferred(model, data, draws))
    if not model.inputs.signature.binary:
        off = head.change(data.next_obs - data.obs) - head(data.obs, data.action, latents)[..., 0, :]
        square = masked_mean(off.square().flatten(1, 2).mT, data.mask.flatten(1)[:, None])
        head.log_std.copy_(0.5 * square.clamp(min=1e-12).log())


@torch.no_grad()
def _apart(model: VariationalModel, rest: Batch, draws: Draws) -> float:
    """How much more likely a trial's own latent, inferred from its even steps, makes its odd ones than another's."""
    even = torch.arange(rest.mask.shape[2]) % 2 == 0
    own, odd = _inferred(model, replace(rest, mask=rest.mask * even), draws), replace(rest, mask=rest.mask * ~even)
    true, other = (
        model.dynamics.log_prob(rest.obs, rest.action, rest.next_obs, _along(rest, latent))[..., 0]
        for latent in (own, own.roll(1, 1))
    )
    return _mean(true - other, odd)


def _conditional(model: VariationalModel, data: Batch, how: CloningConfig, draws: Draws) -> ActionHead:
    """A policy, cloned given the latents that a model infers from the trials."""
    with torch.no_grad():
        features = _features(model, data, draws)
    policy = ActionHead(features.shape[-1], how.width, model.inputs.signature, draws)
    optimizer = Adam([policy], how.learning_rate, how.updates)
    for _ in range(how.updates):
        index = data.draw_steps(how.batch, draws)
        log_policy = policy.log_prob(take_steps(features, index), take_steps(data.action, index))
        optimizer.step(imitation_loss(log_policy, torch.ones_like(log_policy)))
    return policy
