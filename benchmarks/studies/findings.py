"""What studies left in docs/, as parts of pages: of speed.json, validation.json, spectrum.json and tuning.json."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from deconfounded.benchmarks.output import score
from deconfounded.benchmarks.studies import spectra, validation
from deconfounded.benchmarks.studies.cards import DOCS, markdown_table

UNTUNED = "naive_rnn"  # tried with the others, whose first setting is kept: docs/opponents.md says why
BUDGET = 4  # settings of each opponent
NEAR = 0.01  # scores that differ by less: the cheaper setting is chosen


def rates() -> str:
    """The table of docs/speed.md: control steps a second, as `deconf performance speed` measured them."""
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


def _origins(made: list[dict[str, Any]]) -> str:
    """Where what is kept was made, and of which code, each once."""
    where = (
        f"{one['machine']}, torch {one['versions']['torch']}, of {(one['commit'] or 'unknown')[:7]}" for one in made
    )
    return "; ".join(dict.fromkeys(where))


def validated() -> str:
    """The table of docs/diagnose.md: what `deconf validate` measured where the truth is known."""
    rows = diagnosed()
    parts = [f"{validation.told(rows)} ({_origins(rows)})", validation.table(rows)]
    return "\n\n".join([*parts, "![predicted and measured gap](diagnose/validation.png)"])


def diagnosed() -> list[dict[str, Any]]:
    """A row a case that `deconf validate` diagnosed."""
    return validation.rows(DOCS / "diagnose" / "validation.json")


def noises() -> str:
    """The table of docs/spectrum.md: scores and certificates under more and less noise."""
    found = spectrum()
    points = found["points"]
    about = f"Means over {found['seeds']} seeds; {_origins(points)}."
    return "\n\n".join([spectra.foretold(points), spectra.table(points), about])


def spectrum() -> dict[str, Any]:
    """What `deconf spectrum` measured."""
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
    """The table of docs/opponents.md: what `deconf tune` tried of each opponent, and what was best."""
    found, rows = json.loads((DOCS / "tuning.json").read_bytes()), []
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
