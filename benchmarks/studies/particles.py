"""Beliefs by particles beside those by a grid: scores of the exact policy, ranks of the true theta, and CPU seconds.

Agents act in the same trials. Where a belief is right, the true theta's rank, the belief's mass below it, is uniform
between 0 and 1 over trials.
"""

import time
from typing import Any

import numpy as np
from scipy.stats import kstest

from deconfounded import envs
from deconfounded.benchmarks.output.scoring import normalise, two_decimals
from deconfounded.benchmarks.studies.cards import markdown_table
from deconfounded.deconf.exact import ExactAgent, grid_size
from deconfounded.deconf.particles import GRID_UP_TO, ParticleAgent, Particles
from deconfounded.envs.patches import PatchedTask
from deconfounded.envs.streams import Array
from deconfounded.experts import policy
from deconfounded.experts.agent import Agent, ExpertAgent, RandomAgent
from deconfounded.experts.rollout import run_trials

MANY, TRIALS, FEW = 2048, 256, 64  # without physics; of most tasks; where a step simulates many particles
SEED = 11


def compared(task: envs.Task, trials: int) -> dict[str, Any]:
    """Scores, means over trials and episodes, and CPU seconds by belief; p of a test of ranks for each latent.

    Of particles alone, where a grid would have too many latents.
    """
    env, expert = envs.BatchEnv(task, trials), policy.load(task)
    particles = ParticleAgent(env, expert, conditional=False)
    agents: dict[str, Agent] = {"particles": particles}
    if len(task.latents) <= GRID_UP_TO:
        agents["grid"] = ExactAgent(env, expert, False, grid_size(task))
    zero, one = (
        run_trials(env, agent, task.episodes, SEED).returns.mean()
        for agent in (RandomAgent(task.action_space), ExpertAgent(env, expert))
    )
    made: dict[str, Any] = {"trials": trials}
    scores: dict[str, Array] = {}
    for name, agent in agents.items():
        start = time.process_time()
        rollout = run_trials(env, agent, task.episodes, SEED)
        cpu_s = round(time.process_time() - start, 1)
        scores[name] = normalise(rollout.returns, zero, one).mean(-1)
        made[name] = {"score": round(float(scores[name].mean()), 4), "cpu_s": cpu_s}
        if name == "particles" and not task.switches:  # a switch may come after the last step
            rank = ranks(particles.belief, rollout.theta[:, -1], np.random.default_rng(SEED))
            made["p"] = [round(float(kstest(of, "uniform").pvalue), 4) for of in rank.T]
    if "grid" in scores:
        by_trial = scores["particles"] - scores["grid"]
        error = by_trial.std(ddof=1) / np.sqrt(trials)
        made |= {"difference": round(float(by_trial.mean()), 4), "standard_error": round(float(error), 4)}
    return made


def ranks(belief: Particles, theta: Array, rng: np.random.Generator) -> Array:
    """The belief's mass below theta [N, L], in each latent; of mass at theta itself a random share."""
    weight, own = np.exp(belief.log_weight)[..., None], theta[:, None]
    below, at = ((weight * of).sum(1) for of in (belief.theta < own, belief.theta == own))
    return below + rng.random(theta.shape) * at


def by_task(tasks: list[envs.Task]) -> dict[str, dict[str, Any]]:
    """Of each task that has no grid of its own for each patch, printed as they come."""
    measured = {}
    for task in tasks:
        if isinstance(task, PatchedTask):
            continue
        categorical = any(latent.distribution == "categorical" for latent in task.latents)
        physics = isinstance(task, envs.MujocoTask)
        costly = len(task.latents) > GRID_UP_TO or (categorical and physics)
        measured[task.name] = made = compared(task, FEW if costly else TRIALS if physics else MANY)
        print(f"{task.name}: {made}")
    return measured


def table(measured: dict[str, dict[str, Any]]) -> str:
    """A row for each task, in markdown."""
    rows = []
    for name, made in measured.items():
        grid, particles = made.get("grid"), made["particles"]
        by_grid, cpu_grid = (two_decimals(grid["score"]), f"{grid['cpu_s']:.0f}") if grid else ("", "")
        apart = f"{made['difference']:+.3f} ± {made['standard_error']:.3f}" if grid else ""
        p = " ".join(map(two_decimals, made.get("p", ())))
        scores = by_grid, two_decimals(particles["score"]), apart
        rows.append((name, str(made["trials"]), *scores, p, cpu_grid, f"{particles['cpu_s']:.0f}"))
    head = ("grid", "particles", "particles less grid", "p of ranks", "CPU s, grid", "CPU s, particles")
    return markdown_table(("task", "trials", *head), rows)
