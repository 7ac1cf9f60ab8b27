"""Scores from returns: 0 = random actions, 1 = the expert that sees theta. No training happens here."""

import csv
import io
import shutil
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np

from deconfounded import envs
from deconfounded.benchmarks.engine.catalogue import EXACT, REFERENCES
from deconfounded.envs.streams import Array

EXACTLY = 6  # decimals of what tables round to two: rounded to four before, .634985 would be .64
VERSION = 5  # raised when the same records come to other figures


def check_expert(task: str, random: float, expert: float) -> None:
    """Raises InputError unless the expert's mean return is above that of random actions."""
    if not expert > random:
        says = f"the expert returns {expert:.4g} an episode, random actions {random:.4g}"
        raise envs.InputError(f"{task}: {says}; scores need an expert that is better")


def normalise(returns: Array, random: float, expert: float) -> Array:
    """Returns of any shape -> scores; 0 = random actions, 1 = the expert."""
    return (returns - random) / (expert - random)


NEAR = 0.03  # of a score: a task is solved where a method comes that near to the ceiling
MANY = 1000  # values, from which on an interval holds its mean in 95% of cases

MEASURES = ("first", "last", "regret")


def measured(scores: Array) -> dict[str, Array]:
    """Scores of a trial's episodes [..., E] -> MEASURES [...].

    They are the scores of the first and of the last episode; and the regret, the expert's score (1) less the agent's,
    summed over the episodes: less is better.
    """
    return dict(zip(MEASURES, (scores[..., 0], scores[..., -1], (1 - scores).sum(-1)), strict=True))


