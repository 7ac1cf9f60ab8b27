"""docs/headroom.md: what the best methods leave to gain on each task, and how many tasks are solved."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from deconfounded.benchmarks.engine import published
from deconfounded.benchmarks.engine.protocols import PROTOCOLS
from deconfounded.benchmarks.output import index, statistics
from deconfounded.benchmarks.output.pictures import panels
from deconfounded.benchmarks.output.scoring import MEASURES, NEAR, interval, two_decimals
from deconfounded.benchmarks.output.statistics import Figure
from deconfounded.benchmarks.studies.cards import markdown_table
from deconfounded.benchmarks.studies.results import outdated
from deconfounded.envs.streams import Array

EXACT = "interventional"
REACHED = """**That is so now.** To compare strong methods, use `--protocol unseen` or `scarce`, or those of the
[hard tasks](hard.md) that are still hard."""
SHARE = 0.5  # of the tasks, solved in the last episode without queries: then the suite is to be made harder
BEST = 5  # methods, whose spread is shown
ENDS = {"first": "the first episode", "last": "the last episode"}
PICTURE = "![ceiling and the five best methods on each task](headroom.png)"
BLIND = {"123": "of all theta-blind methods", "12": "of those without queries"}  # by tiers


class Headroom(NamedTuple):
    """Of a task and an episode: the exact reference, and the best methods of some tiers, in their best deployments.

    A method's score is the ceiling's less what it leaves to gain by the same seeds: which thetas seeds draw makes
    differences of some hundredths.
    """

    ceiling: tuple[str, float]
    best: list[tuple[str, float]]  # at most BEST, best first
    gap: Figure  # of the ceiling less the best, paired by seed: what is left to gain

    @property
    def left(self) -> float:
        """What is left to gain."""
        return float(self.gap.value)

    @property
    def solved(self) -> bool:
        return self.left <= NEAR + 1e-9

    @property
    def sure(self) -> bool:
        """Whether the whole 95% interval of what is left says so, too."""
        ends = self.gap.interval
        return ends is not None and bool(ends[1] <= NEAR + 1e-9 if self.solved else ends[0] > NEAR)


def headroom(methods: dict[str, Any], end: str, tiers: str = "123") -> Headroom | None:
    """From the `methods` of results.json, of the score of an episode of ENDS; None without reference or methods."""
    exact = {name: entry[f"score_{end}"] for name, entry in methods.items() if entry["method"] == EXACT}
    if not exact:
        return None
    ceiling, by_seed = _ranked(methods, exact)[0], index.measured(methods, end)
    pairs = {name: statistics.paired(by_seed[ceiling[0]], by_seed[name]) for name in _learners(methods, tiers)}
    gaps = {name: gap for name, gap in pairs.items() if gap}
    best = _ranked(methods, {name: round(ceiling[1] - float(gap.value), 9) for name, gap in gaps.items()})
    return Headroom(ceiling, best[:BEST], gaps[best[0][0]]) if best else None


def best_of(methods: dict[str, Any], end: str, tiers: str = "123") -> list[tuple[str, float]]:
    """The learners of some tiers, each in its best deployment, and their scores in an episode of ENDS; best first."""
    return _ranked(methods, {name: methods[name][f"score_{end}"] for name in _learners(methods, tiers)})


def _learners(methods: dict[str, Any], tiers: str) -> list[str]:
    """Agents that learn, of these tiers."""
    return [name for name, entry in methods.items() if entry["method"] != EXACT and entry["tier"] in tiers]


def _ranked(methods: dict[str, Any], scores: Mapping[str, float]) -> list[tuple[str, float]]:
    """Of agents with these scores, the best deployment of each method; best first."""
    best: dict[str, tuple[str, float]] = {}
    for agent in scores.items():
        method = methods[agent[0]]["method"]
        best[method] = max(best.get(method, agent), agent, key=lambda agent: agent[1])
    return sorted(best.values(), key=lambda agent: -agent[1])


def of_tasks(found: index.Found, certified: dict[str, Any], end: str, tiers: str = "123") -> dict[str, Headroom]:
    """By name, of the tasks whose certificate is passed."""
    passed = published.passed(certified)
    made = {task.name: headroom(results["methods"], end, tiers) for task, results in found if task.name in passed}
    return {name: one for name, one in made.items() if one}


def page(found: index.Found, certified: dict[str, Any], others: Mapping[str, index.Found]) -> str:
    """docs/headroom.md; others: found under other protocols, by name."""
    head = f"""# Headroom

