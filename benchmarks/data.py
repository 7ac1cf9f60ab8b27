"""Write demonstrations or explorations as a Minari data set: `deconf data --task slippery_cartpole --out data`

With as many trials as a preset has (256 on control tasks) the expert's are those that seed 0 of a run imitates, since
its actions in a trial depend on how many trials there are; --explore writes trials of uniformly random actions. The
sha256 is of the contents: with the same versions of libraries it is the same everywhere.
"""

from collections.abc import Callable
from importlib.util import find_spec

from deconfounded import envs
from deconfounded.benchmarks.console import Parser, place, whole
from deconfounded.benchmarks.engine.context import DEMOS, EXPLORATION, stream
from deconfounded.envs.support.files import check_folder
from deconfounded.experts import datasets, policy
from deconfounded.experts.agent import Agent, ExpertAgent, RandomAgent
from deconfounded.experts.rollout import run_trials


def main() -> None:
    parser = Parser(__doc__, "--task", "--expert")
    parser.add_argument("--trials", type=whole(1, 100_000), default=256)
    parser.add_argument("--explore", action="store_true", help="uniformly random actions in place of the expert's")
    parser.add_argument("--seed", type=whole(0), default=0)
    parser.add_argument("--out", type=place, required=True, help="a folder of data sets")
    args = parser.parse_args()
    task = envs.get(args.task)
    envs.check_task(task)
    expert = policy.load(task, args.expert)
    if not find_spec("minari"):
        raise envs.InputError("a data set needs Minari; `pip install deconfounded-imitation[data]` brings it")
    check_folder(args.out)
    behaviours: dict[str, Callable[[envs.BatchEnv], Agent]] = {
        "random": lambda env: RandomAgent(task.action_space),
        "expert": lambda env: ExpertAgent(env, expert),
    }
    env = envs.BatchEnv(task, 64)
    low, high = (float(run_trials(env, make(env), 1, args.seed).returns.mean()) for make in behaviours.values())
    kind = "random" if args.explore else "expert"
    seed = stream(EXPLORATION if args.explore else DEMOS, args.seed)
    collected = datasets.collect(task, args.trials, behaviours[kind], seed)
    written = datasets.write(args.out, task, f"{kind}{args.trials}s{args.seed}", collected, kind, (low, high))
    print(f"{task.name}: {args.trials} trials, sha256 {collected[0].sha256} -> {written}")
