"""Kill a run at random moments and resume it: `python -m tests.faults.kills --out DIR` (50 minutes on two busy cores)

Small runs on the bandit, first undisturbed and then with all their processes killed (SIGKILL) again and again. What a
kill finds finished must stay as it is, and what comes out in the end must be what the undisturbed run made, bit for
bit: returns of every trial, agents, records and results, but for the time they took. Stop it as you like: it goes on
from what is in --out.
"""

import argparse
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from deconfounded.benchmarks.engine import job_files
from deconfounded.envs.support.files import write_json

HERE = Path(__file__).parent
AMOUNTS = ("seeds=2", "expert_trials=100", "explore_trials=50", "eval_trials=50")
AMOUNTS += ("naive_rnn.updates=120", "naive_rnn.batch=16")
AMOUNTS += ("deconfounded.inference_updates=60", "deconfounded.imitation_updates=40", "deconfounded.final_updates=40")
METHODS = ("blind_bc", "naive_rnn", "deconfounded")
OF_TIME = ("cpu_s", "spans", "wall_s", "resumed", "sha256", "commit", "commits")


def start(out: Path) -> subprocess.Popen[bytes]:
    """The run, as the leader of a group of processes, with its output in a file beside `out`."""
    line = [sys.executable, str(HERE / "often.py"), "--task", "bandit", "--preset", "smoke", "--out", str(out)]
    line += ["--resume", "--methods", *METHODS, "--set", *AMOUNTS]
    with out.with_suffix(".log").open("ab") as log:
        return subprocess.Popen(line, stdout=log, stderr=log, start_new_session=True)


def finished(out: Path) -> dict[str, str]:
    """SHA-256 of each job's file that is whole."""
    files = [file for file in sorted((out / "jobs").glob("*-*.npz")) if job_files.read(file) is not None]
    return {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


def timeless(data: Any) -> Any:
    """The same without what tells of time."""
    if isinstance(data, dict):
        return {key: timeless(value) for key, value in data.items() if key not in OF_TIME}
    return data


def came_out(out: Path) -> dict[str, str]:
    """SHA-256 of all that a finished run left, file by file, without what tells of time."""
    digests = {}
    for file in sorted(file for file in out.rglob("*") if file.is_file()):
        digest, name = hashlib.sha256(), str(file.relative_to(out))
        if file.suffix == ".npz":
            job = job_files.read(file)
            if job is None:  # demonstrations
                digest.update(file.read_bytes())
            else:
                digest.update(json.dumps(timeless(job.pop("meta"))).encode())
                for key in sorted(job):
                    digest.update(key.encode() + np.ascontiguousarray(job[key]).tobytes())
        elif file.suffix in (".json", ".jsonl"):
            texts = file.read_text().splitlines() if file.suffix == ".jsonl" else [file.read_text()]
            digest.update(json.dumps([timeless(json.loads(text)) for text in texts]).encode())
        elif (
            file.suffix in (".html", ".mp4", ".png") or name == ".lock"
        ):  # the report tells of time, pictures are its own
            continue
        else:
            digest.update(file.read_bytes())
        digests[name] = digest.hexdigest()
    return digests


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True, help="a folder")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    whole, notes = args.out / "whole", args.out / "kills.json"
    if not notes.exists():
        shutil.rmtree(whole, ignore_errors=True)
        begin = time.monotonic()
        if start(whole).wait():
            sys.exit(f"the undisturbed run failed: see {whole.with_suffix('.log')}")
        write_json(notes, {"seconds": time.monotonic() - begin, "kills": [], "finished": 0, "wrong": []})
    state, expected = json.loads(notes.read_text()), came_out(whole)
    while len(state["kills"]) < args.kills or (args.out / f"run{state['finished']}").exists():
        out, done = args.out / f"run{state['finished']}", len(state["kills"])
        before, last = finished(out), done >= args.kills  # the last run may end
        moment = float(np.random.default_rng([args.seed, done]).uniform(0, state["seconds"]))
        run = start(out)
        try:
            code = run.wait(None if last else moment)
        except subprocess.TimeoutExpired:
            code = None
        finally:
            if run.poll() is None:
                os.killpg(run.pid, signal.SIGKILL)
                run.wait()
        lost = [name for name, content in before.items() if finished(out).get(name) != content]
        state["wrong"] += [f"{out.name}: {name} was finished, and is another now" for name in lost]
        if code is None:
            state["kills"].append(round(moment, 2))
            print(
                f"kill {done + 1} of {out.name} after {moment:.1f} s, {len(finished(out))} files finished", flush=True
            )
        else:
            digests = came_out(out)
            differ = sorted(name for name in {*digests, *expected} if digests.get(name) != expected.get(name))
            state["wrong"] += [f"{out.name}: ended with {code}"] * bool(code)
            state["wrong"] += [f"{out.name}: {name} is not as in the undisturbed run" for name in differ]
            state["finished"] += 1
            print(f"{out.name} came to its end: {len(digests)} files, {len(differ)} differ", flush=True)
        write_json(notes, state)
    print(f"{len(state['kills'])} kills, {state['finished']} runs came to their end, {len(state['wrong'])} wrong")
    print("\n".join(state["wrong"]))
    sys.exit(bool(state["wrong"]))


if __name__ == "__main__":
    main()