What is left to gain on the tasks of the suite. Made by `deconf publish` from the [records](records) alone, of the
tasks whose certificate is passed. The *ceiling* is the exact interventional policy, in its best deployment (after the
comma, if not a draw at each step): a posterior over theta, by the true dynamics. *Best* is the best method without
theta in training (its tier in brackets), chosen after the fact, task by task; *fifth* is the fifth best method, each
in its best deployment, if there are as many. What is *left* is the difference from the ceiling, over the seeds that
both have; a method's score is the ceiling's less that, so that methods of five and of ten seeds can be compared. A
task is *solved* where {NEAR:g} or less is left. A question mark says that the 95% interval of that, paired by seed,
leaves it *open*; the interval does not allow for the choice of the best among many. The ceiling is no bound:
posterior sampling is not the best use of a belief. Nor can it always be reached: exact policies read the state, of
which observations may hide a part that tells of theta ([concepts](concepts.md#exact-policies)).

The rule of this suite: where {SHARE:.0%} of its tasks are solved in the last episode without queries, it no longer
separates the best methods, and is to be made harder."""
    parts = [head, *_measured(found, certified)]
    if len(parts) > 1:
        older = any(outdated(*of) for of in (*found, *(of for more in others.values() for of in more)))
        note = " Some records are of older versions than today's; [results](results.md) says which." if older else ""
        solved = np.mean([one.solved for one in of_tasks(found, certified, "last", "12").values()])
        parts[2:2] = [(REACHED if solved >= SHARE else "That is not so yet.") + note, PICTURE]
    else:
        parts.append("No task has the records for it.")
    parts.append(deployments(found, certified))
    for name, of in others.items():
        parts += [f"## Protocol {name}", f"{PROTOCOLS[name].capitalize()}.", *_measured(of, certified)]
    return "\n\n".join(part for part in parts if part) + "\n"


def _measured(found: index.Found, certified: dict[str, Any]) -> list[str]:
    """The shares of tasks that are solved, and the table of tasks; nothing where no task has the records for it."""
    shares = {(end, tiers): of_tasks(found, certified, end, tiers) for end in ENDS for tiers in BLIND}
    if not shares["last", "12"]:
        return []
    lines = [f"- {_solved(of)} in {ENDS[end]}, {BLIND[tiers]}." for (end, tiers), of in shares.items()]
    first, last = (shares[end, "123"] for end in ENDS)
    rows = [(name, *_cells(first[name], found), *_cells(last[name], found)) for name in last]
    columns = [f"{end}: {what}" for end in ENDS for what in ("ceiling", "best", "fifth", "left")]
    return ["\n".join(lines), markdown_table(("task", *columns), rows)]


def _solved(of: dict[str, Headroom]) -> str:
    solved = [task for task in of.values() if task.solved]
    unsure = sum(not task.sure for task in of.values())
    note = f"; of {unsure} that is open" if unsure else ""
    return f"{len(solved)} of {len(of)} tasks are solved ({len(solved) / len(of):.0%}{note})"


def _cells(one: Headroom, found: index.Found) -> list[str]:
    tiers = {name: entry["tier"] for _, results in found for name, entry in results["methods"].items()}
    best = one.best[0]
    ceiling = f"{two_decimals(one.ceiling[1])}{one.ceiling[0].removeprefix(EXACT).replace('_', ', ')}"
    fifth = f"{two_decimals(one.best[-1][1])} {one.best[-1][0]}" if len(one.best) == BEST else ""
    left = ("solved" if one.solved else two_decimals(one.left)) + "?" * (not one.sure)
    return [ceiling, f"{two_decimals(best[1])} {best[0]} ({tiers[best[0]]})", fifth, left]


def _mean(runs: list[Array]) -> Array:
    """The mean over tasks of means over seeds [...], of runs of each task [..., S]."""
    return np.mean([of.mean(-1) for of in runs], 0)


def deployments(found: index.Found, certified: dict[str, Any]) -> str:
    """Its part on ways of deploying one belief: means over the tasks where all ways of a method were run."""
    passed = published.passed(certified)
    ways: dict[str, dict[str, None]] = {}
    for _, results in found:
        for name, entry in results["methods"].items():
            ways.setdefault(entry["method"], {})[name] = None
    rows = []
    for names in (of for of in ways.values() if len(of) > 1):
        having = [results["methods"] for task, results in found if task.name in passed]
        having = [methods for methods in having if set(names) <= set(methods)]
        for name in names if having else ():
            figures = []
            for measure in MEASURES:
                runs = {str(i): np.array([*index.measured(of, measure)[name].values()]) for i, of in enumerate(having)}
                figure = statistics.over_tasks(_mean, runs)
                assert figure is not None
                ends = interval([float(end) for end in figure.interval]) if figure.interval else "one seed"
                figures.append(f"{two_decimals(float(figure.value))} ({ends})")
            rows.append((name, str(len(having)), *figures))
    if not rows:
        return ""
    text = """## Ways of deploying one belief

One training, and one belief. Under the method's own name the latent is drawn at every step; `_episode`: once an
episode, from the belief at its start; `_mode`: the likeliest value; `_mean`: the belief's mean. Where theta is
categorical, the `_mean` of the exact policy is its mode, and that of a learned agent are the probabilities. The mean of
a Gaussian belief is its mode, so that it has no `_mean`. Means over the tasks where all of a method's ways were run,
with 95% intervals of a stratified bootstrap."""
    return "\n\n".join([text, markdown_table(("agent", "tasks", *MEASURES), rows)])


Points = Sequence[tuple[str, dict[str, tuple[float, list[float]]]]]
"""Of each task, by episode of ENDS: the ceiling and the best scores."""


def points(found: index.Found, certified: dict[str, Any]) -> Points:
    """What the picture shows; tasks with most left in the first episode at the top."""
    ends = {end: of_tasks(found, certified, end) for end in ENDS}
    names = sorted(ends["first"], key=lambda name: -ends["first"][name].left)
    return [(name, {end: _scores(of[name]) for end, of in ends.items()}) for name in names]


def _scores(one: Headroom) -> tuple[float, list[float]]:
    return one.ceiling[1], [score for _, score in one.best]


def picture(made: Points, file: Path, mark: str = "") -> None:
    """A row a task, a panel an episode: the ceiling, the zone where it is solved, and the five best methods."""
    size, blue, green = (9, 1.2 + 0.3 * len(made)), "tab:blue", "#2ca02c"
    with panels(file, 1, len(ENDS), size=size, mark=mark, sharex=True, sharey=True) as [row]:
        for panel, (end, said) in zip(row, ENDS.items(), strict=True):
            for y, (_, by_end) in enumerate(made):
                ceiling, (first, *others) = by_end[end]
                labels = (None,) * 3 if y else ("ceiling: exact", "next four", "best theta-blind")
                panel.barh(y, 2 * NEAR, left=ceiling - NEAR, height=0.8, color=green, alpha=0.18)
                panel.vlines(ceiling, y - 0.4, y + 0.4, color=green, lw=2, label=labels[0])
                panel.hlines(y, min(others, default=first), first, color=blue, lw=1.2)
                panel.plot(others, [y] * len(others), "o", ms=3.5, mfc="w", color=blue, label=labels[1])
                panel.plot(first, y, "o", ms=6, color=blue, label=labels[2])
            panel.set(title=f"score in {said}", ylim=(len(made) - 0.5, -0.5))
            panel.grid(axis="x", color="0.92")
            panel.set_axisbelow(True)
        row[0].set_yticks(range(len(made)), [name for name, _ in made])
        row[0].set_xlim(left=0.3)  # of both, when all has been drawn
        handles = row[0].get_legend_handles_labels()
        row[0].figure.legend(*handles, loc="outside lower center", ncols=3, frameon=False, fontsize=8)
