"""docs/protocols.md: the scores of some methods under each protocol, by task, and beside those of the standard one."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from deconfounded.benchmarks.engine import protocols, published
from deconfounded.benchmarks.engine.catalogue import METHODS
from deconfounded.benchmarks.engine.protocols import COMPARED, PROTOCOLS, STANDARD
from deconfounded.benchmarks.output import index, statistics
from deconfounded.benchmarks.output.index import of_versions
from deconfounded.benchmarks.output.pictures import panels
from deconfounded.benchmarks.output.scoring import coverage, two_decimals
from deconfounded.benchmarks.studies.cards import markdown_table
from deconfounded.benchmarks.studies.headroom import ENDS
from deconfounded.benchmarks.studies.results import with_interval

SHOWN = (COMPARED[0], "deconfounded_mode", *COMPARED[1:])  # agents in the tables
INTERVALS = {"first": "ci95_first", "last": "ci95"}  # of an entry of results.json, by episode


def page(standard: index.Found, by_protocol: Mapping[str, index.Found]) -> str:
    """standard: what `results.published` gives of all tasks; by_protocol: the same under the other protocols."""
    held = coverage(5)
    head = f"""# Protocols

A protocol changes the amounts of data, the trial, or the thetas of a task, alike for all methods (`--protocol`). Made
by `deconf publish` from the [records](records) alone. Scores: 0 = random actions, 1 = the expert that sees theta; five
seeds, with intervals of a percentile bootstrap over seeds, which contain the true mean in {held:.0%} of cases, if
scores are normally distributed and the returns that have score 0 and 1 are known exactly. A method's tier is in
brackets. `deconfounded_mode` is `deconfounded`, acting on the likeliest latent. Interquartile means are over the tasks
where all agents of the table have records under both protocols (hard tasks too, if all have them there, other than in
README), and over the seeds that both have. The cell of the standard protocol is empty for a method whose records there
are of another version. The last row has the versions. [Headroom](headroom.md) says what is left to gain under each."""
    over = {name: dict(by_end) for name, by_end in points(standard, by_protocol)}
    pictures = ["![interquartile means under each protocol](protocols.png)"] * bool(over)
    parts = [_part(name, by_protocol.get(name, ()), over.get(name, {})) for name in PROTOCOLS if name != STANDARD]
    return "\n\n".join([head, *pictures, *parts]) + "\n"


def _part(protocol: str, found: index.Found, over: "Mapping[str, Sequence[Mean]]") -> str:
    """A protocol's part. over: the means, by what the episode is called; empty where no task has all of SHOWN."""
    parts = [f"## {protocol}", f"{PROTOCOLS[protocol].capitalize()}. Records: `deconf table --protocol {protocol}`."]
    for end, said in _ends(protocol).items() if found else ():
        head = (said.removeprefix("the "), *(f"{name} ({_tier(name)})" for name in SHOWN))
        rows = [(task.name, *_cells(of["methods"], end)) for task, of in found]
        if of_agents := over.get(said):
            beside = f"the same, {STANDARD}" + ", first episode" * (protocol == "once")
            over_how_many = f"interquartile mean, tasks: {of_agents[0].tasks}"
            rows.append((over_how_many, *(two_decimals(mean.value) for mean in of_agents)))
            rows.append((beside, *("" if mean.standard is None else two_decimals(mean.standard) for mean in of_agents)))
        parts.append(markdown_table(head, [*rows, ("version", *_versions(found))]))
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


def _beside(protocol: str, end: str) -> str:
    """The episode of the standard protocol that compares with an episode of another one."""
    return "first" if protocol == "once" else end


def _ends(protocol: str) -> Mapping[str, str]:
    """Episodes in which agents are scored, and what they are called."""
    return {"last": "the only episode"} if protocol == "once" else ENDS


class Mean(NamedTuple):
    """Of an agent, over so many tasks: the interquartile mean under a protocol, its interval, and that under STANDARD.

    The interval of a single run is its score. The last is None where its records are of other versions of the method.
    """

    agent: str
    tasks: int
    value: float
    interval: tuple[float, float]
    standard: float | None


