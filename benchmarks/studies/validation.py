"""What `validate.py` found where the truth is known: in a sentence, as a table and as a picture."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from scipy import stats

from deconfounded.benchmarks.output.score import two_decimals
from deconfounded.benchmarks.studies import gap, noise
from deconfounded.benchmarks.studies.cards import markdown_table

FIGURES = ("memory", "explained", "explored", "shown", "ratio", "stakes", "strayed", "unlike")  # of its columns


def rows(file: Path) -> list[dict[str, Any]]:
    """One a case; none if none was diagnosed yet."""
    found: list[dict[str, Any]] = json.loads(file.read_bytes()) if file.is_file() else []
    return found


def _unseen(row: dict[str, Any]) -> bool:
    """Whether the thresholds were set without looking at it."""
    return hasattr(noise, row["case"])


def told(rows: list[dict[str, Any]]) -> str:
    """How many are right, and Spearman's correlation of the predicted and the measured gap."""
    sentences = []
    for what, unseen in (("that thresholds were set by", False), ("not looked at then", True)):
        of = [row for row in rows if _unseen(row) is unseen]
        if len(of) > 2:
            share = f"{sum(row['right'] for row in of)} of {len(of)} verdicts are right"
            rank = stats.spearmanr([row["predicted"] for row in of], [row["measured"] for row in of]).statistic
            sentences.append(
                f"Of cases {what}, {share}; predicted and measured gaps rank alike by {two_decimals(rank)}."
            )
    return " ".join(sentences)


def table(rows: list[dict[str, Any]]) -> str:
    """A row a case."""
    lines = []
    for row in rows:
        verdict = row["verdict"] + (f", Tier {row['tier']}" if row["verdict"] == "confounded" and row["tier"] else "")
        figures = (row["found"][key]["value"] if key in row["found"] else None for key in FIGURES)
        cells = ("" if value is None else two_decimals(value) for value in (*figures, row["predicted"]))
        certified, judged = "passed" if row["certified"] else "failed", "" if row["right"] else "wrong"
        lines.append((row["task"], certified, verdict, judged, *cells, two_decimals(row["measured"])))
    return markdown_table(("task", "certificate", "diagnosis", "", *FIGURES, "predicted gap", "measured"), lines)


def picture(rows: list[dict[str, Any]], file: Path, mark: str = "") -> None:
    """A dot a case: red where the certificate is passed, hollow where the thresholds were set without it."""
    names = [row["task"].replace("_process_", " x").replace("x0_", "x.").replace("0_", ".") for row in rows]
    points = [(name, row["predicted"], row["measured"]) for name, row in zip(names, rows, strict=True)]
    hues = ["tab:red" if row["certified"] else "tab:green" for row in rows]
    gap.picture(points, file, "the diagnosis", hues, [_unseen(row) for row in rows], mark)
