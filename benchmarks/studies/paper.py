"""Figures 2 and 3 of the paper, on its bandit: `deconf paper`

Figure 2: roll-outs of expert, conditional and interventional policy. Figure 3: P(best arm) on expert trajectories (a)
and online (b), imitation loss (c) and best-arm pulls (d) during training; learned agents against the exact policies.
"""

from __future__ import annotations

if __name__ == "__main__":  # Ctrl-C while the rest is imported is one line too
    from deconfounded.benchmarks.console import stop_at_once

    stop_at_once()

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deconfounded import envs
from deconfounded.benchmarks import commands
from deconfounded.benchmarks.console import run_command
from deconfounded.benchmarks.engine.context import EVALUATION, Context, stream
from deconfounded.benchmarks.engine.jobs import Job, JobMonitor
from deconfounded.benchmarks.engine.provider import fit
from deconfounded.benchmarks.engine.store import Finished, by_method
from deconfounded.benchmarks.output import score
from deconfounded.benchmarks.output.records import covered
from deconfounded.benchmarks.studies.figures import figure_2, figure_3
from deconfounded.deconf.core.data import Batch
from deconfounded.deconf.equations import posterior_policy
from deconfounded.deconf.exact import ExactAgent
from deconfounded.deconf.methods.deconfounded import DeconfoundedAgent
from deconfounded.deconf.methods.sequence_bc import RecurrentAgent
from deconfounded.envs.streams import Array
from deconfounded.envs.support.files import write_atomically, write_json
from deconfounded.experts import policy
from deconfounded.experts.rollout import Agent, ExpertAgent, run_trials

SHOWN = ("naive_rnn", "deconfounded")  # in Figure 3
LEARNERS = (*SHOWN, "deconfounded_gru", "deconfounded_discrete", "deconfounded_offline", "dagger")
TARGET = {"naive_rnn": "conditional"}  # whom a method should match; interventional, if not named
POINTS = 40  # evaluations during training


class Onlooker(Agent):
    """Sees what the expert does, and notes what it would have done itself: `would` holds [N, A] a step."""

    def __init__(self, agent: Agent, expert: ExpertAgent) -> None:
        self.agent, self.expert = agent, expert

    def begin(self, n: int) -> None:
        self.agent.begin(n)
        self.would: list[Array] = []

    def reset(self, rngs: Sequence[np.random.Generator]) -> None:
        self.agent.reset(rngs)
        self.expert.reset([np.random.default_rng(rng.integers(2**63)) for rng in rngs])

    def act(self, obs: NDArray[np.float32]) -> Array:
        self.would.append(self.agent.act(obs))
        return self.expert.act(obs)

    def observe(
        self, obs: NDArray[np.float32], action: Array, next_obs: NDArray[np.float32], alive: NDArray[np.bool_]
    ) -> None:
        self.agent.observe(obs, action, next_obs, alive)


class Known(ExactAgent):
    """An exact policy that notes its action probabilities at each step, Eq. (2), (5): `policy` [N, K], `best` [N]."""

    def begin(self, n: int) -> None:
        super().begin(n)
        self.policy: list[Array] = []
        self.best: list[Array] = []

    def act(self, obs: NDArray[np.float32]) -> Array:
        arms = self.grid.env.task.expert_probs(obs[: len(self.grid.theta)], self.grid.theta)
        assert arms is not None
        self.policy.append(posterior_policy(self.log_belief, arms))
        self.best.append(np.take_along_axis(self.policy[-1], self.env.theta.astype(int), -1)[:, 0])
        return super().act(obs)


class FigureMonitor(JobMonitor):
    """Deploys the agent and measures its imitation loss POINTS times as it learns."""

    def watch(self, context: Context, held_out: Batch, trials: int) -> None:
        """Begin: on held-out expert trials, and on so many of the agent's own."""
        self.context, self.held_out, self.trials = context, held_out, trials
        self.kept = {"at": [], "loss": [], "pulls": []}  # updates [P], and for each seed [P, S]

    def update(self, done: int, total: int, losses: dict[str, float], agent: Agent | None = None) -> None:
        super().update(done, total, losses, agent)
        seen = self.kept
        due = not seen["at"] or done == total or done * POINTS // total > seen["at"][-1] * POINTS // total
        if due and isinstance(agent, RecurrentAgent | DeconfoundedAgent):
            pulls = online(self.context, agent, self.trials)[1]
            seen["at"].append(done)
            seen["pulls"].append(pulls.reshape(len(self.context.seeds), -1).mean(1).tolist())
            seen["loss"].append(agent.held_out_loss(self.held_out).tolist())


class FigureJob(Job):
    """Train a method with some seeds, watched as it learns."""

    def run(self) -> str:
        task, n, monitor = envs.get(self.task), self.preset.eval_trials, FigureMonitor(self, 0.95)
        few = min(n, 500)
        context = Context(task, self.preset, self.seeds, monitor, self.folder)
        env = envs.BatchEnv(task, few * len(self.seeds))
        seeds = [stream(EVALUATION, seed) + n for seed in self.seeds]
        trials = run_trials(env, ExpertAgent(env, context.expert), 1, seeds).trials
        monitor.watch(context, Batch.of(trials, len(seeds), self.preset.device), few)
        agent = fit(context, self.method)
        trained = monitor.worked()
        best, pulls = online(context, agent, n)
        onlooker = Onlooker(agent, ExpertAgent(context.env, context.expert))
        run_trials(context.env, onlooker, 1, [stream(EVALUATION, seed) for seed in self.seeds])
        would = np.concatenate(onlooker.would, -1) == context.env.theta
        meta = {"train_s": trained}
        for i, seed in enumerate(self.seeds):
            rows, seen = context.rows(i), monitor.kept
            arrays = {"online": best[rows].mean(0), "on_expert": would[rows].mean(0), "pulls": pulls[rows].mean()}
            arrays |= {f"{key}_curve": np.array(seen[key])[:, i] for key in ("loss", "pulls")}
            self.save(seed, {"at": np.array(seen["at"]), **arrays}, monitor, meta)
        return f"{pulls.mean():.1f} best-arm pulls, trained in {trained:.0f} s, all in {monitor.close():.0f} s"


