"""A verdict on whether data is confounded, from expert trials and exploration, without theta or a simulator.

`measures.measure` computes the figures on several splits of the trials; here they are judged.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np

from deconfounded.deconf.core.data import Batch
from deconfounded.deconf.diagnosis.latent import in_range
from deconfounded.deconf.diagnosis.measures import Amounts, Findings, Report, measure
from deconfounded.envs.support.errors import InputError
from deconfounded.experts.rollout import Trials

Verdict = Literal["confounded", "not confounded", "cannot tell"]
VERSION = 1  # raised when figures of the same trials change
NEGLIGIBLE, NO_EVIDENCE = 0.1, 0.01  # nats a step: of memory, of the dynamics
MISFIT = 0.2  # nats a step by which a memory may make a clone worse
GOOD, SMALL_GAP = 0.8, 0.15  # scores
STAKES = 1.5  # times chance
MAX_MODEL_DEVIATION = 4.0  # deviation of rollouts from the data, up to which the absence of stakes is believed


class Next(NamedTuple):
    """What to do, and a line of Python that does it with `trials`; explore and query are the user's functions."""

    advice: str
    fit: str = ""


CLONE = Next(
    "Clone the expert; a memory does no harm here.",
    "naive_rnn.train(trials, naive_rnn.RecurrentConfig(), np.random.default_rng(0))",
)
EXPLORE = Next(
    "Tier 2, Algorithm 1: explore by a policy that does not see the latent.",
    "deconfounded.train(trials, explore, deconfounded.DeconfoundedConfig(), np.random.default_rng(0))",
)
QUERY = Next(
    "Tier 3: query the expert for its actions in states that the clone visits.",
    "dagger.train(query, dagger.DaggerConfig(), np.random.default_rng(0))",
)
EXPLORE_FIRST = Next(
    "Explore a little, by a memoryless clone with some random actions (deconf/diagnosis/exploration.py), and diagnose"
    " again; or try Tier 1, Algorithm 3, which needs no more data.",
    "deconfounded_offline.train(trials, deconfounded_offline.OfflineConfig(), np.random.default_rng(0))",
)
VARY_LATENT = Next("Record trials under other latents too, and diagnose again.")
EXPLORE_MORE = Next("Explore where the expert goes, by any policy that does not see the latent, and diagnose again.")
MORE_TRIALS = Next("Record more trials of the same kind, and diagnose again.")


@dataclass(frozen=True)
class DiagnoseConfig:
    """refits: independent splits of the trials; an interval is their range. least: the number of trials required."""

    refits: int = 3
    least: int = 24
    amounts: Amounts = field(default_factory=Amounts)


class Figure(NamedTuple):
    """The mean over refits, and their range."""

    value: float
    low: float
    high: float

    @staticmethod
    def of(refits: Sequence[float]) -> "Figure":
        """The figure of the refits' values."""
        return Figure(sum(refits) / len(refits), min(refits), max(refits))

    def __str__(self) -> str:
        return f"{self.value:.2g} ({self.low:.2g} to {self.high:.2g})"


@dataclass(frozen=True)
class Diagnosis:
    """The verdict, figures by name, the reasons, the paper's tier that is needed (None: unknown), and what to do next.

    Figures are those of Findings, and three more. `gap`: the predicted loss by naive cloning, in scores by paired
    deviation; `gap_by_actions`: by Eq. (1); `ratio`: the evidence of actions over that of dynamics, in expert trials.
    """

    verdict: Verdict
    figures: dict[str, Figure]
    reasons: tuple[str, ...]
    tier: int | None
    next: Next


def diagnose(
    trials: Trials,
    explore: Trials | None,
    config: DiagnoseConfig,
    rng: np.random.Generator,
    report: Report = lambda share: None,
) -> Diagnosis:
    """Judge expert trials, and exploration if there is any. Raises InputError for data that cannot be judged."""
    check(trials, explore, config)
    refits: list[Findings] = []

    def part(share: float) -> None:
        report((len(refits) + share) / config.refits)

    for generator in rng.spawn(config.refits):
        refits.append(measure(trials, explore, config.amounts, generator, part))
    return judge(refits)


def check(trials: Trials, explore: Trials | None, config: DiagnoseConfig) -> None:
    """Raises InputError for data that cannot be judged."""
    for kind, data in (("", trials), (" of exploration", explore)):
        if data is None:
            continue
        if len(data) < config.least:
            raise InputError(
                f"{len(data)} trial{'s' * (len(data) > 1)}{kind} given; at least {config.least} are needed, each"
                " under a theta of its own, so that some can be held out"
            )
        actions = data.action[data.mask]
        if (actions == actions[0]).all():
            raise InputError(f"every action{kind} is the same; there is nothing to learn, and nothing to judge")
        if data.mask.sum(-1).max() < 2:
            raise InputError(f"every episode{kind} is of one step; no dynamics can be learned from it")
    if explore is not None and (explore.obs.shape[-1], explore.action.shape[-1], explore.actions) != (
        trials.obs.shape[-1],
        trials.action.shape[-1],
        trials.actions,
    ):
        raise InputError("exploration has other observations or actions than the expert's trials; both must be alike")
    if explore is not None:
        in_range(Batch.of(trials, 1), Batch.of(explore, 1))


