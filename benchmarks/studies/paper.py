"""Figures 2 and 3 of the paper, on its bandit: `deconf paper`

Figure 2: roll-outs of expert, conditional and interventional policy. Figure 3: P(best arm) on expert trajectories (a)
and online (b), imitation loss (c) and best-arm pulls (d) during training; learned agents against the exact policies.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import ListedColormap
from numpy.typing import NDArray

from deconfounded import envs
from deconfounded.benchmarks import commands
from deconfounded.benchmarks.engine.catalogue import EXACT
from deconfounded.benchmarks.engine.context import EVALUATION, Context, stream
from deconfounded.benchmarks.engine.job_files import Finished, by_method
from deconfounded.benchmarks.engine.jobs import Job, JobMonitor
from deconfounded.benchmarks.engine.provider import fit
from deconfounded.benchmarks.output import scoring
from deconfounded.benchmarks.output.aggregation import covered
from deconfounded.benchmarks.output.pictures import colour, panels
from deconfounded.deconf.core.data import Batch
from deconfounded.deconf.core.latent_agent import DeconfoundedAgent
from deconfounded.deconf.equations import posterior_policy
from deconfounded.deconf.exact import ExactAgent
from deconfounded.deconf.methods.sequence_bc import RecurrentAgent
from deconfounded.envs.streams import Array
from deconfounded.envs.support.files import write_atomically, write_json
from deconfounded.experts import policy
from deconfounded.experts.agent import Agent, AgentWrapper, ExpertAgent
from deconfounded.experts.rollout import run_trials

SHOWN = ("naive_rnn", "deconfounded")  # in Figure 3
LEARNERS = (*SHOWN, "deconfounded_gru", "deconfounded_discrete", "deconfounded_offline", "dagger")
POINTS = 40  # evaluations during training
WINDOW = 20  # steps of a smoothed curve, as in the paper
COLOURS_OF_ARMS = ["#2ca02c", "#d62728", "#ff7f0e", "#9467bd", "#8c564b"]  # the first is the best arm


class Onlooker(AgentWrapper):
    """Sees what the expert does, and notes what it would have done itself: `would` holds [N, A] a step."""

    def __init__(self, agent: Agent, expert: ExpertAgent) -> None:
        super().__init__(agent)
        self.expert = expert

    def begin(self, n: int) -> None:
        super().begin(n)
        self.would: list[Array] = []

    def reset(self, rngs: Sequence[np.random.Generator]) -> None:
        super().reset(rngs)
        self.expert.reset([np.random.default_rng(rng.integers(2**63)) for rng in rngs])

    def act(self, obs: NDArray[np.float32]) -> Array:
        self.would.append(super().act(obs))
        return self.expert.act(obs)


class ExactPolicyRecorder(ExactAgent):
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
        kept = self.kept
        due = not kept["at"] or done == total or done * POINTS // total > kept["at"][-1] * POINTS // total
        if due and isinstance(agent, RecurrentAgent | DeconfoundedAgent):
            pulls = online(self.context, agent, self.trials)[1]
            kept["at"].append(done)
            kept["pulls"].append(pulls.reshape(len(self.context.seeds), -1).mean(1).tolist())
            kept["loss"].append(agent.held_out_loss(self.held_out).tolist())


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
        kept = {key: np.array(values) for key, values in monitor.kept.items()}
        for i, seed in enumerate(self.seeds):
            rows = context.rows(i)
            arrays = {"online": best[rows].mean(0), "on_expert": would[rows].mean(0), "pulls": pulls[rows].mean()}
            curves = {f"{key}_curve": kept[key][:, i] for key in ("loss", "pulls")}
            self.save(seed, {"at": kept["at"], **arrays, **curves}, monitor, {"train_s": trained})
        return f"{pulls.mean():.1f} best-arm pulls, trained in {trained:.0f} s, all in {monitor.close():.0f} s"


def online(context: Context, agent: Agent, n: int) -> tuple[NDArray[np.bool_], Array]:
    """Deploy in n trials a seed: whether each step's arm was the best [S n, T], and pulls of it [S n]."""
    env = envs.BatchEnv(context.task, n * len(context.seeds))
    trials, returns, _ = run_trials(env, agent, 1, [stream(EVALUATION, seed) for seed in context.seeds])
    return trials.action[:, 0, :, 0] == env.theta, returns[:, 0]