def online(context: Context, agent: Agent, n: int) -> tuple[NDArray[np.bool_], Array]:
    """Deploy in n trials a seed: whether each step's arm was the best [S n, T], and pulls of it [S n]."""
    env = envs.BatchEnv(context.task, n * len(context.seeds))
    trials, returns, _ = run_trials(env, agent, 1, [stream(EVALUATION, seed) for seed in context.seeds])
    return trials.action[:, 0, :, 0] == env.theta, returns[:, 0]


def exact(task: envs.Task, n: int = 40_000) -> dict[str, dict[str, Any]]:
    """Expert and exact policies: P(best arm) online and on expert trajectories [T], pulls, imitation loss."""
    expert, found = policy.load(task), {}
    for name in ("interventional", "conditional"):
        env = envs.BatchEnv(task, n)
        agent = Known(env, expert, name == "conditional")
        returns = run_trials(env, agent, 1, seed=0).returns
        found[name] = {"online": np.mean(agent.best, 1), "pulls": float(returns.mean())}
        trials = run_trials(env, Onlooker(agent, ExpertAgent(env, expert)), 1, seed=1).trials
        arms = np.take_along_axis(np.stack(agent.policy, 1), trials.action[:, 0].astype(int), -1)
        found[name] |= {"on_expert": np.mean(agent.best, 1), "loss": float(-np.log(arms).mean())}
    probs = task.expert_probs(np.zeros((1, 1)), np.zeros((1, 1)))
    assert probs is not None
    always = np.full(task.horizon, probs.max())
    loss = float(-(probs * np.log(probs)).sum())
    found["expert"] = {"online": always, "on_expert": always, "pulls": float(always.sum()), "loss": loss}
    return found


def summarise(finished: Finished, references: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Pulls of each method and how far its curves are from the exact policy it should match."""
    found = {}
    for method, data in by_method(finished).items():
        pulls, curve = np.array([float(entry["pulls"]) for entry in data]), np.mean([e["online"] for e in data], 0)
        target = references[TARGET.get(method, "interventional")]
        found[method] = {
            "pulls": pulls.round(3).tolist(),
            "pulls_mean": round(float(pulls.mean()), 3),
            "pulls_se": round(float(pulls.std(ddof=1) / len(pulls) ** 0.5), 3) if len(pulls) > 1 else None,
            "target": TARGET.get(method, "interventional"),
            "target_pulls": round(target["pulls"], 3),
            "max_gap_online": round(float(np.abs(curve - target["online"]).max()), 4),
            "loss": round(float(np.mean([entry["loss_curve"][-1] for entry in data])), 4),
            "online": curve.round(4).tolist(),
            "on_expert": np.mean([entry["on_expert"] for entry in data], 0).round(4).tolist(),
            "budget": score.mean_budget([entry["meta"]["budget"] for entry in data]),
            "train_s": round(float(np.mean([entry["meta"]["train_s"] for entry in data])), 1),
        }
    return found


def table(methods: dict[str, Any]) -> str:
    """One row a method."""
    lines = ["method                  best-arm pulls   exact   max gap online   budget (a seed)"]
    for name, entry in methods.items():
        error = "" if entry["pulls_se"] is None else f" +- {entry['pulls_se']:.2f}"
        budget = ", ".join(f"{value:,} {key.replace('_', ' ')}" for key, value in entry["budget"].items() if value)
        pulls = f"{entry['pulls_mean']:.2f}{error}"
        lines.append(
            f"{name:23} {pulls:16} {entry['target_pulls']:.2f}   {entry['max_gap_online']:.3f}            {budget}"
        )
    return "\n".join(lines)


def write(
    task: envs.Task, about: dict[str, Any], finished: Finished, references: dict[str, dict[str, Any]], folder: Path
) -> str:
    """Write results, rows and figures; returns what to print."""
    exactly = {name: {"pulls": round(e["pulls"], 3), "loss": round(e["loss"], 4)} for name, e in references.items()}
    spans = [(begin, end) for _, _, entry in finished for begin, end in entry["meta"]["spans"]]
    results = {**about, "wall_s": round(covered(spans), 1), "exact": exactly}
    results["methods"] = summarise(finished, references)
    write_json(folder / "results.json", results)
    rows = [f"{name},{seed},{float(entry['pulls']):.4f}" for name, seed, entry in finished]
    write_atomically(folder / "rows.csv", "\n".join(["method,seed,pulls", *rows]) + "\n")
    figure_2(task, folder / "figure2.png")
    figure_3([entry for entry in finished if entry[0] in SHOWN], references, folder / "figure3.png")
    figure_3(finished, references, folder / "tiers.png")
    return f"\n{table(results['methods'])}\n\n{results['wall_s']:.0f} s -> {folder / 'figure3.png'}"


def main() -> None:
    """The command line."""
    args = commands.parser(__doc__, f"`all`, or some of {', '.join(LEARNERS)}", seeds=10).parse_args()
    methods = commands.check(args, LEARNERS, SHOWN)
    task = envs.get("bandit")
    folder = args.out or Path("results") / f"paper-{args.preset}"
    finished, about = commands.run(FigureJob, task, args, methods, folder)
    print(write(task, about, finished, exact(task), folder))


if __name__ == "__main__":
    run_command(main, commands.KEPT)
