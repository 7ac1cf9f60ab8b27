"""kill -9 in runs on Ray, again and again: `python -m tests.faults.cluster --kills 10 --seed 0`

Starts Ray on this machine, with two nodes. Runs of run.py on it are hit at random times: a worker, a node, the mailbox,
or the command itself, which is then begun again with --resume. Each must end with the numbers of a run in local
processes, bit for bit; what was finished at a kill must be the same file in the end; and nothing may be left running.
Exit code 1 if not.
"""

import argparse
import hashlib
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from ray.cluster_utils import Cluster

from tests import tools

ROOT = Path(__file__).parents[2]
RUN = ("--task", "bandit", "--preset", "smoke", "--methods", "naive_rnn", "blind_bc", "--seeds", "2")
MARK = "DECONFOUNDED_KILLS"  # in the environment of all that this script starts
AMOUNTS = ("naive_rnn.updates=150", "expert_trials=200", "eval_trials=200", "blind_bc.updates=200")


def command(out: Path, *more: str) -> subprocess.Popen[bytes]:
    """Begin a run."""
    words = [sys.executable, str(ROOT / "benchmarks" / "run.py"), *RUN, "--set", *AMOUNTS, "--out", str(out), *more]
    with (out.parent / f"{out.name}.log").open("ab") as log:
        return subprocess.Popen(words, cwd=ROOT, stdout=log, stderr=log)


def finished(out: Path) -> dict[str, str]:
    """SHA-256 of each finished seed's file."""
    files = sorted((out / "jobs").glob("*.npz"))
    return {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


def processes(*starts: str) -> list[int]:
    """Those of this script's Ray whose command line starts so."""
    return [number for number, _ in tools.processes(f"{MARK}={os.environ[MARK]}", *starts)]


def hit(kind: str, run: subprocess.Popen[bytes], cluster: Any, second: list[Any]) -> bool:
    """kill -9 of that kind; returns whether there was something to kill."""
    if kind == "command":
        run.kill()
    elif kind == "node":
        cluster.remove_node(second.pop(), allow_graceful=False)
        second.append(cluster.add_node(num_cpus=1))
    else:
        there = processes("ray::work") if kind == "worker" else processes("ray::Mailbox")
        for process in there[:1]:
            os.kill(process, signal.SIGKILL)
        return bool(there)
    return True


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    rng, bad, kills, runs = random.Random(args.seed), 0, 0, 0
    os.environ |= {MARK: str(os.getpid()), "RAY_USAGE_STATS_ENABLED": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0"}
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    with tempfile.TemporaryDirectory() as scratch:
        local = Path(scratch) / "local"
        if command(local).wait():
            raise SystemExit(f"the run in local processes failed:\n{local.with_suffix('.log').read_text()}")
        expected = (local / "rows.csv").read_bytes()
        cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
        second = [cluster.add_node(num_cpus=1)]
        try:
            while kills < args.kills:
                out, resume, ended, kept = Path(scratch) / f"run-{runs}", list[str](), False, dict[str, str]()
                runs += 1
                while not ended:
                    run = command(out, "--cluster", cluster.address, *resume)
                    killed = False
                    while kills < args.kills and not killed:
                        try:
                            run.wait(rng.uniform(5, 20))
                            break
                        except subprocess.TimeoutExpired:
                            before, kind = finished(out), rng.choice(["worker", "worker", "node", "command", "mailbox"])
                            if hit(kind, run, cluster, second):
                                kills += 1
                                kept |= before
                                killed = kind == "command"
                                print(f"kill {kills}, {kind}: {len(before)} files were finished", flush=True)
                    ended, resume = run.wait() == 0, ["--resume"]
                    if not ended and not killed:
                        print(f"run {runs} failed:\n{out.with_suffix('.log').read_text()}")
                        bad += 1
                        break
                lost = [name for name, digest in kept.items() if finished(out).get(name) != digest]
                same = ended and (out / "rows.csv").read_bytes() == expected
                deadline = time.monotonic() + 30
                while (left := processes("ray::work", "ray::Mailbox")) and time.monotonic() < deadline:
                    time.sleep(0.2)
                bad += bool(lost) + (not same) + bool(left)
                print(f"run {runs}: {len(lost)} lost, same numbers: {same}, processes left: {len(left)}", flush=True)
        finally:
            cluster.shutdown()
    print(f"{kills} kills in {runs} runs: {bad} faults")
    raise SystemExit(bool(bad))


if __name__ == "__main__":
    main()
