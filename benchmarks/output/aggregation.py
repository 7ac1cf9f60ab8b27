"""Aggregation of records: the returns that have score 0 and 1, and the results over seeds that pages and tables show.

Records of different tasks, versions, presets or protocols are never aggregated.
"""

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np

from deconfounded.benchmarks.engine.catalogue import REFERENCES
from deconfounded.benchmarks.engine.protocols import STANDARD
from deconfounded.benchmarks.engine.published import RECORDS
from deconfounded.benchmarks.output import scoring
from deconfounded.benchmarks.output.records import NAME, Record, grouped, named, of_task
from deconfounded.envs.task import InputError

COMMON = ("task", "task_version", "preset", NAME, "set", "salt", "eval_trials", "episodes", "expert")  # of a table
REFERENCED = ("task", "task_version", "protocol", NAME, "expert", "expert_version")  # what 0 and 1 are of


def references(record: Record, beside: Sequence[Record] = ()) -> tuple[float, float]:
    """The returns that have score 0 and 1, for the record: one rule for all scores.

    They are the mean returns of random actions and of the expert, over the episodes of a trial and over all seeds of
    the records that come with the package, if these are of the same REFERENCED; else over the records `beside`. Raises
    InputError if these have none.
    """
    of = referenced(record)
    return _published(record.get(NAME, STANDARD), *of) or _references([r for r in beside if referenced(r) == of])


def referenced(record: Record) -> tuple[Any, ...]:
    """What the record's 0 and 1 are of."""
    return tuple(record.get(key) for key in REFERENCED)


@cache
def _published(protocol: str, *of: Any) -> tuple[float, float] | None:
    kept = [record for record in of_task(RECORDS, of[0], protocol=protocol) if referenced(record) == of]
    return _references(kept) if {record["method"] for record in kept} >= set(REFERENCES) else None


def forget() -> None:
    """Forget what the references of the package were; more records came to it."""
    _published.cache_clear()


def _references(records: Sequence[Record]) -> tuple[float, float]:
    returns = {
        name: [one["returns"][: one["episodes"]] for one in records if named(one) == name] for name in REFERENCES
    }
    if missing := [name for name in REFERENCES if not returns[name]]:
        raise InputError(f"records are without those of {missing[0]}, which scores need")
    random, expert = (float(np.mean(returns[name])) for name in REFERENCES)
    scoring.check_expert(records[0]["task"], random, expert)
    return random, expert


def unlike(records: Sequence[Record], keys: Sequence[str]) -> str:
    """The first of the keys in which records differ, and two of its values; empty if they are alike."""
    for key in keys:
        values = list(dict.fromkeys(str(record.get(key, STANDARD)) for record in records))
        if len(values) > 1:
            return f"{key} {values[0]} and {values[1]}"
    return ""


def gather(records: Sequence[Record], order: Sequence[str] = ()) -> dict[str, Any]:
    """Records -> results: what they share, and of each method the scores over seeds; methods in that order, first.

    Raises InputError for records that do not belong in one table.
    """
    first = records[0]
    if difference := unlike(records, COMMON):
        raise InputError(f"records with {difference} do not belong in one table")
    one_text(records)
    by_method, by_agent = grouped(records, lambda record: record["method"]), grouped(records, named)
    for method, of in by_method.items():
        if any(record[key] != of[0][key] for record in of for key in ("method_version", "outside")):
            raise InputError(f"records of two versions of {method} do not belong in one table")
    if missing := [name for name in REFERENCES if name not in by_method]:
        raise InputError(f"records of {first['task']} are without those of {missing[0]}, which scores need")
    rank = {name: i for i, name in enumerate(order)}
    names = sorted(by_agent, key=lambda name: rank.get(by_agent[name][0]["method"], len(rank)))
    return {
        **{key: first[key] for key in COMMON if first.get(key) not in ("", [], None)},
        **({"text": text} if (text := first["outside"].get("task")) else {}),
        "seeds": sorted({record["seed"] for record in records}),
        "commits": sorted({record["commit"] or "unknown" for record in records}),
        "versions": _versions(records),
        "machine": "; ".join(sorted({record["machine"] for record in records})),
        "wall_s": round(covered([span for record in records for span in record["spans"]]), 1),
        "methods": scoring.summarise(
            {name: by_agent[name] for name in names}, first["episodes"], references(first, records)
        ),
    }


def one_text(records: Sequence[Record]) -> None:
    """Raises InputError for records of a task from outside that were made with several texts of its file."""
    texts = {record["task"]: record["outside"].get("task") for record in records}
    for record in records:
        if record["outside"].get("task") != texts[record["task"]]:
            raise InputError(f"records of {record['task']} are from two versions of its file; make them again with one")


def _versions(records: Sequence[Record]) -> dict[str, str]:
    """Of each library, all versions that the records were made with."""
    names = dict.fromkeys(name for record in records for name in record["versions"])
    return {
        name: " and ".join(dict.fromkeys(r["versions"][name] for r in records if name in r["versions"]))
        for name in names
    }


def covered(spans: Sequence[Any]) -> float:
    """Length of the union of spans of time."""
    total, until = 0.0, -np.inf
    for start, end in sorted(spans):
        total += max(0.0, end - max(start, until))
        until = max(until, end)
    return total
