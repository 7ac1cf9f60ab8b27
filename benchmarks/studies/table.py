"""Make the records that are missing, method by method and task by task: `deconf table`

Every method on every task of the suite: ten seeds of those that a default run makes, the paper's comparison and the
exact policies, and five of all others. Under another `--protocol`, five seeds of the methods that docs/protocols.md
compares; under `scarce`, what learns from no data keeps its records of the standard protocol. A record of today's
versions, settings and expert stays; the others are made, and kept as soon as they are done. Stopped, it goes on where
it was. The first five seeds of everything come first.
"""

from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from deconfounded import envs
from deconfounded.benchmarks import commands
from deconfounded.benchmarks.engine import published
from deconfounded.benchmarks.engine.catalogue import DEFAULT, METHODS, REFERENCES
from deconfounded.benchmarks.engine.identity import named
from deconfounded.benchmarks.engine.protocols import COMPARED, ONLY_AMOUNTS, PROTOCOLS, STANDARD, amounts, applied
from deconfounded.benchmarks.studies import runs

if TYPE_CHECKING:
    from deconfounded.benchmarks.engine.jobs import Job
    from deconfounded.benchmarks.output.records import Record

SEEDS, FEWER = 10, 5


def seeds_of(method: str, least: int, most: int, protocol: str = STANDARD) -> tuple[int, ...]:
    """The seeds of a method that belong in the table, from `least` up to `most`."""
    many = protocol == STANDARD and method in (*DEFAULT, *REFERENCES)
    return tuple(range(least, most if many else min(most, FEWER)))


def fresh(job: "Job", preset: str, kept: "Sequence[Record]") -> "dict[tuple[int, str], Record]":
    """Of the records kept of the job's task, those that the job would make again today, by seed and deployment."""
    from deconfounded.benchmarks.engine.identity import identity
    from deconfounded.benchmarks.output import records

    today = identity(job)
    same = [record for record in kept if (record["method"], record["preset"]) == (job.method, preset)]
    same = [record for record in same if record.get(records.NAME) == today.get(records.NAME)]
    return {(record["seed"], record["deployment"]): record for record in same if not records.stale(record, today)}


def _without(job: "Job", made: "Collection[tuple[int, str]]") -> tuple[int, ...]:
    """The job's seeds of which a deployment is not among those made."""
    ways = ("", *job.about.deployments)
    return tuple(seed for seed in job.seeds if any((seed, way) not in made for way in ways))


def missing(job: "Job", preset: str, kept: "Sequence[Record]") -> tuple[int, ...]:
    """The job's seeds of which a deployment has no record among those kept of its task, or one that is stale."""
    return _without(job, fresh(job, preset, kept))


def copied(job: "Job", preset: str, kept: "Sequence[Record]") -> "list[Record]":
    """The job's records as copies of those of another protocol, if the two differ in amounts of data alone.

    The records of a method that uses no data are of the same settings under both. Empty if a seed has none there.
    """
    from deconfounded.benchmarks.output.records import NAME

    for protocol in ONLY_AMOUNTS if job.protocol in ONLY_AMOUNTS else ():
        of = fresh(replace(job, protocol=protocol), preset, kept)
        if protocol != job.protocol and not _without(job, of):
            plain = [{key: record[key] for key in record if key != NAME} for record in of.values()]
            return [record | named(job.protocol) for record in plain if record["seed"] in job.seeds]
    return []


def _older(records: "Sequence[Record]", method: str, seeds: Sequence[int]) -> str:
    """In brackets, of which older versions of the method there are records of these seeds."""
    own = [record for record in records if record["method"] == method and record["seed"] in seeds]
    versions = {record["method_version"] for record in own}
    older = sorted(versions - {METHODS[method].version})
    return f" (stale: of v{', v'.join(map(str, older))})" if older else ""


def fitting(protocol: str, tasks: Sequence[envs.Task]) -> list[envs.Task]:
    """The tasks under a protocol; those that cannot be are left out, and a line says why."""
    fit = []
    for task in tasks:
        try:
            fit.append(applied(protocol, task))
        except envs.InputError as error:
            if protocol not in PROTOCOLS:
                raise
            print(f"left out: {error}")
    return fit


def main() -> None:
    parser = commands.parser(__doc__, "default: all that the table has", seeds=SEEDS)
    several = f"names, or {', '.join(published.GROUPS)}; default: suite"
    parser.add_argument("--tasks", nargs="+", metavar="NAME", default=list(envs.SUITE), help=several)
    parser.add_argument("--protocol", default=STANDARD, help=f"of {', '.join(PROTOCOLS)}")
    parser.add_argument("--list", action="store_true", help="print what is missing or stale, and stop")
    args = parser.parse_args()
    tasks = fitting(args.protocol, published.tasks(args.tasks))
    default = METHODS if args.protocol == STANDARD else COMPARED
    asked = {*commands.check(args, list(METHODS), list(default)), *REFERENCES}
    methods = [name for name in METHODS if name in asked]
    from deconfounded.benchmarks.engine.benchmark import BenchmarkJob
    from deconfounded.benchmarks.engine.presets import changed, preset
    from deconfounded.benchmarks.output import records
    from deconfounded.benchmarks.studies.cards import DOCS

    folder = args.out or Path("results") / "-".join(["table", *named(args.protocol).values()])
    under = {"protocol": args.protocol}
    kept = DOCS / "records" if args.preset == "default" and not args.set else folder / "records"
    settings = {
        task.name: changed(amounts(args.protocol, preset(args.preset, task, args.device)), args.set) for task in tasks
    }
    jobs = [
        BenchmarkJob(task.reference, settings[task.name], method, seeds, folder / task.name / "jobs", **under)
        for least, most in ((0, min(FEWER, args.seeds)), (FEWER, args.seeds))
        for task in tasks
        for method in methods
        if (seeds := seeds_of(method, least, most, args.protocol))
    ]
    there = {task.reference: records.held(kept / records.place(task.name)) for task in tasks}
    left = {job: seeds for job in jobs if (seeds := missing(job, args.preset, there[job.task]))}
    if args.list:
        lacking: dict[tuple[str, str], list[int]] = {}
        for job, seeds in left.items():
            lacking.setdefault((job.task, job.method), []).extend(seeds)
        for (task_name, method), seeds_left in lacking.items():
            older = _older(there[task_name], method, seeds_left)
            print(f"{task_name}, {method}: seeds {' '.join(map(str, seeds_left))}{older}")
        print(f"{sum(map(len, lacking.values()))} seeds are missing or stale")
        return
    print(f"{sum(map(len, left.values()))} seeds to make, kept one by one: stop when you like")
    options = {"preset": args.preset, "changes": args.set, "cluster": args.cluster, **under}
    for job, seeds in left.items():
        made = copied(job, args.preset, there[job.task])
        if not made:
            base = replace(job.preset, configs={})  # a method's configuration is each job's own affair
            where = job.folder.parent
            made = runs.run(envs.get(job.task), job.preset, [job.method], seeds, where, base=base, **options)
        records.write(kept, made)
