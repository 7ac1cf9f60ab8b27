"""The methods that the benchmark scores, by name: how each agent comes about for one seed.

Learned methods get trials without theta; only the oracle gets theta, and only references get the environment.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

import envs
from deconf import cloning, deconfounded, naive_rnn
from deconf.exact import ExactAgent
from deconf.nets import Progress
from envs.task import Array
from experts import policy
from experts.demos import Agent, ExpertAgent, RandomAgent, Trials, run_trials

DEMOS, EXPLORATION, EVALUATION = 1, 2, 3  # each purpose has seeds of its own


def stream(purpose: int, seed: int) -> int:
    """A seed for one purpose of one run, far from all others."""
    return int(np.random.SeedSequence([purpose, seed]).generate_state(1)[0] >> 1)


@dataclass(frozen=True)
class Preset:
    """Amounts of data and training. Trials are of task.episodes episodes each."""

    seeds: int
    expert_trials: int
    explore_trials: int  # a round
    eval_trials: int
    grid: int
    deconfounded: deconfounded.DeconfoundedConfig
    naive: naive_rnn.NaiveConfig
    cloning: cloning.CloningConfig


class Context:
    """One task, preset and seed: the data, made when first asked for, and the environments agents are scored in."""

    def __init__(self, task: envs.Task, preset: Preset, seed: int, progress: Progress) -> None:
        self.task, self.preset, self.seed, self.progress = task, preset, seed, progress
        self.expert = policy.load(task)
        self.env = envs.BatchEnv(task, preset.eval_trials)

    @cached_property
    def demonstrations(self) -> tuple[Trials, Array]:
        """Expert trials, and beside them theta [B, L] for the oracle."""
        env = envs.BatchEnv(self.task, self.preset.expert_trials)
        trials, _ = run_trials(env, ExpertAgent(env, self.expert), self.task.episodes, stream(DEMOS, self.seed))
        return trials, env.theta.copy()

    @property
    def rng(self) -> np.random.Generator:
        """For initial weights and batches; the same for every method of this seed."""
        return np.random.default_rng([self.seed, 0])

    def explore(self, agent: Agent | None, rng: np.random.Generator) -> Trials:
        """Trials under fresh thetas, by an agent that knows nothing of them; None: uniformly random actions."""
        env = envs.BatchEnv(self.task, self.preset.explore_trials)
        behaviour = agent or RandomAgent(self.task.action_space)
        return run_trials(env, behaviour, self.task.episodes, stream(EXPLORATION, int(rng.integers(2**31))))[0]


def _deconfounded(context: Context, **changes: Any) -> dict[str, Agent]:
    config = replace(context.preset.deconfounded, **changes)
    agent = deconfounded.fit(context.demonstrations[0], context.explore, config, context.rng, context.progress)
    suffix = "" if config.belief == "evidence" else f"_{config.belief}"
    once = deconfounded.DeconfoundedAgent(agent.belief, agent.policy, agent.scaler, "episode")
    return {f"deconfounded{suffix}": agent, f"deconfounded{suffix}_episode": once}


def _naive_rnn(context: Context) -> dict[str, Agent]:
    agent = naive_rnn.fit(context.demonstrations[0], context.preset.naive, context.rng, context.progress)
    return {"naive_rnn": agent}


def _oracle(context: Context) -> dict[str, Agent]:
    trials, theta = context.demonstrations
    encode = context.task.encode_theta
    agent = cloning.fit(
        trials,
        context.preset.cloning,
        context.rng,
        encode(theta),
        lambda: encode(context.env.theta),
        context.progress,
    )
    return {"oracle_bc": agent}


def _blind(context: Context) -> dict[str, Agent]:
    trials, _ = context.demonstrations
    return {"blind_bc": cloning.fit(trials, context.preset.cloning, context.rng, progress=context.progress)}


def _exact(context: Context, conditional: bool) -> dict[str, Agent]:
    agent = ExactAgent(context.env, context.expert, conditional, context.preset.grid)
    return {"conditional" if conditional else "interventional": agent}


METHODS: dict[str, Callable[[Context], dict[str, Agent]]] = {
    "deconfounded": _deconfounded,
    "deconfounded_gru": lambda context: _deconfounded(context, belief="gru"),
    "naive_rnn": _naive_rnn,
    "oracle_bc": _oracle,
    "blind_bc": _blind,
    "conditional": lambda context: _exact(context, True),
    "interventional": lambda context: _exact(context, False),
    "expert": lambda context: {"expert": ExpertAgent(context.env, context.expert)},
    "random": lambda context: {"random": RandomAgent(context.task.action_space)},
}
"""Longest first, so that the last ones to run are short. A method may score several ways of deploying one agent."""

COST = {"deconfounded": 7, "deconfounded_gru": 14, "naive_rnn": 4, "conditional": 4, "interventional": 3}
"""Of a method, about, where blind BC is 1: for the ETA alone."""

REFERENCES = ("random", "expert")  # always run: they are the 0 and 1 of every score
LEARNED = ("deconfounded", "deconfounded_gru", "naive_rnn", "oracle_bc", "blind_bc")
