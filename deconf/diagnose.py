"""Is this data confounded? From an expert's trials alone: no theta, no simulator, no name of a task.

An expert that sees more than its clone will leaves three traces. Memory tells its actions better than the present
observation does; a latent explains whole trials, Eq. (7); and what the *world* says of that latent, against what the
expert's own actions say of it, decides whether a recurrent clone finds out or deludes itself. What that would cost is
seen in the learned dynamics, where the naive clone and the latent-conditional one act under latents drawn from the
data, and are judged by the expert who knows the latent, as in Eq. (1).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from deconfounded.deconf import cloning, naive_rnn, offline
from deconfounded.deconf.agents import Monitor
from deconfounded.deconf.cloning import CloningConfig
from deconfounded.deconf.data import Batch, Draws, Signature, take
from deconfounded.deconf.deconfounded import final_belief
from deconfounded.deconf.dream import Clone, Expert, Filter, World
from deconfounded.deconf.equations import belief_update, masked_mean
from deconfounded.deconf.offline import OfflineConfig
from deconfounded.deconf.recurrent import RecurrentConfig
from deconfounded.envs.task import Array, InputError
from deconfounded.experts.demos import Trials, joined

Verdict = Literal["confounded", "not confounded", "cannot tell"]
LITTLE, SILENT = 0.03, 0.01  # nats a step: of memory, of the world
FINE, GAP = 0.8, 0.15  # scores
STAKES = 1.3  # times chance
CLONE = "clone it: deconf.naive_rnn, or deconf.cloning, which has no memory to be deluded"
OFFLINE = "deconf.offline, Algorithm 3: it needs these trials alone"
EXPLORE = "deconf.deconfounded, Algorithm 1: it needs exploration that is blind to what the expert knows"
ASK = "deconf.dagger: it asks the expert in states of its own"
LOST = "give the clone a sensor of what the expert knows"
MORE = "collect more trials of the same kind, and diagnose again"


@dataclass(frozen=True)
class DiagnoseConfig:
    """Amounts. refits: independent splits of the trials, trained side by side; an interval is their range."""

    refits: int = 3
    held_out: float = 0.25  # share of the trials
    rivals: int = 24  # latents that each trial's own is weighed against
    dreams: int = 96  # trials in the learned dynamics
    least_trials: int = 24
    cloning: CloningConfig = field(default_factory=lambda: CloningConfig(updates=1500))
    naive: RecurrentConfig = field(default_factory=lambda: RecurrentConfig(updates=1000))
    offline: OfflineConfig = field(default_factory=OfflineConfig)


class Figure(NamedTuple):
    """Mean over refits, and their range."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.3g} ({self.low:.3g} to {self.high:.3g})"


class Findings(NamedTuple):
    """What was measured, over refits. Nats are a step, of held-out trials.

    memory: what memory adds to predicting the expert's action. explained: what a latent inferred from dynamics alone
    adds. dynamics, actions: how much more likely a trial's own latent makes the world's answer, and the expert's
    action, than another trial's does. stakes: how many times as far off the way an expert goes who holds another latent
    for true, as one who knows it goes by chance. naive, latent: predicted scores in the last episode: 0 is an expert
    who holds another latent for true, 1 the one who knows it. explored: as dynamics, of exploration, if there is some.
    """

    memory: Figure
    explained: Figure
    dynamics: Figure
    actions: Figure
    stakes: Figure
    naive: Figure
    latent: Figure
    explored: Figure | None = None


@dataclass(frozen=True)
class Diagnosis:
    """The verdict, why, the tier that the data reaches (None: no tier does), and what to do next."""

    verdict: Verdict
    found: Findings
    reasons: tuple[str, ...]
    tier: int | None
    next: str

    @property
    def gap(self) -> float:
        """What cloning is predicted to lose."""
        return self.found.latent.value - self.found.naive.value