def bootstrap(values: Array) -> Array | None:
    """Percentile-bootstrap intervals [..., 2] of means over seeds, of values [S, ...]; None for a single seed.

    Of few seeds they are too narrow for the 95% of many: see `coverage`.
    """
    if len(values) < 2:
        return None
    from scipy import stats  # takes a second

    batch = max(1, 10**7 // values.size) if values.size > MANY else None  # resamples at once, for memory; None: all
    made = stats.bootstrap((values,), np.mean, method="percentile", n_resamples=5000, rng=0, batch=batch)
    return np.stack([made.confidence_interval.low, made.confidence_interval.high], -1)


@cache
def coverage(seeds: int) -> float:
    """The share of cases in which such an interval holds the mean, if scores are normal: .75 of 3 seeds. Simulated."""
    if seeds > MANY:
        return 0.95
    rng = np.random.default_rng(0)
    scores, draws = rng.standard_normal((4000, seeds)), rng.integers(seeds, size=(1000, seeds))
    counts = np.apply_along_axis(np.bincount, 1, draws, minlength=seeds)  # [resamples, S]
    low, high = np.percentile(scores @ counts.T / seeds, [2.5, 97.5], 1)
    return float(((low <= 0) & (high >= 0)).mean())


def interval(ends: Sequence[float] | None, seeds: int = 0) -> str:
    """An interval as tables show it, and with its coverage if seeds are given: `0.31 to 0.42 (75%)`."""
    held = f" ({coverage(seeds):.0%})" if seeds else ""
    return "-" if ends is None else " to ".join(map(two_decimals, ends)) + held


def fewest_to_most(counts: Sequence[int]) -> str:
    """Of how many seeds several figures are: `5 to 10`, or `5` where all are of as many."""
    fewest, most = min(counts), max(counts)
    return f"{fewest} to {most}" if fewest < most else str(most)


def mean_curve(curves: Sequence[dict[str, dict[str, list[Any]]]]) -> dict[str, dict[str, Any]]:
    """The mean over seeds of training curves, by kind of loss, and of how many `seeds`.

    Of those that were noted at the same updates as the first. Where the method did something else for a while, the loss
    is None at one update in between: not to be bridged.
    """
    means = {}
    for kind in dict.fromkeys(kind for curve in curves for kind in curve):
        same = [curve[kind] for curve in curves if kind in curve]
        update = np.array(same[0]["update"])
        alike = [curve["loss"] for curve in same if curve["update"] == same[0]["update"]]
        loss = np.mean(alike, 0)
        steps = np.diff(update)
        gaps = 1 + np.flatnonzero(steps > 1.5 * np.median(steps)) if len(steps) else np.zeros(0, int)
        means[kind] = {
            "update": np.insert(update, gaps, update[gaps - 1] + 1).tolist(),
            "loss": [None if np.isnan(x) else float(f"{x:.4g}") for x in np.insert(loss, gaps, np.nan)],
            "seeds": len(alike),
        }
    return means


def mean_budget(budgets: Sequence[dict[str, int]]) -> dict[str, int]:
    """What a seed used, by kind of data: the mean over seeds."""
    kinds = dict.fromkeys(kind for budget in budgets for kind in budget)
    return {kind: round(float(np.mean([budget.get(kind, 0) for budget in budgets]))) for kind in kinds}


def summarise(
    by_method: dict[str, list[dict[str, Any]]], episodes: int, references: tuple[float, float]
) -> dict[str, Any]:
    """Records by method, random and expert among them -> the `methods` entry of results.json.

    `episodes` is the length of the trials trained on; what agents did in later ones, if any, is told apart.
    references: the returns that have score 0 and 1.
    """

    def stacked(name: str, key: str) -> Array:
        return np.array([record[key] for record in by_method[name]])

    random, expert = references
    methods = {}
    for name, seeds in by_method.items():
        returns = stacked(name, "returns")
        scores = normalise(returns, random, expert)
        measures = measured(scores[:, :episodes])
        intervals = bootstrap(np.column_stack([scores, measures["regret"]]))
        band = None if intervals is None else intervals[:-1]
        methods[name] = {
            "method": seeds[0]["method"],
            "deployment": seeds[0]["deployment"],
            "seeds": [record["seed"] for record in seeds],
            "return": returns[:, :episodes].round(4).tolist(),
            "score": scores[:, :episodes].mean(0).round(EXACTLY).tolist(),
            **{f"score_{end}": round(float(measures[end].mean()), EXACTLY) for end in ("first", "last")},
            "regret": round(float(measures["regret"].mean()), EXACTLY),
            "ci95": None if band is None else band[episodes - 1].tolist(),
            "ci95_first": None if band is None else band[0].tolist(),
            "ci95_regret": None if intervals is None else intervals[-1].tolist(),
            "band": None if band is None else band.round(4).tolist(),
            "objective": stacked(name, "objective")[:, :episodes].mean(0).round(3).tolist(),
            "theta_r2": stacked(name, "theta_r2")[:, :episodes].mean(0).round(4).tolist(),
            "tier": seeds[0]["tier"],
            "version": seeds[0]["method_version"],
            "budget": mean_budget([record["budget"] for record in seeds]),
            "cpu_s": _cpu_seconds(seeds),
        }
        if returns.shape[1] > episodes:
            methods[name]["score_beyond"] = scores[:, episodes:].mean(0).round(4).tolist()
        if curves := [record["curve"] for record in seeds if "curve" in record]:
            methods[name]["curve"] = mean_curve(curves)
    for name, reference in zip(REFERENCES, (random, expert), strict=True):
        methods[name]["reference"] = reference
    return methods


def outcome(methods: dict[str, Any]) -> str:
    """A sentence on scores of the last episode: which methods infer theta, and which are deluded.

    A method that does not see theta infers it if its interval lies above the middle between the exact conditional and
    the exact interventional policy; it is deluded if its interval lies below and the agent has features to read theta
    from. If the two are not .1 apart, nothing can be concluded. Other ways to deploy the same agent are left out.
    """

    def listed(*names: str) -> str:
        scores = [f"{name} ({two_decimals(methods[name]['score_last'])})" for name in names]
        return " and ".join(filter(None, [", ".join(scores[:-1]), scores[-1]]))

    judged = [name for name, entry in methods.items() if entry["tier"] in "123" and not entry["deployment"]]
    judged.sort(key=lambda name: -methods[name]["score_last"])
    named = [*judged, *(name for name in EXACT if name in methods)] or methods
    seeds = fewest_to_most([len(methods[name]["seeds"]) for name in named])
    basis = f"Scores of the last episode, {'of one seed' if seeds == '1' else f'means of {seeds} seeds'}."
    if not judged or not set(EXACT) <= set(methods):
        text = (
            f"{listed(*judged)}, where the expert has 1; no"
            if judged
            else "No method that learns without theta, and no"
        )
        return f"{text} pair of exact policies was run to compare with. {basis}"
    (low, deluded), (high, exact) = ((methods[name]["score_last"], listed(name)) for name in EXACT)
    if high - low < 0.1:
        alike = f"Nothing can be concluded: the exact policies, {exact} and {deluded}, score alike."
        return f"{alike} The others: {listed(*judged)}. {basis}"
    middle, sides = (low + high) / 2, dict[str, list[str]]()
    for name in judged:
        entry = methods[name]
        least, most = entry["ci95"] or (entry["score_last"],) * 2
        if most < middle:
            memory = any(entry["theta_r2"])
            below = f"scored below the middle between the exact policies, {two_decimals(middle)}"
            unknown = f"{below}, and has no features to read theta from"
            fate = f"scored like the deluded exact policy, {deluded}" if memory else unknown
        elif least <= middle:
            fate = f"may be on either side of the middle between the exact policies, {two_decimals(middle)}"
        else:
            fate = f"inferred theta, like the exact policy {exact}"
        sides.setdefault(fate, []).append(name)
    return f"{'; '.join(f'{listed(*names)} {fate}' for fate, names in sides.items())}. {basis}"


def csv_rows(task: envs.Task, results: dict[str, Any], finished: Sequence[tuple[str, int, dict[str, Any]]]) -> str:
    """rows.csv: one row per method, seed, latent (trial) and episode."""
    text = io.StringIO()
    out = csv.writer(text, lineterminator="\n")
    latents = [lat.name for lat in task.latents]
    out.writerow(["method", "seed", "trial", *latents, "episode", "return", "score", "objective"])
    random, expert = (results["methods"][name]["reference"] for name in REFERENCES)
    for _, seed, data in finished:
        for name in data["meta"]["agents"]:
            returns, theta = data[f"{name}/returns"], data[f"{name}/theta"]
            values = np.stack([returns, normalise(returns, random, expert), data[f"{name}/objective"]], -1).round(4)
            for trial, episode in np.ndindex(returns.shape):
                latent = (f"{value:.6g}" for value in theta[trial, episode])
                out.writerow([name, seed, trial, *latent, episode + 1, *values[trial, episode].tolist()])
    return text.getvalue()


INTERVALS = (
    "Intervals: percentile bootstrap over seeds. In brackets: how often an interval of that many seeds contains the"
    " true mean, if scores are normally distributed and the returns that have score 0 and 1 are known exactly. Which"
    " thetas seeds draw makes differences of some hundredths between methods of five and of ten seeds; compare them by"
    " the same seeds (`deconf compare`)."
)
DROPPED = (
    *("data, a seed", "theta R2 of each episode", "CPU s, a seed", "Eq. (1)", "return", "tier"),
    *("interval of regret", "interval of first", "interval", "regret", "first"),
)
COLUMNS = (
    *("method", "tier", "return", "score of each episode", "first", "interval of first", "last", "interval"),
    *("regret", "interval of regret"),
    *("Eq. (1)", "theta R2 of each episode", "data, a seed", "CPU s, a seed"),
)


def two_decimals(value: float) -> str:
    """As tables show scores: never as -0.00."""
    return f"{np.round(value, 2):z.2f}"


def _cpu_seconds(seeds: Sequence[dict[str, Any]]) -> float | None:
    """Mean of the records that were trained on a CPU; None if there are none: then a GPU did the work."""
    seconds = [record["cpu_s"] for record in seeds if "trained on cuda" not in record.get("machine", "")]
    return round(float(np.mean(seconds)), 1) if seconds else None


def cpu_seconds(entry: dict[str, Any]) -> str:
    """CPU seconds a seed, as tables show them."""
    return "by GPU" if entry["cpu_s"] is None else f"{entry['cpu_s']:,.0f}"


def budget(used: dict[str, int]) -> str:
    """The data that a seed used, as tables show it."""
    return ", ".join(f"{n:,} {kind.replace('_', ' ')}" for kind, n in used.items() if n)


def rows(methods: dict[str, Any]) -> list[tuple[str, ...]]:
    """The `methods` of results.json as rows of COLUMNS, best first; return and Eq. (1) are of the last episode."""
    lines: list[tuple[str, ...]] = []
    for name, entry in sorted(methods.items(), key=lambda item: -item[1]["score_last"]):
        scores, r2 = (" ".join(map(two_decimals, entry[key])) for key in ("score", "theta_r2"))
        returned = np.mean(entry["return"], 0)[-1]
        returned = f"{returned:.1f}" if abs(returned) >= 10 else two_decimals(returned)
        costs = (budget(entry["budget"]), cpu_seconds(entry))
        first = (two_decimals(entry["score_first"]), interval(entry["ci95_first"]))
        last = (two_decimals(entry["score_last"]), interval(entry["ci95"], len(entry["seeds"])))
        regret = (two_decimals(entry["regret"]), interval(entry["ci95_regret"]))
        objective = f"{entry['objective'][-1]:,.0f}"
        lines.append((name, entry["tier"], returned, scores, *first, *last, *regret, objective, r2, *costs))
    return lines


def plain_table(head: Sequence[str], rows: Sequence[Sequence[str]], dropped: Sequence[str] = ()) -> str:
    """Rows of cells under a head, in columns as wide as they must be.

    dropped: columns that are left out, in that order, until a line fits into the terminal; a last line names them.
    """
    columns, out = list(zip(head, *rows, strict=True)), list[str]()
    width = shutil.get_terminal_size((10_000, 24)).columns  # a file has room
    for name in (name for name in dropped if name in head):
        if sum(max(map(len, column)) + 2 for column in columns) - 2 <= width:
            break
        columns = [column for column in columns if column[0] != name]
        out.append(name)
    padded = [[cell.ljust(max(map(len, column))) for cell in column] for column in columns]
    lines = ["  ".join(line).rstrip() for line in zip(*padded, strict=True)]
    return "\n".join([*lines, *([f"(too wide for this terminal: {'; '.join(out)})"] if out else [])])
