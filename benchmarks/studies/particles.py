"""Beliefs by particles beside those by a grid: scores of the exact policy, ranks of the true theta, and CPU seconds.

Agents act in the same trials. Where a belief is right, the true theta's rank, the belief's mass below it, is uniform
between 0 and 1 over trials.
"""

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import kstest

from deconfounded import envs
from deconfounded.benchmarks.engine import identity
from deconfounded.benchmarks.output.scoring import normalise, two_decimals
from deconfounded.benchmarks.studies.cards import markdown_table
from deconfounded.deconf.exact import ExactAgent, grid_size
from deconfounded.deconf.particles import GRID_UP_TO, ParticleAgent, Particles, needs_particles
from deconfounded.envs.streams import Array
from deconfounded.envs.support.files import write_json
from deconfounded.experts import policy
from deconfounded.experts.agent import Agent, ExpertAgent, RandomAgent
from deconfounded.experts.rollout import run_trials

MANY, TRIALS, FEW = 2048, 128, 32  # without physics; of most tasks; where a step simulates many particles
ENOUGH, MOST = 0.005, 4  # an error of a difference at which trials suffice; if it is larger, as many again, up to four
SEED = 11


@dataclass(frozen=True)
class Deployed:
    """What agents did in the same trials, by agent; rank: of the true thetas, none where theta may switch."""

    returns: dict[str, Array]
    cpu_s: dict[str, float]
    rank: Array | None


def compared(task: envs.Task, trials: int) -> dict[str, Any]:
    """Scores, means over trials and episodes, CPU seconds, and p of a test of ranks for each latent, by belief.

    Of particles alone, where there is no grid. As long as the difference of scores has a standard error above ENOUGH,
    there are as many trials again, MOST times at most.
    """
    env, expert = envs.BatchEnv(task, trials), policy.load(task)
    agents: dict[str, Agent] = {"particles": ParticleAgent(env, expert, conditional=False)}
    if not needs_particles(task):
        agents["grid"] = ExactAgent(env, expert, False, grid_size(task))
    agents |= {"random": RandomAgent(task.action_space), "expert": ExpertAgent(env, expert)}
    batches, made = list[Deployed](), dict[str, Any]()
    for seed in range(SEED, SEED + MOST * trials, trials):  # near seeds share trials
        batches.append(_deployed(env, agents, seed))
        made = _pooled(batches)
        if made.get("standard_error", 0) <= ENOUGH:
            break
    return made


def _deployed(env: envs.BatchEnv, agents: Mapping[str, Agent], seed: int) -> Deployed:
    """Each agent in the trials of a seed."""
    returns, cpu_s, rank = dict[str, Array](), dict[str, float](), None
    for name, agent in agents.items():
        start = time.process_time()
        rollout = run_trials(env, agent, env.task.episodes, seed)
        returns[name], cpu_s[name] = rollout.returns, time.process_time() - start
        if isinstance(agent, ParticleAgent) and not env.task.switches:  # a switch may come after the last step
            rank = ranks(agent.belief, rollout.theta[:, -1], np.random.default_rng(seed))
    return Deployed(returns, cpu_s, rank)


def _pooled(batches: Sequence[Deployed]) -> dict[str, Any]:
    """What `compared` returns, of all trials."""
    returns = {name: np.concatenate([each.returns[name] for each in batches]) for name in batches[0].returns}
    random, best = returns.pop("random").mean(), returns.pop("expert").mean()
    score = {name: normalise(of, random, best).mean(-1) for name, of in returns.items()}
    made: dict[str, Any] = {"trials": len(score["particles"])}
    for name, of in score.items():
        cpu_s = sum(each.cpu_s[name] for each in batches)
        made[name] = {"score": round(float(of.mean()), 4), "cpu_s": round(cpu_s, 1)}
    rank = [each.rank for each in batches if each.rank is not None]
    if rank:
        made["p"] = [round(float(kstest(of, "uniform").pvalue), 4) for of in np.concatenate(rank).T]
    if "grid" in score:
        by_trial = score["particles"] - score["grid"]
        error = by_trial.std(ddof=1) / np.sqrt(len(by_trial))
        made |= {"difference": round(float(by_trial.mean()), 4), "standard_error": round(float(error), 4)}
    return made


def ranks(belief: Particles, theta: Array, rng: np.random.Generator) -> Array:
    """The belief's mass below theta [N, L], in each latent; of mass at theta itself a random share."""
    weight, own = np.exp(belief.log_weight)[..., None], theta[:, None]
    below, at = ((weight * of).sum(1) for of in (belief.theta < own, belief.theta == own))
    return below + rng.random(theta.shape) * at


def by_task(tasks: Sequence[envs.Task], file: Path) -> None:
    """Of each task, printed and added to a .json file as they come; those that are there stay."""
    about = {"commit": identity.commit(), "machine": identity.machine("cpu"), "versions": identity.versions()}
    rows = json.loads(file.read_bytes())["rows"] if file.is_file() else []
    for task in tasks:
        if task.name in {row["task"] for row in rows}:
            continue
        categorical = any(latent.distribution == "categorical" for latent in task.latents)
        physics = isinstance(task, envs.MujocoTask)
        costly = len(task.latents) > GRID_UP_TO or (categorical and physics)
        made = compared(task, FEW if costly else TRIALS if physics else MANY)
        print(f"{task.name}: {made}")
        rows.append({"task": task.name, **made, **about})
        write_json(file, {"rows": rows})


def table(measured: Sequence[dict[str, Any]]) -> str:
    """A row for each task, in markdown."""
    rows = []
    for made in measured:
        grid, particles = made.get("grid"), made["particles"]
        by_grid, cpu_grid = (two_decimals(grid["score"]), f"{grid['cpu_s']:.0f}") if grid else ("", "")
        apart = f"{made['difference']:+.3f} ± {made['standard_error']:.3f}" if grid else ""
        p = " ".join(map(two_decimals, made.get("p", ())))
        scores = by_grid, two_decimals(particles["score"]), apart
        rows.append((made["task"], str(made["trials"]), *scores, p, cpu_grid, f"{particles['cpu_s']:.0f}"))
    head = ("grid", "particles", "particles less grid", "p of ranks", "CPU s, grid", "CPU s, particles")
    return markdown_table(("task", "trials", *head), rows)