def judge(refits: Sequence[Findings]) -> Diagnosis:
    """The verdict, and why. Raises InputError if a figure is not finite."""
    figures = {}
    for key, column in zip(Findings._fields, zip(*refits, strict=True), strict=True):
        if values := [value for value in column if value is not None]:
            if not np.isfinite(values).all():
                raise InputError(
                    f"learning failed: {key} is {values}; are there outliers, or scales that differ a lot?"
                )
            figures[key] = Figure.of(values)
    gap = figures["gap"] = Figure.of([refit.latent - refit.naive for refit in refits])
    gaps = [refit.latent_by_actions - refit.naive_by_actions for refit in refits]
    by_actions = figures["gap_by_actions"] = Figure.of(gaps)
    names = ("memory_gain", "stakes", "paired_stakes", "model_deviation")
    memory, stakes, paired, model = (figures[name] for name in names)
    naive, latent = figures["naive"], figures["latent"]
    in_exploration = figures.get("exploration_evidence")
    if in_exploration is not None:
        ratios = [(refit.action_evidence or 0.0) / max(refit.expert_evidence or 0.0, NO_EVIDENCE) for refit in refits]
        figures["ratio"] = Figure.of(ratios)
    reasons = [
        f"A memory improves the prediction of the expert's action by {memory} nats a step over the present observation."
    ]

    def conclude(verdict: Verdict, tier: int | None, reason: str, advice: Next) -> Diagnosis:
        return Diagnosis(verdict, figures, (*reasons, reason), tier, advice)

    if memory.low < -MISFIT:
        reason = "It makes the prediction worse: the recurrent clone did not fit, so that nothing follows."
        return conclude("cannot tell", None, reason, MORE_TRIALS)
    if memory.low <= NEGLIGIBLE:
        if memory.high > NEGLIGIBLE:
            reason = "That may be zero or not; more trials would decide."
            return conclude("cannot tell", None, reason, MORE_TRIALS)
        if in_exploration is not None and figures["expert_evidence"].low > NO_EVIDENCE:
            reason = (
                "The dynamics differ between trials, but the expert acts on nothing that its clone does not observe."
            )
            return conclude("not confounded", 1, reason, CLONE)
        reason = (
            "The expert acts alike in all trials: there is no latent, or it was the same in all of them. Under this"
            " latent a clone misses nothing; about others the trials say nothing."
        )
        return conclude("cannot tell", None, reason, VARY_LATENT)
    reasons.append(
        "The expert acts on something that the present observation does not show. In rollouts in the learned dynamics,"
        f" trajectories of an expert policy given a wrong latent deviate from those given right ones {stakes} times as"
        f" much as by chance, and {paired} times as much when paired by latent and start. From 0 for the wrong latent"
        f" to 1 for the right one, a naive clone scores {naive} by trajectories, and a policy that infers the latent"
        f" from the dynamics {latent}; by actions, Eq. (1), {figures['naive_by_actions']} and"
        f" {figures['latent_by_actions']}."
    )
    if in_exploration is None:
        reason = (
            "But the dynamics were learned from expert trials alone, which hold nearly one action for each observation"
            " and latent: effects of actions and of the latent cannot be separated there."
        )
        return conclude("cannot tell", None, reason, EXPLORE_FIRST)
    in_trials, gain = figures["expert_evidence"], figures["latent_gain"]
    reasons.append(
        f"The dynamics are evidence of the latent, by {in_exploration} nats a step in exploration and {in_trials} in"
        " expert trials; the latent inferred from them improves the prediction of the expert's actions by"
        f" {gain} over the present observation. The actions are evidence of it by {figures['action_evidence']} nats a"
        f" step: {figures['ratio']} times as much, for a clone that takes its own actions for the expert's."
    )
    if max(-in_trials.low, in_trials.value, gain.high) < NEGLIGIBLE:
        reason = (
            "In expert trials the evidence of the dynamics is next to zero, and so is what the latent explains: these"
            " trials do not identify it, and no exploration helps. Query the expert in states that the clone visits; if"
            " the dynamics are no evidence anywhere, a sensor is needed. (An expert with a memory, or with noise that"
            " lasts, looks the same; queries tell these apart.)"
        )
        return conclude("confounded", 3, reason, QUERY)
    if in_trials.low <= NO_EVIDENCE:
        reason = "The evidence in expert trials may be zero or not."
        return conclude("cannot tell", None, reason, EXPLORE_MORE)
    if max(stakes.high, paired.high) < STAKES and model.value < MAX_MODEL_DEVIATION and gain.low > 0:
        reason = "But trajectories under a wrong latent hardly deviate; nor will a clone's."
        return conclude("not confounded", 1, reason, CLONE)
    if not any(figure.value >= STAKES and figure.low > 1 for figure in (stakes, paired)):
        reason = (
            "These deviations may be chance: the latent hardly matters, or the learned dynamics are poor where it does."
            f" (Over all features, trajectories in them deviate {model} times as much from the data's as by chance.)"
        )
        return conclude("cannot tell", None, reason, EXPLORE_MORE)
    if naive.low > GOOD and max(gap.high, by_actions.high) < SMALL_GAP:
        return conclude("not confounded", 1, "The naive clone infers the latent by itself.", CLONE)
    if max(gap.low, by_actions.low) <= 0 or max(gap.high, by_actions.high) < SMALL_GAP:
        reason = "The scores hardly differ; more trials and more exploration would decide."
        return conclude("cannot tell", None, reason, MORE_TRIALS)
    reason = "A clone takes its own actions for evidence; inference from the dynamics does better."
    return conclude("confounded", 2, reason, EXPLORE)
