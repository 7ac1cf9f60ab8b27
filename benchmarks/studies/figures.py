"""Figures 2 and 3 of the paper, drawn."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import ListedColormap

from deconfounded import envs
from deconfounded.benchmarks.engine.catalogue import EXACT
from deconfounded.benchmarks.engine.store import Finished, by_method
from deconfounded.benchmarks.output.pictures import colour, panels
from deconfounded.deconf.exact import ExactAgent
from deconfounded.envs.streams import Array
from deconfounded.experts import policy
from deconfounded.experts.rollout import Agent, ExpertAgent, run_trials

WINDOW = 20  # steps of a smoothed curve, as in the paper
COLOURS_OF_ARMS = ["#2ca02c", "#d62728", "#ff7f0e", "#9467bd", "#8c564b"]  # the first is the best arm


def smoothed(curves: Array) -> Array:
    """Sliding mean over WINDOW steps of [S, T]; shorter at the start."""
    total = np.concatenate([np.zeros((len(curves), 1)), curves.cumsum(1)], 1)
    end = np.arange(1, curves.shape[1] + 1)
    start = np.maximum(end - WINDOW, 0)
    return (total[:, end] - total[:, start]) / (end - start)


def figure_2(task: envs.Task, file: Path, rolled: int = 5) -> None:
    """Roll-outs as rows of colours: green is the best arm."""
    expert = policy.load(task)
    env = envs.BatchEnv(task, rolled)
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
