"""What docs/ and README show of tasks, certificates and results: `deconf pages`

Writes docs/tasks.md (the card of every task, read off its class and its certificate), docs/results.md and
docs/index.html (of the records that `publish.py` kept), the tables in README, docs/paper.md and docs/speed.md, and
those in docs/diagnose.md (of what `validate.py` kept), docs/opponents.md (of the records, and what `tune.py` kept) and
docs/spectrum.md (of spectrum.json, which is `spectrum.py`'s).
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from deconfounded import envs
from deconfounded.benchmarks.engine import sources
from deconfounded.benchmarks.engine.catalogue import DEFAULT, METHODS, REFERENCES
from deconfounded.benchmarks.engine.presets import preset
from deconfounded.benchmarks.output import index, records, score
from deconfounded.benchmarks.output.answers import NOTE, PEER, answers
from deconfounded.benchmarks.output.pictures import mark, mark_of
from deconfounded.benchmarks.studies import cards, gap, spectra
from deconfounded.benchmarks.studies import validation as validated
from deconfounded.benchmarks.studies.cards import DOCS, TIERS, kept, markdown_table, nats
from deconfounded.envs.support.files import write_atomically

README = DOCS.parent / "README.md"
SUMMARY = (
    *("deconfounded", "deconfounded_discrete", "deconfounded_offline", "dagger", "rma", "naive_rnn", "naive_obs"),
    *("oracle_bc", "blind_bc", "conditional", "interventional"),
)  # methods in README's table
AUTHORS = {
    "swapped_lander": {"oracle_bc": 235, "dagger": 235, "deconfounded": 235, "gail": 130, "naive_rnn": -20},
    "cheetah_speed": {"oracle_bc": -500, "dagger": -500, "deconfounded": -500, "gail": -1300, "naive_rnn": -900},
    "ant_goal": {"oracle_bc": -500, "dagger": -500, "deconfounded": -630, "gail": -1550, "naive_rnn": -2200},
}  # returns in the published paper's control tasks, read off its figures, so approximate
UNTUNED = "naive_rnn"  # tried with the others, whose first setting is kept: docs/opponents.md says why
BUDGET = 4  # settings of each opponent
NEAR = 0.01  # scores that differ by less: the cheaper setting is chosen
NOT_RUN = "It has not been run yet with today's code."


def _certified() -> dict[str, dict[str, Any]]:
    """In the registry's order, the tasks that have a certificate in docs/, and what it holds."""
    return {name: found for name in envs.SUITE if (found := kept(DOCS / "certificates", name))}


def published() -> index.Found:
    """In the registry's order, the tasks that have records in docs/, and what these come to. Reads every record."""
    found = []
    for name in envs.SUITE:
        task = envs.get(name)
        if of_task := records.of_task(DOCS / "records", name):
            found.append((task, records.gather(of_task, list(METHODS))))
    return found


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
    return f"python benchmarks/run.py --task {task.name}{chosen}{changed}{counted}{named}"


def section(task: envs.Task, results: dict[str, Any]) -> str:
    """A task's part of docs/results.md."""
    seeds = score.fewest_to_most([len(entry["seeds"]) for entry in results["methods"].values()])
    versions = ", ".join(f"{name} {results['versions'][name]}" for name in ("python", "mujoco", "torch"))
    commits = ", ".join(dict.fromkeys(one[:7] for one in results["commits"]))
    rows = []
    for row in score.rows(results["methods"]):
        beyond = results["methods"][row[0]].get("score_beyond")
        rows.append((*row, score.two_decimals(beyond[-1]) if beyond else ""))
    parts = [
        f"## {task.name}",
        f"`{command(task, results)}`",
        f"{seeds} seeds of {results['eval_trials']:,} trials; {results['wall_s']:,.0f} s; {results['machine']};"
        f" {versions} ([records](records/{task.name}.jsonl), of {commits}).",
        markdown_table((*score.COLUMNS, "after as many again"), rows),
        f"![score by episode]({task.name}.png)",
    ]
    if older := outdated(task, results):
        parts.append(f"Of an older version, and not yet made again: {', '.join(older)}.")
    if (DOCS / "records" / "superseded" / records.place(task.name)).exists():
        link = f"records/superseded/{records.place(task.name)}"
        parts.append(f"Superseded, and not to be compared: [the records of earlier versions]({link}).")
    if (DOCS / f"{task.name}.webp").exists():
        parts.append(f"![expert, naive and deconfounded under one theta]({task.name}.webp)")
    return "\n\n".join(parts)


