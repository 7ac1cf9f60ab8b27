"""Commands that train methods share this: arguments, their checks, the engine, and the description of a run."""

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from deconfounded import envs
from deconfounded.benchmarks.console import Parser, place
from deconfounded.benchmarks.engine import catalogue, identity
from deconfounded.benchmarks.engine.catalogue import METHODS, PRESETS
from deconfounded.benchmarks.engine.protocols import STANDARD, amounts, check_methods, possible
from deconfounded.envs.support import outside
from deconfounded.envs.support.files import check_folder

if TYPE_CHECKING:  # torch takes seconds: what only checks its arguments goes without
    from deconfounded.benchmarks.engine.job_files import Finished
    from deconfounded.benchmarks.engine.jobs import Job
    from deconfounded.benchmarks.engine.local import Local
    from deconfounded.benchmarks.engine.presets import Preset
    from deconfounded.benchmarks.engine.scheduler import Engine


def parser(description: str | None, methods: str, seeds: int | None = None, resumes: bool = False) -> Parser:
    """Arguments of a run; methods: help on what they may be; seeds: how many by default, if not the preset's.

    resumes: whether it goes on in a folder that holds a part of it only if it is given --resume.
    """
    made = Parser(description, "--device")
    presets = "; ".join(f"{name}: {text}" for name, text in PRESETS.items())
    made.add_argument("--preset", default="default", help=presets)
    made.add_argument("--methods", nargs="+", metavar="NAME", help=methods)
    made.add_argument("--set", nargs="+", metavar="KEY=VALUE", default=[], help="settings, e.g. naive_rnn.updates=500")
    made.add_argument("--seeds", type=int, default=seeds, metavar="N", help=f"default: {seeds or 'of the preset'}")
    cluster = "run on a Ray cluster: HOST:PORT, or auto for this machine's"
    made.add_argument("--cluster", metavar="ADDRESS", help=cluster)
    made.add_argument("--out", type=place, help="output folder; default: a folder under results/")
    if resumes:
        made.add_argument("--resume", action="store_true", help="run what is not finished in the output folder")
    made.set_defaults(expert=None, salt="", track=None, debug=False, protocol=STANDARD)  # of run.py alone
    return made


def check(args: argparse.Namespace, allowed: Sequence[str], default: Sequence[str], guests: bool = False) -> list[str]:
    """The methods asked for; guests: from outside too. Raises InputError for anything that cannot be run."""
    every = possible(args.protocol, allowed)
    methods = [name for asked in args.methods or default for name in (every if asked == "all" else [asked])]
    if guests:
        methods = [catalogue.add(name) if outside.is_outside(name) else name for name in methods]
        allowed = [*allowed, *METHODS.outside]
    catalogue.check(args.preset, methods, args.seeds, allowed)
    if args.seeds and (given := [change for change in args.set if change.partition("=")[0] == "seeds"]):
        raise envs.InputError(f"--set had {given[0]}, and --seeds is {args.seeds}; give --seeds alone")
    check_methods(args.protocol, methods)
    if args.cluster is None:
        check_device(args.device)
    elif args.device not in ("cpu", "cuda"):
        raise envs.InputError(
            f"--device was {args.device}; with --cluster it must be cpu, or cuda, of which Ray gives one"
        )
    elif not find_spec("ray"):
        raise envs.InputError("--cluster needs Ray; `pip install deconfounded-imitation[cluster]` brings it")
    return list(dict.fromkeys(methods))


def check_device(device: str) -> None:
    """Raises InputError for a torch device that cannot be used."""
    if device == "cpu":
        return
    import torch

    try:
        torch.zeros(1, device=device).item()
    except Exception:  # torch raises errors of many types
        raise envs.InputError(f"--device {device} cannot be used here; cpu always can") from None


def about(
    kind: "type[Job]",
    task: envs.Task,
    name: str,
    settings: "Preset",
    changes: Sequence[str],
    expert: str | None,
    salt: str,
    protocol: str = STANDARD,
) -> dict[str, Any]:
    """What a folder is for, so that no other run writes there. Each job checks the rest that its results depend on."""
    ours = {method: values for method, values in settings.configs.items() if method not in METHODS.outside}
    made_of = {"task": task.name, "task_version": task.version, "reference": task.reference, "preset": name}
    made_of |= {"set": list(changes), "settings": {**asdict(settings), "configs": ours}}
    made_of |= {"versions": identity.versions(), **identity.expert(task, expert)}
    return {"kind": kind.__name__, **made_of, "salt": salt, "episodes": task.episodes, **identity.named(protocol)}


def engine(cluster: str | None, debug: bool = False) -> "Engine":
    """What jobs run on: processes of this machine, or the Ray cluster of that address; or, to debug, this process."""
    if debug:
        from deconfounded.benchmarks.engine.local import Here

        return Here()
    if cluster is None:
        return local()
    from deconfounded.benchmarks.engine.cluster import Cluster

    return Cluster(cluster)


def local() -> "Local":
    """Processes of this machine."""
    from deconfounded.benchmarks.engine.local import Local

    return Local()


def run(
    kind: "type[Job]",
    task: envs.Task,
    args: argparse.Namespace,
    methods: Sequence[str],
    folder: Path,
    where: "Engine",
    check: "Callable[[envs.Task, dict[str, Any], Finished], None]" = lambda task, about, references: None,
) -> "tuple[Finished, dict[str, Any], list[Exception]]":
    """Run what is not finished in the folder; returns all that is, what the folder is for, and errors of jobs.

    check: is called with the results of random actions and of the expert before anything is trained, and may raise.
    """
    from deconfounded.benchmarks.engine.job_files import prepare
    from deconfounded.benchmarks.engine.presets import changed, preset
    from deconfounded.benchmarks.engine.scheduler import run_all

    settings = changed(amounts(args.protocol, preset(args.preset, task, args.device)), args.set)
    seeds = args.seeds or settings.seeds
    catalogue.check(args.preset, (), seeds, ())
    own = args.expert, args.salt
    described = about(kind, task, args.preset, settings, args.set, *own, args.protocol)
    with locked(folder):
        prepare(folder, described, args.resume)
        track = args.track is not None
        jobs = [
            kind(
                *(task.reference, settings, name, tuple(range(seeds)), folder / "jobs", *own),
                guest=catalogue.guest(name),
                track=track,
                walled=not args.debug,
                protocol=args.protocol,
            )
            for name in methods
        ]
        label, checked = f"{task.name}, {args.preset}", partial(check, task, described)
        finished, resumed, failed = run_all(jobs, args.device, label, where, checked)
    return finished, {**described, "resumed": resumed}, failed


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Lock a folder against other commands; a lock ends with its process. Raises InputError if another one has it."""
    from filelock import FileLock, Timeout

    check_folder(folder)
    try:
        with FileLock(folder / ".lock", timeout=0):
            yield
    except Timeout:
        raise envs.InputError(f"another command is at work in {folder}; wait for it, or give another --out") from None
