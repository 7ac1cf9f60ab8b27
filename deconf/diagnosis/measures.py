"""What one split of an expert's trials tells of what the expert sees and its clone does not: figures, no judgement.

An expert that sees more than its clone will leaves three traces. Memory tells its actions better than the present
observation does; one latent explains whole episodes, Eq. (7); and what the *world* says of it, against what the
expert's own actions say, decides whether a recurrent clone finds out or deludes itself. What that would cost is
seen in the learned dynamics, where the naive clone and one that infers the latent from the world act under latents
drawn from the data, and are judged by the expert who knows the latent, as in Eq. (1).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from deconfounded.deconf.core import termination
from deconfounded.deconf.core.agents import LearnedAgent
from deconfounded.deconf.core.data import Batch, Draws, take
from deconfounded.deconf.core.drift import apart
from deconfounded.deconf.core.monitor import Monitor
from deconfounded.deconf.core.sizes import MANY, SPACIOUS, WIDE
from deconfounded.deconf.diagnosis import latent
from deconfounded.deconf.diagnosis.deviation import back, oddest, strange, strayed, ways
from deconfounded.deconf.diagnosis.latent import Explanation, mean
from deconfounded.deconf.diagnosis.learned_env import Actor, Clone, Expert, Filter, World, farther
from deconfounded.deconf.methods import cloning, naive_rnn
from deconfounded.deconf.methods.cloning import CloningConfig
from deconfounded.deconf.methods.deconfounded import DeconfoundedConfig
from deconfounded.deconf.methods.deconfounded_offline import OfflineConfig
from deconfounded.deconf.methods.recurrent import RecurrentConfig
from deconfounded.experts.rollout import Agent, Trials

CLEARLY = 0.1  # nats a step


@dataclass(frozen=True)
class Amounts:
    """Of training, for one split; offline: of Eq. (7); exploring: of Eq. (6).

    rivals: latents of the data, each as likely as the others, of which dreams have one. dreams: trials of each actor in
    the learned dynamics.
    """

    held_out: float = 0.25  # share of the trials
    rivals: int = 32
    dreams: int = 192
    cloning: CloningConfig = field(default_factory=lambda: CloningConfig(updates=1500))
    naive: RecurrentConfig = field(default_factory=lambda: RecurrentConfig(updates=1000))
    offline: OfflineConfig = field(default_factory=lambda: OfflineConfig(online_updates=0))
    exploring: DeconfoundedConfig = field(
        default_factory=lambda: DeconfoundedConfig(inference_updates=2000, shortest=1 / 4)
    )  # of shorter sets the bandit's latent was ignored for too long

    def fitting(self, observed: int) -> Amounts:
        """The same, of networks that are large enough for so many observed numbers."""
        if observed < MANY:
            return self
        return replace(
            self,
            cloning=replace(self.cloning, width=WIDE),
            naive=replace(self.naive, width=WIDE),
            offline=replace(self.offline, width=WIDE, latent=SPACIOUS),
            exploring=replace(self.exploring, width=WIDE, latent=SPACIOUS),
        )


class Findings(NamedTuple):
    """What was measured. Nats are a step, of held-out trials.

    memory: what memory adds to predicting the expert's action over the present observation. explained: what a latent
    adds that explains the world's answers, and nothing else. explored: how much more likely an episode's own latent
    makes the world's answers in exploration than another trial's does; shown: in the expert's trials; acted: how much
    more likely it makes the expert's actions there, the evidence that a naive clone takes its own for. The others are
    seen in the last episode of trials in the learned dynamics. stakes: how strange the ways of one are who holds
    another latent for true, of the half that is farther from it, among those of experts who know theirs, in what shows
    it most, over the same by chance.
    strayed: how far they are from those of the expert who knows that latent, from the same start, over the same by
    chance. unlike: how strange these are in turn, among those of the data, on the whole. naive, latent: scores of a
    naive clone and of one that infers the latent from the world, by how far they strayed: 1 is the expert who knows the
    latent, 0 the one who holds another for true. naive_judged, latent_judged: the same as the expert judges their
    actions, Eq. (1). Without exploration, explained to acted are None, and the latent is one that explains actions
    too, Eq. (7).
    """

    memory: float
    explained: float | None
    explored: float | None
    shown: float | None
    acted: float | None
    stakes: float
    strayed: float
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
    amounts = amounts.fitting(trials.obs.shape[-1])
    expert, rngs = split(trials, amounts.held_out, rng), [rng]
    shown, held = expert
    blind = cloning.train(shown, amounts.cloning, rng, monitor=Part(tell, 0, 0.1))
    recurrent = naive_rnn.train(shown, amounts.naive, rng, Part(tell, 0.1, 0.25))
    draws = Draws(rngs, "cpu")
    if explore is None:
        found = latent.alone(shown, amounts.offline, draws, Part(tell, 0.25, 0.8))
    else:
        found = _by_world(expert, split(explore, amounts.held_out, rng), amounts, draws, tell)
    data = [shown] if explore is None else [shown, explore]
    ends = termination.fit(data, blind.scaler, draws)
    with torch.no_grad():
        other, episodes = Batch.of(held, 1), Batch.of(apart(shown), 1)
        present = blind.policy.log_prob(blind.scaler(other.obs), other.action)
        memory = -float(recurrent.held_out_loss(other)) - mean(present, other)
        some = episodes[:, (episodes.mask[0].sum(-1) > 0).nonzero()[:, 0]]  # logs are ragged
        every, (_, each, horizon) = [Batch.of(trials, 1) for trials in data], trials.mask.shape

        def world(judge: Expert) -> World:
            return World(judge, some, every, each, horizon, ends)

        dreamt = _dreamt(found, world, recurrent, ways(some), amounts, rngs)
    tell(1)
    tells = None if found.actions is None else found.actions - mean(present, latent.odd(other))
    return Findings(memory, tells, found.explored, found.shown, found.acted, *dreamt)


def _dreamt(
    found: Explanation,
    world: Callable[[Expert], World],
    recurrent: LearnedAgent,
    went: Tensor,
    amounts: Amounts,
    rngs: list[np.random.Generator],
) -> tuple[float, ...]:
    """Stakes and what follows in Findings. went: the ways of the data's episodes, [N, T, O]."""
    draws = Draws(rngs, "cpu")
    rivals = take(found.latents, draws.below(found.latents.shape[1], amounts.rivals))
    known = draws.below(amounts.rivals, amounts.dreams)
    knower, mistaker = (
        Expert(found.model, found.policy, take(rivals, index)) for index in (known, farther(rivals, known, draws))
    )
    actors: Sequence[Actor] = (
        knower,
        mistaker,
        Clone(recurrent),
        Filter(found.model, found.policy, rivals),
        *[knower] * 3,
    )
    dream, half = world(knower), amounts.dreams // 2
    visits = [dream.visit(actor, rngs) for actor in actors]
    one, zero, *others = (off for off, _ in visits[:4])
    judged = (float(1 - (off - one) / (zero - one).clamp(min=0.05)) for off in others)
    home, away, cloned, inferred, again, *anew = (path[0] for _, path in visits)
    mistake, *astray, chance, by_chance = (strayed(path, home, again) for path in (away, cloned, inferred, *anew))
    stakes = oddest(*(strange(path[half:], home[:half], again[half:]) for path in (away, home)))
    scores = (back(off - by_chance, mistake - chance) for off in astray)
    shuffled = went[torch.randperm(len(went), generator=torch.Generator().manual_seed(0))]
    unlike = float(strange(home, *shuffled.tensor_split(2)).mean())
    return stakes, oddest(mistake, chance), unlike, *scores, *judged


