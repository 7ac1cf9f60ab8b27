"""A verdict on whether data is confounded, from expert trials and exploration, without theta or a simulator.

`measures.measure` computes the figures on several splits of the trials; `judgement.judge` judges them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from deconfounded.deconf.core.data import Batch
from deconfounded.deconf.core.sizes import Configuration
from deconfounded.deconf.diagnosis import fits, labels, state
from deconfounded.deconf.diagnosis.doubts import doubts
from deconfounded.deconf.diagnosis.held_out import Report
from deconfounded.deconf.diagnosis.judgement import judge
from deconfounded.deconf.diagnosis.latent import in_range
from deconfounded.deconf.diagnosis.measures import Amounts, Findings, measure
from deconfounded.deconf.diagnosis.verdict import Diagnosis
from deconfounded.envs.support.errors import InputError
from deconfounded.experts.trials import Trials, check_trials

VERSION = 21  # raised when figures or verdicts of the same trials change


@dataclass(frozen=True)
class DiagnoseConfig(Configuration):
    """refits: independent splits of the trials; an interval is their range. least: the number of trials required."""

    refits: int = 3
    least: int = 24
    amounts: Amounts = field(default_factory=Amounts)


def diagnose(
    trials: Trials,
    explore: Trials | None,
    config: DiagnoseConfig,
    rng: np.random.Generator,
    report: Report = lambda share: None,
) -> Diagnosis:
    """Judge expert trials, and exploration if there is any. Raises InputError for data that cannot be judged."""
    if not isinstance(rng, np.random.Generator):
        raise InputError(f"rng was {rng!r}; it must be a generator: np.random.default_rng(0)")
    if not isinstance(config, DiagnoseConfig):
        raise InputError(f"config was {config!r}; it must be a DiagnoseConfig, such as DiagnoseConfig()")
    check(trials, explore, config)
    refits: list[Findings] = []

    def part(share: float) -> None:
        report((len(refits) + share) / config.refits)

    for generator in rng.spawn(config.refits):
        refits.append(measure(trials, explore, config.amounts, generator, part))
    return conclude(refits, trials, explore)


def conclude(refits: Sequence[Findings], trials: Trials, explore: Trials | None) -> Diagnosis:
    """The verdict on the figures of splits of these trials, with what their columns show."""
    trials, explore = fits.distinct(trials), explore and fits.distinct(explore)  # a copy is no evidence
    if explore is None:
        return judge(refits, None, labels.named(trials, None), state.named(None))
    doubted = doubts(trials, explore) if any(refit.dynamics_differ == 0 for refit in refits) else ()
    return judge(refits, len(explore), labels.named(trials, explore), state.named(explore), doubted)


def check(trials: Trials, explore: Trials | None, config: DiagnoseConfig) -> None:
    """Raises InputError for data that cannot be judged."""
    check_trials("diagnose", trials)
    for kind, data in (("", trials), (" of exploration", explore)):
        if data is None:
            continue
        check_trials("diagnose", data)
        count = int(data.mask.any((1, 2)).sum())
        if count < config.least:
            raise InputError(
                f"{count} trial{'s' * (count != 1)}{kind} given; at least {config.least} are needed, each"
                " under a theta of its own, so that some can be held out"
            )
        copied = sum(len(same) - 1 for same in fits.copies(data)[0])
        if count - copied < config.least:
            raise InputError(
                f"{count} trials{kind} given, of which {copied} repeat{'s' * (copied == 1)} another; at least"
                f" {config.least} different ones are needed"
            )
        if (np.diff(data.mask.astype(int), axis=2) > 0).any():
            raise InputError(
                f"a mask{kind} has steps after one that did not take place; those of an episode come first"
            )
        actions = data.action[data.mask]
        if (actions == actions[0]).all():
            raise InputError(f"every action{kind} is the same; there is nothing to learn, and nothing to judge")
        if not np.diff(data.obs, axis=2)[data.mask].any():
            raise InputError(f"no observation{kind} ever changes within an episode; there are no dynamics to learn")
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
