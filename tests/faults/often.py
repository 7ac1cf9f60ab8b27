"""`deconf run` that leaves a checkpoint within a job every .3 s, in its worker processes too: for kills.py."""

from deconfounded.__main__ import main
from deconfounded.benchmarks.engine import jobs

jobs.SAVE_EVERY_S = 0.3  # workers run this file too, before their jobs

if __name__ == "__main__":
    main("run")
