"""Tables of LeRobot data sets, versions 2 and 3: meta/info.json, meta/episodes, data/chunk-*/*.parquet; no videos."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from deconfounded.envs.support.errors import InputError
from deconfounded.experts.datasets.table import Column, Table, of_episodes
from deconfounded.experts.datasets.tabular import parquet_columns

INTERNAL = ("stats/", "data/", "videos/", "meta/", "dataset_")  # columns of meta/episodes that say nothing of episodes


def read_lerobot(folder: Path) -> Table:
    """The folder of a data set. Columns of meta/episodes, which hold for a whole episode, are columns too.

    Raises InputError if files are missing, or are of another version.
    """
    info = _json(folder / "meta" / "info.json", _text(folder / "meta" / "info.json"))
    version, features = str(info.get("codebase_version")), info.get("features")
    if not version.startswith(("v2", "v3")) or not isinstance(features, dict):
        raise InputError(f"{folder} is a LeRobot data set of version {version}; it must be v2 or v3")
    if strange := [name for name, feature in features.items() if not isinstance(feature, dict)]:
        raise InputError(f"feature {strange[0]} of {folder}/meta/info.json is no dictionary")
    files = sorted((folder / "data").rglob("*.parquet"))
    if not files:
        raise InputError(f"{folder} has no data/chunk-*/*.parquet")
    parts = {name: _parts(feature.get("names")) for name, feature in features.items()}
    tables = [parquet_columns(file, parts) for file in files]
    for file, table in zip(files, tables, strict=True):
        if {"episode_index", "frame_index"} - set(table) or set(table) != set(tables[0]):
            raise InputError(f"{file} has other columns than {files[0]}; all need episode_index and frame_index")
    columns: dict[str, Column] = {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}
    order = np.lexsort((columns["frame_index"], columns["episode_index"]))
    columns = {name: column[order] for name, column in columns.items()}
    numbers, lengths = np.unique(columns["episode_index"], return_counts=True)
    promised = {"frames": info.get("total_frames"), "episodes": info.get("total_episodes")}
    for what, held in (("frames", len(order)), ("episodes", len(numbers))):
        if promised[what] not in (None, held):
            raise InputError(
                f"{folder} holds {held} {what}; its meta/info.json says {promised[what]}: are files missing?"
            )
    entries = [(entry.get("episode_index"), entry) for entry in _episodes(folder)]
    by_number = {number: entry for number, entry in entries if isinstance(number, int | float)}
    if set(numbers) <= set(by_number):
        columns |= _new(of_episodes([by_number[number] for number in numbers], lengths.tolist()), columns)
    obs = tuple(name for name in columns if name.startswith("observation") and columns[name].dtype.kind == "f")
    action = tuple(name for name in columns if name == "action" or name.startswith("action."))
    if not obs or not action:
        raise InputError(f"{folder} has no `{'action' if obs else 'observation.state'}`; columns: {', '.join(columns)}")
    return Table(str(folder), columns, np.repeat(np.arange(len(numbers)), lengths), obs, action)


def _parts(names: Any) -> list[str]:
    """Names of a feature's parts, which are a list, or a dictionary that holds a list, or None."""
    names = next(iter(names.values()), []) if isinstance(names, dict) else names
    return [str(name) for name in names] if isinstance(names, list) else []


def _new(of: dict[str, Column], columns: dict[str, Column]) -> dict[str, Column]:
    return {name: x for name, x in of.items() if name not in columns and not name.startswith(INTERNAL)}


def _episodes(folder: Path) -> list[dict[str, Any]]:
    """What is said of each episode: meta/episodes.jsonl of version 2, meta/episodes/**/*.parquet of version 3."""
    lines = folder / "meta" / "episodes.jsonl"
    if lines.is_file():
        return [_json(lines, line) for line in _text(lines).splitlines() if line.strip()]
    entries: list[dict[str, Any]] = []
    for file in sorted((folder / "meta" / "episodes").rglob("*.parquet")):
        columns = parquet_columns(file)
        tasks = [name for name in columns if name.startswith("tasks.")]
        for i in range(len(next(iter(columns.values()), ()))):
            entry = {name: column[i] for name, column in columns.items() if name not in tasks}
            entries.append(entry | ({"tasks": [columns[name][i] for name in tasks]} if tasks else {}))
    return entries


def _text(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"{file} is not in UTF-8: {error}") from None


def _json(file: Path, text: str) -> dict[str, Any]:
    try:
        made = json.loads(text)
    except ValueError as error:
        raise InputError(f"{file} cannot be read: {error}") from None
    if not isinstance(made, dict):
        raise InputError(f"{file} holds no dictionary")
    return made