def diagnose(
    trials: Trials, config: DiagnoseConfig, rng: np.random.Generator, monitor: Monitor | None = None
) -> Diagnosis:
    """Judge expert trials. Raises InputError for data that cannot be judged at all."""
    check(trials, config)
    shown, hidden = split(trials, config, rng)
    rngs = [np.random.default_rng(rng.integers(2**63)) for _ in range(config.refits)]
    signature, monitor = Signature.of(trials), monitor or Monitor()
    held = Batch.of(hidden, config.refits)

    blind = cloning.fit(shown, config.cloning, rngs, monitor=monitor)
    recurrent = naive_rnn.fit(shown, config.naive, rngs, monitor)
    data, draws = Batch.of(shown, config.refits), Draws(rngs, "cpu")
    model, _, policy = offline.explain(data, signature, config.offline, draws, monitor)
    with torch.no_grad():
        latents = model.sample(final_belief(model, data), draws)
        particles, own = take(latents, draws.below(latents.shape[1], config.rivals)), final_belief(model, held)
        knowing = Expert(model, policy, model.sample(own, draws))
        world = Filter(model, policy, particles)
        world.begin(len(held), rngs)

        present = -_mean(blind.policy.log_prob(blind.scaler(held.obs), held.action), held)
        naive = Clone(recurrent)
        naive.begin(1, rngs)
        memory = present - recurrent.held_out_loss(held)
        log_next, log_policy = world.log_next(held), world.log_policy(held)
        final = belief_update(world.log_belief, (log_next * held.mask[..., None]).sum(2))
        explained = present + _mean(torch.logsumexp(final[:, :, None] + log_policy, -1), held)
        told = knowing.theta_hat[:, :, None].expand(-1, -1, held.mask.shape[2], -1)
        true_next = model.dynamics.log_prob(held.obs, held.action, held.next_obs, told)[..., 0]
        true_policy = policy.log_prob(knowing.features(held.obs, told), held.action)
        dynamics, actions = _mean(true_next - log_next.mean(-1), held), _mean(true_policy - log_policy.mean(-1), held)

    starts = torch.tensor(shown.obs[:, :, 0]).reshape(config.refits, -1, signature.obs)
    theta_hat, other = (take(knowing.theta_hat, draws.below(len(held), config.dreams)) for _ in range(2))
    knower = Expert(model, policy, theta_hat)
    dreamt = World(knower, held, starts, *trials.mask.shape[1:])
    actors = (knower, Expert(model, policy, other), naive, world)
    (one, home), (zero, away), *others = (dreamt.visit(actor, rngs) for actor in actors)
    again = dreamt.visit(knower, rngs)[1]
    stakes = (away - home).abs().mean((1, 2)) / (again - home).abs().mean((1, 2)).clamp(min=1e-6)
    scores = (1 - (off - one) / (zero - one).clamp(min=1e-3) for off, _ in others)
    return judge(Findings(*(_figure(x) for x in (memory, explained, dynamics, actions, stakes, *scores))))


def _mean(x: Tensor, held: Batch) -> Tensor:
    """Over all steps [S, B, T] that took place: [S]."""
    return masked_mean(x.flatten(1), held.mask.flatten(1))


def check(trials: Trials, config: DiagnoseConfig) -> None:
    """Raises InputError, in one line, for what cannot be judged."""
    if len(trials) < config.least_trials:
        raise InputError(f"{len(trials)} trials were given; at least {config.least_trials} are needed to hold some out")
    if trials.mask.shape[1] < 2:
        raise InputError(
            "trials are of one episode each; at least two under the same theta are needed: join those of one context"
        )
    acted = trials.action[trials.mask]
    if (acted == acted[0]).all():
        raise InputError("every action is the same; there is nothing to clone, and nothing to judge")


def split(trials: Trials, config: DiagnoseConfig, rng: np.random.Generator) -> tuple[Trials, Trials]:
    """Training and held-out trials of each refit, one refit after another."""
    count = max(1, round(config.held_out * len(trials)))
    parts: tuple[list[Trials], list[Trials]] = ([], [])
    for _ in range(config.refits):
        order = rng.permutation(len(trials))
        for part, index in zip(parts, (order[count:], order[:count]), strict=True):
            part.append(Trials(trials.obs[index], trials.action[index], trials.mask[index], trials.actions))
    return joined(parts[0]), joined(parts[1])


def _figure(x: Tensor | Array) -> Figure:
    """Of refits [S]."""
    values = np.asarray(x, float)
    return Figure(float(values.mean()), float(values.min()), float(values.max()))


def judge(found: Findings) -> Diagnosis:
    """The verdict, and why."""
    said = [f"Memory adds {found.memory} nats a step to what the present observation tells of the expert's action."]

    def told(verdict: Verdict, tier: int | None, why: str, then: str) -> Diagnosis:
        return Diagnosis(verdict, found, (*said, why), tier, then)

    if found.memory.high < LITTLE:
        return told("not confounded", 1, "The expert acts on nothing that a clone without memory does not see.", CLONE)
    if found.memory.low <= LITTLE:
        return told("cannot tell", None, "That may be nothing, or something: more trials would settle it.", MORE)
    said.append(
        f"A trial's own latent makes the world's answers {found.dynamics} nats a step more likely than another's, and"
        f" the expert's actions {found.actions}."
    )
    if found.dynamics.high < SILENT:
        said.append("Where this expert goes, the world does not tell what it knows: no inference from such trials can.")
        if found.explored is None:
            return told("confounded", 3, "Exploration would show whether the world tells it anywhere.", ASK)
        if found.explored.low > SILENT:
            return told("confounded", 3, f"In exploration it does, by {found.explored} nats a step.", ASK)
        return told("confounded", None, "Nor does it in exploration: nobody who does not see it can act on it.", LOST)
    said.append(f"Who acts on another latent goes {found.stakes} times as far off the way as chance does.")
    if found.stakes.high < STAKES:
        return told("not confounded", 1, "That is little: what the expert knows hardly matters.", CLONE)
    said.append(
        f"In the learned dynamics a naive clone scores {found.naive}, one that infers the latent from the world"
        f" {found.latent}: 1 knows the latent, 0 acts on another one."
    )
    if found.naive.value > FINE and found.latent.value - found.naive.value < GAP:
        return told("not confounded", 1, "The naive clone finds out by itself.", CLONE)
    if found.latent.low > found.naive.high:
        enough = found.latent.value > FINE
        why = "Trials alone are enough." if enough else "Trials alone are not quite enough: explore."
        return told("confounded", 1 if enough else 2, why, OFFLINE if enough else EXPLORE)
    return told("cannot tell", None, "The two overlap: more trials, or exploration, would settle it.", MORE)
