"""Write a run's tables, pictures and report again, from its finished jobs: `deconf report results/bandit-default`

Nothing is trained. Of a run that is not finished, they show the jobs that are.
"""

from pathlib import Path

from deconfounded import envs
from deconfounded.benchmarks.console import Parser
from deconfounded.benchmarks.engine import job_files
from deconfounded.benchmarks.engine.protocols import STANDARD, applied
from deconfounded.envs.support.files import read_sealed


def main() -> None:
    parser = Parser(__doc__)
    parser.add_argument("run", type=Path, help="output folder of a run")
    folder = parser.parse_args().run
    try:
        about = read_sealed(folder / "settings.json")
        task, kind, _, _ = envs.get(about["reference"]), about["kind"], about["preset"], about["set"]
        task = applied(about.get("protocol_name", STANDARD), task)
    except (OSError, KeyError):
        says = f"{folder} holds no settings.json of a run; give a folder that `deconf run` wrote"
        raise envs.InputError(says) from None
    finished = job_files.left_in(folder / "jobs")
    if kind != "BenchmarkJob" or not {"random", "expert"} <= {method for method, *_ in finished}:
        raise envs.InputError(f"{folder} holds no finished jobs of random and expert; give a folder of run.py")
    from deconfounded.benchmarks.output import run_report  # it takes seconds; bad input is refused at once

    print(f"{run_report.write(task, about, finished, folder)} -> {folder / 'report.html'}")