def outdated(task: envs.Task, results: dict[str, Any]) -> list[str]:
    """What of a task's results is of an older version than today's of the task or a method, and of which."""
    older = [f"the task, v{results['task_version']} of v{task.version}"] * (results["task_version"] != task.version)
    for name, entry in results["methods"].items():
        method = METHODS.get(entry["method"])
        if method is not None and entry["version"] != method.version:
            older.append(f"{name}, v{entry['version']} of v{method.version}")
    return older


def results_page(found: index.Found, certified: dict[str, Any]) -> str:
    """docs/results.md."""
    head = """# Results

Made by `deconf pages` from the [records](records) alone, one a seed. Scores: 0 = random actions, 1 = the
expert that sees theta. Return and Eq. (1), the log-likelihood of the agent's own actions under the expert that sees
theta (more is better), are of the last episode; theta R2 is of a linear probe of the belief or memory, held out.
Intervals are 95% bootstrap intervals over seeds, too narrow of few: if scores are normal, one of five seeds holds the
mean five times in six, one of ten nine times in ten. *After as many again*: the last score in a trial twice as long as
those of training."""
    parts = [head, in_short(found, certified), *(section(*one) for one in found), gap.section(_gaps(found))]
    return "\n\n".join(part for part in parts if part) + "\n"


def in_short(found: index.Found, certified: dict[str, Any]) -> str:
    """The part of docs/results.md that answers what is asked first, over the tasks whose certificate is passed."""
    told = [f"- {answer}" for answer in answers(index.certified(found, certified))]
    return "\n".join(["## In short", "", *told, "", NOTE]) if told else ""


def _gaps(found: index.Found) -> list[gap.Gap]:
    """Of all tasks that have the records for it."""
    return [one for task, results in found if (one := gap.gap(task, results["methods"]))]


def summary(found: index.Found) -> str:
    """README's table: scores in the last episode."""
    rows, column = [], score.COLUMNS.index("last")
    for task, results in found:
        last = {row[0]: row[column] for row in score.rows(results["methods"])}
        tier = "none" if task.tier is None else str(task.tier)
        rows.append((task.name, tier, *(last.get(name, "") for name in SUMMARY), f"{results['wall_s']:,.0f}"))
    methods = (f"{name} ({METHODS[name].tier})" for name in SUMMARY)
    return markdown_table(("task", "tier", *methods, "seconds"), rows)


def controls(found: index.Found) -> str:
    """The table of docs/paper.md: the paper's control tasks, its returns beside ours."""
    methods, rows = list(AUTHORS["ant_goal"]), []
    ours = {task.name: results["methods"] for task, results in found if task.name in AUTHORS}
    for task, theirs in AUTHORS.items():
        rows.append((task, "the authors' return", *(f"{theirs[method]:,}" for method in methods)))
        last = {
            method: (np.mean(entry["return"], 0)[-1], entry["score_last"])
            for method, entry in ours.get(task, {}).items()
        }
        for i, what in enumerate(("the return here", "the score here")):
            rows.append(("", what, *(score.two_decimals(last[name][i]) if name in last else "" for name in methods)))
    return markdown_table(("task", "in the last episode", *methods), rows)


def certificates(certified: dict[str, Any]) -> str:
    """README's table of certificates."""
    rows, asked = [], list[str]()
    for name, found in certified.items():
        measured = (f"{check['measured']:.2f}" for check in found["checks"].values())
        rows.append((name, *measured, *nats(found), found["verdict"]))
        asked = [f"{name} ({check['required']})" for name, check in found["checks"].items()]
    return markdown_table(("task", *asked, "dynamics, nats a step", "actions, nats a step", "verdict"), rows)


TIMED = ("bandit", "tilted_cartpole", "slippery_cartpole")


def costs(found: index.Found) -> str:
    """The table of docs/speed.md: CPU seconds a seed of each method, on some tasks."""
    by_task = {task.name: results["methods"] for task, results in found if task.name in TIMED}
    rows = []
    for method in METHODS:
        seconds = [methods.get(method, {}).get("cpu_s") for methods in by_task.values()]
        rows.append((method, *("" if one is None else f"{one:,.1f}" for one in seconds)))
    return markdown_table(("method", *by_task), rows)


