"""Run a saved agent in one gymnasium environment: `deconf play --agent DIR --task slippery_cartpole`

Prints the return of each episode of a trial, under one theta; --video writes a film of it.
"""

from pathlib import Path
from typing import Any

import numpy as np

import deconfounded
from deconfounded import envs
from deconfounded.benchmarks.console import Parser, whole
from deconfounded.envs.support.files import check_file
from deconfounded.experts import saved_agents
from deconfounded.experts.agent import Agent


def ready(folder: Path, task: envs.Task) -> Agent:
    """The agent of a folder. Raises InputError if it does not fit the task, or sees theta."""
    about = saved_agents.describe(folder)
    from deconfounded.benchmarks.engine.benchmark import (
        spaces,
    )  # torch takes seconds; bad input is refused at once
    from deconfounded.benchmarks.engine.guest_host import ReseededAgent
    from deconfounded.deconf.core.agents import LearnedAgent
    from deconfounded.deconf.methods.memoryless_bc import MemorylessAgent
    from deconfounded.experts.datasets.units import RawAgent

    agent, ours, theirs = deconfounded.load(folder), spaces(task), about.get("spaces")
    if isinstance(agent, RawAgent):
        raise envs.InputError(f"the agent in {folder} acts in the units of a log; save the agent without them")
    if theirs is None and isinstance(agent, LearnedAgent):
        signature = agent.policy.signature
        theirs = {"observations": signature.obs, "action": signature.action, "actions": signature.actions}
    if theirs not in (None, ours):
        raise envs.InputError(f"the agent in {folder} is for {described(theirs)}; {task.name} has {described(ours)}")
    if isinstance(agent, MemorylessAgent) and agent.shape()["theta"]:
        raise envs.InputError(f"the agent in {folder} is an oracle, which acts on theta; give one that does not")
    trained = about.get("task")
    if trained and trained.rpartition(":")[2] != (task.reference or task.name).rpartition(":")[2]:
        print(f"note: the agent in {folder} was trained on {trained}")
    return agent if isinstance(agent, LearnedAgent) else ReseededAgent(agent)


def described(spaces: dict[str, int]) -> str:
    """Spaces that `benchmark.spaces` gives, e.g. `3 observations and 1 continuous action`."""
    width, actions = spaces["action"], spaces["actions"]
    acts = f"one of {actions} actions" if actions else f"{width} continuous action{'s' * (width > 1)}"
    return f"{spaces['observations']} observation{'s' * (spaces['observations'] > 1)} and {acts}"


def play(agent: Agent, env: envs.GymEnv, episodes: int, seed: int, theta: Any = None) -> tuple[list[float], list[Any]]:
    """One trial: the return of each episode, and the frames if the environment renders."""
    frames, returns = [], []
    agent.begin(1)
    for episode in range(episodes):
        options = {"keep_theta": True} if episode else None if theta is None else {"theta": theta}
        obs, _ = env.reset(seed=None if episode else seed, options=options)
        agent.reset([np.random.default_rng([seed, 1, episode])])
        total, over = 0.0, False
        while not over:
            action = agent.act(obs[None])
            if env.task.n_actions:
                taken = int(action[0, 0])
            else:
                action = action.clip(-1, 1)  # as the environment does; an agent may remember what it took
                taken = action[0]
            then, reward, terminated, truncated, _ = env.step(taken)
            agent.observe(obs[None], action, then[None], np.ones(1, bool))
            total, over, obs = total + reward, terminated or truncated, then
            if env.render_mode:
                frames.append(env.render())
        returns.append(total)
    return returns, frames


def main() -> None:
    parser = Parser(__doc__, "--agent", "--task")
    parser.add_argument("--theta", type=float, nargs="+", help="its values; default: drawn from p(theta)")
    parser.add_argument("--episodes", type=whole(1, 1000), help="default: those of the task's trials")
    parser.add_argument("--seed", type=whole(0), default=0)
    parser.add_argument("--video", type=Path, help="an .mp4 file to write")
    args = parser.parse_args()
    task = envs.get(args.task)
    if args.video is not None:
        if args.video.suffix != ".mp4":
            raise envs.InputError(f"--video was {args.video}; it must end in .mp4")
        if not task.has_likelihood:
            raise envs.InputError(f"--video was given, and {task.name} is a black box, which has no pictures")
        check_file(args.video)
    agent = ready(args.agent, task)
    env = envs.GymEnv(task, render_mode="rgb_array" if args.video else None)
    returns, frames = play(agent, env, args.episodes or task.episodes, args.seed, args.theta)
    pairs = zip(task.latents, env.batch.theta[0], strict=True)
    named = (f"{lat.name} {value:g} {lat.unit}".strip() for lat, value in pairs)
    print(f"{task.name}, {', '.join(named)}: returns {' '.join(f'{one:.2f}' for one in returns)}")
    if args.video is not None:
        from deconfounded.benchmarks.output import film

        film.save(frames, film.frame_rate(task), args.video)
        print(f"-> {args.video}")
