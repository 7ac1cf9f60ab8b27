"""Is this data confounded? From an expert's trials and some exploration: no theta, no simulator, no name of a task.

`findings.measure` takes the figures, on several splits of the trials; here they are judged.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np

from deconfounded.deconf.core.data import Batch
from deconfounded.deconf.diagnosis.latent import near
from deconfounded.deconf.diagnosis.measures import Amounts, Findings, measure
from deconfounded.envs.support.errors import InputError
from deconfounded.experts.rollout import Trials

Verdict = Literal["confounded", "not confounded", "cannot tell"]
VERSION = 1  # raised when the same trials come to other figures
LITTLE, SILENT = 0.1, 0.01  # nats a step: of memory, of the world
WORSE = 0.2  # nats a step by which a clone may be worse for its memory
FINE, GAP = 0.8, 0.15  # scores
STAKES = 1.5  # times chance
LIKE = 4.0  # how strange dreams may be, among what happened, and be believed of what does not show


class Next(NamedTuple):
    """What to do, and lines of Python that do it with `trials`; explore and query are functions of your own world."""

    advice: str
    fit: str = ""


CLONE = Next(
    "Clone it; memory does no harm here.",
    "naive_rnn.train(trials, naive_rnn.RecurrentConfig(), np.random.default_rng(0))",
)
EXPLORE = Next(
    "Tier 2, Algorithm 1: explore the world, blind to what the expert knows.",
    "deconfounded.train(trials, explore, deconfounded.DeconfoundedConfig(), np.random.default_rng(0))",
)
ASK = Next(
    "Tier 3: ask the expert what it would do in states that the clone comes to.",
    "dagger.train(query, dagger.DaggerConfig(), np.random.default_rng(0))",
)
TRY = Next(
    "Explore a little, with a clone without memory that tries things (deconf/diagnosis/exploration.py), and diagnose"
    " again; or try Tier 1, Algorithm 3, which needs no more.",
    "deconfounded_offline.train(trials, deconfounded_offline.OfflineConfig(), np.random.default_rng(0))",
)
VARY = Next("Record trials under other circumstances too, and diagnose again.")
WIDER = Next("Explore where the expert goes, by any behaviour that is blind to what it knows, and diagnose again.")
MORE = Next("Record more trials of the same kind, and diagnose again.")


@dataclass(frozen=True)
class DiagnoseConfig:
    """refits: independent splits of the trials; an interval is their range. least: trials, below which none is made."""

    refits: int = 3
    least: int = 24
    amounts: Amounts = field(default_factory=Amounts)


class Figure(NamedTuple):
    """Mean over refits, and their range."""

    value: float
    low: float
    high: float

    @staticmethod
    def of(refits: Sequence[float]) -> Figure:
        """Of what each refit found."""
        return Figure(sum(refits) / len(refits), min(refits), max(refits))

    def __str__(self) -> str:
        return f"{self.value:.2g} ({self.low:.2g} to {self.high:.2g})"


@dataclass(frozen=True)
class Diagnosis:
    """The verdict, what was found by name as in Findings, why, the tier that the data reaches, and what to do next.

    Found is also the `gap`: what cloning is predicted to lose, in scores of where it goes; `gap_judged`, by Eq. (1);
    and the `ratio` of what actions tell to what the world does. tier: of the paper; None if it is not known, or if
    none does.
    """

    verdict: Verdict
    found: dict[str, Figure]
    reasons: tuple[str, ...]
    tier: int | None
    next: Next


def diagnose(
    trials: Trials,
    explore: Trials | None,
    config: DiagnoseConfig,
    rng: np.random.Generator,
    tell: Callable[[float], None] = lambda share: None,
) -> Diagnosis:
    """Judge expert trials, and exploration of the same kind if there is some.

    Raises InputError for data that cannot be judged at all.
    """
    check(trials, explore, config)
    found: list[Findings] = []

    def told(share: float) -> None:
        tell((len(found) + share) / config.refits)

    for one in rng.spawn(config.refits):
        found.append(measure(trials, explore, config.amounts, one, told))
    return judge(found)


def check(trials: Trials, explore: Trials | None, config: DiagnoseConfig) -> None:
    """Raises InputError, in one line, for what cannot be judged."""
    for kind, some in (("", trials), (" of exploration", explore)):
        if some is None:
            continue
        if len(some) < config.least:
            raise InputError(
                f"{len(some)} trial{'s' * (len(some) > 1)}{kind} given; at least {config.least} are needed, each"
                " under a theta of its own, so that some can be held out"
            )
        acted = some.action[some.mask]
        if (acted == acted[0]).all():
            raise InputError(f"every action{kind} is the same; there is nothing to learn, and nothing to judge")
        if some.mask.sum(-1).max() < 2:
            raise InputError(f"every episode{kind} is of one step; a world that answers nothing tells nothing")
    if explore is not None and (explore.obs.shape[-1], explore.action.shape[-1], explore.actions) != (
        trials.obs.shape[-1],
        trials.action.shape[-1],
        trials.actions,
    ):
        raise InputError("exploration has other observations or actions than the expert's trials; both must be alike")
    if explore is not None:
        near(Batch.of(trials, 1), Batch.of(explore, 1))


def judge(refits: Sequence[Findings]) -> Diagnosis:
    """The verdict, and why. Raises InputError if a figure is not finite."""
    found = {}
    for key, each in zip(Findings._fields, zip(*refits, strict=True), strict=True):
        if values := [value for value in each if value is not None]:
            if not np.isfinite(values).all():
                raise InputError(
                    f"learning failed: {key} is {values}; are there outliers, or scales that differ a lot?"
                )
            found[key] = Figure.of(values)
    gap = found["gap"] = Figure.of([refit.latent - refit.naive for refit in refits])
    judged = found["gap_judged"] = Figure.of([refit.latent_judged - refit.naive_judged for refit in refits])
    memory, stakes, strayed, unlike = (found[key] for key in ("memory", "stakes", "strayed", "unlike"))
    naive, latent = found["naive"], found["latent"]
    explored = found.get("explored")
    if explored is not None:
        found["ratio"] = Figure.of([(refit.acted or 0.0) / max(refit.shown or 0.0, SILENT) for refit in refits])
    said = [f"Memory adds {memory} nats a step to what the present observation tells of the expert's action."]

    def told(verdict: Verdict, tier: int | None, why: str, then: Next) -> Diagnosis:
        return Diagnosis(verdict, found, (*said, why), tier, then)

    if memory.low < -WORSE:
        why = "With memory it was cloned the worse: the recurrent clone did not fit, and that says nothing."
        return told("cannot tell", None, why, MORE)
    if memory.low <= LITTLE:
        if memory.high > LITTLE:
            return told("cannot tell", None, "That may be nothing, or something: more trials would settle it.", MORE)
        if explored is not None and found["shown"].low > SILENT:
            why = "The world differs from trial to trial, and the expert acts on nothing that a clone does not see."
            return told("not confounded", 1, why, CLONE)
        why = (
            "The expert acts alike in all trials: nothing is hidden, or it was the same in all of them. In the"
            " circumstances of these trials a clone misses nothing; of others they tell nothing."
        )
        return told("cannot tell", None, why, VARY)
    said.append(
        "The expert acts on something that the present observation does not show. In the learned dynamics, an expert"
        f" who is told another latent goes other ways: {stakes} times as strange, among those of experts who know"
        f" theirs, as by chance, and {strayed} times as far from where the one who knows it goes. Between these two, 0"
        f" and 1, a naive clone scores {naive} by where it goes, and one that infers the latent from the world"
        f" {latent}; by what they do, Eq. (1), {found['naive_judged']} and {found['latent_judged']}."
    )
    if explored is None:
        why = (
            "But these were learned from expert trials alone, which hold nearly one action for each observation and"
            " latent: what an action does, and what the latent does, cannot be told apart there."
        )
        return told("cannot tell", None, why, TRY)
    shown, explained = found["shown"], found["explained"]
    said.append(
        f"The world tells it by {explored} nats a step in exploration, and by {shown} where the expert went; what it"
        f" tells explains the expert's actions better than the present observation by {explained}. The actions tell it"
        f" by {found['acted']} nats a step: {found['ratio']} times the world's evidence, for a clone that takes its own"
        " actions for the expert's."
    )
    if max(-shown.low, shown.value, explained.high) < LITTLE:
        why = (
            "Both are next to nothing, and what the world tells does not explain what the expert does: expert trials do"
            " not say which latent was theirs, and no exploration helps. Ask what the expert would do where the clone"
            " goes; if the world tells it nowhere, only a sensor does. (An expert that remembers, or whose noise lasts,"
            " looks the same; asked, it shows that too.)"
        )
        return told("confounded", 3, why, ASK)
    if shown.low <= SILENT:
        return told("cannot tell", None, "The latter may be nothing, or something.", WIDER)
    if max(stakes.high, strayed.high) < STAKES and unlike.value < LIKE and explained.low > 0:
        why = "But who mistakes it comes about as the others do, and where they do; and so will a clone."
        return told("not confounded", 1, why, CLONE)
    if not any(one.value >= STAKES and one.low > 1 for one in (stakes, strayed)):
        why = (
            "The ways may be other ones by chance: either it hardly matters, or the dynamics are not known well enough"
            f" where it does. (On the whole, ways in the learned ones are {unlike} times as strange as the data's.)"
        )
        return told("cannot tell", None, why, WIDER)
    if naive.low > FINE and max(gap.high, judged.high) < GAP:
        return told("not confounded", 1, "The naive clone finds out by itself.", CLONE)
    if max(gap.low, judged.low) <= 0 or max(gap.high, judged.high) < GAP:
        return told("cannot tell", None, "The scores hardly differ; more of both would settle it.", MORE)
    return told(
        "confounded", 2, "A clone takes its own actions for evidence; what the world answers is better.", EXPLORE
    )
