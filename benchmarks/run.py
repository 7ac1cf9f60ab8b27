"""The benchmark: expert demonstrations, exploration, imitation, deployment over resets, scores, a report.

    python benchmarks/run.py --task slippery_cartpole

Seeds of a method run side by side in one program, in as many groups as there are cores (one group on a GPU). Every
(method, seed) has a file, written when it is done, and --resume goes on from the files that are there.
"""

if __name__ == "__main__":  # this file is `deconf run` too
    from deconfounded.__main__ import main as deconf

    deconf("run")
    raise SystemExit

from importlib.util import find_spec
from pathlib import Path

from deconfounded import envs
from deconfounded.benchmarks import commands
from deconfounded.benchmarks.console import COMMON
from deconfounded.benchmarks.engine.catalogue import DEFAULT, EXACT, METHODS, REFERENCES
from deconfounded.experts import policy


def main() -> None:
    """The experiment on one page."""
    parser = commands.parser(__doc__, "`all`, or some of those that --list names; your own is path/file.py:fit")
    parser.add_argument("--task", help="which task; see --list; your own is path/file.py:Class")
    parser.add_argument("--expert", **COMMON["--expert"])
    parser.add_argument("--list", action="store_true", help="list tasks and methods, and stop")
    parser.add_argument("--track", choices=["tensorboard"], help="log losses during training, in the run's folder")
    parser.add_argument("--salt", default="", help="any text: evaluation draws other thetas by it")
    args = parser.parse_args()
    if args.list:
        if args.task is not None:
            raise envs.InputError(f"--list was given with --task {args.task}; it lists all; give it alone")
        for name in envs.names():
            try:
                task = envs.get(name)
            except envs.InputError as error:  # of another package
                print(f"{name}: {error}")
                continue
            latents = (f"{lat.name} {lat.low:g}..{lat.high:g} {lat.unit}".strip() for lat in task.latents)
            print(f"{name}: {', '.join(latents)}")
        print(f"methods: {', '.join(METHODS)}\n    by default: {', '.join(DEFAULT)}")
        return
    if args.task is None:
        raise envs.InputError(f"--task is missing; there are {', '.join(envs.names())}")
    task = envs.get(args.task)
    possible = [name for name in METHODS if name not in EXACT or task.has_likelihood]
    if refused := [name for name in args.methods or () if name in EXACT and name not in possible]:
        right = "`deconf certify` has learned ones"
        raise envs.InputError(f"--methods had {refused[0]}, and {task.name} has no likelihood for it; {right}")
    default = [name for name in DEFAULT if name in possible]
    wanted = {*commands.check(args, possible, default, guests=True), *REFERENCES}
    envs.check_task(task)
    policy.load(task, args.expert)
    if args.track and not find_spec("tensorboard"):
        raise envs.InputError("--track tensorboard needs it; `pip install deconfounded-imitation[track]` brings it")
    from deconfounded.benchmarks.engine.benchmark import BenchmarkJob
    from deconfounded.benchmarks.output import run_report  # it takes seconds; bad input is refused at once

    folder = args.out or Path("results") / f"{task.name}-{args.preset}"
    finished, about = commands.run(BenchmarkJob, task, args, [name for name in METHODS if name in wanted], folder)
    print(run_report.write(task, about, finished, folder))
