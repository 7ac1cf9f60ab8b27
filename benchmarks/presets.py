"""How much data and training each preset spends, by kind of task."""

from __future__ import annotations

from dataclasses import replace

from gymnasium import spaces

import envs
from benchmarks.methods import METHODS, Preset
from deconf.cloning import CloningConfig
from deconf.deconfounded import DeconfoundedConfig
from deconf.naive_rnn import NaiveConfig

PRESETS = {
    "smoke": "a minute: does everything work?",
    "default": "minutes on two cores: the figures in README",
    "paper": "ten seeds",
}
DEFAULT_METHODS = tuple(name for name in METHODS if name != "deconfounded_gru")

_CONTROL = Preset(
    seeds=3,
    expert_trials=256,
    explore_trials=64,
    eval_trials=128,
    grid=21,
    deconfounded=DeconfoundedConfig(inference_updates=800),
    naive=NaiveConfig(),
    cloning=CloningConfig(),
)
_BANDIT = Preset(
    seeds=5,
    expert_trials=24000,
    explore_trials=8000,
    eval_trials=4000,
    grid=0,
    deconfounded=DeconfoundedConfig(
        latent=5,
        beta=5e-3,
        rounds=2,
        inference_updates=800,
        inference_batch=64,
        inference_steps=6400,
        imitation_updates=800,
        learning_rate=3e-3,
        random_share=1.0,
    ),
    naive=NaiveConfig(updates=2000, batch=100, chunk=50, learning_rate=1e-2),
    cloning=CloningConfig(updates=1000),
)
_SMOKE_CONTROL = replace(
    _CONTROL,
    seeds=1,
    expert_trials=32,
    explore_trials=16,
    eval_trials=16,
    grid=9,
    deconfounded=replace(_CONTROL.deconfounded, rounds=2, inference_updates=100, imitation_updates=100),
    naive=replace(_CONTROL.naive, updates=60),
    cloning=replace(_CONTROL.cloning, updates=400),
)
_SMOKE_BANDIT = replace(
    _BANDIT,
    seeds=1,
    expert_trials=2000,
    explore_trials=1000,
    eval_trials=1000,
    deconfounded=replace(_BANDIT.deconfounded, rounds=1, imitation_updates=400),
    naive=replace(_BANDIT.naive, updates=500),
    cloning=replace(_BANDIT.cloning, updates=400),
)


def preset(name: str, task: envs.Task, device: str) -> Preset:
    """The amounts for a task: discrete ones take the bandit's, all others those of control."""
    amounts = _BANDIT if isinstance(task.action_space, spaces.Discrete) else _CONTROL
    if name == "smoke":
        amounts = _SMOKE_BANDIT if amounts is _BANDIT else _SMOKE_CONTROL
    if name == "paper":
        amounts = replace(amounts, seeds=10)
    return replace(
        amounts,
        deconfounded=replace(amounts.deconfounded, device=device),
        naive=replace(amounts.naive, device=device),
        cloning=replace(amounts.cloning, device=device),
    )
