"""Run a kept agent in one plain gymnasium environment: `deconf play --agent DIR --task slippery_cartpole`

Prints the return of each episode of a trial, under one theta; --video writes what it looked like.
"""

from __future__ import annotations

if __name__ == "__main__":  # Ctrl-C while the rest is imported is one line too
    from deconfounded.benchmarks.console import stop_at_once

    stop_at_once()

from pathlib import Path
from typing import Any

import numpy as np

import deconfounded
from deconfounded import envs
from deconfounded.benchmarks.console import Parser, run_command
from deconfounded.benchmarks.engine.benchmark import spaces
from deconfounded.benchmarks.engine.guest import Stranger
from deconfounded.deconf.core.agents import LearnedAgent
from deconfounded.deconf.methods.memoryless_bc import MemorylessAgent
from deconfounded.envs.support.files import check_file
from deconfounded.experts import store
from deconfounded.experts.rollout import Agent


def ready(folder: Path, task: envs.Task) -> Agent:
    """The agent of a folder. Raises InputError if it does not fit the task, or sees theta."""
    about, agent = store.describe(folder), deconfounded.load(folder)
    ours, theirs = spaces(task), about.get("spaces")
    if theirs not in (None, ours):
        raise envs.InputError(f"the agent in {folder} is for {theirs}; {task.name} has {ours}")
    if isinstance(agent, MemorylessAgent) and agent.shape()["theta"]:
        raise envs.InputError(f"the agent in {folder} is an oracle, which acts on theta; give one that does not")
    return agent if isinstance(agent, LearnedAgent) else Stranger(agent)


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
            taken = int(action[0, 0]) if env.task.n_actions else action[0]
            then, reward, terminated, truncated, _ = env.step(taken)
            agent.observe(obs[None], action, then[None], np.ones(1, bool))
            total, over, obs = total + reward, terminated or truncated, then
            if env.render_mode:
                frames.append(env.render())
        returns.append(total)
    return returns, frames


def main() -> None:
    """The command line."""
    parser = Parser(__doc__)
    parser.add_argument("--agent", type=Path, required=True, help="a folder under a run's agents/")
    parser.add_argument("--task", required=True)
    parser.add_argument("--theta", type=float, nargs="+", help="forced; default: drawn")
    parser.add_argument("--episodes", type=int, help="default: those of the task's trials")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--video", type=Path, help="an .mp4 file to write")
    args = parser.parse_args()
    task = envs.get(args.task)
    agent, episodes = ready(args.agent, task), task.episodes if args.episodes is None else args.episodes
    if not 1 <= episodes <= 1000 or args.seed < 0:
        raise envs.InputError(
            f"--episodes was {episodes} and --seed {args.seed}; they must be from 1 to 1,000, and from 0 up"
        )
    if args.video is not None:
        if args.video.suffix != ".mp4":
            raise envs.InputError(f"--video was {args.video}; it must end in .mp4")
        check_file(args.video)
    env = envs.GymEnv(task, render_mode="rgb_array" if args.video else None)
    returns, frames = play(agent, env, episodes, args.seed, args.theta)
    pairs = zip(task.latents, env.batch.theta[0], strict=True)
    named = (f"{lat.name} {value:g} {lat.unit}".strip() for lat, value in pairs)
    print(f"{task.name}, {', '.join(named)}: returns {' '.join(f'{one:.2f}' for one in returns)}")
    if args.video is not None:
        import imageio.v2 as imageio

        from deconfounded.benchmarks.output.film import frame_rate

        imageio.mimsave(args.video, frames, fps=frame_rate(task), macro_block_size=8)
        print(f"-> {args.video}")


if __name__ == "__main__":
    run_command(main)
