"""What seeds cost side by side: `deconf seeds`

Seconds an update of S seeds in one program, in one thread or on a GPU, over those of one seed. S means that stacking
gains nothing, 1 that the other seeds come for free.
"""

from __future__ import annotations

if __name__ == "__main__":  # Ctrl-C while the rest is imported is one line too
    from deconfounded.benchmarks.console import stop_at_once

    stop_at_once()

import time
from dataclasses import replace
from statistics import median
from typing import Any

import torch

from deconfounded import envs
from deconfounded.benchmarks import commands
from deconfounded.benchmarks.console import Parser, run_command
from deconfounded.benchmarks.engine import catalogue
from deconfounded.benchmarks.engine.context import Context
from deconfounded.benchmarks.engine.presets import Preset, preset
from deconfounded.benchmarks.engine.provider import fit
from deconfounded.deconf.core.agents import Monitor
from deconfounded.experts.rollout import Agent

TIMED = ("naive_rnn", "deconfounded", "deconfounded_discrete")
UPDATES = 12  # of each kind; the first ones warm up


class Clock(Monitor):
    """Times the updates of each kind."""

    def __init__(self) -> None:
        super().__init__()
        self.times: dict[str, list[float]] = {}
        self.last, self.done = time.perf_counter(), 0

    def update(self, done: int, total: int, losses: dict[str, float], agent: Agent | None = None) -> None:
        now = time.perf_counter()  # a GPU is done by now: the loss was read
        self.times.setdefault(next(iter(losses)), []).append((now - self.last) / (done - self.done))
        self.last, self.done = now, done

    def seconds(self) -> dict[str, float]:
        """Of an update, by kind."""
        return {kind: median(times[2:]) for kind, times in self.times.items()}


def few(full: Preset) -> Preset:
    """The preset's networks and batches, on little data and for few updates."""
    small: dict[str, Any] = {"rounds": 1, "final_updates": 0}
    small |= {"inference_updates": UPDATES, "imitation_updates": UPDATES}
    little = replace(full, expert_trials=128, explore_trials=128, eval_trials=1, fresh=0)
    little = little.configured("deconfounded", **small).configured("deconfounded_discrete", **small)
    return little.configured("naive_rnn", updates=UPDATES, chunk=min(full.configs["naive_rnn"]["chunk"], 50))


def main() -> None:
    """The command line."""
    parser = Parser(__doc__)
    parser.add_argument("--task", default="bandit")
    parser.add_argument("--preset", default="default")
    parser.add_argument("--device", default="cpu", help="torch device of training, e.g. cuda")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 5, 10], metavar="S", help="default: 1 2 5 10")
    args = parser.parse_args()
    task = envs.get(args.task)
    for seeds in args.seeds:
        catalogue.check(args.preset, None, seeds, TIMED)
    commands.check_device(args.device)
    settings = few(preset(args.preset, task, args.device))
    print(f"{task.name}, {args.preset}, {args.device}, torch {torch.__version__}")
    for method in TIMED:
        alone: dict[str, float] = {}
        for seeds in sorted({1, *args.seeds}):
            clock = Clock()
            fit(Context(task, settings, range(seeds), clock), method)
            for kind, seconds in clock.seconds().items():
                ratio = seconds / alone.setdefault(kind, seconds)
                print(f"{method:22} {kind:10} {seeds:3} seeds {1000 * seconds:8.1f} ms an update, {ratio:5.2f} of one")


if __name__ == "__main__":
    run_command(main)
