"""docs/protocols.md: the scores of some methods under each protocol, by task, and beside those of the standard one."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from deconfounded.benchmarks.engine import protocols, published
from deconfounded.benchmarks.engine.catalogue import METHODS
from deconfounded.benchmarks.engine.protocols import COMPARED, PROTOCOLS, STANDARD
from deconfounded.benchmarks.output import index, statistics
from deconfounded.benchmarks.output.scoring import two_decimals
from deconfounded.benchmarks.studies.cards import markdown_table
from deconfounded.benchmarks.studies.headroom import ENDS
from deconfounded.benchmarks.studies.results import of_versions, with_interval

SHOWN = (COMPARED[0], "deconfounded_mode", *COMPARED[1:])  # agents in the tables
INTERVALS = {"first": "ci95_first", "last": "ci95"}  # of an entry of results.json, by episode


def page(standard: index.Found, by_protocol: Mapping[str, index.Found]) -> str:
    """standard: what `results.published` gives of all tasks; by_protocol: the same under the other protocols."""
    head = """# Protocols

A protocol changes the amounts of data, the trial, or the thetas of a task, alike for all methods (`--protocol`). Made
by `deconf publish` from the [records](records) alone. Scores: 0 = random actions, 1 = the expert that sees theta; five
seeds, with 95% intervals of a percentile bootstrap over seeds. A method's tier is in brackets. `deconfounded_mode` is
`deconfounded`, acting on the likeliest latent. Interquartile means are over the tasks where all agents of the table
have records under both protocols; that of the standard one is left out where its records are of other versions of the
method. The last row has the versions. [Headroom](headroom.md) says what is left to gain under each."""
    parts = [_part(name, standard, by_protocol.get(name, ())) for name in PROTOCOLS if name != STANDARD]
    return "\n\n".join([head, *parts]) + "\n"


def _part(protocol: str, standard: index.Found, found: index.Found) -> str:
    parts = [f"## {protocol}", f"{PROTOCOLS[protocol].capitalize()}. Records: `deconf table --protocol {protocol}`."]
    ends = {"last": "the only episode"} if protocol == "once" else ENDS
    for end, said in ends.items() if found else ():
        head = (said.removeprefix("the "), *(f"{name} ({_tier(name)})" for name in SHOWN))
        rows = [(task.name, *_cells(of["methods"], end)) for task, of in found]
        beside = ("first", f"{STANDARD}, first episode") if protocol == "once" else (end, STANDARD)
        means = _means(standard, found, end, *beside)
        parts.append(markdown_table(head, [*rows, *means, ("version", *_versions(found))]))
    tasks = published.tasks(["suite", "hard"])
    unfit = {task.name: why for task in tasks if (why := protocols.why_not(protocol, task))}
    missing = [name for task in tasks if (name := task.name) not in {*unfit, *(made.name for made, _ in found)}]
    parts += [f"Not yet made: {', '.join(missing)}."] * bool(missing)
    parts += ["\n".join(f"- Not for {name}: {why}." for name, why in unfit.items())] * bool(unfit)
    return "\n\n".join(parts)


def _tier(agent: str) -> str:
    return METHODS[agent.removesuffix("_mode")].tier


def _cells(methods: dict[str, Any], end: str) -> list[str]:
    """The scores of SHOWN in an episode of ENDS, with intervals."""
    entries = (methods.get(name) for name in SHOWN)
    return [
        with_interval(entry and {"value": entry[f"score_{end}"], "interval": entry[INTERVALS[end]]})
        for entry in entries
    ]


def _means(standard: index.Found, found: index.Found, end: str, theirs: str, called: str) -> list[tuple[str, ...]]:
    """Rows of interquartile means, of found and of the standard protocol; none where no task has all of both.

    theirs: the episode of the standard protocol that is beside `end`; called: the row's name.
    """
    pairs = ((found, end), (standard, theirs))
    runs = [{task.name: index.measured(of["methods"], each) for task, of in both} for both, each in pairs]
    tasks = [task for task in runs[0] if all(set(SHOWN) <= set(of.get(task, ())) for of in runs)]
    if not tasks:
        return []
    rows, shared = [], [[(task, of) for task, of in both if task.name in tasks] for both in (found, standard)]
    versions, standard_versions = (_versions(both) for both in shared)
    for said, by_task in zip(("interquartile mean", f"the same, {called}"), runs, strict=True):
        scores = ([np.array([*by_task[task][name].values()]) for task in tasks] for name in SHOWN)
        cells = [two_decimals(float(statistics.iqm(of))) for of in scores]
        if by_task is runs[1]:
            cells = [
                cell if was == now else "" for cell, was, now in zip(cells, standard_versions, versions, strict=True)
            ]
        rows.append((said, *cells))
    return rows


def _versions(found: index.Found) -> list[str]:
    """Of the records of each of SHOWN."""
    entries = [[of["methods"][name] for _, of in found if name in of["methods"]] for name in SHOWN]
    pairs = zip(SHOWN, entries, strict=True)
    return [of_versions(name.removesuffix("_mode"), {entry["version"] for entry in of}) for name, of in pairs]
