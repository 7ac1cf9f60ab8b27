"""Roll-outs: the loop in which an agent acts, and the trials, returns and thetas that come of it."""

from __future__ import annotations  # as what only type checkers import is no name at run time

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from deconfounded.envs.batch import BatchEnv
from deconfounded.envs.streams import Array, Streams, generators, unseeded
from deconfounded.envs.support.errors import InputError
from deconfounded.envs.support.numbers import check_number, is_seed
from deconfounded.experts.agent import Agent, AgentWrapper
from deconfounded.experts.trials import Trials

if TYPE_CHECKING:
    from deconfounded.envs.task import Task

Seeds = int | Sequence[int]  # one for all trials, or one for each of equal groups of them


def thetas(task: Task, n: int, episodes: int, seed: Seeds) -> Array:
    """The theta of the roll-out that `run_trials` makes with these seeds, drawn once more."""
    streams = [generators(env_seed) for env_seed in trial_seeds(n, seed)]
    rng, switches = Streams([each[0] for each in streams]), Streams([each[3] for each in streams])
    theta, hidden = task.sample_theta(rng), []
    for e in range(episodes):
        theta = task.drifted(theta, rng) if task.drifts and e else theta
        if task.switches:
            path = task.theta_path(theta, switches)
            theta = path[:, -1]
        hidden.append(path[:, :-1] if task.switches else theta)
    return np.stack(hidden, 1)


def _group_seeds(seed: Seeds) -> list[int]:
    """The seed of each group of trials. Raises InputError for anything else."""
    given: Any = seed.tolist() if isinstance(seed, np.ndarray) else seed
    seeds = list(given) if isinstance(given, Sequence) and not isinstance(given, str | bytes) else [given]
    if not seeds or not all(is_seed(first) for first in seeds):
        raise InputError(f"seed was {seed!r}; it must be a whole number from 0 up, or one for each group of trials")
    return [int(group) for group in seeds]


def trial_seeds(n: int, seed: int | Sequence[int]) -> list[int]:
    """The environments' seeds for n trials, in equal groups. Raises InputError where n is no multiple of the seeds."""
    seeds = _group_seeds(seed)
    if n % len(seeds):
        raise InputError(f"{n} trials were to share {len(seeds)} seeds; it must be a multiple of their number")
    return [first + i for first in seeds for i in range(n // len(seeds))]


class Rollout(NamedTuple):
    """A roll-out, N trials of E episodes: the trials, their returns [N, E], and their theta.

    theta is [N, E, L], that of each episode; or, where it switches, [N, E, T, L], that of each step, after an episode's
    early end too. Learners are handed `trials` alone; returns and theta are for scoring, and theta for methods that
    declare it.
    """

    trials: Trials
    returns: Array
    theta: Array


def run_trials(env: BatchEnv, agent: Agent, episodes: int, seed: Seeds, theta: Array | None = None) -> Rollout:
    """Run an agent in N trials of `episodes` episodes each.

    seed: of the environments and, independently, of the agent; or a seed for each of equal consecutive groups of
    trials, each of which is the same, bit for bit, as it is alone. Trial i of a group has the seed `seed + i`: groups
    whose seeds are near each other share trials. theta [N, L], or None: then it is drawn from p(theta). Raises
    InputError for an agent that reads other environments than `env`.
    """
    task, n = env.task, env.n
    check_number("episodes", episodes)
    if env.privileged:
        raise InputError("run_trials was given privileged environments; agents act on observations without theta")
    layer: Agent | None = agent
    while layer is not None:
        if isinstance(read := getattr(layer, "env", env), BatchEnv) and read is not env:
            who = type(layer).__name__
            raise InputError(f"{who} reads the state or theta of other environments than it was to act in")
        layer = layer.agent if isinstance(layer, AgentWrapper) else None
    each, seeds = trial_seeds(n, seed), _group_seeds(seed)
    obs = np.zeros((n, episodes, task.horizon + 1, len(task.observation)), np.float32)
    mask = np.zeros((n, episodes, task.horizon), bool)
    returns = np.zeros((n, episodes))
    hidden = []
    action = np.zeros((n, episodes, task.horizon, task.action_width), np.float32)
    for e in range(episodes):
        if e == 0:
            now = env.reset(each, None if theta is None else {"theta": theta})
            agent.begin(n)
        else:
            now = env.reset(options={"keep_theta": True})
        hidden.append(env.path[:, :-1].copy() if task.switches else env.theta.copy())
        agent.reset([unseeded(np.random.default_rng([first, 1, e])) for first in seeds])  # not the environments' seeds
        obs[:, e, 0] = now
        for t in range(task.horizon):
            alive = env.alive
            chosen = agent.act(now)
            then, reward, _, _ = env.step(chosen)
            if not task.n_actions:
                chosen = np.clip(chosen, -1, 1)  # as the environments did
            agent.observe(now, chosen, then, alive)
            obs[:, e, t + 1] = np.where(alive[:, None], then, obs[:, e, t])
            action[:, e, t] = np.where(alive[:, None], chosen, 0)
            mask[:, e, t] = alive
            returns[:, e] += reward
            now = then
            if not env.alive.any():
                obs[:, e, t + 2 :] = obs[:, e, t + 1 : t + 2]
                break
    return Rollout(Trials(obs, action, mask, task.n_actions), returns, np.stack(hidden, 1))
