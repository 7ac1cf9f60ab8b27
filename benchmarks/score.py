"""Score a saved agent on fresh thetas: `deconf score --agent DIR --task slippery_cartpole --salt mine`

Thetas are drawn from p(theta) by --seed and --salt, or with --range from another range, which may exceed the task's.
The expert and random actions are run under the same thetas: the score is 1 for the expert, and 0 for random actions.
The interval is a percentile bootstrap over trials, with the share of cases in which one of so many holds the mean.
"""

from dataclasses import replace
from typing import Any

from deconfounded import envs
from deconfounded.benchmarks.console import Parser, place, whole
from deconfounded.benchmarks.engine.catalogue import check_names
from deconfounded.benchmarks.play import ready
from deconfounded.envs.support.files import check_file, write_json
from deconfounded.experts import policy
from deconfounded.experts.agent import Agent, ExpertAgent, RandomAgent
from deconfounded.experts.policy import Expert
from deconfounded.experts.rollout import run_trials


def with_ranges(task: envs.Task, ranges: list[str]) -> envs.Task:
    """The task with other ranges of its latents, name=low:high.

    Raises InputError for an unknown latent, or an invalid range.
    """
    if not ranges:
        return task
    if not task.draws_by_latents:
        raise envs.InputError(f"--range was {ranges[0]!r}; {task.name} draws theta by its own sample_theta alone")
    latents, ranged = {latent.name: latent for latent in task.latents}, set[str]()
    for text in ranges:
        name, _, bounds = text.partition("=")
        try:
            low, high = map(float, bounds.split(":"))
        except ValueError:
            raise envs.InputError(f"--range was {text!r}; it must be like {task.latents[0].name}=0.1:0.2") from None
        check_names("latent", [name], list(latents))
        if name in ranged:
            raise envs.InputError(f"--range had {name} twice; give each latent one range")
        ranged.add(name)
        latent = latents[name]
        if not low < high:
            raise envs.InputError(f"--range was {text!r}; {low:g} must be less than {high:g}")
        if latent.distribution == "categorical" and not latent.low <= low < high <= latent.high:
            raise envs.InputError(f"--range was {text!r}; {name} has {latent.low:g} to {latent.high:g} alone")
        latents[name] = replace(latent, low=low, high=high)
    other = type(task)()
    other.latents = tuple(latents.values())  # type: ignore[misc]
    return other


def rescore(agent: Agent, task: envs.Task, expert: Expert, trials: int, seed: int, where: envs.Task) -> dict[str, Any]:
    """Returns [trials, episodes] of agent, expert and random actions under the same thetas; scores by episode.

    Raises InputError if the expert is no better than random actions.
    """
    from deconfounded.benchmarks.output import scoring
    from deconfounded.benchmarks.output.trial_scores import bootstrap_score

    env = envs.BatchEnv(where, trials)
    agents = {"agent": agent, "expert": ExpertAgent(env, expert), "random": RandomAgent(task.action_space)}
    returns = {name: run_trials(env, each, task.episodes, seed).returns for name, each in agents.items()}
    references = (returns["random"].mean(), returns["expert"].mean())
    scoring.check_expert(task.name, *references)
    each = [returns["agent"][:, -1], *(returns[name].mean(1) for name in ("random", "expert"))]
    interval = bootstrap_score(*each)
    return {
        "score": scoring.normalise(returns["agent"], *references).mean(0).round(4).tolist(),
        "ci95_last": None if interval is None else interval.tolist(),
        "return": {name: of.mean(0).round(4).tolist() for name, of in returns.items()},
    }


def main() -> None:
    parser = Parser(__doc__, "--agent", "--task", "--expert")
    parser.add_argument("--trials", type=whole(2, 100_000), default=128)
    parser.add_argument("--seed", type=whole(0), default=0, help="draws thetas; 0 without --salt: as a run's seed 0")
    parser.add_argument("--salt", default="", help="any text: draw other thetas by it")
    parser.add_argument("--range", nargs="+", default=[], metavar="LATENT=LOW:HIGH", help="draw thetas from this range")
    parser.add_argument("--out", type=place, help="a .json file to write; one that is there is replaced")
    args = parser.parse_args()
    task = envs.get(args.task)
    expert, where = policy.load(task, args.expert), with_ranges(task, args.range)
    if args.out is not None:
        if args.out.suffix != ".json":
            raise envs.InputError(f"--out was {args.out}; it must end in .json")
        check_file(args.out)
    agent = ready(args.agent, task)
    from deconfounded.benchmarks.engine.context import EVALUATION, stream  # torch takes seconds
    from deconfounded.benchmarks.output import scoring

    scored = rescore(agent, task, expert, args.trials, stream(EVALUATION, args.seed, args.salt), where)
    held = f"{scoring.coverage(args.trials):.0%} of such intervals hold the mean"
    last = f"last {scoring.interval(scored['ci95_last'])} over trials; {held}"
    scores = " ".join(map(scoring.two_decimals, scored["score"]))
    print(f"{task.name}, {args.trials} trials: score of each episode {scores} (0 random, 1 expert; {last})")
    if args.out is not None:
        asked = {name: getattr(args, name) for name in ("trials", "seed", "salt", "range")}
        about = {"task": task.name, "task_version": task.version, "agent": str(args.agent)}
        write_json(args.out, {**about, **asked, **scored})
        print(f"-> {args.out}")
