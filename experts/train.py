"""Train a task's expert with PPO on the view that sees theta: `python -m experts.train --task slippery_cartpole`."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import stable_baselines3
import torch
from safetensors.numpy import save_file
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

import envs
from envs.console import Parser, Progress, check_folder, run_command, write_json
from experts import policy
from experts.demos import ExpertAgent, RandomAgent, run_trials
from experts.sb3 import Sb3VecEnv

PPO_SETTINGS: dict[str, Any] = {
    "n_steps": 128,
    "batch_size": 2048,
    "n_epochs": 10,
    "gamma": 0.98,
    "gae_lambda": 0.95,
    "learning_rate": 1e-3,  # falling linearly to zero
}


class _Progress(BaseCallback):
    def __init__(self, total: int) -> None:
        super().__init__()
        self._bar = Progress(total, "training")

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        returns = [episode["r"] for episode in self.model.ep_info_buffer or []]
        self._bar.update(self.num_timesteps - self._bar.done, f"return {np.mean(returns):.1f}" if returns else "")


def train(task: envs.Task, steps: int, seed: int, n: int = 64) -> dict[str, np.ndarray]:
    """PPO for `steps` control steps in n environments -> the weights of the policy's mean, layer by layer."""
    torch.set_num_threads(1)  # the networks are small: a second thread only gets in the way
    rate = PPO_SETTINGS["learning_rate"]
    schedule: Callable[[float], float] = lambda left: rate * left  # noqa: E731
    model = PPO(
        "MlpPolicy",
        Sb3VecEnv(task, n, seed),
        **{**PPO_SETTINGS, "learning_rate": schedule},
        policy_kwargs={"net_arch": [64, 64], "log_std_init": -0.5},
        seed=seed,
        device="cpu",
    )
    model.learn(steps, callback=_Progress(steps))
    layers = [*model.policy.mlp_extractor.policy_net, model.policy.action_net]
    weights = {}
    for i, layer in enumerate(layer for layer in layers if isinstance(layer, torch.nn.Linear)):
        weights[f"{i}.weight"] = layer.weight.detach().numpy()
        weights[f"{i}.bias"] = layer.bias.detach().numpy()
    return weights


def main() -> None:
    """The command line."""
    parser = Parser(__doc__)
    parser.add_argument("--task", required=True)
    parser.add_argument("--steps", type=int, default=3_000_000, help="control steps of PPO")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="weights file; default: the one that ships with the task")
    args = parser.parse_args()
    task = envs.get(args.task)
    if not isinstance(task, envs.MujocoTask):
        raise envs.InputError(f"the expert of {task.name} is its closed form; there is nothing to train")
    if args.steps < 1 or args.seed < 0:
        raise envs.InputError(f"--steps was {args.steps} and --seed {args.seed}; they must be at least 1 and 0")
    file = args.out or policy.path(task)
    if file.suffix != ".safetensors":
        raise envs.InputError(f"--out was {file}; it must end in .safetensors")
    envs.check_task(task)
    check_folder(file.parent)
    start = time.time()
    weights = train(task, args.steps, args.seed)
    partial = file.with_suffix(".partial")
    save_file(weights, partial)
    os.replace(partial, file)
    env = envs.BatchEnv(task, 256)
    _, returns = run_trials(env, ExpertAgent(env, policy.load(task, file)), 1, seed=args.seed)
    _, random = run_trials(env, RandomAgent(task.action_space), 1, seed=args.seed)
    card = {
        "task": task.name,
        "task_version": task.version,
        "command": f"python -m experts.train --task {task.name} --steps {args.steps} --seed {args.seed}",
        "algorithm": "PPO (stable-baselines3), privileged view, 64 environments, tanh networks of 64 x 64",
        "settings": PPO_SETTINGS,
        "return_mean": round(float(returns.mean()), 2),
        "return_standard_error": round(float(returns.std() / np.sqrt(len(returns))), 2),
        "return_random": round(float(random.mean()), 2),
        "episodes_scored": len(returns),
        "wall_s": round(time.time() - start, 1),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
        "versions": {
            **{name: version(name) for name in ("mujoco", "numpy", "torch")},
            "stable-baselines3": stable_baselines3.__version__,
            "python": platform.python_version(),
        },
    }
    write_json(file.with_suffix(".json"), card)
    if returns.mean() - random.mean() < 2 * random.std():
        print(
            f"warning: the expert of {task.name} is hardly better than random actions: more --steps, or another reward"
        )
    print(f"{task.name}: expert {card['return_mean']}, random {card['return_random']}, in {card['wall_s']} s -> {file}")


if __name__ == "__main__":
    run_command(main)
