"""What jobs leave in a run's folder, one file a (method, seed): what is in it is finished, and kept."""

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from deconfounded import envs
from deconfounded.benchmarks.engine import catalogue
from deconfounded.envs.support.files import check_folder, read_sealed, sweep, write_sealed

META: dict[str, Any] = {  # what a file says of itself, and of what types
    **{"identity": dict, "seed": int, "budget": dict, "spans": list, "cpu_s": (int, float), "arrays": list},
    **{"machine": str, "commit": (str, type(None))},
}
SCORED = {"agents": dict, "curve": dict, "tier": str}  # and what a file of run.py says beside that
OF_AGENT = ("returns", "objective", "probe")
LARGEST = 1e100  # return, whose square is still a number
DAMAGED = "it is damaged"


def broken(data: dict[str, Any]) -> str:
    """Why what a file holds cannot be what a job wrote; empty if it can."""
    meta = data["meta"]
    wanted = META | (SCORED if "agents" in meta else {})
    right = all(isinstance(meta.get(key, ...), kind) for key, kind in wanted.items())
    if not right or not isinstance(meta["identity"].get("method"), str):
        return "it does not say what it was made of"
    if not all(isinstance(amount, int) for amount in meta["budget"].values()):
        return "it does not say what data it used"
    if lost := {"meta", *meta["arrays"]} ^ set(data):
        return f"it lacks {', '.join(sorted(lost))}"
    for name in meta.get("agents", ()):
        returns, objective, probe = (data.get(f"{name}/{key}", np.zeros(())) for key in OF_AGENT)
        if returns.ndim != 2 or objective.shape != returns.shape or probe.ndim != 1:
            return f"returns of {name} have shape {returns.shape}, Eq. (1) {objective.shape}, probes {probe.shape}"
    for key, value in data.items():
        if key != "meta" and value.dtype.kind == "f" and not np.isfinite(value).all():
            return f"{key} holds NaN or infinity"
        if key.endswith("/returns") and np.abs(value).max(initial=0) > LARGEST:
            return f"{key} are up to {np.abs(value).max():.2g}; they must be at most {LARGEST:g}"
    return ""


def read(file: Path) -> dict[str, Any] | None:
    """A job's file: arrays, and `meta` decoded. None if it is missing, or damaged (a zip has checksums)."""
    try:
        with np.load(file, allow_pickle=False) as data:
            arrays = {key: data[key] for key in data.files}
        meta = json.loads(str(arrays["meta"]))
    except Exception:  # damaged, which shows in many ways
        return None
    return {**arrays, "meta": meta} if isinstance(meta, dict) else None


def in_name(seeds: Sequence[int]) -> str:
    """Seeds as names of files have them: 0-1-2, or of many the first, the last, and a hash."""
    every = "-".join(map(str, seeds))
    return every if len(seeds) <= 10 else f"{seeds[0]}-to-{seeds[-1]}-{hashlib.sha256(every.encode()).hexdigest()[:8]}"


Finished = list[tuple[str, int, dict[str, Any]]]
"""Method, seed, and what its job wrote."""


def know_guests(folder: Path) -> None:
    """Make the methods from outside known whose results are in a folder, so that they stay in its tables."""
    for file in sorted(folder.glob("*-*.npz")):
        if (data := read(file)) and (reference := data["meta"].get("reference")):
            try:
                catalogue.add(str(reference))
            except envs.InputError as error:
                print(f"{file.name} is left out: {error}")


def left_in(folder: Path) -> Finished:
    """What jobs left in a folder, whatever code made it: each file is what it says it is.

    Of files for which the text of a task or a method from outside differed, it is those of the latest text.
    """
    finished = []
    for file in sorted(folder.glob("*-*.npz")):
        if (data := read(file)) is None:
            if not file.stem.startswith("demonstrations-"):
                print(f"{file.name} is left out: {DAMAGED}; run it again with --resume")
            continue
        if "agents" not in (meta := data["meta"]):
            continue
        if why := broken(data):
            print(f"{file.name} is left out: {why}")
        elif file.stem != (name := f"{meta['identity']['method']}-{meta['seed']}"):
            print(f"{file.name} is left out: it is of {name}")
        else:
            finished.append((meta["identity"]["method"], meta["seed"], data))
    return _of_latest_text(finished)


def _of_latest_text(finished: Finished) -> Finished:
    """Those of the latest text of the task, and of the latest version and text of the method; a line on others."""
    texts, task, kept = dict[str, dict[str, str]](), None, list[tuple[str, int, dict[str, Any]]]()
    versions: dict[str, int | None] = {}
    for method, _, data in sorted(finished, key=lambda job: max(end for _, end in job[2]["meta"]["spans"])):
        texts[method] = data["meta"]["identity"]["outside"]
        versions[method] = data["meta"]["identity"].get("method_version")
        task = texts[method].get("task")
    for method, seed, data in finished:
        made_of = data["meta"]["identity"]
        if made_of.get("method_version") != versions[method]:
            print(f"{method}-{seed}.npz is left out: it is of another version; run it again with --resume")
        elif made_of["outside"] == texts[method] and texts[method].get("task") == task:
            kept.append((method, seed, data))
        else:
            print(f"{method}-{seed}.npz is left out: its task or method had another text; run it again with --resume")
    return kept


def by_method(finished: Finished) -> dict[str, list[dict[str, Any]]]:
    """What the jobs of each method wrote, by seed."""
    return {name: [data for method, _, data in finished if method == name] for name, *_ in finished}


def prepare(folder: Path, settings: dict[str, Any], resume: bool) -> None:
    """Make the output folder, or see that what it holds can be gone on with."""
    for place in (folder, folder / "jobs"):
        check_folder(place)
        sweep(place)
    file = folder / "settings.json"
    if not file.exists():
        if any((folder / "jobs").iterdir()):
            raise envs.InputError(f"{folder} holds jobs, but not their settings.json; give another --out")
        if files := sorted(each.name for each in folder.iterdir() if each.is_file() and each.name[0] != "."):
            right = "give --out a folder of its own, which may be new"
            raise envs.InputError(f"{folder} holds {files[0]}, and no run whose file that could be; {right}")
        write_sealed(file, settings)
    elif not resume:
        raise envs.InputError(f"{folder} holds a run already; give --resume to go on with it, or another --out")
    before, now = read_sealed(file), json.loads(json.dumps(settings))
    if differ := [key for key in {**now, **before} if before.get(key) != now.get(key)]:
        which = differing(differ[0], before.get(differ[0]), now.get(differ[0]))
        raise envs.InputError(f"{folder} holds a run that differs in its {which}; give another --out, or remove it")


def differing(key: str, before: Any, now: Any) -> str:
    """What differs in two values under a key, e.g. `versions (torch was 2.13.0, is 2.14.0)`; at most three parts."""

    def parts(name: str, one: Any, other: Any) -> list[str]:
        if isinstance(one, dict) and isinstance(other, dict):
            inner = [(f"{name}.{each}".lstrip("."), one.get(each), other.get(each)) for each in {**one, **other}]
            return [part for each in inner if each[1] != each[2] for part in parts(*each)]
        was, now = (
            "none" if each is None else "given" if isinstance(each, dict) else str(each)[:60] or "empty"
            for each in (one, other)
        )
        return [f"{name} was {was}, is {now}".lstrip()]

    found = parts("", before, now)
    more = f", and {len(found) - 3} more" if len(found) > 3 else ""
    return f"{key} ({'; '.join(found[:3])}{more})"
