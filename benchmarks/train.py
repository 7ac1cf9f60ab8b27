"""Train a task's expert with PPO on the view that sees theta: `deconf train --task slippery_cartpole`."""

import os
import platform
import tempfile
import time
from pathlib import Path

import numpy as np
from safetensors.numpy import save as to_bytes

from deconfounded import envs
from deconfounded.benchmarks.console import Parser, place, whole
from deconfounded.benchmarks.engine import identity
from deconfounded.benchmarks.engine.progress import Progress
from deconfounded.envs.support.files import check_file, write_atomically, write_json
from deconfounded.experts import policy
from deconfounded.experts.agent import ExpertAgent, RandomAgent
from deconfounded.experts.rollout import run_trials

STEPS = 3_000_000


def main() -> None:
    parser = Parser(__doc__, "--task")
    parser.add_argument(
        "--steps", type=whole(1, 2**40), default=STEPS, help=f"control steps of PPO; default: {STEPS:,}"
    )
    parser.add_argument("--seed", type=whole(0, 2**32 - 1), default=0)
    parser.add_argument("--out", type=place, help="weights file; default: <task>.safetensors in this folder")
    args = parser.parse_args()
    task = envs.get(args.task)
    if task.has_closed_expert or not isinstance(task, envs.MujocoTask):
        raise envs.InputError(f"the expert of {task.name} is a closed form; there is nothing to train")
    file = args.out or Path(f"{task.name}.safetensors")
    if file.suffix != ".safetensors":
        raise envs.InputError(f"--out was {file}; it must end in .safetensors")
    if args.out is None and file.exists():
        raise envs.InputError(f"{file} is here already; give --out {file} to replace it, or another --out")
    envs.check_task(task)
    check_file(file)
    if not policy.has_card(file):
        what = f"{file.with_suffix('.json')}, where the card of the weights belongs, is none"
        raise envs.InputError(f"{what}; give another --out")
    from deconfounded.benchmarks.engine.context import EVALUATION, stream
    from deconfounded.experts.train import PPO_SETTINGS, train

    start = time.time()
    progress = Progress(args.steps, "training")
    weights = train(task, args.steps, args.seed, progress.update)
    progress.close()
    content, env = to_bytes(weights), envs.BatchEnv(task, 256)
    with tempfile.TemporaryDirectory() as scratch:  # what is there already stays until all is ready
        (aside := Path(scratch) / file.name).write_bytes(content)
        agents = ExpertAgent(env, policy.load(task, aside)), RandomAgent(task.action_space)
    fresh = stream(EVALUATION, args.seed)  # thetas and noise that training has not seen
    returns, random = (run_trials(env, agent, 1, seed=fresh).returns for agent in agents)
    number = policy.version(task, file) + 1
    file.with_suffix(".json").unlink(missing_ok=True)  # the card of other weights, which would call these damaged
    write_atomically(file, content)
    card = {
        "task": task.name,
        "task_version": task.version,
        "version": number,
        "sha256": policy.fingerprint(task, file),
        "command": f"deconf train --task {args.task} --steps {args.steps} --seed {args.seed}",
        "algorithm": "PPO (stable-baselines3), privileged view, 64 environments, tanh networks of 64 x 64",
        "settings": PPO_SETTINGS,
        "return_mean": round(float(returns.mean()), 2),
        "return_standard_error": round(float(returns.std() / np.sqrt(len(returns))), 2),
        "return_random": round(float(random.mean()), 2),
        "episodes_scored": len(returns),
        "wall_s": round(time.time() - start, 1),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
        "versions": identity.versions(),
    }
    write_json(file.with_suffix(".json"), card)
    if returns.mean() - random.mean() < 2 * random.std():
        remedy = "more --steps, or another reward"
        better = "hardly" if returns.mean() > random.mean() else "not"
        print(f"warning: the expert of {task.name} is {better} better than random actions: {remedy}")
    print(f"{task.name}: expert {card['return_mean']}, random {card['return_random']}, in {card['wall_s']} s -> {file}")
    if file.resolve() != policy.path(task).resolve():
        print(f"commands use it if given --expert {file}; their default is {policy.path(task)}")
