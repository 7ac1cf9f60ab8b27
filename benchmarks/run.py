"""The benchmark: expert demonstrations, exploration, imitation, deployment over resets, scores, a report.

    python benchmarks/run.py --task slippery_cartpole
    deconf run --tasks certified --methods my_rnn.py:fit --seeds 5

Seeds of a method run side by side in one program, in as many groups as there are cores (one group on a GPU). Every
(method, seed) has a file, written when it is done, and --resume goes on from the files that are there.
"""

if __name__ == "__main__":  # this file is `deconf run` too
    import sys

    sys.path.pop(0)  # benchmarks/, whose `data` or `train` would be taken for a user's
    from deconfounded.__main__ import main as deconf

    deconf("run")
    raise SystemExit

import argparse
import tempfile
import traceback
from importlib.util import find_spec
from pathlib import Path

from deconfounded import envs
from deconfounded.benchmarks import commands
from deconfounded.benchmarks.console import COMMON
from deconfounded.benchmarks.engine import published
from deconfounded.benchmarks.engine.catalogue import DEFAULT, EXACT, METHODS, REFERENCES
from deconfounded.benchmarks.engine.identity import named
from deconfounded.benchmarks.engine.protocols import PROTOCOLS, STANDARD, amounts, applied
from deconfounded.experts import policy


def main() -> None:
    """The experiment on one page."""
    parser = commands.parser(
        __doc__, "`all`, or some of those that --list names; your own is path/file.py:fit", resumes=True
    )
    parser.add_argument("--task", help="which task; see --list; your own is path/file.py:Class")
    several = f"several tasks, a folder each: names, or {', '.join(published.GROUPS)}"
    parser.add_argument("--tasks", nargs="+", metavar="NAME", help=several)
    parser.add_argument("--expert", **COMMON["--expert"])
    parser.add_argument("--list", action="store_true", help="list tasks and methods, and stop")
    parser.add_argument("--track", choices=["tensorboard"], help="log losses during training, in the run's folder")
    parser.add_argument("--salt", default="", help="any text: evaluation draws other thetas by it")
    protocols = "; ".join(f"{name}: {text}" for name, text in PROTOCOLS.items())
    parser.add_argument("--protocol", default=STANDARD, help=protocols)
    parser.add_argument("--debug", action="store_true", help="run in this process, for a debugger; keeps nothing")
    args = parser.parse_args()
    if args.list:
        return listed(args)
    if (args.task is None) == (args.tasks is None):
        given = "--task and --tasks were both given" if args.task else "neither --task nor --tasks was given"
        raise envs.InputError(f"{given}; give one of them: there are {', '.join(envs.names())}")
    tasks = [envs.get(args.task)] if args.task is not None else published.tasks(args.tasks)
    tasks = [applied(args.protocol, task) for task in tasks]
    opaque = next((task.name for task in tasks if not task.has_likelihood), None)
    possible = [name for name in METHODS if name not in EXACT or opaque is None]
    if refused := [name for name in args.methods or () if name in EXACT and name not in possible]:
        right = "`deconf certify` has learned ones"
        raise envs.InputError(f"--methods had {refused[0]}, and {opaque} has no likelihood for it; {right}")
    default = [name for name in DEFAULT if name in possible]
    wanted = {*commands.check(args, possible, default, guests=True), *REFERENCES}
    for task in tasks:
        envs.check_task(task)
        policy.load(task, args.expert)
    if args.track and not find_spec("tensorboard"):
        raise envs.InputError("--track tensorboard needs it; `pip install deconfounded-imitation[track]` brings it")
    if args.debug and (args.cluster or args.out or args.resume):
        raise envs.InputError("--debug runs in this process and keeps nothing; leave out --cluster, --out and --resume")
    from deconfounded.benchmarks.engine.job_files import know_guests
    from deconfounded.benchmarks.engine.presets import changed, preset, whose  # torch takes seconds

    with tempfile.TemporaryDirectory(prefix="deconfounded-debug-") as aside:
        base = Path(aside) if args.debug else args.out or Path("results")
        own = args.out is not None and args.task is not None
        kind = "-".join([args.preset, *named(args.protocol).values()])
        folders = {task.name: base if own else base / f"{task.name}-{kind}" for task in tasks}
        for task in tasks:
            know_guests(folders[task.name] / "jobs")
            changed(amounts(args.protocol, preset(args.preset, task, args.device)), args.set)
        if not args.resume:  # a resumed run has to be given the same --set
            for change in args.set:
                if (method := whose(change)) not in ("", *wanted):
                    right = "add it to --methods, or leave the change out"
                    raise envs.InputError(f"--set had {change}, and method {method} does not run; {right}")
        run_tasks(tasks, args, [name for name in METHODS if name in wanted], folders)


def run_tasks(tasks: list[envs.Task], args: argparse.Namespace, methods: list[str], folders: dict[str, Path]) -> None:
    """Run the methods on each task; where one fails, the others go on. Raises InputError in the end if one failed.

    Each task has its report, if random actions and the expert, which scores need, did not fail.
    """
    from deconfounded.benchmarks.engine.benchmark import BenchmarkJob
    from deconfounded.benchmarks.output import run_report  # it takes seconds; bad input is refused at once

    begun = [str(folder) for folder in folders.values() if (folder / "settings.json").exists()]
    if begun and not args.resume and len(tasks) > 1:
        raise envs.InputError(f"there are runs in {', '.join(begun)}; give --resume to go on, or another --out")
    failed: dict[str, Exception] = {}
    with commands.engine(args.cluster, args.debug) as where:
        for task in tasks:
            folder = folders[task.name]
            try:
                run_report.check_kept(task, folder)
                finished, about, errors = commands.run(
                    BenchmarkJob, task, args, methods, folder, where, run_report.check_references
                )
                if not errors or {name for name, *_ in finished} >= set(REFERENCES):
                    text = run_report.write(task, about, finished, folder)
                    print(text if args.debug else f"{text} -> {folder / 'report.html'}")  # --debug keeps none
                if len(errors) > 1:
                    raise envs.InputError(f"{len(errors)} jobs failed, as said above; the last: {errors[-1]}")
                if errors:
                    raise errors[0]
            except envs.InputError as error:
                if args.debug:
                    traceback.print_exc()
                if len(tasks) == 1:
                    raise
                failed[task.name] = error
                print(f"{task.name} failed: {error}")
    if failed:
        name, reason = next(iter(failed.items()))
        raise envs.InputError(f"{len(failed)} of {len(tasks)} tasks failed; {name}: {reason}")


def listed(args: argparse.Namespace) -> None:
    """Print the tasks with their latents, and the methods."""
    if args.task is not None or args.tasks is not None:
        raise envs.InputError(
            f"--list was given with {args.task or ' '.join(args.tasks or ())}; it lists all; give it alone"
        )
    for name in envs.names():
        try:
            task = envs.get(name)
        except envs.InputError as error:  # of another package
            print(f"{name}: {error}")
            continue
        latents = (f"{lat.name} {lat.low:g}..{lat.high:g} {lat.unit}".strip() for lat in task.latents)
        print(f"{name}: {', '.join(latents)}")
    print(f"methods: {', '.join(METHODS)}\n    by default: {', '.join(DEFAULT)}")
