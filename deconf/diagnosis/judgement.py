"""The verdict on figures of several splits of the trials, with its reasons."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from deconfounded.deconf.diagnosis.advice import (
    CLONE,
    CLONE_HABITS,
    EXPLORE,
    EXPLORE_FIRST,
    EXPLORE_MORE,
    MORE_TRIALS,
    PASSING,
    QUERY,
    SHOWN_ACTIONS,
    VARY_LATENT,
    Next,
    Verdict,
    clone_with_memory,
)
from deconfounded.deconf.diagnosis.measures import Findings
from deconfounded.deconf.diagnosis.thresholds import (
    DIFFERS,
    GOOD,
    MAX_MODEL_DEVIATION,
    MIN_MODEL_LENGTH,
    MISFIT,
    NEGLIGIBLE,
    NO_EVIDENCE,
    NO_LOSS,
    SHARED,
    SMALL_GAP,
    STAKES,
    TRAIT_SHARE,
    TRAIT_STAKES,
    UNUSED,
)
from deconfounded.deconf.diagnosis.verdict import Diagnosis, Figure, with_tier
from deconfounded.envs.support.errors import InputError


def judge(
    refits: Sequence[Findings],
    explored: int | None = None,
    labels: Sequence[str] = (),
    incomplete: Sequence[str] = (),
    doubts: Sequence[str] = (),
) -> Diagnosis:
    """The verdict, and why. It cannot tell where less than half of the refits, judged alone, lead to the same tier.

    That is, both "not confounded" and "nothing at stake" say that a clone loses nothing. explored: trials of
    exploration. labels: observations that show how trials differ in their dynamics, see `labels.py`. incomplete: those
    that depend on more than columns show, see `state.py`; they decide what to clone with, and no verdict. doubts: about
    exploration, see `doubts.py`. Raises InputError if a figure is not finite.
    """
    diagnosis = _judge(refits, explored, labels, doubts)
    alone = [_judge([refit], explored, labels, doubts) for refit in refits]
    if diagnosis.tier is not None and 2 * sum(split.tier == diagnosis.tier for split in alone) < len(refits):
        reason, advice = alone[0].conclusion, alone[0].next
        if len({split.conclusion for split in alone}) > 1:
            reason = "Random splits of your trials lead to different verdicts: there are too few trials for any."
            advice = MORE_TRIALS
        diagnosis = replace(diagnosis, verdict="cannot tell", tier=None, conclusion=reason, next=advice)
    if diagnosis.next is CLONE_HABITS and incomplete and _alike(diagnosis.figures):
        diagnosis = replace(diagnosis, next=clone_with_memory(incomplete))
    dissent = [split for split in alone if split.tier != diagnosis.tier]
    dissenting = dict.fromkeys(with_tier(split.verdict, split.tier) for split in dissent)
    return replace(diagnosis, agreeing=len(alone) - len(dissent), refits=len(refits), dissenting=tuple(dissenting))


def check_finite(findings: Findings) -> None:
    """Raises InputError if a figure is not finite."""
    for key, value in findings._asdict().items():
        if value is not None and not np.isfinite(value):
            raise InputError(f"learning failed: {key} is {value}; are there outliers, or scales that differ a lot?")


def _figures(refits: Sequence[Findings]) -> dict[str, Figure]:
    """Figures of Diagnosis; those of traits only if all refits have them."""
    for refit in refits:
        check_finite(refit)
    figures = {}
    for key, column in zip(Findings._fields, zip(*refits, strict=True), strict=True):
        values = [value for value in column if value is not None]
        if len(values) == len(refits):
            figures[key] = Figure.of(values)
    figures["gap"] = Figure.of([refit.latent - refit.naive for refit in refits])
    figures["gap_by_actions"] = Figure.of([refit.latent_by_actions - refit.naive_by_actions for refit in refits])
    if "exploration_evidence" in figures:
        ratios = [(refit.action_evidence or 0.0) / max(refit.expert_evidence or 0.0, NO_EVIDENCE) for refit in refits]
        figures["ratio"] = Figure.of(ratios)
    return figures


def _alike(figures: dict[str, Figure]) -> bool:
    """Whether trials do not differ in their dynamics: what a latent explains is then where a trial went."""
    differ = figures.get("dynamics_differ")
    return differ is not None and differ.high == 0


def _judge(refits: Sequence[Findings], explored: int | None, labels: Sequence[str], doubts: Sequence[str]) -> Diagnosis:
    figures = _figures(refits)
    names = ("memory_gain", "stakes", "paired_stakes", "model_deviation", "naive", "latent", "gap", "gap_by_actions")
    memory, stakes, paired, model, naive, latent, gap, by_actions = (figures[name] for name in names)
    in_exploration, alike = figures.get("exploration_evidence"), _alike(figures)
    at_stake = any(figure.value >= STAKES and figure.low > 1 for figure in (stakes, paired))
    harmless = max(stakes.high, paired.high) < STAKES and model.value < MAX_MODEL_DEVIATION
    reasons = [
        f"A memory improves the prediction of the expert's action by {memory} nats a step over the present observation."
    ]

    def conclude(verdict: Verdict, tier: int | None, conclusion: str, advice: Next) -> Diagnosis:
        return Diagnosis(verdict, figures, tuple(reasons), tier, advice, conclusion)

    def more_exploration(conclusion: str) -> Diagnosis:
        had = "" if explored is None else f" You have {explored} trials of exploration."
        return conclude("cannot tell", None, conclusion + had, EXPLORE_MORE)

    if memory.low < -MISFIT:
        conclusion = (
            "The clone with a memory did not fit: it predicts less well than one without, so that nothing follows."
        )
        return conclude("cannot tell", None, conclusion, MORE_TRIALS)
    least = UNUSED * max(memory.high, 0) + NEGLIGIBLE
    unused = in_exploration is not None and not alike and figures["over_memory"].low > least
    if memory.low <= NEGLIGIBLE and not unused:
        if memory.high > NEGLIGIBLE:
            return conclude("cannot tell", None, "Whether past actions help a clone is not clear.", MORE_TRIALS)
        loses = at_stake and max(gap.low, by_actions.low) > SMALL_GAP and model.value < MAX_MODEL_DEVIATION
        seen = in_exploration is not None and min(in_exploration.low, figures["expert_evidence"].low) > DIFFERS
        if seen and not alike:
            reasons.append(_rollouts(figures))
            if loses and figures["latent_gain"].low > 0:
                conclusion = (
                    "Your system differs from trial to trial, and the expert seems to act on it: the clone with a"
                    f" memory found nothing of that in the logs, and would lose by it. {SHOWN_ACTIONS}"
                )
                return conclude("cannot tell", None, conclusion, MORE_TRIALS)
            conclusion = (
                "Your system differs from trial to trial, but past actions tell a clone nothing of the expert's next"
                " one that the present observation does not."
            )
            return conclude("not confounded", 1, conclusion, CLONE)
        if labels:
            conclusion = (
                f"Your system differs from trial to trial, and your columns show it: {', '.join(labels)}, constant in"
                " each trial. Given this, past actions tell a clone nothing more. A clone that will not observe it is"
                " another matter: leave it out of --obs, and diagnose again."
            )
            return conclude("not confounded", 1, conclusion, CLONE)
        if loses and in_exploration is None:
            reasons.append(_rollouts(figures))
            conclusion = (
                "Past actions tell a clone nothing of the expert's next one that the present observation does not, and"
                f" yet a clone loses in the learned model of your system: more trials may show why. {SHOWN_ACTIONS}"
            )
            return conclude("cannot tell", None, conclusion, MORE_TRIALS)
        conclusion = (
            "The expert acts alike in all trials: nothing is hidden, or it was the same in all of them. Under these"
            " conditions a clone misses nothing; about others the trials say nothing."
        )
        return conclude("cannot tell", None, conclusion, VARY_LATENT)
    reasons.append(_rollouts(figures))
    if in_exploration is None:
        conclusion = (
            "Past actions tell a clone more of the expert's next one than the present observation. Whether the world"
            " would tell it too cannot be seen in expert trials alone: they hold nearly one action for each"
            " observation, so that effects of the action and of what is hidden cannot be separated."
        )
        return conclude("cannot tell", None, conclusion, EXPLORE_FIRST)
    in_trials, gain = figures["expert_evidence"], figures["latent_gain"]
    reasons.append(_evidence(figures))
    if alike:
        reasons.append(
            "But trials of exploration do not differ in their dynamics: what one half of a trial does beyond a fit of"
            " all trials, the other does not. The evidence is then of where a trial went, and of nothing hidden."
        )
        reasons += doubts
        return _goal_or_habit(figures, doubts, conclude)
    if "dynamics_differ" not in figures:
        return more_exploration("Trials of exploration are too few to see whether they differ in their dynamics.")
    if max(-in_trials.low, in_trials.value, gain.high) < NEGLIGIBLE:
        return more_exploration(
            "Whether trials differ in what actions do, and what that tells of the expert's actions, is not clear from"
            " so little exploration."
        )
    if in_trials.low <= NO_EVIDENCE:
        return more_exploration("Whether what the world does in expert trials tells what is hidden is not clear.")
    length = figures["model_length"]
    if length.value < MIN_MODEL_LENGTH and (naive.low > GOOD or not at_stake):
        return more_exploration(
            "In the learned model of your system episodes of the expert itself, given the right latent, are only"
            f" {length} times as long as in your trials, so that what a clone would lose does not show there."
        )
    if harmless and gain.low > 0:
        conclusion = (
            "Something is hidden that the expert acts on, but where trials go hardly depends on it: acting on another"
            " value of it would change next to nothing."
        )
        return conclude("not confounded", 1, conclusion, CLONE)
    if (harmless and gain.high < NEGLIGIBLE) or (min(naive.low, latent.low) > NO_LOSS and not unused):
        return conclude("nothing at stake", 1, PASSING, CLONE_HABITS)
    if not at_stake:
        return more_exploration(
            "What is hidden hardly matters for where trials go, or the learned model of your system is poor where it"
            " does."
        )
    if gain.high <= 0:
        return more_exploration("What the world tells does not yet explain any of the expert's actions.")
    if naive.low > GOOD and max(gap.high, by_actions.high) < SMALL_GAP:
        conclusion = "Something is hidden, and the clone with a memory infers it by itself."
        return conclude("not confounded", 1, conclusion, CLONE)
    if unused:
        conclusion = (
            "The world tells more of the expert's actions than the clone's memory makes use of: it did not learn what"
            f" it could. {SHOWN_ACTIONS}"
        )
        return conclude("cannot tell", None, conclusion, MORE_TRIALS)
    if max(gap.low, by_actions.low) <= 0 or max(gap.high, by_actions.high) < SMALL_GAP:
        conclusion = "Something is hidden; whether a clone loses by it is not clear."
        return conclude("cannot tell", None, conclusion, MORE_TRIALS)
    if (shared := figures.get("shared")) is not None and shared.value < SHARED:
        reasons.append(
            f"But of what that latent makes a policy do, {shared:%} lasts through trials of exploration as it does"
            " through the expert's. What is in the system lasts in both; where a trial went lasts where somebody goes"
            " there on purpose."
        )
        return more_exploration(
            "Your system differs from trial to trial, and the expert acts on something that your columns do not show;"
            " whether that is the same, or something that the world does not tell, is not clear. If more exploration"
            " does not change this, only the expert, or a sensor, can tell."
        )
    conclusion = (
        "The expert acts on something that your columns do not show. A clone with a memory takes its own past actions"
        " for evidence of it, though it chose them itself; what the world does would tell."
    )
    return conclude("confounded", 2, conclusion, EXPLORE)


def _goal_or_habit(
    figures: dict[str, Figure], doubts: Sequence[str], conclude: Callable[[Verdict, int | None, str, Next], Diagnosis]
) -> Diagnosis:
    """The verdict where past actions predict, and trials do not differ in their dynamics: see `trait.py`."""
    memory, gain = figures["memory_gain"], figures.get("trait_gain")
    if gain is None:
        return conclude("cannot tell", None, "Whether past actions help a clone is not clear.", MORE_TRIALS)
    if gain.low < -MISFIT:
        conclusion = "What half of a trial shows of its expert could not be fitted to the other half: nothing follows."
        return conclude("cannot tell", None, conclusion, MORE_TRIALS)
    if gain.high < max(NEGLIGIBLE, TRAIT_SHARE * memory.low):
        return conclude("nothing at stake", 1, PASSING, CLONE_HABITS)
    if doubts:
        conclusion = (
            "The expert acts on something that lasts for a trial, and your columns do not show it. Whether the world"
            f" tells it is not clear. {doubts[0]}"
        )
        return conclude("cannot tell", None, conclusion, EXPLORE_MORE)
    if max(figures["trait_stakes"].high, figures["paired_trait_stakes"].high) < TRAIT_STAKES:
        conclusion = (
            "Experts act in ways of their own, which last for a trial, but where trials go hardly depends on them, and"
            " the world tells nothing of them: habits, rather than anything hidden in your system."
        )
        return conclude("nothing at stake", 1, conclusion, CLONE_HABITS)
    if gain.low < max(NEGLIGIBLE, TRAIT_SHARE * memory.high) or figures["paired_trait_stakes"].low < TRAIT_STAKES:
        conclusion = "Whether experts differ by goals that only they see, or by habits, is not clear."
        return conclude("cannot tell", None, conclusion, MORE_TRIALS)
    conclusion = (
        "The expert goes elsewhere in different trials, by something that only it sees, and nothing in your exploration"
        " tells of it. If where it goes is a matter of taste, nothing is lost: any clone's way is right. Otherwise only"
        " the expert, or a sensor, can tell."
    )
    return conclude("confounded", 3, conclusion, QUERY)


def _rollouts(figures: dict[str, Figure]) -> str:
    names = ("stakes", "paired_stakes", "naive", "latent", "naive_by_actions", "latent_by_actions")
    stakes, paired, naive, latent, *by_actions = (figures[name] for name in names)
    return (
        "In rollouts in the learned dynamics, trajectories of an expert policy given a wrong latent deviate from those"
        f" given right ones {stakes} times as much as by chance, and {paired} times as much when paired by latent and"
        f" start. From 0 for the wrong latent to 1 for the right one, a naive clone scores {naive} by trajectories, and"
        f" a policy that infers the latent from the dynamics {latent}; by actions, Eq. (1), {by_actions[0]} and"
        f" {by_actions[1]}."
    )


def _evidence(figures: dict[str, Figure]) -> str:
    names = ("exploration_evidence", "expert_evidence", "latent_gain", "action_evidence", "ratio")
    in_exploration, in_trials, gain, in_actions, ratio = (figures[name] for name in names)
    return (
        f"The dynamics are evidence of the latent, by {in_exploration} nats a step in exploration and {in_trials} in"
        f" expert trials; the latent inferred from them improves the prediction of the expert's actions by {gain} over"
        f" latents of other trials. The actions are evidence of it by {in_actions} nats a step: {ratio} times as much,"
        " for a clone that takes its own actions for the expert's."
    )
