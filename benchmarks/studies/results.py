"""Results on pages: docs/results.md, and the tables of results in README, docs/speed.md, paper.md and baselines.md."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from deconfounded import envs
from deconfounded.benchmarks.engine.catalogue import DEFAULT, METHODS, REFERENCES
from deconfounded.benchmarks.engine.presets import preset
from deconfounded.benchmarks.engine.protocols import PROTOCOLS, STANDARD
from deconfounded.benchmarks.output import aggregation, index, records, scoring, statistics
from deconfounded.benchmarks.output.index import NOTE, PEER, answers, of_versions
from deconfounded.benchmarks.studies import gap
from deconfounded.benchmarks.studies.cards import DOCS, markdown_table
from deconfounded.deconf import methods as registry

SUMMARY = {
    "interventional": "exact posterior over theta from transitions alone, Eq. (5)",
    "dagger": "cloning of the expert's actions in states that the imitator visits",
    "rma": "student of a teacher that sees theta",
    "deconfounded": "the paper's Algorithms 1 and 2",
    "deconfounded_offline": "the paper's Algorithm 3: demonstrations alone",
    "naive_rnn": "behavioural cloning with an RNN",
    "naive_transformer": "behavioural cloning with a causal transformer",
    "naive_obs": "the RNN without its own past actions",
    "gail": "adversarial imitation, with recurrent PPO",
    "conditional": "exact posterior from transitions and actions, Eq. (3): what naive cloning converges to",
}  # methods in README's table, and what they are
BY_TASK = (
    *("deconfounded", "deconfounded_discrete", "deconfounded_offline", "dagger", "rma", "naive_rnn", "naive_obs"),
    *("oracle_bc", "blind_bc", "conditional", "interventional"),
)  # methods in the table of tasks of docs/results.md
AUTHORS = {
    "swapped_lander": {"oracle_bc": 235, "dagger": 235, "deconfounded": 235, "gail": 130, "naive_rnn": -20},
    "cheetah_speed": {"oracle_bc": -500, "dagger": -500, "deconfounded": -500, "gail": -1300, "naive_rnn": -900},
    "ant_goal": {"oracle_bc": -500, "dagger": -500, "deconfounded": -630, "gail": -1550, "naive_rnn": -2200},
}  # returns in the published paper's control tasks, read off its figures, so approximate
TIMED = ("bandit", "tilted_cartpole", "slippery_cartpole")  # in docs/speed.md


def published(protocol: str = STANDARD, names: Sequence[str] = envs.SUITE) -> index.Found:
    """In the registry's order, the tasks that have records in docs/, and what these come to. Reads every record."""
    return _gathered({name: records.of_task(DOCS / "records", name, protocol=protocol) for name in names})


def other_protocols() -> dict[str, index.Found]:
    """The same under each other protocol, of the tasks whose references have records; reads the files that have any."""
    files = {name: DOCS / "records" / records.place(name) for name in (*envs.SUITE, *envs.HARD)}
    names = [name for name, file in files.items() if file.exists() and records.NAME.encode() in file.read_bytes()]
    by_protocol: dict[str, index.Found] = {}
    for protocol in PROTOCOLS:
        if protocol == STANDARD:
            continue
        kept = {name: records.of_task(DOCS / "records", name, protocol=protocol) for name in names}
        # a table that is being made has the references last, which scores need
        scored = {name: of for name, of in kept.items() if {*REFERENCES} <= {record["method"] for record in of}}
        if scored:
            by_protocol[protocol] = _gathered(scored)
    return by_protocol


def _gathered(kept: Mapping[str, Sequence[records.Record]]) -> index.Found:
    """The tasks that have records, and what these come to."""
    return [(envs.get(name), aggregation.gather(of, list(METHODS))) for name, of in kept.items() if of]


def command(task: envs.Task, results: dict[str, Any], method: str = "") -> str:
    """That makes the results, or those of one method."""
    methods = [name for name in METHODS if name in results["methods"]]
    asked = " ".join(name for name in methods if name not in REFERENCES)
    named = "" if methods == list(DEFAULT) else f" --methods {asked}"
    seeds = len(results["seeds"])
    if method and method not in REFERENCES:
        seeds = len(results["methods"][method]["seeds"])
        base = results["methods"][method]["method"]
        named = f" --methods {base if base in METHODS else f'path/{base}.py:fit'}"
    chosen = "" if results["preset"] == "default" else f" --preset {results['preset']}"
    counted = "" if seeds == preset(results["preset"], task, "cpu").seeds else f" --seeds {seeds}"
    changed = f" --set {' '.join(results['set'])}" if "set" in results else ""
    changed += f" --protocol {results[records.NAME]}" if records.NAME in results else ""
    return f"python benchmarks/run.py --task {task.name}{chosen}{changed}{counted}{named}"


