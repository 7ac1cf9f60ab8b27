"""How far trajectories differ between two versions of MuJoCo: to be run once under each.

    python -m tests.trajectories --write FILE.npz    # under the version that records are of
    python -m tests.trajectories --against FILE.npz  # under another: a table of what differs from it

Of every task with a MuJoCo model, 64 environments under the same thetas, seeds and noise. *One step*: outcomes from the
states of the file, under its actions, half of them the expert's and half uniform. *Same actions*: a whole episode of
these. *Expert*: returns of two episodes of it, which acts on what it sees. docs/versions.md says what follows from it.
"""

import argparse
import io
from pathlib import Path

import mujoco
import numpy as np

from deconfounded import envs
from deconfounded.envs.streams import Array
from deconfounded.envs.support.files import write_atomically
from deconfounded.experts import policy
from deconfounded.experts.agent import ExpertAgent
from deconfounded.experts.rollout import run_trials

N, SEED = 64, 1000
Arrays = dict[str, Array]


def measure(task: envs.MujocoTask, before: Arrays | None) -> Arrays:
    """All that is compared. before: another version's, for the same actions and the same states."""
    env = envs.BatchEnv(task, N)
    trials, returns, _ = run_trials(env, ExpertAgent(env, policy.load(task)), 2, SEED)
    actions = np.array(trials.action[:, 0], float)
    actions[::2] = np.random.default_rng(SEED).uniform(-1, 1, actions[::2].shape)
    if before is not None:
        actions = before["actions"]
    env = envs.BatchEnv(task, N)
    env.reset(SEED)
    states = [env.state.copy()]
    for t in range(task.horizon):
        env.step(actions[:, t])
        states.append(env.state.copy())
    mine = {"returns": returns, "actions": actions, "states": np.stack(states, 1)}
    start = (mine if before is None else before)["states"]
    outcomes = [env.simulator.outcome(start[:, t], actions[:, t]) for t in range(task.horizon)]
    return {**mine, "outcomes": np.stack(outcomes, 1)}


def compare(task: envs.MujocoTask, was: Arrays, now: Arrays) -> tuple[str, ...]:
    """A row of the table."""
    flat = was["outcomes"].reshape(-1, was["outcomes"].shape[-1])
    off = np.abs(now["outcomes"].reshape(flat.shape) - flat)
    noisy, unit = task.noise.columns, np.ones((len(flat), task.noise.size + task.readings))
    stds = np.abs(task.apply_noise(flat.copy(), unit) - flat)[:, noisy]
    whole, change = np.abs(now["states"] - was["states"]).max(), (now["returns"] - was["returns"]).mean(1)
    sizes = (off.max(), (off[:, noisy] / stds).max(), whole)
    expert = f"{change.mean():+.0e} ± {change.std() / np.sqrt(N):.0e}" if change.any() else "0"
    mean = f"{was['returns'].mean():.4f}"
    return task.name, f"{1 - off.any(-1).mean():.1%}", *(f"{size:.0e}" if size else "0" for size in sizes), mean, expert


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("--write", type=Path, metavar="FILE")
    which.add_argument("--against", type=Path, metavar="FILE")
    args = parser.parse_args()
    tasks = [task for task in map(envs.get, envs.names()) if isinstance(task, envs.MujocoTask)]
    if args.write:
        arrays = {f"{task.name}/{key}": x for task in tasks for key, x in measure(task, None).items()}
        buffer = io.BytesIO()
        np.savez_compressed(buffer, version=mujoco.__version__, **arrays)  # type: ignore[arg-type]
        write_atomically(args.write, buffer.getvalue())
        return
    with np.load(args.against) as file:
        kept = dict(file)
    print(f"mujoco {mujoco.__version__} against {kept['version']}\n")
    print("| task | steps bit equal | one step | in stds of noise | same actions | expert's return | its change |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for task in tasks:
        was = {key: kept[f"{task.name}/{key}"] for key in ("returns", "actions", "states", "outcomes")}
        print("|", " | ".join(compare(task, was, measure(task, was))), "|", flush=True)


if __name__ == "__main__":
    main()
