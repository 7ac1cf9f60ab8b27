"""What studies run, each over its own tasks and settings: methods with some seeds, and certificates.

What a folder has of either stays, so that an interrupted study goes on where it was.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from deconfounded import envs
from deconfounded.benchmarks import commands
from deconfounded.benchmarks.engine.catalogue import EXACT, METHODS
from deconfounded.benchmarks.engine.protocols import STANDARD, applied
from deconfounded.envs.support.files import write_json

if TYPE_CHECKING:
    from deconfounded.benchmarks.engine.presets import Preset
    from deconfounded.benchmarks.output.records import Record


def run(
    task: envs.Task,
    settings: "Preset",
    methods: Sequence[str],
    seeds: Sequence[int],
    folder: Path,
    *,
    expert: str | None = None,
    preset: str = "default",
    changes: Sequence[str] = (),
    cluster: str | None = None,
    base: "Preset | None" = None,
    protocol: str = STANDARD,
) -> "list[Record]":
    """The records of the methods' seeds on a task, under a protocol with its settings.

    folder: of this run alone, or new. base: the settings that it is for, if others follow there.
    """
    from deconfounded.benchmarks.engine.benchmark import BenchmarkJob
    from deconfounded.benchmarks.engine.job_files import prepare
    from deconfounded.benchmarks.engine.scheduler import listed, run_all
    from deconfounded.benchmarks.output import records

    wanted, own = [name for name in METHODS if name in methods], tuple(seeds)
    task, jobs = applied(protocol, task), []
    for name in wanted:
        what = (task.reference, settings, name, own, folder / "jobs")
        jobs.append(BenchmarkJob(*what, expert=expert, protocol=protocol))
    label = f"{task.name}, {', '.join(wanted)}, {listed(own)}"
    # Workers of its own: a record names the code that is there when it is made, and they have imported it.
    with commands.locked(folder), commands.engine(cluster) as engine:
        about = commands.about(BenchmarkJob, task, preset, base or settings, changes, expert, "", protocol)
        prepare(folder, about, resume=True)
        finished, _, failed = run_all(jobs, settings.device, label, engine)
    if failed:
        raise failed[0]
    asked = [entry for entry in finished if entry[0] in wanted and entry[1] in own]
    return records.of_run(asked, preset, changes, task.episodes)


def certificate(task: envs.Task, expert: str | None, folder: Path) -> dict[str, Any]:
    """The task's certificate, made with that expert; kept while both and its methods keep their versions."""
    from deconfounded.benchmarks.certify import certify
    from deconfounded.benchmarks.engine import identity
    from deconfounded.experts import policy

    file, of = folder / "certificate.json", {"task_version": task.version, **identity.expert(task, expert)}
    of["methods"] = {name: METHODS[name].version for name in (*EXACT, "blind_bc")}
    held: dict[str, Any] = json.loads(file.read_bytes()) if file.is_file() else {}
    if held.get("made_of") != of:
        folder.mkdir(parents=True, exist_ok=True)
        held = {**certify(task, policy.load(task, expert)), "made_of": of}
        write_json(file, held)
    return {key: value for key, value in held.items() if key != "made_of"}