def section(task: envs.Task, results: dict[str, Any]) -> str:
    """A task's part of docs/results.md."""
    seeds = scoring.fewest_to_most([len(entry["seeds"]) for entry in results["methods"].values()])
    versions = ", ".join(f"{name} {results['versions'][name]}" for name in ("python", "mujoco", "torch"))
    commits = ", ".join(dict.fromkeys(map(records.short_commit, results["commits"])))
    rows = []
    for row in scoring.rows(results["methods"]):
        beyond = results["methods"][row[0]].get("score_beyond")
        rows.append((*row, scoring.two_decimals(beyond[-1]) if beyond else ""))
    parts = [
        f"## {task.name}",
        f"`{command(task, results)}`",
        f"{seeds} seeds of {results['eval_trials']:,} trials; {results['wall_s']:,.0f} s; {results['machine']};"
        f" {versions} ([records](records/{task.name}.jsonl), of {commits}).",
        markdown_table((*scoring.COLUMNS, "twice as long"), rows),
    ]
    if (DOCS / f"{task.name}.png").exists():
        parts.append(f"![score by episode]({task.name}.png)")
    if older := outdated(task, results):
        parts.append(f"Records of an older version, not yet made again: {'; '.join(older)}.")
    if (DOCS / (link := f"records/superseded/{records.place(task.name)}")).exists():
        parts.append(f"Superseded, and not to be compared with these: [the records of the versions before]({link}).")
    if (DOCS / f"{task.name}.webp").exists():
        parts.append(f"![expert, naive and deconfounded under one theta]({task.name}.webp)")
    return "\n\n".join(parts)


def outdated(task: envs.Task, results: dict[str, Any]) -> list[str]:
    """The parts of a task's results that an older version of the task or of a method made, and which version."""
    older = [f"the task v{results['task_version']} (now v{task.version})"] * (results["task_version"] != task.version)
    methods = {entry["method"]: entry["version"] for entry in results["methods"].values()}
    by_version: dict[tuple[int, int], list[str]] = {}
    for name, version in methods.items():
        if name in METHODS and version != METHODS[name].version:
            by_version.setdefault((version, METHODS[name].version), []).append(name)
    older += [f"{', '.join(names)} v{was} (now v{now})" for (was, now), names in by_version.items()]
    return older


