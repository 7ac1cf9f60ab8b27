"""Methods against others, by the same seeds: differences on each task, and over tasks; as text, csv, LaTeX, pictures.

Scores are normalised by one rule (`aggregation.references`). A method is compared on the tasks where both were run.
"""

import csv
import difflib
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from deconfounded import envs
from deconfounded.benchmarks.engine.catalogue import METHODS, REFERENCES
from deconfounded.benchmarks.engine.protocols import STANDARD
from deconfounded.benchmarks.engine.published import RECORDS
from deconfounded.benchmarks.output import aggregation, records, scoring, statistics
from deconfounded.benchmarks.output.pictures import colours, panels
from deconfounded.benchmarks.output.records import Record
from deconfounded.benchmarks.output.scoring import MEASURES, measured
from deconfounded.benchmarks.output.statistics import Figure
from deconfounded.envs.streams import Array
from deconfounded.envs.support.errors import InputError
from deconfounded.envs.support.files import check_folder, write_atomically

Scores = Mapping[str, Mapping[str, Mapping[int, Array]]]
"""By method, task and seed: scores [E] of the episodes of a trial."""


def published(every: Sequence[Record], against: Sequence[str]) -> list[Record]:
    """Records that come with the package, of the same tasks and protocol: of those in `against` that no run has."""
    chosen = []
    for made in {record["task"]: record for record in every}.values():
        task, ran = made["task"], {records.named(one) for one in every if one["task"] == made["task"]}
        kept = records.of_task(RECORDS, task, protocol=made.get(records.NAME, STANDARD))
        same = [record for record in kept if aggregation.referenced(record) == aggregation.referenced(made)]
        chosen += [record for record in same if records.named(record) in {*against} - ran]
    return chosen


def outdated(every: Sequence[Record], against: Sequence[str]) -> list[str]:
    """A line for each method of which records that are compared are of another version than today's."""
    versions: dict[tuple[str, str], set[int]] = {}
    for where, made in (("given", every), ("of the package", published(every, against))):
        for record in made:
            versions.setdefault((record["method"], where), set()).add(record["method_version"])
    return [
        f"{name} is of version {' and '.join(map(str, sorted(of)))} in the records {where}; today's is {today}"
        for (name, where), of in versions.items()
        if name in METHODS and not METHODS[name].reference and of != {today := METHODS[name].version}
    ]


def _check_alike(task: str, every: Sequence[Record]) -> None:
    """Raises InputError for records of a task that were not measured alike, or of two versions of a method."""
    methods = records.grouped(every, lambda record: record["method"])
    groups: list[tuple[str, Sequence[Record], tuple[str, ...]]]
    groups = [(task, every, ("task_version", "expert", "expert_version", "eval_trials"))]
    groups += [(f"{name} on {task}", of, ("method_version",)) for name, of in methods.items()]
    for what, of, keys in groups:
        if difference := aggregation.unlike(of, keys):
            raise InputError(f"records of {what} have {difference}; such are not to be compared")


def gathered(every: Sequence[Record], against: Sequence[str]) -> dict[str, dict[str, dict[int, Array]]]:
    """Scores of all methods in records of runs, and of those in `against`: with the package where no run has them.

    Raises InputError for two records of a method, task and seed, for a method that has none, and for a task without
    records of random and expert.
    """
    scores: dict[str, dict[str, dict[int, Array]]] = {}
    protocols = list(dict.fromkeys(record.get(records.NAME, STANDARD) for record in every))
    if len(protocols) > 1:
        raise InputError(f"records of protocols {' and '.join(protocols)} are not to be compared; give --protocol")

    for task, of_task in records.grouped(every, lambda record: record["task"]).items():
        _check_alike(task, of_task)

    def add(record: Record) -> None:
        of = scores.setdefault(records.named(record), {}).setdefault(record["task"], {})
        if record["seed"] in of:
            what = f"{records.named(record)} on {record['task']} with seed {record['seed']}"
            raise InputError(f"there are two records of {what}; give one run of it")
        zero, one = aggregation.references(record, every)
        of[record["seed"]] = scoring.normalise(np.array(record["returns"][: record["episodes"]]), zero, one)

    aggregation.one_text(every)
    for name, of_method in records.grouped(every, lambda record: record["method"]).items():
        if len({record["outside"].get("method") for record in of_method}) > 1:
            raise InputError(f"records of {name} are from two versions of its file; make them again with one")
    for record in every:
        if records.named(record) not in REFERENCES:
            add(record)
    if not scores:
        raise InputError("the records given are of random and expert alone; give those of a method")
    for record in published(every, against):
        add(record)
    for name in against:
        if name in REFERENCES:
            raise InputError(f"--against {name}: scores are made by random, 0, and expert, 1; give a method")
        if name not in scores:
            tasks = dict.fromkeys(record["task"] for record in every)
            package = [records.named(one) for task in tasks for one in records.of_task(RECORDS, task)]
            methods = [each for each in dict.fromkeys([*scores, *package]) if each not in REFERENCES]
            near = difflib.get_close_matches(name, methods, 1)
            hint = f"did you mean {near[0]}? " if near else ""
            task = next((task for task in tasks if task in envs.names()), "path/file.py:Class")
            made = f"; `deconf run --task {task} --methods {name}` makes them" * (name in METHODS)
            raise InputError(
                f"--against {name}: no record is of it on these tasks; {hint}there are {', '.join(methods)}{made}"
            )
    return scores


