"""Records: what came of one seed of one method on one task, and of what it was made. All pages are made of them alone.

This module makes records of what jobs wrote, checks them, reads and writes their files, and says which are of older
versions; `aggregation` makes results of them. A file `<task>.jsonl` holds a record a line, each with its own checksum;
`read` and `write` are the only ones that open it.
"""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import fastjsonschema
import numpy as np

from deconfounded.benchmarks.engine.catalogue import METHODS, label
from deconfounded.benchmarks.engine.identity import named as named_protocol
from deconfounded.benchmarks.engine.job_files import Finished
from deconfounded.benchmarks.engine.protocols import STANDARD
from deconfounded.envs.support.files import check_folder, sealed, sweep, unsealed, write_atomically
from deconfounded.envs.task import InputError

Record = dict[str, Any]
SCHEMA = Path(__file__).with_name("record.schema.json")
NAME = "protocol_name"  # which a record of the standard protocol lacks
MADE_OF = (  # what makes a record stale when it changes
    *("protocol", "task_version", "method_version", "settings", "expert", "expert_version"),
    *("salt", "outside", NAME),
)
APART = ("preset", NAME, "set", "salt")  # of records that no table mixes
SLOT = (*APART, "method", "deployment", "seed")  # of which a task's file holds one record


def of_job(data: dict[str, Any], preset: str, changes: Sequence[str], episodes: int) -> list[Record]:
    """The records of what a job wrote of a seed, one for each agent that it scored; see record.schema.json.

    The training curve is in that of the agent as it is, and not again in those of its other ways of deployment.
    """
    meta = data["meta"]
    seed = {key: meta["identity"][key] for key in ("task", "method", *MADE_OF) if key in meta["identity"]}
    seed |= {"versions": meta["identity"]["versions"]}
    seed |= {key: meta[key] for key in ("seed", "tier", "budget", "cpu_s", "commit", "machine")}
    seed |= {"schema": 3, "preset": preset, "set": list(changes), "episodes": episodes}
    seed |= {"spans": [[round(at, 1) for at in span] for span in meta["spans"]]}
    seed |= {key: meta[key] for key in ("salts", "package") if key in meta}
    records = []
    for name, deployment in meta["agents"].items():
        returns = data[f"{name}/returns"]
        scored = {
            "deployment": deployment,
            "eval_trials": len(returns),
            "returns": returns.mean(0).round(6).tolist(),
            "returns_sd": returns.std(0).round(6).tolist(),
            "objective": data[f"{name}/objective"].mean(0).round(3).tolist(),
            "theta_r2": data[f"{name}/probe"].round(4).tolist(),
            "bits": bits(returns),
        }
        curve = {"curve": thinned(meta["curve"])} if meta["curve"] and not deployment else {}
        records.append(seed | scored | curve)
    return records


