"""What `spectrum.py` finds, drawn and as a table: scores and evidence of theta against the amount of noise."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from deconfounded.benchmarks.engine.catalogue import EXACT
from deconfounded.benchmarks.output.pictures import colour, panels
from deconfounded.benchmarks.output.score import two_decimals
from deconfounded.benchmarks.studies.cards import markdown_table, nats

LEARNED = ("deconfounded", "naive_rnn", "dagger")
KINDS = {"process": "process noise", "expert": "the expert's action noise"}

Point = dict[str, Any]
"""The task, the kind of its noise, times which factor, made where; its certificate; the last scores of each method."""


def _columns(points: list[Point]) -> list[tuple[str, str, list[Point]]]:
    """Each task and kind of noise, and its points in the order of their factors; that times 1 belongs to all kinds."""
    tasks = dict.fromkeys(point["task"] for point in points)
    found = []
    for task, kind in ((task, kind) for task in tasks for kind in KINDS):
        of = [one for one in points if one["task"] == task and (one["kind"] == kind or one["factor"] == 1)]
        found.append((task, KINDS[kind], sorted(of, key=lambda point: point["factor"])))
    return found


def foretold(points: list[Point]) -> str:
    """By how much deconfounded is ahead of naive_rnn, where the certificate is passed and where it is failed."""
    parts = []
    for verdict in ("passed", "failed"):
        of = [point["scores"] for point in points if point["certificate"]["verdict"] == verdict]
        ahead = [np.mean(scores["deconfounded"]) - np.mean(scores["naive_rnn"]) for scores in of]
        ends = " to ".join(two_decimals(end(ahead)) for end in (min, max)) if ahead else "(none)"
        parts.append(f"where it is {verdict}, on {len(ahead)}, by {ends}")
    return f"The certificate said so beforehand: {'; '.join(parts)} is `deconfounded` ahead of `naive_rnn`."


def table(points: list[Point]) -> str:
    """A row for each point of each column, in markdown."""
    rows = [
        (
            *(task, kind, f"{point['factor']:g}", *nats(point["certificate"]), point["certificate"]["verdict"]),
            *(two_decimals(np.mean(point["scores"][method])) for method in (*EXACT, *LEARNED)),
        )
        for task, kind, of in _columns(points)
        for point in of
    ]
    told = ("dynamics, nats a step", "actions, nats a step", "certificate")
    return markdown_table(("task", "noise", "times", *told, *EXACT, *LEARNED), rows)


def picture(points: list[Point], file: Path, mark: str = "") -> None:
    """A column for each task and kind of noise: scores above, evidence below."""
    columns = _columns(points)
    shared: dict[str, Any] = {"sharex": True, "sharey": "row", "height_ratios": (3, 2)}
    with panels(file, 2, len(columns), size=(4.1 * len(columns), 6.2), dpi=100, mark=mark, **shared) as grid:
        for (task, kind, of), (above, below) in zip(columns, grid.T, strict=True):
            factors = [point["factor"] for point in of]
            for method in (*EXACT, *LEARNED):
                scores = [np.array(point["scores"][method]) for point in of]
                hue, style = colour(method), "--" if method in EXACT else "o-"
                above.plot(factors, [x.mean() for x in scores], style, color=hue, label=method)
                above.vlines(factors, [x.min() for x in scores], [x.max() for x in scores], color=hue, alpha=0.4)
            for point in of:
                hue = "tab:green" if point["certificate"]["verdict"] == "passed" else "0.5"
                above.axvspan(point["factor"] / 1.2, point["factor"] * 1.2, color=hue, alpha=0.09, lw=0)
            for source, hue in (("dynamics", "tab:green"), ("actions", "tab:red")):
                evidence = [point["certificate"]["evidence_nats_per_step"][source] for point in of]
                below.plot(factors, evidence, "s-", color=hue, label=f"of {source}")
            above.set(title=f"{task}\n{kind}", xscale="log")
            below.set(yscale="log", xlabel="times that of the suite")
            below.set_xticks(factors, [f"{factor:g}" for factor in factors])
            below.minorticks_off()
        grid[0, 0].set(ylabel="score, last episode", ylim=(0, None))
        grid[1, 0].set_ylabel("evidence of theta, nats a step")
        grid[0, 0].legend(frameon=False, fontsize=8)
        grid[1, 0].legend(frameon=False, fontsize=8)