def _by_world(
    expert: tuple[Trials, Trials],
    explored: tuple[Trials, Trials],
    amounts: Amounts,
    draws: Draws,
    tell: Callable[[float], None],
) -> Explanation:
    """Of a latent that stays for a trial; or for an episode alone, if that clearly tells more of all that happened.

    Of the world's answers as of the expert's actions: what an episode alone tells can be where it went, no latent.
    """
    each, found = max(some[0].mask.shape[1] for some in (expert, explored)), list[Explanation]()
    how, batch = amounts.exploring, amounts.exploring.inference_batch
    units = [(expert, explored, 1, how)]
    if each > 1:
        longer = replace(how, inference_batch=batch and each * batch)  # as much evidence as of trials that are whole
        units.append(((apart(expert[0]), apart(expert[1])), (apart(explored[0]), apart(explored[1])), each, longer))
    for i, (shown, tried, at_once, how) in enumerate(units):
        part = Part(tell, 0.25 + 0.55 * i / len(units), 0.25 + 0.55 * (i + 1) / len(units))
        found.append(latent.by_world(shown, tried, at_once, how, amounts.cloning, draws, part))
    whole, single = found[0], found[-1]
    more = (single.actions or 0.0) - (whole.actions or 0.0), (single.shown or 0.0) - (whole.shown or 0.0)
    return single if min(more) > CLEARLY else whole


def split(trials: Trials, share: float, rng: np.random.Generator) -> tuple[Trials, Trials]:
    """Trials to learn from, and that share of them that is held out."""
    order, count = rng.permutation(len(trials)), max(1, round(share * len(trials)))
    shown, held = (
        Trials(trials.obs[index], trials.action[index], trials.mask[index], trials.actions)
        for index in (order[count:], order[:count])
    )
    return shown, held
