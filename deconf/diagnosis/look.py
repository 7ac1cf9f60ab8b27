"""A first look at logs, before any diagnosis: what is in them, and what would mislead it, in plain words."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from deconfounded.deconf.diagnosis import columns, fits, labels, state, trial_dynamics
from deconfounded.deconf.diagnosis.fits import Steps
from deconfounded.deconf.diagnosis.remark import LISTED, Remark, listed
from deconfounded.experts.datasets.logs import Log
from deconfounded.experts.datasets.table import Odd
from deconfounded.experts.trials import Trials, check_trials

Array = NDArray[np.float64]
OUTLYING, SEVERAL = 8.0, 0.05  # times the usual spread of trials; share of trials
FEW = 8  # values of a column that does not move, but jumps
STILL, PAUSE = 0.02, 5  # of the motion's 90th percentile; steps
LATEST, USUAL = 8, 4  # lags that are tried, in short episodes; of the last one, as of slow noise, nothing follows
BETTER = 0.95  # of the variance that another row leaves
EQUAL = 1e-5  # of the spread: the rounding of float32
REPEATED, LASTING = 0.95, 0.7  # shares of variance; correlation from step to step
ALIKE = 0.5  # of that correlation, which a poor fit has at alike observations too


def look(given: Trials, blind: bool = False) -> list[Remark]:
    """Remarks on trials, those of a log by the names of its columns; what is odd comes last.

    blind: they are of exploration, of which it does not matter how its actions are chosen. Raises InputError for what
    is no Trials.
    """
    check_trials("look", given)
    log = given if isinstance(given, Log) else Log.of(given, "Trials")
    part = fits.sample(given)
    steps, fitted = Steps.of(log), Steps.of(part)
    remarks = [Remark("size", note, isinstance(note, Odd)) for note in log.notes]
    for describe in (
        _ranges,
        _outliers,
        _duplicates,
        _pauses,
        _states,
        columns.extremes,
        columns.angles,
        columns.units,
        *[_repeats] * (not blind),
    ):
        remarks += describe(log, steps)
    if not blind and log.actions != 1:  # of one action alone nothing follows
        remarks += [*_lag(part), *_lasting(part, fitted)]
    remarks += [*columns.of_trials(log)] * (not blind)
    remarks += _dynamics(part, fitted, log.units.obs, blind)
    return sorted(remarks, key=lambda remark: remark.odd)


def _ranges(log: Log, steps: Steps) -> Iterator[Remark]:
    low, middle, high = np.quantile(steps.obs, [0, 0.5, 1], 0)
    ranges = zip(log.units.obs, low, middle, high, strict=True)
    said = [f"{name} {a:.4g} to {c:.4g} (median {b:.4g})" for name, a, b, c in ranges]
    yield Remark("range", f"Observations: {listed(said)}.")
    if log.actions:
        counts = np.bincount(steps.action[:, 0].astype(int), minlength=log.actions) / len(steps.action)
        named = [f"{name} {share:.0%}" for name, share in zip(log.units.values, counts, strict=True)]
        yield Remark("range", f"Actions used: {listed(named)}.")
        return
    raw = log.units.unscaled(steps.action)
    said = []
    for name, column, scaled in zip(log.units.action, raw.T, steps.action.T, strict=True):
        a, b = np.quantile(column, [0.01, 0.99])
        said.append(f"{name} {a:.4g} to {b:.4g} ({(np.abs(scaled) > 0.999).mean():.0%} at an end of the range)")
    yield Remark("range", f"Actions used, without the extreme 1% at each side: {listed(said)}.")


def _outliers(log: Log, steps: Steps) -> Iterator[Remark]:
    """Trials whose medians, spreads, shares or lengths are far from those of the others."""
    present = np.flatnonzero(log.mask.any((1, 2)))
    count = len(present)
    if count < 8:
        return
    mask = log.mask[present]
    per_episode = mask.sum(2).sum(1) / mask.any(2).sum(1)
    names, features = ["length of episodes"], [per_episode.astype(float)]
    least = [0.1 * float(per_episode.mean())]
    rows = [np.flatnonzero(steps.trial == i) for i in present]
    acted = fits.one_hot(steps.action, log.actions)
    actions = (
        [f"{value} in {log.units.action[0]}" for value in log.units.values[1:]] if log.actions else log.units.action
    )
    for name, column in zip((*log.units.obs, *actions), np.concatenate([steps.obs, acted], 1).T, strict=True):
        if len(values := np.unique(column)) == 2:  # quartiles of a flag, or of numbers of actions, say nothing
            share = f"share of {name}" if name in actions else f"share of {values[1]:g} in {name}"
            names, least = [*names, share], [*least, 0.05]
            features.append(np.array([(column[index] == values[1]).mean() for index in rows]))
            continue
        quartiles = np.array([np.quantile(column[index], [0.25, 0.5, 0.75]) for index in rows])
        names += [f"median of {name}", f"interquartile range of {name}"]
        features += [quartiles[:, 1], quartiles[:, 2] - quartiles[:, 0]]
        least += [0.05 * float(column.std())] * 2
    table = np.stack(features, 1)
    centre = np.median(table, 0)
    unit = 1.48 * np.median(np.abs(table - centre), 0)
    low, high = np.quantile(table, [0.05, 0.95], 0)
    far = np.abs(table - centre) / np.maximum(np.maximum(unit, 0.1 * (high - low)), np.maximum(least, 1e-9))
    far *= (far > OUTLYING).sum(0) <= max(2, SEVERAL * count)  # more of them are of another kind
    worst = far.max(1)
    for i in [i for i in np.argsort(-worst) if worst[i] > OUTLYING][:LISTED]:
        j = int(far[i].argmax())
        text = (
            f"Trial {log.names[present[i]]} is unlike the others: its {names[j]} is {table[i, j]:.4g}, and"
            f" {centre[j]:.4g} is usual ({worst[i]:.0f} times the usual deviation)."
        )
        yield Remark("outlier", text, True)


def _duplicates(log: Log, steps: Steps) -> Iterator[Remark]:
    """Trials and episodes that repeat others."""
    whole, acted, episodes = fits.copies(log)
    for kind, groups in (("", whole), (" in its actions", [group for group in acted if group not in whole])):
        if groups:
            named = [" = ".join(log.names[i] for i in group[:LISTED]) for group in groups]
            again = sum(len(group) - 1 for group in groups)
            text = f"{again} of {len(log)} trials repeat{'s' * (again == 1)} another{kind}: {listed(named)}."
            apart = "Where one is held out, its copy betrays it; keep one of each."
            if not kind:
                apart = "A diagnosis takes one of each; a clone counts them as often as they are there."
            yield Remark("duplicate", f"{text} {apart}", True)
    if repeated := [group for group in episodes if group not in whole]:
        names = [log.names[i] for i in sorted({i for group in repeated for i in group})]
        again = sum(len(group) - 1 for group in repeated)
        yield Remark("duplicate", f"{again} episodes repeat others, in trials {listed(names)}.", True)


def _pauses(log: Log, steps: Steps) -> Iterator[Remark]:
    """Stretches in which nothing moves, at the start of episodes and later."""
    if not np.diff(log.obs.astype(float), axis=2)[log.mask].any():
        yield Remark("pause", "No observation ever changes within an episode.", True)
        return
    moving = [i for i, x in enumerate(steps.obs.T) if len(np.unique(x[: 1 << 16])) > FEW]
    if not moving:
        return
    change = np.abs(np.diff(log.obs[..., moving].astype(float), axis=2))
    spread = np.sqrt((change[log.mask] ** 2).mean(0))
    motion = (change / np.where(spread > 0, spread, np.inf)).max(-1)
    moves = motion[log.mask]
    usual = np.quantile(moves, 0.9) or np.quantile(moves[moves > 0], 0.9) if moves.any() else 0.0
    still = (motion <= STILL * usual) & log.mask
    if not usual:  # only what jumps between few values changes
        return
    at_start, later, longest, where = 0, 0, 0, (0, 0)
    for b, e in np.argwhere(log.mask.any(2)):
        row = np.concatenate([[False], still[b, e], [False]]).astype(int)
        begins, ends = np.flatnonzero(np.diff(row) == 1), np.flatnonzero(np.diff(row) == -1)
        long = ends - begins >= PAUSE
        at_start += bool(long.any() and begins[long][0] == 0)
        later += int((begins[long] > 0).sum())
        if long.any() and (length := int((ends - begins)[long].max())) > longest:
            longest, where = length, (b, e)
    if at_start or later:
        count = int(log.mask.any(2).sum())
        text = (
            f"Nothing moves for {PAUSE} steps or more at the start of {at_start:,} of {count:,} episodes, and {later:,}"
            f" times later; the longest is {longest} steps, in episode {where[1]} of trial {log.names[where[0]]}. In"
            f" all {still[log.mask].mean():.0%} of steps are at rest. A clone learns to rest, and when to go on is"
            " nothing that the present observation shows. Cut pauses out, unless waiting is part of the task."
        )
        yield Remark("pause", text, at_start + later > 0.02 * count)


def _lag(trials: Trials) -> Iterator[Remark]:
    """The lag at which actions match observations, and the motion that follows, best."""
    latest = min(LATEST, max(USUAL, trials.mask.shape[2] // 5))
    window = fits.Window.of(trials, latest + 2)
    if len(window) < 200 or not window.action.std():
        return
    left = [window.unexplained([lag]) for lag in range(-1, latest + 1)]
    lag = int(np.argmin(left)) - 1
    if not 0 < lag < latest or left[lag + 1] > BETTER * left[1]:
        if lag <= 0 and left[1] < BETTER:
            yield Remark(
                "lag",
                "Actions match the observation of their own row better than earlier ones: they are not logged late.",
            )
        return
    motion = [1 - window.unexplained([j, j + 1, j - 1]) / window.unexplained([j, j + 1]) for j in (0, lag)]
    if lag >= USUAL and motion[1] <= motion[0] + 0.02:  # as of noise that lasts
        return
    rows = f"{lag} row{'s' * (lag > 1)}"
    text = (
        f"Actions match the observation {rows} before theirs best ({1 - left[lag + 1]:.0%} of their variance, and"
        f" {1 - left[1]:.0%} by that of their own row)"
    )
    if motion[1] > motion[0] + 0.02:
        text += f", and the motion that follows it: they are probably logged late. Move actions up by {rows}."
    elif motion[0] > motion[1] + 0.02:
        text += ", and move what follows their own: a reaction time. An expert that answers late is one with a memory."
    else:
        text += ": a reaction time, or logged late."
    yield Remark("late", text, True)


def _states(log: Log, steps: Steps) -> Iterator[Remark]:
    """Actions that are an observation: of the next row, or of their own."""
    if log.actions:
        return
    raw, spread = log.units.unscaled(steps.action), steps.obs.std(0)
    for name, action in zip(log.units.action, raw.T, strict=True):
        errors = [
            np.sqrt(((x - action[:, None]) ** 2).mean(0)) / np.maximum(spread, 1e-9) for x in (steps.obs, steps.then)
        ]
        present, then = (float(error.min()) for error in errors)
        if action.std() > 0 and min(present, then) < 0.05:
            which = "the next" if then < present else "the present"
            column = log.units.obs[int(errors[then < present].argmin())]
            text = f"The action {name} is {which} {column}, to {min(present, then):.1%} of its spread: "
            if then < EQUAL:
                text += (
                    "that column is the last action, which a clone takes for evidence with a memory or without (leave"
                    " it out, --obs); or the log has no commands, or a controller that follows them at once."
                )
            elif then < present:
                text += "the log has no commands, or a controller that follows them at once; that column tells nothing."
            else:
                text += "the log has no commands, but what was reached."
            yield Remark("state", text, True)


def _repeats(log: Log, steps: Steps) -> Iterator[Remark]:
    """How well the last action, and a mean action, predict the next one."""
    mask = log.mask[:, :, 1:]
    if not mask.any():
        return
    now, last = (log.action[:, :, part][mask].astype(float) for part in (slice(1, None), slice(-1)))
    trial = np.nonzero(mask)[0]
    if log.actions:
        most = np.bincount(now[:, 0].astype(int)).max() / len(now)
        repeat = float((now == last).mean())
        text = f"The most frequent action is right in {most:.0%} of steps, the last action in {repeat:.0%}."
    else:
        total = max(float(now.var(0).sum()), 1e-12)
        repeat = 1 - float(((now - last) ** 2).mean(0).sum()) / total
        own = np.stack([fits.by_trial(x, trial, len(log))[trial] for x in now.T], 1)
        mean = 1 - float(((now - own) ** 2).mean(0).sum()) / total
        linear = 1 - (1 - mean) * min(1.0, fits.unexplained(now, log.obs[:, :, 1:-1][mask].astype(float), trial))
        text = (
            f"The mean action, always taken, errs by {np.sqrt(total):.2g} (rms, of actions scaled to -1 to 1). Of that"
            f" variance the last action predicts {repeat:.0%}, the mean action of each trial {mean:.0%}, a linear"
            f" function of the observation, fitted to each trial, {linear:.0%}."
        )
    high = repeat > REPEATED
    text += " A clone can score well by repeating itself; errors of its actions say little." * high
    yield Remark("repeat", text, high)


def _lasting(trials: Trials, steps: Steps) -> Iterator[Remark]:
    """Whether what observations leave open of the action lasts from step to step, within a trial."""
    measured = fits.lasting(trials, steps)
    if measured is None:
        return
    correlation, share, alike = measured
    if correlation > LASTING and share > 0.02 and alike < ALIKE * correlation:
        half = np.log(0.5) / np.log(min(correlation, 0.999))
        text = (
            f"What the observation leaves open of the action in a trial ({share:.0%} of the variance) lasts: its"
            f" correlation from step to step is {correlation:.2f}, so that it halves in {half:.0f} steps. Noise that"
            " lasts, AR(1), or the expert's own memory looks like something hidden, and is not in the world."
            " A speed that no column shows looks so too: add it, if you can."
        )
        yield Remark("lasting", text, True)


def _dynamics(trials: Trials, steps: Steps, names: tuple[str, ...], blind: bool) -> Iterator[Remark]:
    """Whether trials differ in their dynamics."""
    measured, odd = trial_dynamics.own_dynamics(trials, steps), False
    if measured is None:
        text = "Whether trials differ in their dynamics cannot be seen: they are too few, or too short."
    elif measured[0]:
        text = (
            f"Trials differ in their dynamics: {names[measured[1]]} departs from a fit of all trials in the same way in"
            f" both halves of a trial (rank correlation {measured[0]:.2f})."
        )
    elif labelling := [names[i] for i in labels.decisive(trials)]:
        how = f"observations show how: {listed(labelling)}, constant in each trial"
        text = f"Trials differ in their dynamics, and {how}."
    elif blind:
        odd = True
        text = (
            "Trials do not differ in their dynamics, as far as a smooth fit shows. If that is so, an imitator can infer"
            " nothing from what its actions do."
        )
        if unshown := [names[i] for i in state.incomplete(trials)]:
            text += (
                f" But what comes next ({listed(unshown)}) depends on the step before too, as where a speed is not"
                " observed, or actions take effect late: a clone needs a memory, or that speed as a column."
            )
    else:
        text = (
            "No difference in dynamics is seen between trials. The expert's actions can hide one, as they make up for"
            " it; exploration can show it (--explore)."
        )
    yield Remark("dynamics", text, odd)
