"""What tests share."""

import contextlib
import io
import signal
import sys
from dataclasses import asdict
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any
from unittest import mock

from deconfounded import __main__
from deconfounded.benchmarks import commands
from deconfounded.benchmarks.engine.catalogue import METHODS
from deconfounded.benchmarks.engine.local import Here
from deconfounded.benchmarks.engine.presets import Preset

FEW = {"rounds": 2, "inference_updates": 2, "inference_batch": 4, "imitation_updates": 2, "final_updates": 2}
OFFLINE = {"offline_updates": 2, "online_updates": 2, "online_batch": 4, "offline_batch": 4, "synthetic": 4}
PLAIN: dict[str, dict[str, Any]] = {
    "deconfounded": FEW,
    "deconfounded_gru": {"model": "gru", **FEW},
    "deconfounded_forgetting": {"model": "forgetting", **FEW},
    "deconfounded_discrete": {"model": "discrete", **FEW},
    "deconfounded_large": {**FEW, "restart": True},
    "deconfounded_offline": {**OFFLINE, "online_steps": 64},
    "deconfounded_mean": {**FEW, "inference_steps": 64},
    "dagger": {"updates": 6, "rounds": 2, "batch": 4},
    "dpt": {"updates": 2, "rounds": 2, "batch": 4, "width": 16, "heads": 2},
    "gail": {
        **{"width": 16, "rounds": 2, "envs": 2, "steps": 32},
        **{"epochs": 1, "minibatch": 32, "discriminator_updates": 2},
    },
    "rma": {"updates": 2, "rounds": 2, "batch": 4, "teacher_updates": 3, "teacher_batch": 64},
    "naive_transformer": {"updates": 2, "batch": 4, "width": 16, "heads": 2},
    "naive_obs": {"updates": 2, "batch": 4},
    "naive_dropout": {"updates": 2, "batch": 4},
    "palr": {"updates": 2, "batch": 4, "samples": 32},
    "dml_il": {"updates": 4, "batch": 4, "components": 2, "steps": 64},
    "dadp": {"inference_updates": 2, "inference_batch": 4, "inference_steps": 64, "imitation_updates": 2},
    "flow_bc": {"updates": 2, "batch": 4, "steps": 32},
    "naive_rnn": {"updates": 2, "batch": 4},
    "oracle_bc": {"updates": 3, "batch": 64},
    "blind_bc": {"updates": 3, "batch": 64},
    "conditional": {"grid": 3},
    "interventional": {"grid": 3},
}
"""Two or three updates of each kind; what is left out is as a configuration's class has it."""


def tiny_preset() -> Preset:
    """Two or three updates of each kind, on four trials."""
    ours = {name: method for name, method in METHODS.items() if not method.reference}
    if lacking := [name for name, method in ours.items() if method.config({}) is not None and name not in PLAIN]:
        raise AssertionError(f"{lacking[0]} has no amounts in PLAIN of tests/tools.py; two updates are enough")
    configs = {name: asdict(METHODS[name].config(values)) for name, values in PLAIN.items()}
    return Preset(seeds=3, expert_trials=4, explore_trials=4, eval_trials=4, query_trials=4, configs=configs)


def deconf(folder: Path, *args: str) -> "CompletedProcess[str]":
    """The command `deconf ARGS`, run in a folder, but in this process, jobs and all: others take seconds to begin.

    Methods from outside that it makes known are unknown afterwards, as they would be after a process of its own.
    """
    out, err, code = io.StringIO(), io.StringIO(), 0
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    with contextlib.ExitStack() as stack:
        for context in (contextlib.chdir(folder), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err)):
            stack.enter_context(context)
        stack.enter_context(mock.patch.object(sys, "argv", ["deconf", *args]))
        stack.enter_context(mock.patch.object(commands, "local", Here))
        stack.enter_context(mock.patch.dict(METHODS.outside))
        try:
            __main__.main()
        except SystemExit as ended:
            code = ended.code if isinstance(ended.code, int) else 1
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
    return CompletedProcess(args, code, out.getvalue(), err.getvalue())


def dots(axes: Any) -> list[tuple[float, float]]:
    """The points that are drawn in a panel, in the order of drawing."""
    return [(float(x), float(y)) for line in axes.lines for x, y in zip(*line.get_data(), strict=True)]


def bars(axes: Any) -> list[tuple[float, ...]]:
    """The lines from one end to another in a panel, in the order of drawing: x, y, then x, y."""
    return [tuple(map(float, line.ravel())) for lines in axes.collections for line in lines.get_segments()]


def processes(mark: str, *starts: str) -> list[tuple[int, str]]:
    """Number and command line of those with `mark` (NAME=value) in their environment, whose command line starts so."""
    matching = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            words, environ = ((folder / name).read_bytes() for name in ("cmdline", "environ"))
        except OSError:
            continue
        line = words.decode(errors="replace")
        if mark.encode() in environ.split(b"\0") and line.startswith(starts):
            matching.append((int(folder.name), line))
    return sorted(matching)
