"""docs/protocols.md: the scores of some methods under each protocol, by task, and beside those of the standard one."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from deconfounded import envs
from deconfounded.benchmarks.engine import protocols
from deconfounded.benchmarks.engine.catalogue import METHODS
from deconfounded.benchmarks.engine.protocols import PROTOCOLS, STANDARD
from deconfounded.benchmarks.output import index, scoring, statistics
from deconfounded.benchmarks.output.scoring import two_decimals
from deconfounded.benchmarks.studies.cards import markdown_table
from deconfounded.benchmarks.studies.headroom import ENDS

SHOWN = (
    *("deconfounded", "deconfounded_mode", "deconfounded_offline", "dagger", "rma", "naive_rnn", "oracle_bc"),
    *("conditional", "interventional"),
)  # agents in the tables
EVERY = (*envs.SUITE, *envs.HARD)
INTERVALS = {"first": "ci95_first", "last": "ci95"}  # of an entry of results.json, by episode


def page(standard: index.Found, others: Mapping[str, index.Found]) -> str:
    """standard: what `results.published` gives of all tasks; others: found under other protocols, by name."""
    head = """# Protocols

A protocol changes the amounts of data, the trial, or the thetas of a task, alike for all methods (`--protocol`). Made
by `deconf publish` from the [records](records) alone. Scores: 0 = random actions, 1 = the expert that sees theta; five
seeds, with 95% intervals of a percentile bootstrap over seeds. A method's tier is in brackets. `deconfounded_mode` is
`deconfounded`, acting on the likeliest latent. The last two rows are interquartile means over the tasks where all
agents of the table have records under both protocols. [Headroom](headroom.md) says what is left to gain under each."""
    parts = [_part(name, standard, others.get(name, ())) for name in PROTOCOLS if name != STANDARD]
    return "\n\n".join([head, *parts]) + "\n"


def _part(protocol: str, standard: index.Found, found: index.Found) -> str:
    parts = [f"## {protocol}", f"{PROTOCOLS[protocol].capitalize()}. Records: `deconf table --protocol {protocol}`."]
    ends = {"last": "the only episode"} if protocol == "once" else ENDS
    for end, said in ends.items() if found else ():
        head = (said.removeprefix("the "), *(f"{name} ({_tier(name)})" for name in SHOWN))
        rows = [(task.name, *_cells(of["methods"], end)) for task, of in found]
        parts.append(markdown_table(head, [*rows, *_means(standard, found, end)]))
    there = {task.name for task, _ in found}
    unfit = {name: why for name in EVERY if (why := protocols.why_not(protocol, envs.get(name)))}
    missing = [name for name in EVERY if name not in there and name not in unfit]
    parts += [f"Not yet made: {', '.join(missing)}."] * bool(missing)
    parts += ["\n".join(f"- Not for {name}: {why}." for name, why in unfit.items())] * bool(unfit)
    return "\n\n".join(parts)


def _tier(agent: str) -> str:
    return METHODS[agent.removesuffix("_mode")].tier


def _cells(methods: dict[str, Any], end: str) -> list[str]:
    """The scores of SHOWN in an episode of ENDS, with intervals."""
    cells = []
    for entry in map(methods.get, SHOWN):
        ends = f" ({scoring.interval(entry[INTERVALS[end]])})" if entry else ""
        cells.append(two_decimals(entry[f"score_{end}"]) + ends if entry else "")
    return cells


def _means(standard: index.Found, found: index.Found, end: str) -> list[tuple[str, ...]]:
    """Rows of interquartile means, of found and of the standard protocol; none where no task has all of both."""
    runs = [{task.name: index.measured(of["methods"], end) for task, of in both} for both in (found, standard)]
    tasks = [task for task in runs[0] if all(set(SHOWN) <= set(of.get(task, ())) for of in runs)]
    rows = []
    for said, by_task in zip(("interquartile mean", f"the same, {STANDARD}"), runs, strict=True):
        values = [{task: np.array([*by_task[task][name].values()]) for task in tasks} for name in SHOWN]
        figures = [statistics.over_tasks(statistics.iqm, of) for of in values if tasks]
        rows.append((said, *(two_decimals(float(figure.value)) for figure in figures if figure)))
    return rows if tasks else []
