"""One command for all: `deconf run --task slippery_cartpole` is `python benchmarks/run.py --task slippery_cartpole`.

Each name below is a file with a command line of its own; `deconf NAME --help` shows it.
"""

from __future__ import annotations

import runpy
import sys

from deconfounded.benchmarks.console import need_checkout, quiet_pipe, stop_at_once

STUDIES = "benchmarks.studies."  # of a checkout alone: they make this repository's own pages
COMMANDS = {
    "run": ("benchmarks.run", "train, deploy and score methods on a task"),
    "train": ("benchmarks.train", "train a task's expert (PPO)"),
    "check": ("benchmarks.check", "does a task hold together? the contract tests"),
    "certify": ("benchmarks.certify", "is a task confounded, and by how much?"),
    "diagnose": ("benchmarks.diagnose", "is *your* data confounded? from an expert's trials alone"),
    "validate": ("benchmarks.studies.validate", "is a diagnosis right, where the truth is known?"),
    "play": ("benchmarks.play", "run a kept agent in one environment"),
    "score": ("benchmarks.score", "score a kept agent on fresh thetas, or a range never seen"),
    "data": ("benchmarks.data", "write demonstrations or explorations as a Minari data set"),
    "report": ("benchmarks.report", "make a run's report again, without training"),
    "verify": ("benchmarks.verify", "run a record's seed again, and compare"),
    "table": ("benchmarks.studies.table", "make the records that are missing"),
    "publish": ("benchmarks.studies.publish", "write the pages of docs/ anew, of a finished run too"),
    "paper": ("benchmarks.studies.paper", "figures 2 and 3 of the paper"),
    "performance": ("benchmarks.studies.performance", "what the benchmark costs: steps a second, CPU seconds"),
    "tune": ("benchmarks.studies.tune", "the opponents' tuning"),
    "spectrum": ("benchmarks.studies.spectrum", "where delusion begins: more and less noise"),
}


def main() -> None:
    """Run the command that is named first, with the arguments that follow it."""
    name = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if name in ("-h", "--help"):
        with quiet_pipe():
            print("usage: deconf COMMAND ...\n")
            for command, (module, text) in COMMANDS.items():
                print(f"  {command:11} {text}{' (in a checkout)' * module.startswith(STUDIES)}")
        return
    if name not in COMMANDS:
        print(f"error: command {name!r} is unknown; there are {', '.join(COMMANDS)}", file=sys.stderr)
        sys.exit(2)
    if COMMANDS[name][0].startswith(STUDIES):
        need_checkout(name)
    stop_at_once()
    sys.argv = [f"deconf {name}", *sys.argv[2:]]
    try:
        runpy.run_module(f"deconfounded.{COMMANDS[name][0]}", run_name="__main__", alter_sys=True)
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("deconfounded"):
            raise
        extra = "train" if name == "train" else "data" if error.name == "minari" else "bench"
        print(
            f"error: {error.name} is not installed; `pip install deconfounded-imitation[{extra}]` brings it",
            file=sys.stderr,
        )
        sys.exit(2)


if __name__ == "__main__":
    main()