def exact(task: envs.Task, n: int = 40_000) -> dict[str, dict[str, Any]]:
    """Expert and exact policies: P(best arm) online and on expert trajectories [T], pulls, imitation loss."""
    expert, measured = policy.load(task), {}
    for name in EXACT[::-1]:
        env = envs.BatchEnv(task, n)
        agent = ExactPolicyRecorder(env, expert, name == "conditional")
        returns = run_trials(env, agent, 1, seed=0).returns
        measured[name] = {"online": np.mean(agent.best, 1), "pulls": float(returns.mean())}
        trials = run_trials(env, Onlooker(agent, ExpertAgent(env, expert)), 1, seed=1).trials
        arms = np.take_along_axis(np.stack(agent.policy, 1), trials.action[:, 0].astype(int), -1)
        measured[name] |= {"on_expert": np.mean(agent.best, 1), "loss": float(-np.log(arms).mean())}
    probs = task.expert_probs(np.zeros((1, 1)), np.zeros((1, 1)))
    assert probs is not None
    always = np.full(task.horizon, probs.max())
    loss = float(-(probs * np.log(probs)).sum())
    measured["expert"] = {"online": always, "on_expert": always, "pulls": float(always.sum()), "loss": loss}
    return measured


def summarise(finished: Finished, references: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Pulls of each method and how far its curves are from the exact policy it should match."""
    methods = {}
    for method, data in by_method(finished).items():
        pulls, curve = np.array([float(entry["pulls"]) for entry in data]), np.mean([e["online"] for e in data], 0)
        name = "conditional" if method == "naive_rnn" else "interventional"
        target = references[name]
        methods[method] = {
            "pulls": pulls.round(3).tolist(),
            "pulls_mean": round(float(pulls.mean()), 3),
            "pulls_se": round(float(pulls.std(ddof=1) / len(pulls) ** 0.5), 3) if len(pulls) > 1 else None,
            "target": name,
            "target_pulls": round(target["pulls"], 3),
            "max_gap_online": round(float(np.abs(curve - target["online"]).max()), 4),
            "loss": round(float(np.mean([entry["loss_curve"][-1] for entry in data])), 4),
            "online": curve.round(4).tolist(),
            "on_expert": np.mean([entry["on_expert"] for entry in data], 0).round(4).tolist(),
            "budget": scoring.mean_budget([entry["meta"]["budget"] for entry in data]),
            "train_s": round(float(np.mean([entry["meta"]["train_s"] for entry in data])), 1),
        }
    return methods


def table(methods: dict[str, Any]) -> str:
    """One row a method."""
    rows = []
    for name, entry in methods.items():
        pulls = f"{entry['pulls_mean']:.2f}"
        pulls += "" if entry["pulls_se"] is None else f" +- {entry['pulls_se']:.2f}"
        exact, apart = f"{entry['target_pulls']:.2f}", f"{entry['max_gap_online']:.3f}"
        rows.append((name, pulls, exact, apart, scoring.budget(entry["budget"])))
    return scoring.plain_table(("method", "best-arm pulls", "exact", "max gap online", "budget (a seed)"), rows)


def write(
    task: envs.Task, about: dict[str, Any], finished: Finished, references: dict[str, dict[str, Any]], folder: Path
) -> str:
    """Write results, rows and figures; returns what to print."""
    exactly = {name: {"pulls": round(e["pulls"], 3), "loss": round(e["loss"], 4)} for name, e in references.items()}
    spans = [span for *_, entry in finished for span in entry["meta"]["spans"]]
    results = {**about, "wall_s": round(covered(spans), 1), "exact": exactly}
    results["methods"] = summarise(finished, references)
    write_json(folder / "results.json", results)
    rows = [f"{name},{seed},{float(entry['pulls']):.4f}" for name, seed, entry in finished]
    write_atomically(folder / "rows.csv", "\n".join(["method,seed,pulls", *rows]) + "\n")
    figure_2(task, folder / "figure2.png")
    figure_3([entry for entry in finished if entry[0] in SHOWN], references, folder / "figure3.png")
    figure_3(finished, references, folder / "tiers.png")
    return f"\n{table(results['methods'])}\n\n{results['wall_s']:.0f} s -> {folder / 'figure3.png'}"


def smoothed(curves: Array) -> Array:
    """Sliding mean over WINDOW steps of [S, T]; shorter at the start."""
    total = np.concatenate([np.zeros((len(curves), 1)), curves.cumsum(1)], 1)
    end = np.arange(1, curves.shape[1] + 1)
    start = np.maximum(end - WINDOW, 0)
    return (total[:, end] - total[:, start]) / (end - start)


def figure_2(task: envs.Task, file: Path) -> None:
    """Roll-outs as rows of colours: green is the best arm."""
    expert = policy.load(task)
    env = envs.BatchEnv(task, 5)
    agents: dict[str, Agent] = {"expert": ExpertAgent(env, expert)}
    agents |= {name: ExactAgent(env, expert, name == "conditional") for name in EXACT}
    colours = ListedColormap(COLOURS_OF_ARMS)
    with panels(file, 3, size=(8, 4.4), sharex=True) as grid:
        for axes, (name, agent) in zip(grid[:, 0], agents.items(), strict=True):
            trials = run_trials(env, agent, 1, seed=3).trials
            shifted = (trials.action[:, 0, :, 0] - env.theta) % len(COLOURS_OF_ARMS)  # 0: the best arm
            axes.imshow(shifted, cmap=colours, vmin=-0.5, vmax=4.5, aspect="auto", interpolation="nearest")
            axes.set(title=name, yticks=[])
        grid[-1, 0].set(xlabel="step")


def figure_3(finished: Finished, references: dict[str, dict[str, Any]], file: Path) -> None:
    """Panels a to d; shaded: standard error over seeds, smoothed over WINDOW steps; dashed: exact."""
    titles = ["(a) on expert trajectories", "(b) online", "(c) imitation loss, held out", "(d) online, during training"]
    share = np.linspace(0, 1, 101)
    with panels(file, 1, 4, size=(16, 3.6)) as [row]:
        for method, data in by_method(finished).items():
            for axes, key in zip(row, ("on_expert", "online", "loss_curve", "pulls_curve"), strict=True):
                if key.endswith("curve"):  # at the updates that were watched, as a share of all
                    curves = np.array([np.interp(share, e["at"] / e["at"][-1], e[key], left=np.nan) for e in data])
                    x: Array = share
                else:
                    curves = smoothed(np.array([entry[key] for entry in data], float))
                    x = np.arange(1, curves.shape[1] + 1)
                mean, error = curves.mean(0), curves.std(0, ddof=len(curves) > 1) / len(curves) ** 0.5
                axes.plot(x, mean, color=colour(method), label=method)
                axes.fill_between(x, mean - error, mean + error, color=colour(method), alpha=0.3, lw=0)
        for name, entry in references.items():
            for axes, key in zip(row[:2], ("on_expert", "online"), strict=True):
                axes.plot(np.arange(1, 101), smoothed(entry[key][None])[0], "--", color=colour(name), lw=1, label=name)
            for axes, key in zip(row[2:], ("loss", "pulls"), strict=True):
                axes.axhline(entry[key], ls="--", color=colour(name), lw=1)
        for axes, title in zip(row, titles, strict=True):
            axes.set(title=title, xlabel="share of training")
        for axes in row[:2]:
            axes.set(xlabel="step", ylabel="P(best arm)", ylim=(0.15, 0.65))
        row[3].set(ylabel="best-arm pulls of 100")
        handles = row[1].get_legend_handles_labels()
        row[1].figure.legend(*handles, loc="outside right center", frameon=False, fontsize=8)


def main() -> None:
    args = commands.parser(__doc__, f"`all`, or some of {', '.join(LEARNERS)}", seeds=10, resumes=True).parse_args()
    methods = commands.check(args, LEARNERS, SHOWN)
    task = envs.get("bandit")
    folder = args.out or Path("results") / f"paper-{args.preset}"
    with commands.engine(args.cluster) as where:
        finished, about, failed = commands.run(FigureJob, task, args, methods, folder, where)
    if failed:
        raise failed[0]
    print(write(task, about, finished, exact(task), folder))
