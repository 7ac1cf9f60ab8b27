"""One record for each (task, version, preset, method, seed): a small json that says what came out, and of what.

All pages and tables are made of records alone. Those of another version of a task, or under another preset, are never
mixed with others.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from deconfounded.benchmarks.engine.catalogue import REFERENCES
from deconfounded.benchmarks.output import score
from deconfounded.envs.files import check_folder, unsealed, write_sealed
from deconfounded.envs.task import InputError

Record = dict[str, Any]
SCHEMA = Path(__file__).with_name("record.schema.json")
COMMON = ("task", "task_version", "preset", "set", "salt", "eval_trials", "episodes", "expert")  # of a table's records


def of_job(data: dict[str, Any], preset: str, changes: Sequence[str], episodes: int) -> list[Record]:
    """The records of what a job wrote of a seed, one for each agent that it scored; see record.schema.json."""
    meta = data["meta"]
    made = meta["identity"]
    found = []
    for name in meta["agents"]:
        returns = data[f"{name}/returns"]
        curve = {"curve": thinned(meta["curve"])} if meta["curve"] else {}
        found.append(
            {
                "schema": 1,
                "task": made["task"],
                "task_version": made["task_version"],
                "method": name,
                "job": made["method"],
                "seed": meta["seed"],
                "preset": preset,
                "set": list(changes),
                "salt": made["salt"],
                "tier": meta["tier"],
                "budget": meta["budget"],
                "eval_trials": len(returns),
                "episodes": episodes,
                "returns": returns.mean(0).round(6).tolist(),
                "returns_sd": returns.std(0).round(6).tolist(),
                "objective": data[f"{name}/objective"].mean(0).round(3).tolist(),
                "theta_r2": data[f"{name}/probe"].round(4).tolist(),
                "bits": bits(returns),
                "cpu_s": meta["cpu_s"],
                "spans": [[round(at, 1) for at in span] for span in meta["spans"]],
                "settings": made["settings"],
                "expert": made["expert"],
                "code": made["code"],
                "commit": meta["commit"],
                "versions": made["versions"],
                "machine": meta["machine"],
                **curve,
            }
        )
    return found


def thinned(curve: dict[str, list[tuple[int, float]]]) -> dict[str, dict[str, list[Any]]]:
    """Losses (update, loss) by kind as a record holds them: four digits, at least 50 points if there are as many."""
    found: dict[str, dict[str, list[Any]]] = {}
    for kind, points in curve.items():
        kept = [(update, loss) for update, loss in points[:: max(len(points) // 50, 1)] if np.isfinite(loss)]
        found[kind] = {"update": [at for at, _ in kept], "loss": [float(f"{loss:.4g}") for _, loss in kept]}
    return found


def of_run(
    finished: Sequence[tuple[str, int, dict[str, Any]]], preset: str, changes: Sequence[str], episodes: int
) -> list[Record]:
    """The records of all that jobs wrote: method, seed, and the data of `of_job`."""
    return [record for *_, data in finished for record in of_job(data, preset, changes, episodes)]


def bits(returns: np.ndarray) -> str:
    """SHA-256 of the returns of every trial and episode [N, E]."""
    return hashlib.sha256(np.ascontiguousarray(returns, np.float64).tobytes()).hexdigest()


@cache
def _schema() -> dict[str, Any]:
    return json.loads(SCHEMA.read_text())


def check(record: Any, where: str) -> Record:
    """The record, if it is one. Raises InputError that names what does not fit the schema."""
    from jsonschema import Draft202012Validator

    for error in Draft202012Validator(_schema()).iter_errors(record):
        at = ".".join(map(str, error.absolute_path)) or "it"
        raise InputError(f"{where} is no record: {at} {error.message[:120]}")
    if any(end < begin for begin, end in record["spans"]):
        raise InputError(f"{where} is no record: spans must end after they begin")
    if len({len(record[key]) for key in ("returns", "returns_sd", "objective")}) > 1:
        raise InputError(f"{where} is no record: returns, returns_sd and objective must be of as many episodes")
    if any(len(curve["update"]) != len(curve["loss"]) for curve in record.get("curve", {}).values()):
        raise InputError(f"{where} is no record: a curve must have as many losses as updates")
    return record


def place(record: Record) -> Path:
    """Where it is kept, under a folder of records."""
    return Path(
        f"{record['task']}-v{record['task_version']}", record["preset"], f"{record['method']}-{record['seed']}.json"
    )


def _no_number(text: str) -> None:
    raise ValueError(text)  # NaN and Infinity, which Python's reader takes though JSON does not have them


def read(file: Path) -> Record:
    """A record from a file. Raises InputError if it is missing, damaged or none."""
    try:
        record = check(json.loads(file.read_bytes(), parse_constant=_no_number), str(file))
    except OSError as error:
        raise InputError(f"record {file} cannot be read: {error.strerror}") from None
    except InputError:
        raise
    except (ValueError, RecursionError):
        raise InputError(f"record {file} is not json") from None
    try:  # a note is written by hand
        note = {"note": record.pop("note")} if "note" in record else {}
        return {**(unsealed(record) if "sha256" in record else record), **note}
    except ValueError:
        raise InputError(f"record {file} is damaged, or was changed by hand: its sha256 is of something else") from None


def write(folder: Path, record: Record) -> None:
    """Keep a record in its place."""
    file = folder / place(record)
    check_folder(file.parent)
    write_sealed(file, check(record, str(file)))


def of_task(folder: Path, task: str, version: int, preset: str = "default") -> list[Record]:
    """The records of a task's version, by method and seed."""
    return [read(file) for file in sorted((folder / f"{task}-v{version}" / preset).glob("*.json"))]


def gather(records: Sequence[Record], order: Sequence[str] = ()) -> dict[str, Any]:
    """Records -> results: what they share, and of each method the scores over seeds; methods in that order, first.

    Raises InputError for records that do not belong in one table.
    """
    first = records[0]
    for record in records:
        for key in COMMON:
            if record[key] != first[key]:
                raise InputError(f"records with {key} {first[key]} and {record[key]} do not belong in one table")
    if missing := [name for name in REFERENCES if name not in {record["method"] for record in records}]:
        raise InputError(f"records of {first['task']} are without those of {missing[0]}, which scores need")
    by_method: dict[str, list[Record]] = {}
    for record in records:
        by_method.setdefault(record["method"], []).append(record)
    rank = {name: i for i, name in enumerate(order)}
    names = sorted(by_method, key=lambda name: rank.get(name.removesuffix("_episode"), len(rank)))
    return {
        **{key: first[key] for key in COMMON if first[key] not in ("", [])},
        "seeds": sorted({record["seed"] for record in records}),
        "commits": sorted({record["commit"] or "unknown" for record in records}),
        "versions": first["versions"],
        "machine": "; ".join(sorted({record["machine"] for record in records})),
        "wall_s": round(covered([(begin, end) for record in records for begin, end in record["spans"]]), 1),
        "methods": score.summarise({name: by_method[name] for name in names}, first["episodes"]),
    }


def covered(spans: list[tuple[float, float]]) -> float:
    """Length of the union of spans of time."""
    total, until = 0.0, -np.inf
    for start, end in sorted(spans):
        total += max(0.0, end - max(start, until))
        until = max(until, end)
    return total
