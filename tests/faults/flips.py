"""Flip single bits in the files that commands read back: `python -m tests.faults.flips` (10 CPU seconds)

Of each kind of file, 300 copies with one bit flipped, drawn by --seed. *noticed*: the file is not believed (it is made
again, or told of in one line); *harmless*: what is read is equal to what was written, every value of it. Anything else
is *believed* or an *error* of another kind, and makes this end with 1.
"""

import argparse
import queue
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import deconfounded
from deconfounded import envs
from deconfounded.benchmarks.engine import job_files, jobs, progress
from deconfounded.benchmarks.engine.benchmark import BenchmarkJob, CurveMonitor
from deconfounded.benchmarks.output import records
from deconfounded.deconf.core.agents import LearnedAgent
from deconfounded.envs.support.files import read_sealed
from deconfounded.experts import policy
from deconfounded.experts.trials import Trials
from tests.tools import tiny_preset

Read = Callable[[], Any]


def equal(one: Any, other: Any) -> bool:
    """Of the same types and values, all the way down."""
    if type(one) is not type(other):
        return False
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(equal(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(equal, one, other))
    if hasattr(one, "numpy"):
        one, other = one.numpy(), other.numpy()
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes()
    return one == other


def files(folder: Path) -> dict[str, tuple[Path, Read]]:
    """One file of each kind, as commands write it, and what reads it: None or InputError if it is not believed."""
    progress._ticks = queue.Queue()  # type: ignore[assignment]
    job_files.prepare(folder, {"task": "bandit", "seeds": 3, "set": ["seeds=3"], "rate": 1e-3}, resume=False)
    jobs.SAVE_EVERY_S = 0.0
    job = BenchmarkJob("bandit", tiny_preset(), "naive_rnn", (0,), folder / "jobs")
    kept = folder / "kept.pt"
    close = CurveMonitor.close

    def keeping(self: CurveMonitor) -> float:
        shutil.copy(self.file, kept)
        return close(self)

    CurveMonitor.close = keeping  # type: ignore[method-assign]
    job.run()
    data = job.load(0)
    assert data is not None
    (record,) = records.of_job(data, "smoke", [], 1)
    records.write(folder, [record])
    agent = folder / "agents" / "naive_rnn-0"
    monitor = CurveMonitor(job, 0.8)
    shutil.copy(kept, monitor.file)
    task = envs.get("tilted_cartpole")
    weights = folder / "tilted_cartpole.safetensors"
    for suffix in (".safetensors", ".json"):
        shutil.copy(policy.path(task).with_suffix(suffix), weights.with_suffix(suffix))
    trials_file = folder / "trials.npz"
    rng = np.random.default_rng(0)
    Trials(rng.random((4, 2, 9, 3)), rng.random((4, 2, 8, 1)), np.ones((4, 2, 8), bool)).save(trials_file)

    def whole(trials: Trials) -> list[Any]:
        return [trials.obs, trials.action, trials.mask, trials.actions]

    def state() -> Any:
        loaded = deconfounded.load(agent)
        assert isinstance(loaded, LearnedAgent)
        return type(loaded).__name__, loaded.state()

    def checkpoint() -> Any:
        loaded = monitor.load()
        return loaded and [loaded, monitor.kept, monitor.before, monitor.budget, monitor.cpu_before]

    def demonstrations() -> Any:
        return whole(job.context().demonstrations) if job.context().has_demonstrations(0) else None

    def weights_read() -> Any:
        expert = policy.load(task, weights)
        assert isinstance(expert, policy.NetworkExpert)
        return expert.weights

    return {
        "a job's .npz": (job.file(0), lambda: job.load(0)),
        "a checkpoint .pt": (monitor.file, checkpoint),
        "demonstrations .npz": (folder / "jobs" / "demonstrations-0.npz", demonstrations),
        "an expert's .safetensors": (weights, weights_read),
        "Trials .npz": (trials_file, lambda: whole(Trials.load(trials_file))),
        "agent.safetensors": (agent / "agent.safetensors", state),
        "agent.json": (agent / "agent.json", state),
        "records .jsonl": (folder / "bandit.jsonl", lambda: records.read(folder / "bandit.jsonl")),
        "settings.json": (folder / "settings.json", lambda: read_sealed(folder / "settings.json")),
    }


def flip(file: Path, read: Read, flips: int, seed: int) -> Counter[str]:
    """How many of so many flips are noticed, harmless, believed, or an error of another kind."""
    content, expected, rng = file.read_bytes(), read(), np.random.default_rng(seed)
    assert expected is not None
    outcomes: Counter[str] = Counter()
    for _ in range(flips):
        at, bit = int(rng.integers(len(content))), int(rng.integers(8))
        flipped = bytearray(content)
        flipped[at] ^= 1 << bit
        file.write_bytes(bytes(flipped))
        try:
            got = read()
        except envs.InputError as error:
            outcomes["noticed" if "\n" not in str(error) else "error: more than a line"] += 1
        except Exception as error:
            outcomes[f"error: {type(error).__name__} at byte {at}, bit {bit}"] += 1
        else:
            outcomes["noticed" if got is None else "harmless" if equal(got, expected) else "believed"] += 1
    file.write_bytes(content)
    return outcomes


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flips", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    args, bad = parser.parse_args(), 0
    with tempfile.TemporaryDirectory() as scratch:
        for kind, (file, read) in files(Path(scratch)).items():
            outcomes = flip(file, read, args.flips, args.seed)
            bad += args.flips - outcomes["noticed"] - outcomes["harmless"]
            counts = ", ".join(f"{count} {what}" for what, count in sorted(outcomes.items(), reverse=True))
            print(f"{kind:25} {file.stat().st_size:7,} bytes: {counts}", flush=True)
    print(f"{bad} believed, or an error of another kind")
    sys.exit(bad > 0)


if __name__ == "__main__":
    main()
