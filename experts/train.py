"""Training of experts: PPO (Stable-Baselines3) on the privileged view, which has theta."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger

from deconfounded import envs
from deconfounded.experts.sb3 import Sb3VecEnv

PPO_SETTINGS: dict[str, Any] = {"n_steps": 128, "batch_size": 2048, "n_epochs": 10, "gamma": 0.98, "gae_lambda": 0.95}
PPO_SETTINGS["learning_rate"] = 1e-3  # falling linearly to zero
Report = Callable[[int, str], None]  # takes the number of steps since the last call, and a text about returns


class _Progress(BaseCallback):
    def __init__(self, report: Report) -> None:
        super().__init__()
        self._report, self._done = report, 0

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        returns = [episode["r"] for episode in self.model.ep_info_buffer or []]
        self._report(self.num_timesteps - self._done, f"return {np.mean(returns):.1f}" if returns else "")
        self._done = self.num_timesteps


def train(task: envs.Task, steps: int, seed: int, report: Report, n: int = 64) -> dict[str, np.ndarray]:
    """Train by PPO for `steps` control steps in n environments; returns the weights of the policy's mean by layer."""
    torch.set_num_threads(1)  # the networks are small: more threads are slower
    settings = {**PPO_SETTINGS, "learning_rate": lambda left: PPO_SETTINGS["learning_rate"] * left}
    network = {"net_arch": [64, 64], "log_std_init": -0.5}
    model = PPO("MlpPolicy", Sb3VecEnv(task, n, seed), policy_kwargs=network, seed=seed, device="cpu", **settings)
    model.set_logger(Logger(None, []))  # the default logger leaves an empty temporary folder
    model.learn(steps, callback=_Progress(report))
    layers = [*model.policy.mlp_extractor.policy_net, model.policy.action_net]
    linear = torch.nn.Sequential(*(layer for layer in layers if isinstance(layer, torch.nn.Linear)))
    return {name: values.numpy() for name, values in linear.state_dict().items()}
