"""benchmarks/run.py that leaves a checkpoint within a job every .3 s, in its worker processes too: for kills.py."""

from __future__ import annotations

if __name__ == "__main__":
    from deconfounded.benchmarks.console import stop_at_once

    stop_at_once()

from deconfounded.benchmarks import commands, run
from deconfounded.benchmarks.console import run_command
from deconfounded.benchmarks.engine import jobs

jobs.SAVE_EVERY_S = 0.3  # workers run this file too, before their jobs

if __name__ == "__main__":
    run_command(run.main, commands.KEPT)