@dataclass(frozen=True)
class Row:
    """A method on a task, or over tasks (task ""): its scores, and its differences to each of the others."""

    method: str
    task: str
    n: int  # seeds; over tasks, tasks
    score: dict[str, Figure]  # of MEASURES: the mean; over tasks the interquartile mean
    minus: dict[str, dict[str, Figure]]  # by MEASURES and the other, paired by seed
    better: dict[str, Figure]  # probability of improvement over the other in the last episode; over tasks


def at(scores: Scores, method: str, task: str, measure: str) -> dict[int, float]:
    """One of MEASURES, by seed."""
    return {seed: float(measured(values)[measure]) for seed, values in scores[method].get(task, {}).items()}


def of_tasks(scores: Scores, methods: Sequence[str], against: Sequence[str]) -> list[Row]:
    """A row of each method on each task, then those of the others there."""
    made = []
    for task in dict.fromkeys(task for name in methods for task in scores[name]):
        for name in (name for name in dict.fromkeys([*methods, *against]) if task in scores[name]):
            mean: dict[str, Figure] = {}
            minus: dict[str, dict[str, Figure]] = {measure: {} for measure in MEASURES}
            for measure in MEASURES:
                own = at(scores, name, task, measure)
                mean[measure] = Figure(np.asarray(np.mean(list(own.values()))), None, len(own))
                for other in against if name in methods else ():
                    pairs = statistics.paired(own, at(scores, other, task, measure)) if other != name else None
                    if pairs is not None:
                        minus[measure][other] = pairs
            made.append(Row(name, task, len(scores[name][task]), mean, minus, {}))
    return made


def over_tasks(scores: Scores, methods: Sequence[str], against: Sequence[str]) -> list[Row]:
    """A row of each method, over the tasks that it has; differences are over the tasks that both have."""
    made = []
    for name in dict.fromkeys([*methods, *against]):
        mean: dict[str, Figure] = {}
        minus: dict[str, dict[str, Figure]] = {measure: {} for measure in MEASURES}
        better: dict[str, Figure] = {}
        for measure in MEASURES:
            own = {task: at(scores, name, task, measure) for task in scores[name]}
            average = statistics.over_tasks(
                statistics.iqm, {task: np.array([*of.values()]) for task, of in own.items()}
            )
            assert average is not None
            mean[measure] = average
            for other in against if name in methods else ():
                theirs = {task: at(scores, other, task, measure) for task in own if task in scores[other]}
                first, second = statistics.matched(own, theirs)
                if other == name or not first:
                    continue
                minus[measure][other] = statistics.mean_difference({task: first[task] - second[task] for task in first})
                if measure == "last":
                    improvement = statistics.over_tasks(statistics.improvement, first, second)
                    assert improvement is not None
                    better[other] = improvement
        made.append(Row(name, "", len(scores[name]), mean, minus, better))
    return made


def signed(figure: Figure | None, sign: bool = True) -> str:
    """A figure with its interval, as tables show it."""
    if figure is None:
        return ""
    value = f"{np.round(figure.value, 2):{'+' if sign else ''}z.2f}"
    if figure.interval is None:
        return value
    low, high = (f"{np.round(end, 2):{'+' if sign else ''}z.2f}" for end in figure.interval)
    return f"{value} ({low} to {high})"


def tables(by_task: Sequence[Row], over: Sequence[Row], against: Sequence[str]) -> dict[str, list[list[str]]]:
    """The tables by name, of cells: a head, then rows."""
    differences = [f"{measure} - {other}" for other in against for measure in MEASURES]
    first = [["task", "method", "seeds", *MEASURES, *differences]]
    for row in by_task:
        cells = [signed(row.minus[measure].get(other)) for other in against for measure in MEASURES]
        first.append([row.task, row.method, str(row.n), *(signed(x, False) for x in row.score.values()), *cells])
    better = [f"P(better than {other})" for other in against]
    second = [["method", "tasks", *(f"IQM, {measure}" for measure in MEASURES), *differences, *better]]
    for row in over:
        cells = [signed(row.minus[measure].get(other)) for other in against for measure in MEASURES]
        cells += [signed(row.better.get(other), False) for other in against]
        second.append([row.method, str(row.n), *(signed(x, False) for x in row.score.values()), *cells])
    return {"tasks": first, "over_tasks": second}