def thinned(curve: dict[str, list[tuple[int, float]]]) -> dict[str, dict[str, list[Any]]]:
    """Losses (update, loss) by kind as a record holds them: four digits, at least 50 points if there are as many."""
    thin: dict[str, dict[str, list[Any]]] = {}
    for kind, points in curve.items():
        kept = [(update, loss) for update, loss in points[:: max(len(points) // 50, 1)] if np.isfinite(loss)]
        thin[kind] = {"update": [update for update, _ in kept], "loss": [float(f"{loss:.4g}") for _, loss in kept]}
    return thin


def short_commit(commit: str | None) -> str:
    """A commit's first seven digits, with a + if the tree had uncommitted changes."""
    return "unknown" if commit is None else commit[:7] + "+" * commit.endswith("+")


def of_run(finished: Finished, preset: str, changes: Sequence[str], episodes: int) -> list[Record]:
    """The records of all that jobs wrote."""
    return [record for *_, data in finished for record in of_job(data, preset, changes, episodes)]


def bits(returns: np.ndarray) -> str:
    """SHA-256 of the returns of every trial and episode [N, E]."""
    return hashlib.sha256(np.ascontiguousarray(returns, np.float64).tobytes()).hexdigest()


@cache
def _validate() -> Callable[[Any], Any]:
    """Raises JsonSchemaValueException for what does not fit the schema. Compiled: pages read thousands of records."""
    made: Callable[[Any], Any] = fastjsonschema.compile(json.loads(SCHEMA.read_text(encoding="utf-8")))
    return made


def check(record: Any, where: str) -> Record:
    """The record, if it is one. Raises InputError that names what does not fit the schema."""
    try:
        _validate()(record)
    except fastjsonschema.JsonSchemaValueException as error:
        what = error.message.removeprefix("data").removeprefix(".")  # the path in the record, and what it must be
        raise InputError(f"{where} is no record: {what.strip()[:160]}") from None
    if any(end < begin for begin, end in record["spans"]):
        raise InputError(f"{where} is no record: spans must end after they begin")
    if len({len(record[key]) for key in ("returns", "returns_sd", "objective")}) > 1:
        raise InputError(f"{where} is no record: returns, returns_sd and objective must be of as many episodes")
    if any(len(curve["update"]) != len(curve["loss"]) for curve in record.get("curve", {}).values()):
        raise InputError(f"{where} is no record: a curve must have as many losses as updates")
    return record


def stale(record: Record, identity: Mapping[str, Any]) -> list[str]:
    """What a record was made of that is no longer so, of `MADE_OF`; identity: of the job that would make it today.

    A setting that is newer than the record had its default, by which a method does what it did before.
    """
    made_of = {**record, "settings": _completed(record, identity["settings"].get("config", {}))}
    return [key for key in MADE_OF if made_of.get(key) != identity.get(key)]


def _completed(record: Record, config: Mapping[str, Any]) -> Any:
    """The settings of a record; those of a configuration today that it lacks at their defaults."""
    settings, method = record["settings"], METHODS.get(record["method"])
    if method is None or "config" not in settings:
        return settings
    newer = {name: value for name, value in method.defaults.items() if name in config}
    return {**settings, "config": {**newer, **settings["config"]}}


def place(task: str) -> str:
    """The name of a task's file in a folder of records."""
    return f"{task}.jsonl"


def _no_number(text: str) -> None:
    raise ValueError(text)  # NaN and Infinity, which Python's reader takes though JSON does not have them


def _parse(line: bytes, where: str) -> Record:
    """The record in a line of a file. Raises InputError if it is damaged or none."""
    try:
        record = check(json.loads(line, parse_constant=_no_number), where)
    except InputError:
        raise
    except (ValueError, RecursionError):
        raise InputError(f"{where} is not json") from None
    try:  # a note is written by hand
        note = {"note": record.pop("note")} if "note" in record else {}
        return {**unsealed(record), **note}
    except ValueError:
        raise InputError(f"{where} is damaged, or was changed by hand: its sha256 is of something else") from None


def read(file: Path) -> list[Record]:
    """The records of a file, in its order.

    Raises InputError if it is missing or empty, or if a line is damaged, no record, of another task than the file's
    name says, or a second one of the same preset, method and seed.
    """
    try:
        content = file.read_bytes()
    except OSError as error:
        raise InputError(f"records {file} cannot be read: {error.strerror}") from None
    if not content:
        raise InputError(f"records {file} are empty; restore the file, or delete it if there are to be none")
    return list(_records(content, file))


@lru_cache(maxsize=64)  # one page reads all tasks under each protocol, and scores read the package's beside it
def _records(content: bytes, file: Path) -> tuple[Record, ...]:
    """The records in a file's content, which nobody may change."""
    records: dict[str, Record] = {}
    for number, line in enumerate(content.splitlines(), 1):
        record = _parse(line, where := f"line {number} of {file}")
        if place(record["task"]) != file.name:
            raise InputError(f"{where} is of {record['task']}, which belongs in {place(record['task'])}")
        if (slot := _slot(record)) in records:
            raise InputError(f"{where} is a second record of {named(record)} with seed {record['seed']}")
        records[slot] = record
    return tuple(records.values())


def held(file: Path) -> list[Record]:
    """The records of a file, if it exists."""
    return read(file) if file.exists() else []


def named(record: Record) -> str:
    """What the record's agent is called in tables."""
    return label(record["method"], record["deployment"])


def _slot(record: Record, keys: Sequence[str] = SLOT) -> str:
    return json.dumps([record.get(key) for key in keys])


def grouped(records: Sequence[Record], key: Callable[[Record], str]) -> dict[str, list[Record]]:
    """Groups of records by what `key` gives of each, in the order of the records."""
    groups: dict[str, list[Record]] = {}
    for record in records:
        groups.setdefault(key(record), []).append(record)
    return groups


def write(folder: Path, records: Sequence[Record]) -> None:
    """Add records to the files of their tasks in a folder, each file atomically.

    A record takes the place of the one in its slot, unless that is of a newer version. One that was made of something
    else is kept in the folder `superseded`, and so are those of an older version or of another text from outside, of
    all seeds, which no table shows any more; without their training curves, which no page draws, and one for each slot:
    those of still older versions are in git's history. Raises InputError for what is no record, before anything is
    written.
    """
    from filelock import FileLock

    for record in records:
        check(record, f"{record.get('method')}, seed {record.get('seed')}")
    check_folder(folder)
    with FileLock(folder / ".lock"):
        sweep(folder)
        for task, new in grouped(records, lambda record: record["task"]).items():
            file = folder / place(task)
            kept = {_slot(record): record for record in held(file)}
            superseded = []
            for record in new:
                slot = _slot(record)
                if outdone(record, kept.get(slot)):
                    superseded.append(record)
                    continue
                before = kept.pop(slot, None)
                if before is not None and stale(before, record):
                    superseded.append(before)
                kept[slot] = record
            today = _of_one_text(_newest(list(kept.values())), new)
            slots = set(map(_slot, today))
            superseded += [record for slot, record in kept.items() if slot not in slots]
            if superseded:
                _supersede(folder / "superseded" / place(task), superseded)
            write_atomically(file, "".join(map(_line, today)))


def outdone(record: Record, by: Record | None) -> bool:
    """Whether a record is of an older version than another, of the task or else of the method."""
    versions = "task_version", "method_version"
    return by is not None and [record[key] for key in versions] < [by[key] for key in versions]


def _of_one_text(records: Sequence[Record], new: Sequence[Record]) -> list[Record]:
    """Without those for which the task or the method from outside had another text than for new ones beside them."""
    task = {_slot(record, APART): record["outside"].get("task") for record in new}
    method = {_slot(record, ("method", *APART)): record["outside"] for record in new}

    def same(record: Record) -> bool:
        text = record["outside"]
        by_task, by_method = _slot(record, APART), _slot(record, ("method", *APART))
        return text.get("task") == task.get(by_task, text.get("task")) and text == method.get(by_method, text)

    return [record for record in records if same(record)]


def _supersede(file: Path, records: Sequence[Record]) -> None:
    check_folder(file.parent)
    kept = {_slot(record): record for record in held(file)}
    for record in records:
        if not outdone(record, kept.get(slot := _slot(record))):
            kept[slot] = {key: value for key, value in record.items() if key != "curve"}
    write_atomically(file, "".join(map(_line, kept.values())))


def _line(record: Record) -> str:
    note = {"note": record["note"]} if "note" in record else {}
    rest = {key: value for key, value in record.items() if key != "note"}
    return json.dumps({**sealed(rest), **note}, separators=(",", ":"), allow_nan=False) + "\n"


def of_task(folder: Path, task: str, preset: str = "default", protocol: str = STANDARD) -> list[Record]:
    """The records of a task under an unchanged preset, by method and seed: of its newest version, and each method's."""
    plain: dict[str, Any] = {"preset": preset, "set": [], "salt": "", NAME: None, **named_protocol(protocol)}
    kept = [record for record in held(folder / place(task)) if all(record.get(key) == plain[key] for key in plain)]
    return sorted(_newest(kept), key=lambda record: (named(record), record["seed"]))


def _newest(records: Sequence[Record]) -> list[Record]:
    """Those of the newest version of their task and their method; presets, settings and protocols are apart."""
    for kind in ("task", "method"):
        versions: dict[str, int] = {}
        groups = [_slot(record, (kind, *APART)) for record in records]
        for group, record in zip(groups, records, strict=True):
            versions[group] = max(versions.get(group, 0), record[f"{kind}_version"])
        pairs = zip(groups, records, strict=True)
        records = [record for group, record in pairs if record[f"{kind}_version"] == versions[group]]
    return list(records)