def means(protocol: str, end: str, standard: index.Found, found: index.Found) -> list[Mean]:
    """Of each of SHOWN, over the tasks and seeds that have records under both; empty where no task has all of SHOWN."""
    here, there = (
        {task.name: (task, of) for task, of in made if {*SHOWN} <= {*of["methods"]}} for made in (found, standard)
    )
    names = [name for name in here if name in there]
    under = {name: index.measured(here[name][1]["methods"], end) for name in names}
    plain = {name: index.measured(there[name][1]["methods"], _beside(protocol, end)) for name in names}
    versions, before = (_versions([made[name] for name in names]) for made in (here, there))
    rows = []
    for agent, now, was in zip(SHOWN, versions, before, strict=True):
        runs, usual = statistics.matched(*({name: made[name][agent] for name in names} for made in (under, plain)))
        figure = statistics.over_tasks(statistics.iqm, runs)
        if figure is None:
            return []
        beside = statistics.iqm([*usual.values()])
        value, standing = (round(float(mean), 4) for mean in (figure.value, beside))  # the same on all machines
        low, high = (round(end.item(), 4) for end in figure.interval or (figure.value, figure.value))
        rows.append(Mean(agent, len(names), value, (low, high), standing if was == now else None))
    return rows


def _versions(found: index.Found) -> list[str]:
    """Of the records of each of SHOWN."""
    entries = [[of["methods"][name] for _, of in found if name in of["methods"]] for name in SHOWN]
    pairs = zip(SHOWN, entries, strict=True)
    return [of_versions(name.removesuffix("_mode"), {entry["version"] for entry in of}) for name, of in pairs]


Points = Sequence[tuple[str, Sequence[tuple[str, Sequence[Mean]]]]]
"""By protocol and, in it, by what the episode is called: the means of SHOWN."""


def points(standard: index.Found, by_protocol: Mapping[str, index.Found]) -> Points:
    """What the picture shows: protocols that have records of a task of all agents."""
    made = [
        (name, [(said, means(name, end, standard, found)) for end, said in _ends(name).items()])
        for name, found in by_protocol.items()
    ]
    return [(name, by_end) for name, by_end in made if by_end[0][1]]


def picture(made: Points, file: Path, mark: str = "") -> None:
    """A row a protocol, a panel an episode, a line an agent: its mean with interval, and that of the standard one."""
    size, blue = (9, 0.8 + 2.5 * len(made)), "tab:blue"
    with panels(file, len(made), len(ENDS), size=size, mark=mark, sharex=True, sharey=True) as rows:
        for row, (protocol, by_end) in zip(rows, made, strict=True):
            for panel in row[len(by_end) :]:
                panel.set_visible(False)
            for panel, (said, over) in zip(row, by_end, strict=False):
                for y, (_, _, value, interval, standard) in enumerate(over):
                    labels = (None, None) if y else (STANDARD, "under the protocol")
                    if standard is not None:
                        panel.plot([standard, value], [y, y], color=blue, lw=1, alpha=0.5)
                        panel.plot(standard, y, "o", ms=5, mfc="w", color=blue, label=labels[0])
                    panel.plot(interval, [y, y], color=blue, lw=3, alpha=0.5)
                    panel.plot(value, y, "o", ms=5, color=blue, label=labels[1])
                tasks = over[0].tasks
                panel.set_title(f"{protocol}: {said}, {tasks} task{'s' * (tasks > 1)}", fontsize=10)
                panel.grid(axis="x", color="0.92")
                panel.tick_params(labelbottom=True)
                panel.set_xlabel("interquartile mean of scores")
                panel.set_axisbelow(True)
        first = rows[0][0]
        first.set_yticks(range(len(SHOWN)), [f"{name} ({_tier(name)})" for name in SHOWN])
        first.set_ylim(len(SHOWN) - 0.5, -0.5)
        handles = first.get_legend_handles_labels()
        first.figure.legend(*handles, loc="outside lower center", ncols=2, frameon=False, fontsize=8)
