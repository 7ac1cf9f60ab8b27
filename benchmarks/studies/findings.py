"""What studies left in docs/, as parts of pages: of speed.json, validation.json, spectrum.json and others."""

from typing import Any

import numpy as np

from deconfounded.benchmarks.output import records, scoring
from deconfounded.benchmarks.studies import exploration, particles, spectrum, validate
from deconfounded.benchmarks.studies.cards import kept, markdown_table
from deconfounded.benchmarks.studies.foreign import report

UNTUNED = "naive_rnn"  # tried with the others, whose first setting is kept: docs/baselines.md says why
BUDGET = 4  # settings of each baseline
NEAR = 0.01  # scores that differ by less: the cheaper setting is chosen


def rates() -> str:
    """The table of docs/speed.md: control steps a second, as `deconf performance speed` measured them."""
    sizes = ("64", "256", "4096")
    rows = []
    for name, by_size in kept("speed/speed")["tasks"].items():
        few, middle, many = (by_size[n] for n in sizes)
        closed = (f"{by_size[n]['closed_loop']:,.0f}" for n in sizes)
        shares = (scoring.two_decimals(by_size[n]["closed_loop"] / by_size[n]["open_loop"]) for n in sizes)
        peers = (f"{few[way]:,.0f}" for way in ("mj_step", "sync_vector_env"))
        slowdown = scoring.two_decimals(middle["closed_loop"] / many["closed_loop"])
        rows.append((name, *closed, *shares, *peers, slowdown, f"{many['kib']:.0f}"))
    loops = [f"{what} loop, {n}" for what in ("closed", "of open") for n in sizes]
    others = ("mj_step x threads", "SyncVectorEnv, 64", "a step, 4096 / 256", "KiB each")
    return markdown_table(("task", *loops, *others), rows)


def beliefs() -> str:
    """The table of docs/concepts.md: what `deconf performance particles` measured."""
    rows = kept("speed/particles")["rows"]
    return f"{particles.table(rows)}\n\n{_origins(rows)}."


def _origins(made: list[dict[str, Any]]) -> str:
    """Where what is kept was made, and of which commits, each once."""
    commits: dict[str, list[str]] = {}
    for row in made:
        commits.setdefault(f"{row['machine']}, torch {row['versions']['torch']}", []).append(row["commit"])
    return "; ".join(
        f"{where}, of {', '.join(dict.fromkeys(map(records.short_commit, of)))}" for where, of in commits.items()
    )


def _outdated(rows: list[dict[str, Any]]) -> str:
    """Which verdicts are of earlier versions of the diagnosis, as a sentence after another."""
    from deconfounded.deconf.diagnosis.diagnose import VERSION  # torch takes seconds

    judged = [row for row in rows if "verdict" in row]
    old = [row["case"] for row in judged if row.get("diagnosis") != VERSION]
    if not old:
        return ""
    numbers = sorted({row.get("diagnosis", 0) for row in judged} - {VERSION})
    versions = ", ".join(str(number) if number else "unknown" for number in numbers)
    which = "all" if len(old) == len(judged) else ", ".join(old)
    return f" Verdicts of earlier versions of the diagnosis ({versions}; today's is {VERSION}): {which}."


def validated() -> str:
    """The table of docs/diagnose_accuracy.md: what `deconf validate` measured where the truth is known."""
    rows = kept(validate.KEPT)
    parts = [f"{validate.summary(rows)}{_outdated(rows)} ({_origins(rows)})", validate.table(rows)]
    return "\n\n".join([*parts, "![predicted and measured gap](diagnose/validation.png)"])


def foreign() -> str:
    """The second table of docs/diagnose_accuracy.md: what `deconf foreign` measured on simulators of others."""
    rows = kept(report.KEPT)
    if not rows:
        return "These worlds have not been measured with the present versions of methods and diagnosis."
    return f"{report.summary(rows)}{_outdated(rows)} ({_origins(rows)})\n\n{report.table(rows)}".lstrip()


def right() -> str:
    """The sentence of docs/diagnose.md on how often verdicts are right, of the cases of both tables."""
    own = [(row["right"] is True, validate.unseen(row)) for row in kept(validate.KEPT)]
    foreign = [(row["right"] is True, row["unseen"]) for row in kept(report.KEPT) if "verdict" in row]
    parts = []
    for cases, what in ((own, "cases on tasks of this suite"), (foreign, "worlds on simulators of others")):
        judged = [is_right for is_right, unseen in cases if unseen]
        shares = f"{sum(is_right for is_right, _ in cases)} of {len(cases)} {what}"
        parts.append(f"{shares} ({sum(judged)} of the {len(judged)} by which no threshold was set)")
    where = "[how often the diagnosis is right](diagnose_accuracy.md), and by which of its versions"
    return f"Verdicts are right in {' and in '.join(parts)}: {where}."


def noises() -> str:
    """The table of docs/spectrum.md: scores and certificates under more and less noise."""
    measured = kept("spectrum")
    points = measured["points"]
    about = f"Means over {measured['seeds']} seeds; {_origins(points)}."
    return "\n\n".join([spectrum.predictions(points), spectrum.table(points), about])


def explored() -> str:
    """The tables of docs/exploration.md: what less exploration costs."""
    points = kept("exploration")
    about = f"Made on {_origins(points)}."
    losses = "Loss in the last episode against all trials, the median over tasks (their number in brackets):"
    scores = "Score in the first and in the last episode, means over seeds, and explored trials of a seed in brackets:"
    parts = losses, exploration.median_losses(points), scores, exploration.table(points), about
    return "\n\n".join(parts)


def chosen(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Of the settings of a method: the cheapest of those that score best over the tasks."""
    if rows[0]["method"] == UNTUNED:
        return rows[0]
    means = [np.mean([np.mean(scores) for scores in row["scores"].values()]) for row in rows]
    near = [row for row, mean in zip(rows, means, strict=True) if mean >= max(means) - NEAR]
    return min(near, key=lambda row: sum(row["cpu_s"].values()))


def tuning() -> str:
    """The table of docs/baselines.md: what `deconf tune` tried of each baseline, and what was best."""
    tried, rows = kept("tuning")["rows"], []
    tasks = list(tried[0]["scores"])
    for method in dict.fromkeys(row["method"] for row in tried):
        of = [row for row in tried if row["method"] == method]
        best = chosen(of) if len(of) == BUDGET else None
        for row in of:
            scores = [scoring.two_decimals(np.mean(row["scores"][task])) for task in tasks]
            cpu = [f"{row['cpu_s'][task]:.0f}" for task in tasks]
            word = "" if row is not best else "kept" if method == UNTUNED else "chosen"
            rows.append((method, row["setting"], *scores, *cpu, word))
    head = ("method", "setting", *tasks, *(f"{task}, CPU s a seed" for task in tasks), "")
    return f"{markdown_table(head, rows)}\n\n{_origins(tried)}."