def rates() -> str:
    """The table of docs/speed.md: control steps a second, of what `speed.py` kept."""
    shown, grown = ("64", "256", "4096"), ("256", "4096")
    rows = []
    for name, by_size in json.loads((DOCS / "speed" / "speed.json").read_bytes())["tasks"].items():
        few, many = (by_size[n]["closed_loop"] for n in grown)
        rows.append(
            (
                name,
                *(f"{by_size[n]['closed_loop']:,.0f}" for n in shown),
                *(score.two_decimals(by_size[n]["closed_loop"] / by_size[n]["open_loop"]) for n in shown),
                *(f"{by_size[shown[0]][way]:,.0f}" for way in ("mj_step", "sync_vector_env")),
                score.two_decimals(few / many),
                f"{by_size[grown[1]]['kib']:.0f}",
            )
        )
    loops = (*(f"closed loop, {n}" for n in shown), *(f"of open loop, {n}" for n in shown))
    told = ("mj_step x threads", f"SyncVectorEnv, {shown[0]}", "a step, {1} / {0}".format(*grown), "KiB each")
    return markdown_table(("task", *loops, *told), rows)


def fared(found: index.Found, certified: dict[str, Any]) -> str:
    """The table of docs/opponents.md: each method over the tasks whose certificate is passed, best first."""
    scores, rows = index.certified(found, certified), list[tuple[str, ...]]()
    over = index.over_tasks(scores, list(scores))["methods"]
    for name in sorted(set(METHODS) & set(over), key=lambda name: -over[name]["iqm"]["value"]):
        means = {task: float(np.mean([*of[name].values()])) for task, of in scores.items() if name in of}
        ends = (
            f"{task}, {score.two_decimals(means[task])}"
            for task in (end(means, key=means.__getitem__) for end in (min, max))
        )
        figures = (_with_interval(over[name].get(figure)) for figure in ("iqm", "improvement"))
        rows.append((name, METHODS[name].tier, str(len(means)), *figures, *ends))
    told = ("interquartile mean", f"probability that {PEER} is better", "least on", "most on")
    return markdown_table(("method", "tier", "tasks", *told), rows)


def _with_interval(figure: dict[str, Any] | None) -> str:
    """Two decimals, and from where to where."""
    value, *ends = map(score.two_decimals, (figure["value"], *(figure["interval"] or ()))) if figure else [""]
    return f"{value} ({' to '.join(ends)})" if ends else value


def _origin(found: dict[str, Any]) -> str:
    """Where what is kept was made, and of which code."""
    return f"{found['machine']}, torch {found['versions']['torch']}, of {(found['commit'] or 'unknown')[:7]}"


def _origins(found: list[dict[str, Any]]) -> str:
    """Each once."""
    return "; ".join(dict.fromkeys(map(_origin, found)))


def validation() -> str:
    """The table of docs/diagnose.md: what `validate.py` found where the truth is known."""
    rows = _validated()
    parts = [f"{validated.told(rows)} ({_origins(rows)})", validated.table(rows)]
    return "\n\n".join([*parts, "![predicted and measured gap](diagnose/validation.png)"]) if rows else NOT_RUN


def _validated() -> list[dict[str, Any]]:
    return validated.rows(DOCS / "diagnose" / "validation.json")


def noises() -> str:
    """The table of docs/spectrum.md: scores and certificates under more and less noise."""
    found = _spectrum()
    points = found["points"]
    about = f"Means over {found['seeds']} seeds; {_origins(points)}."
    return "\n\n".join([spectra.foretold(points), spectra.table(points), about])


def _spectrum() -> dict[str, Any]:
    """What `spectrum.py` found."""
    found: dict[str, Any] = json.loads((DOCS / "spectrum.json").read_bytes())
    return found


