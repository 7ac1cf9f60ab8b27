"""What `deconf foreign` found, in words and as a table of docs/diagnose_accuracy.md."""

from typing import Any

from deconfounded.benchmarks.output.scoring import two_decimals
from deconfounded.benchmarks.studies.cards import markdown_table
from deconfounded.benchmarks.studies.validate import rank_correlation
from deconfounded.deconf.diagnosis.verdict import with_tier

KEPT = "diagnose/foreign"
AGENTS = ("wrong theta", "blind_bc", "naive_rnn", "deconfounded", "oracle_bc", "filter")
JUDGED = {True: "right", False: "wrong", None: "cannot tell"}


def summary(rows: list[dict[str, Any]]) -> str:
    """How many verdicts are right, and Spearman's correlation of the predicted and the measured gap, of each half."""
    sentences = []
    for what, unseen in (("by which thresholds are set", False), ("by which they are judged", True)):
        of = [row for row in rows if row["unseen"] is unseen and "verdict" in row]
        if not of:
            continue
        wrong = [row for row in of if row["right"] is False]
        sure = sum(row.get("agreeing") == row["splits"] for row in wrong)
        share = f"{sum(row['right'] is True for row in of)} of {len(of)} verdicts are right, {len(wrong)} wrong"
        share += f" ({sure} of these with all splits agreeing)" * bool(wrong)
        gaps = [(row["predicted"], gap, row["right"] is not None) for row in of if (gap := measured(row)) is not None]
        sentences.append(f"Of the half {what}, {share}{rank_correlation(gaps)}.")
    if of_version := scored(rows):
        sentences.append(of_version)
    if few := [row["case"] for row in rows if row.get("splits") == 1]:
        sentences.append(f"Judged by a single split of their trials, so far: {', '.join(few)}.")
    return " ".join(sentences)


def scored(rows: list[dict[str, Any]]) -> str:
    """Which version of `deconfounded` has the scores: the latest, and where an earlier one was measured."""
    name = "deconfounded"
    versions = {
        row["case"]: row.get("method_versions", {}).get(name, 0) for row in rows if name in row.get("scores", {})
    }
    latest = max(versions.values(), default=0)
    if not latest:
        return ""
    earlier = ", ".join(case for case, version in versions.items() if version < latest)
    return f"Scores of {name} are of its version {latest}" + f"; of an earlier one: {earlier}" * bool(earlier) + "."


def measured(row: dict[str, Any]) -> float | None:
    """The gap that was measured, if it was."""
    scores = row["scores"]
    return scores["deconfounded"] - scores["naive_rnn"] if {"deconfounded", "naive_rnn"} <= scores.keys() else None


def table(rows: list[dict[str, Any]]) -> str:
    """A row a case."""
    lines = []
    for row in rows:
        cells = (two_decimals(row["scores"][name]) if name in row["scores"] else "" for name in AGENTS)
        verdict = with_tier(row.get("verdict", ""), row.get("diagnosed_tier"))
        judged = JUDGED[row["right"]] if "verdict" in row else ""
        half = "judged" if row["unseen"] else "set"
        agree = f"{row['agreeing']} of {row['splits']}" if "agreeing" in row else ""
        lines.append((row["world"], str(row["tier"]), half, *cells, verdict, agree, judged))
    return markdown_table(("world", "tier needed", "half", *AGENTS, "diagnosis", "splits that agree", ""), lines)