def results_page(found: index.Found, certified: dict[str, Any]) -> str:
    """docs/results.md."""
    head = """# Results

[![all results as one page, to sort and filter](index.png)](index.html)

*[index.html](index.html), one file that works offline: every score with its interval, seeds, curves and command,
figures over tasks, clips and certificates. This page is its short form.*

Made by `deconf publish` from the [records](records) alone, each of one task, method and seed; a commit with a + had
uncommitted changes. `deconf verify slippery_cartpole deconfounded 0` runs a seed again and says whether the same bits
come out; `deconf table --list` lists what is missing or stale. What each task is, to the last noise term, is in
[tasks.md](tasks.md).

Scores: 0 = random actions, 1 = the expert that sees theta. Return and Eq. (1), the log-likelihood of the agent's own
actions under the expert that sees theta (more is better), are of the last episode; theta R2 is of a linear probe of the
belief or memory, held out. *First* and *last* are the scores of these episodes; *regret* is the expert's score less the
agent's, summed over the episodes of a trial (less is better). *Twice as long*: the last score in a trial of twice as
many episodes as in training. """
    head += scoring.INTERVALS
    parts = [
        head,
        in_short(found, certified),
        by_task(found),
        *(section(*of) for of in found),
        gap.section(gaps(found)),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def in_short(found: index.Found, certified: dict[str, Any]) -> str:
    """The part of docs/results.md that answers common questions, over the tasks whose certificate is passed."""
    lines = [f"- {answer}" for answer in answers(index.certified(found, certified))]
    return "\n".join(["## In short", "", *lines, "", NOTE]) if lines else ""


def gaps(found: index.Found) -> list[gap.Gap]:
    """Of all tasks that have the records for it."""
    return [both for task, results in found if (both := gap.gap(task, results["methods"]))]


def by_task(found: index.Found) -> str:
    """The part of docs/results.md with a row for each task: scores in the last episode, by the same seeds in a row."""
    rows = []
    for task, results in found:
        by_seed = index.last_scores(results["methods"])
        made = [name for name in BY_TASK if name in by_seed]
        matched = statistics.matched(*({"": by_seed[name]} for name in made)) if made else ()
        last = dict(zip(made, matched, strict=True))
        means = {name: scoring.two_decimals(float(of[""].mean())) for name, of in last.items() if of}
        row = (*(means.get(name, "") for name in BY_TASK),)
        seeds = min((len(scores) for of in last.values() for scores in of.values()), default=0)
        row += (str(seeds), f"{results['wall_s']:,.0f}")
        rows.append((f"[{task.name}](#{task.name})", task.tier_name, *row))
    methods = (f"{name} ({METHODS[name].tier})" for name in BY_TASK)
    table = markdown_table(("task", "tier needed", *methods, "seeds", "seconds"), rows)
    text = """Scores are of the *seeds* that all methods of a row have: which thetas seeds draw makes differences of
some hundredths, so that a task's part, of all seeds of each method, may have other figures. A *tier* is what a method
may use: 1, demonstrations; 2, also exploration that is blind to theta; 3, also an expert to query. Methods have
theirs in brackets; *tier needed* is the lowest that suffices on a task, if one does. Seconds are wall-clock time in
which jobs of the task ran, mostly two at a time (counted once) and with other work on both cores."""
    older = " Some records are of older versions than today's; each task's part says which."
    return f"## Last episode, by task\n\n{table}\n\n{text}{older * any(outdated(*of) for of in found)}"


def summary(found: index.Found, certified: dict[str, Any]) -> str:
    """README's table: some methods, over the certified tasks where all of them were run; first and last episode."""
    first, last = (index.certified(found, certified, measure) for measure in ("first", "last"))
    tasks = [task for task, of in last.items() if SUMMARY.keys() <= of.keys()]
    rows, rank = [], dict[str, float]()
    for name, what in SUMMARY.items():
        runs = ({task: np.array([*of[task][name].values()]) for task in tasks} for of in (first, last))
        figures = [index.as_json(statistics.over_tasks(statistics.iqm, of)) for of in runs]
        versions = {results["methods"][name]["version"] for task, results in found if task.name in tasks}
        link = f"[{name}](deconf/methods/{registry.METHODS[name].partition(':')[0]}.py)"
        rank[link] = figures[1]["value"] if figures[1] else 0.0
        rows.append((link, what, METHODS[name].tier, *map(with_interval, figures), of_versions(name, versions)))
    rows.sort(key=lambda row: -rank[row[0]])
    table = markdown_table(("method", "what it is", "tier", "first episode", "last episode", "version"), rows)
    return f"Interquartile means over {len(tasks)} tasks, and 95% intervals:\n\n{table}"


def controls(found: index.Found) -> str:
    """The table of docs/paper.md: the paper's control tasks, its returns beside ours."""
    methods, rows = list(AUTHORS["ant_goal"]), []
    ours = {task.name: results["methods"] for task, results in found if task.name in AUTHORS}
    for task, theirs in AUTHORS.items():
        rows.append((task, "the authors' return", *(f"{theirs[method]:,}" for method in methods)))
        entries = ours.get(task, {})
        returns = {name: np.mean(entry["return"], 0)[-1] for name, entry in entries.items()}
        scores = {name: entry["score_last"] for name, entry in entries.items()}
        for what, last in (("the return here", returns), ("the score here", scores)):
            rows.append(("", what, *(scoring.two_decimals(last[name]) if name in last else "" for name in methods)))
    return markdown_table(("task", "in the last episode", *methods), rows)


def costs(found: index.Found) -> str:
    """The table of docs/speed.md: CPU seconds a seed of each method, on some tasks."""
    by_task = {task.name: results["methods"] for task, results in found if task.name in TIMED}
    rows = []
    for method in METHODS:
        entries = [methods.get(method) for methods in by_task.values()]
        rows.append((method, *(scoring.cpu_seconds(entry) if entry else "" for entry in entries)))
    return markdown_table(("method", *by_task), rows)


def fared(found: index.Found, certified: dict[str, Any]) -> str:
    """The table of docs/baselines.md: each method over the tasks whose certificate is passed, best first."""
    scores, rows = index.certified(found, certified), list[tuple[str, ...]]()
    over = index.over_tasks(scores, list(scores))["methods"]
    for name in sorted((name for name in METHODS if name in over), key=lambda name: -over[name]["iqm"]["value"]):
        means = {task: float(np.mean([*of[name].values()])) for task, of in scores.items() if name in of}
        ends = (end(means, key=means.__getitem__) for end in (min, max))
        extremes = (f"{task}, {scoring.two_decimals(means[task])}" for task in ends)
        figures = (with_interval(over[name].get(figure)) for figure in ("iqm", "improvement"))
        rows.append((name, METHODS[name].tier, str(len(means)), *figures, *extremes))
    summary = ("interquartile mean", f"probability that {PEER} is better", "least on", "most on")
    return markdown_table(("method", "tier", "tasks", *summary), rows)


def with_interval(figure: dict[str, Any] | None) -> str:
    """Two decimals, and from where to where."""
    value, *ends = map(scoring.two_decimals, (figure["value"], *(figure["interval"] or ()))) if figure else [""]
    return f"{value} ({' to '.join(ends)})" if ends else value
