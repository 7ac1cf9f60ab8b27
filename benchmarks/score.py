"""Score a kept agent anew, on thetas that it has not seen: `deconf score --agent DIR --task slippery_cartpole`

Thetas are drawn from p(theta) by --seed and --salt, or with --range from another range, outside of the task's own if
you like: what the expert, random actions and the agent then make of it are measured side by side.
"""

from __future__ import annotations

if __name__ == "__main__":  # Ctrl-C while the rest is imported is one line too
    from deconfounded.benchmarks.console import stop_at_once

    stop_at_once()

from dataclasses import replace
from pathlib import Path
from typing import Any

from deconfounded import envs
from deconfounded.benchmarks.console import Parser, place, run_command
from deconfounded.benchmarks.engine.catalogue import check_names
from deconfounded.benchmarks.engine.context import EVALUATION, stream
from deconfounded.benchmarks.output import score
from deconfounded.benchmarks.play import ready
from deconfounded.envs.support.files import check_file, write_json
from deconfounded.experts import policy
from deconfounded.experts.policy import Expert
from deconfounded.experts.rollout import Agent, ExpertAgent, RandomAgent, run_trials


def elsewhere(task: envs.Task, ranges: list[str]) -> envs.Task:
    """The task with other ranges of its latents, name=low:high; the encoding of theta is the task's own still.

    Raises InputError for a latent that there is not, or a range that cannot be.
    """
    moved = {}
    for text in ranges:
        name, _, bounds = text.partition("=")
        try:
            low, high = map(float, bounds.split(":"))
        except ValueError:
            raise envs.InputError(f"--range was {text!r}; it must be like {task.latents[0].name}=0.1:0.2") from None
        known = {lat.name: lat for lat in task.latents}
        check_names("latent", [name], list(known))
        inside = known[name].low <= low <= high <= known[name].high
        if known[name].distribution == "categorical" and not inside:
            raise envs.InputError(f"--range was {text!r}; {name} has {known[name].low:g} to {known[name].high:g} alone")
        moved[name] = replace(known[name], low=low, high=high)
    other = type(task)()
    other.latents = tuple(moved.get(lat.name, lat) for lat in task.latents)  # type: ignore[misc]
    return other


def rescore(agent: Agent, task: envs.Task, expert: Expert, trials: int, seed: int, where: envs.Task) -> dict[str, Any]:
    """Returns [trials, episodes] of agent, expert and random actions under the same thetas; scores by episode."""
    env = envs.BatchEnv(where, trials)
    found = {}
    for name, one in (
        ("agent", agent),
        ("expert", ExpertAgent(env, expert)),
        ("random", RandomAgent(task.action_space)),
    ):
        found[name] = run_trials(env, one, task.episodes, seed).returns
    best, worst = found["expert"].mean(), found["random"].mean()
    by_trial = score.normalise(found["agent"], worst, best)
    interval = score.bootstrap(by_trial[:, -1])
    return {
        "score": by_trial.mean(0).round(4).tolist(),
        "ci95_last": None if interval is None else interval.tolist(),
        "return": {name: returns.mean(0).round(4).tolist() for name, returns in found.items()},
    }


def main() -> None:
    """The command line."""
    parser = Parser(__doc__)
    parser.add_argument("--agent", type=Path, required=True, help="a folder under a run's agents/")
    parser.add_argument("--task", required=True)
    parser.add_argument("--trials", type=int, default=128)
    parser.add_argument("--seed", type=int, default=0, help="0 and no --salt: the thetas of a run's seed 0")
    parser.add_argument("--salt", default="", help="any text")
    parser.add_argument("--range", nargs="+", default=[], metavar="LATENT=LOW:HIGH", help="draw thetas from there")
    parser.add_argument("--expert", help="another expert: weights.safetensors, or path/file.py:name of a callable")
    parser.add_argument("--out", type=place, help="a .json file to write")
    args = parser.parse_args()
    task = envs.get(args.task)
    agent, expert, where = ready(args.agent, task), policy.load(task, args.expert), elsewhere(task, args.range)
    if not 2 <= args.trials <= 100_000 or args.seed < 0:
        raise envs.InputError(
            f"--trials was {args.trials} and --seed {args.seed}; they must be from 2 to 100,000, and from 0 up"
        )
    if args.out is not None:
        check_file(args.out)
    found = rescore(agent, task, expert, args.trials, stream(EVALUATION, args.seed, args.salt), where)
    low, high = found["ci95_last"]
    print(
        f"{task.name}, {args.trials} trials: score of each episode {' '.join(map(score.two_decimals, found['score']))}"
        f" (0 random, 1 expert; last {low:.2f} to {high:.2f}, 95% over trials)"
    )
    if args.out is not None:
        asked = {name: getattr(args, name) for name in ("trials", "seed", "salt", "range")}
        about = {"task": task.name, "task_version": task.version, "agent": str(args.agent)}
        write_json(args.out, {**about, **asked, **found})


if __name__ == "__main__":
    run_command(main)
