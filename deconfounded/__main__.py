"""The command line, `deconf NAME ...`: one entrance for all commands, with one line for bad input and for signals.

Each name below is a module whose `main` reads the rest of the line; `deconf NAME --help` shows it.
"""

import importlib
import sys

from deconfounded.benchmarks.console import ROOT, end, run_command, stop_at_once

STUDIES = "benchmarks.studies."  # of a checkout alone: they make this repository's own pages
EXTRAS = {"train": "train", "foreign": "foreign", "site": "docs"}  # of commands that need more than bench
NOTHING = "nothing was written"
RESUMED = "what was finished is kept, and --resume goes on"
REPEATED = "what was finished is kept, and the same command goes on"
WRITTEN = "what was written so far stays; run it again"
COMMANDS = {  # name: module, what it does, what is said when it is interrupted
    "run": ("benchmarks.run", "train, deploy and score methods on a task", RESUMED),
    "train": ("benchmarks.train", "train a task's expert (PPO)", NOTHING),
    "check": ("benchmarks.check", "does a task meet the contract? its tests", NOTHING),
    "certify": ("benchmarks.certify", "is a task confounded, and by how much?", NOTHING),
    "diagnose": ("benchmarks.diagnose", "is *your* data confounded? from logs alone", REPEATED),
    "look": ("benchmarks.look", "what is in your data, and what would mislead a diagnosis", NOTHING),
    "validate": ("benchmarks.studies.validate", "is a diagnosis right, where the truth is known?", REPEATED),
    "foreign": ("benchmarks.studies.foreign.measure", "is a diagnosis right on simulators of others?", REPEATED),
    "play": ("benchmarks.play", "run a saved agent in one environment", NOTHING),
    "score": ("benchmarks.score", "score a saved agent on fresh thetas, or on another range", NOTHING),
    "data": ("benchmarks.data", "write demonstrations or explorations as a Minari data set", NOTHING),
    "push": ("benchmarks.push", "share an agent or a Minari data set on the Hugging Face hub", NOTHING),
    "pull": ("benchmarks.pull", "fetch an agent or a data set from the hub", NOTHING),
    "report": ("benchmarks.report", "make a run's report again, without training", WRITTEN),
    "compare": ("benchmarks.compare", "compare methods over seeds and tasks: tables and figures for a paper", WRITTEN),
    "verify": ("benchmarks.verify", "run a record's seed again, and compare", NOTHING),
    "version": ("benchmarks.version", "versions, machine and GL, for a bug report", NOTHING),
    "table": ("benchmarks.studies.table", "make the records that are missing or stale", REPEATED),
    "publish": ("benchmarks.studies.publish", "write the pages of docs/ again, with a finished run too", WRITTEN),
    "site": ("benchmarks.studies.site", "build the documentation site", NOTHING),
    "paper": ("benchmarks.studies.paper", "figures 2 and 3 of the paper", RESUMED),
    "performance": ("benchmarks.studies.performance", "what the benchmark costs: steps a second, CPU seconds", WRITTEN),
    "tune": ("benchmarks.studies.tune", "the baselines' tuning", REPEATED),
    "spectrum": ("benchmarks.studies.spectrum", "where delusion begins: scores under more and less noise", REPEATED),
    "exploration": ("benchmarks.studies.exploration", "scores against the amount of exploration", REPEATED),
}


def print_help() -> None:
    """What commands there are."""
    print("usage: deconf COMMAND ...\n")
    for command, (module, text, _) in COMMANDS.items():
        print(f"  {command:11} {text}{' (in a checkout)' * module.startswith(STUDIES)}")


def main(*first: str) -> None:
    """Run a command; the command line is what is given here, and then this process's arguments."""
    stop_at_once()
    name, *arguments = [*first, *sys.argv[1:]] or ["--help"]
    if name in ("-h", "--help"):
        return run_command(print_help)
    name = "version" if name == "--version" else name
    if name not in COMMANDS:
        from deconfounded.envs import closest

        end(f"error: {closest('command', name, list(COMMANDS))}")
    module, _, interrupted = COMMANDS[name]
    if module.startswith(STUDIES) and not ((ROOT / "pyproject.toml").is_file() and (ROOT / "docs").is_dir()):
        end(f"error: {name} makes the pages of a checkout, and {ROOT} is none; clone the repository, and run it there")
    sys.argv = [f"deconf {name}", *arguments]
    try:
        run_command(importlib.import_module(f"deconfounded.{module}").main, interrupted)
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("deconfounded"):
            raise
        extra = EXTRAS.get(name) or ("data" if error.name in ("minari", "h5py", "pyarrow") else "bench")
        end(f"error: {error.name} is not installed; `pip install deconfounded-imitation[{extra}]` brings it")


if __name__ == "__main__":
    main()
