"""Run the seed of a record again, and compare: `deconf verify slippery_cartpole deconfounded 0`

Says `same bits`, `inside the interval` (the mean return of every episode within three standard errors of the trials) or
`not the same`, and what differs. Exit code 1 for `not the same`. The interval is wide, as thetas differ among trials:
it shows a wrong return, and not a method a little worse.
"""

import tempfile
from pathlib import Path

import numpy as np

from deconfounded import envs
from deconfounded.benchmarks import commands
from deconfounded.benchmarks.console import Parser
from deconfounded.benchmarks.engine import catalogue, protocols
from deconfounded.benchmarks.engine.catalogue import METHODS
from deconfounded.benchmarks.engine.published import RECORDS
from deconfounded.benchmarks.output import records
from deconfounded.envs.support import outside

COMPARED = ("commit", "machine", "expert", "outside", "protocol", "task_version", "method_version", "expert_version")


def verdict(record: records.Record, again: records.Record) -> tuple[str, list[str]]:
    """What to say of a record whose seed was run again, and what differs in how they were made."""
    differs = [f"{key}: {record[key]}, now {again[key]}" for key in COMPARED if record[key] != again[key]]
    was, now = (each.get("package", "unknown") for each in (record, again))
    differs += [f"package: {was}, now {now}"] * (was != now)
    for name in sorted({*record["versions"], *again["versions"]}):
        was, now = record["versions"].get(name, "none"), again["versions"].get(name, "none")
        differs += [f"{name}: {was}, now {now}"] * (was != now)
    if record["bits"] == again["bits"]:
        return "same bits", differs
    if len(record["returns"]) != len(again["returns"]):
        return "not the same", differs
    mean, sd = (np.array([record[key], again[key]]) for key in ("returns", "returns_sd"))
    error = np.sqrt((sd**2).sum(0) / record["eval_trials"]) + 1e-9
    apart = np.abs(mean[0] - mean[1])
    worst = np.argmax(apart / error)
    differs.append(f"mean returns: up to {apart[worst]:.3g} apart, where the interval allows {3 * error[worst]:.3g}")
    return ("inside the interval" if (apart <= 3 * error).all() else "not the same"), differs


def rerun(record: records.Record, task: envs.Task, method: str, expert: str | None, device: str) -> records.Record:
    """The same seed, made again in a folder that goes away."""
    from deconfounded.benchmarks.engine.benchmark import BenchmarkJob
    from deconfounded.benchmarks.engine.local import Local
    from deconfounded.benchmarks.engine.presets import changed, preset, whose
    from deconfounded.benchmarks.engine.scheduler import run_all

    protocol = record.get("protocol_name", protocols.STANDARD)
    task = protocols.applied(protocol, task)
    settings = protocols.amounts(protocol, preset(record["preset"], task, device, [method]))
    settings = changed(settings, [change for change in record["set"] if whose(change) in ("", method)])
    guest, salts = catalogue.guest(method), tuple(record["salts"]) if "salts" in record else None
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "jobs"
        folder.mkdir()
        what, of = (task.reference, settings, method, (record["seed"],)), (expert, record["salt"], guest)
        job = BenchmarkJob(*what, folder, *of, salts=salts, protocol=protocol)
        with Local() as engine:
            finished, _, failed = run_all([job], device, f"{task.name}, {method}", engine)
        if failed:
            raise failed[0]
        for again in records.of_run(finished, record["preset"], record["set"], task.episodes):
            if again["deployment"] == record["deployment"]:
                return again
    raise envs.InputError(f"{method} left no {records.named(record)} to compare with")


def pick(file: Path, method: str, seed: int, protocol: str = protocols.STANDARD) -> records.Record:
    """The record of a method and seed in a file, of a protocol.

    Raises InputError if there is none, or if there are several.
    """
    by_protocol: dict[str, list[records.Record]] = {}
    for record in records.read(file):
        by_protocol.setdefault(record.get(records.NAME, protocols.STANDARD), []).append(record)
    if protocol not in by_protocol:
        there = f"give --protocol, of {', '.join(by_protocol)}" if by_protocol else "it is empty"
        raise envs.InputError(f"{file} has no records of protocol {protocol}; {there}")
    every = by_protocol[protocol]
    ours = [record for record in every if records.named(record) == method]
    if not ours:
        there = f" in {file}; --records names other files"
        raise envs.closest("method", method, list(dict.fromkeys(map(records.named, every))), there)
    fitting = [record for record in ours if record["seed"] == seed]
    if not fitting:
        seeds = ", ".join(map(str, sorted(record["seed"] for record in ours)))
        raise envs.InputError(f"seed of {method} was {seed}; {file} has {seeds}")
    if len(fitting) > 1:  # of another preset, or other thetas
        several = f"{len(fitting)} records of {method} with seed {seed}"
        raise envs.InputError(f"{file} has {several}; give --records a file that has one")
    return fitting[0]


def main() -> None:
    parser = Parser(__doc__, "--expert", "--device")
    parser.add_argument("task", help="its name, or path/file.py:Class")
    parser.add_argument("method", help="its name, or path/file.py:fit")
    parser.add_argument("seed", type=int)
    parser.add_argument("--protocol", default=protocols.STANDARD, help=f"of {', '.join(protocols.PROTOCOLS)}")
    parser.add_argument("--records", type=Path, help="folder or file; default: those that come with the package")
    args = parser.parse_args()
    task = envs.get(args.task)
    protocols.check(args.protocol, task)
    method = catalogue.add(args.method) if outside.is_outside(args.method) else args.method
    file = args.records or RECORDS
    file = file / records.place(task.name) if file.is_dir() else file
    record = pick(file, method, args.seed, args.protocol)
    if record["method"] not in METHODS:
        raise envs.InputError(f"method {record['method']} is not ours; give it as path/file.py:fit")
    if (task.name, task.version) != (record["task"], record["task_version"]):
        theirs = f"{record['task']} v{record['task_version']}"
        raise envs.InputError(f"the record is of {theirs}; here is {task.name} v{task.version}")
    commands.check_device(args.device)
    outcome, differs = verdict(record, rerun(record, task, record["method"], args.expert, args.device))
    print(f"{task.name} {method} {args.seed}: {outcome}" + "".join(f"\n    {line}" for line in differs))
    if outcome == "not the same":
        raise SystemExit(1)