def chosen(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Of the settings of a method: the cheapest of those that score best over the tasks."""
    if rows[0]["method"] == UNTUNED:
        return rows[0]
    means = [np.mean([np.mean(scores) for scores in row["scores"].values()]) for row in rows]
    near = [row for row, mean in zip(rows, means, strict=True) if mean >= max(means) - NEAR]
    return min(near, key=lambda row: sum(row["cpu_s"].values()))


def tuning() -> str:
    """The table of docs/opponents.md: what `tune.py` tried of each opponent, and what was best."""
    if not (file := DOCS / "tuning.json").is_file():
        return NOT_RUN
    found, rows = json.loads(file.read_bytes()), []
    tasks = list(found["rows"][0]["scores"])
    for method in dict.fromkeys(row["method"] for row in found["rows"]):
        of = [row for row in found["rows"] if row["method"] == method]
        best = chosen(of) if len(of) == BUDGET else None
        for row in of:
            scores = [score.two_decimals(np.mean(row["scores"][task])) for task in tasks]
            cpu = [f"{row['cpu_s'][task]:.0f}" for task in tasks]
            word = "" if row is not best else "kept" if method == UNTUNED else "chosen"
            rows.append((method, row["setting"], *scores, *cpu, word))
    head = ("method", "setting", *tasks, *(f"{task}, CPU s a seed" for task in tasks), "")
    return f"{markdown_table(head, rows)}\n\n{_origins(found['rows'])}."


def _filled(file: Path, **tables: str) -> str:
    """The page with each table between `<!-- its name -->` and `<!-- /its name -->`."""
    text = file.read_text("utf-8")
    for name, table in tables.items():
        marks = [f"<!-- {slash}{name} -->" for slash in ("", "/")]
        if [text.count(mark) for mark in marks] != [1, 1]:
            raise envs.InputError(f"{file.name} lacks its marks {' and '.join(marks)}, each once; put them back")
        before, rest = text.split(marks[0])
        text = "\n".join([before + marks[0], table, marks[1] + rest.split(marks[1])[1]])
    return text


def check_certificate(file: Path, task: envs.Task) -> None:
    """Raises InputError for a file that is no certificate of the task, as pages show it."""
    try:
        found = json.loads(file.read_bytes())
        numbers = [check["measured"] for check in found["checks"].values()] + found["conditional"]["score"]
        numbers += [found["evidence_nats_per_step"][kind] for kind in ("dynamics", "actions")]
        whole = np.isfinite(np.array(numbers, float)).all() and found["verdict"] in ("passed", "failed")
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        whole = False
    if not whole or (found["task"], found["task_version"]) != (task.name, task.version):
        raise envs.InputError(f"{file} is no certificate of {task.name} v{task.version}; run certify.py again")


def texts(found: index.Found) -> dict[Path, str]:
    """By its file, what each page is to say. found: what `published` gives."""
    certified = _certified()
    tiers = {"none" if tier is None else str(tier): text.partition(": ")[2] for tier, text in TIERS.items()}
    return {
        DOCS / "index.html": index.page(DOCS, found, certified, command, tiers),
        DOCS / "tasks.md": cards.tasks_page(),
        DOCS / "results.md": results_page(found, certified),
        DOCS / "diagnose.md": _filled(DOCS / "diagnose.md", validation=validation()),
        DOCS / "opponents.md": _filled(DOCS / "opponents.md", fared=fared(found, certified), tuning=tuning()),
        DOCS / "spectrum.md": _filled(DOCS / "spectrum.md", noises=noises()),
        DOCS / "speed.md": _filled(DOCS / "speed.md", costs=costs(found), rates=rates()),
        DOCS / "paper.md": _filled(DOCS / "paper.md", controls=controls(found)),
        README: _filled(README, summary=summary(found), certificates=certificates(certified)),
    }


def write() -> str:
    """Bring all of them up to date, and their pictures; what has not changed is not written.

    Returns README's table of results.
    """
    found = published()
    for file, text in texts(found).items():
        if file.read_text(encoding="utf-8") != text:
            write_atomically(file, text)
    redraw(DOCS / "gap.png", gap.picture, [(one.task.name, *one[1:]) for one in _gaps(found)])
    redraw(DOCS / "diagnose" / "validation.png", validated.picture, _validated())
    redraw(DOCS / "spectrum.png", spectra.picture, _spectrum()["points"])
    return summary(found)


def redraw(file: Path, draw: Callable[..., None], data: Any) -> None:
    """Draw a picture of data (json) again, if these or the module that draws it have changed since it was drawn."""
    made_of = mark(data, sources.of_code(draw))
    if mark_of(file) != made_of:
        draw(data, file, mark=made_of)