def notes() -> str:
    """What the figures are, and what their intervals hold."""
    return (
        "Scores of the first and the last episode of a trial: 0 is random actions and 1 the expert, of the records that"
        " come with the package, or of the runs on a task that these do not have. Regret is the expert's score less the"
        " method's, summed over the episodes; less is better. Differences are paired by seed; their 95% intervals are"
        " Student's, over tasks Welch's. Over tasks they are of means, not of interquartile means."
        " IQM is the interquartile mean of all runs, in which each task counts the same; P is of the seeds that both"
        " have. Their intervals are stratified bootstraps, and of few seeds of a few tasks too narrow. The references,"
        " 0 and 1, are taken to be exact."
    )


def as_csv(table: Sequence[Sequence[str]]) -> str:
    """The cells; intervals stand in the cell of their figure."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(table)
    return text.getvalue()


def as_latex(table: Sequence[Sequence[str]], caption: str) -> str:
    """A booktabs table; it needs `\\usepackage{booktabs}`."""
    left = sum(head in ("task", "method") for head in table[0])
    lines = [f"% {caption}", f"\\begin{{tabular}}{{{'l' * left}{'r' * (len(table[0]) - left)}}}", "\\toprule"]
    before = ""
    for i, row in enumerate(table):
        cells = [_escaped(cell) for cell in row]
        if left == 2 and i:  # a task's name once
            lines += ["\\midrule"] * (before not in ("", row[0]))
            cells[0], before = "" if row[0] == before else cells[0], row[0]
        lines += [" & ".join(cells) + r" \\", *(["\\midrule"] if i == 0 else [])]
    return "\n".join([*lines, "\\bottomrule", "\\end{tabular}", ""])


def _escaped(cell: str) -> str:
    for plain, escaped in (("_", r"\_"), ("%", r"\%"), ("&", r"\&")):
        cell = cell.replace(plain, escaped)
    return re.sub(r"(?<![\w.])([+-])(?=\d)", r"$\1$", cell)


def picture(by_task: Sequence[Row], over: Sequence[Row], against: Sequence[str], file: Path) -> None:
    """Differences of the last episode by task, a panel for each other method; interquartile means; .png and .pdf."""
    hues = colours([row.method for row in over])
    own = [row for row in by_task if any(row.minus["last"].values())]
    names = list(dict.fromkeys(row.task for row in own))
    methods = list(dict.fromkeys(row.method for row in own))
    height = 1.2 + 0.28 * max(len(names) * max(len(methods), 1) ** 0.5, len(over))
    with panels(file, 1, len(against) + 1, size=(3.4 * (len(against) + 1), height), pdf=True) as [axes]:
        for panel, other in zip(axes, against, strict=False):
            for row in own:
                if (figure := row.minus["last"].get(other)) is None:
                    continue
                offset = 0.5 * ((methods.index(row.method) + 0.5) / len(methods) - 0.5)
                y, hue = names.index(row.task) + offset, hues[row.method]
                panel.plot(figure.value, y, "o", ms=4, color=hue, label=row.method)
                if figure.interval is not None:
                    panel.hlines(y, *figure.interval, color=hue)
            panel.axvline(0, color="0.6", lw=0.8)
            panel.set(title=f"last score - {other}", ylim=(len(names) - 0.5, -0.5))
            panel.set_yticks(range(len(names)), names if panel is axes[0] else [""] * len(names))
        for i, row in enumerate(over):
            figure = row.score["last"]
            axes[-1].plot(figure.value, i, "o", color=hues[row.method])
            if figure.interval is not None:
                axes[-1].hlines(i, *figure.interval, color=hues[row.method])
        axes[-1].set(title="IQM of the last score", ylim=(len(over) - 0.5, -0.5))
        axes[-1].set_yticks(range(len(over)), [row.method for row in over])


def write(scores: Scores, methods: Sequence[str], against: Sequence[str], folder: Path) -> str:
    """All tables and pictures of a comparison into a folder; returns what a terminal shows."""
    by_task, over = of_tasks(scores, methods, against), over_tasks(scores, methods, against)
    made, said = tables(by_task, over, against), notes()
    check_folder(folder)
    shown = []
    for name, table in made.items():
        write_atomically(folder / f"{name}.csv", as_csv(table))
        write_atomically(folder / f"{name}.tex", as_latex(table, said))
        dropped = [f"{measure} - {other}" for measure in ("regret", "first") for other in against]
        dropped += ["seeds", "IQM, regret", "IQM, first", "regret", "first"]
        shown.append((scoring.plain_table(table[0], table[1:]), scoring.plain_table(table[0], table[1:], dropped)))
    write_atomically(folder / "comparison.txt", "\n\n".join([*(whole for whole, _ in shown), said]) + "\n")
    picture(by_task, over, against, folder / "comparison.png")
    return "\n\n".join([*(narrow for _, narrow in shown), said, f"-> {folder}"])
