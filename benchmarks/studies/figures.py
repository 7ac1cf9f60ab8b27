"""Figures 2 and 3 of the paper, drawn."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import ListedColormap

from deconfounded import envs
from deconfounded.benchmarks.engine.catalogue import EXACT
from deconfounded.benchmarks.engine.store import Finished, by_method
from deconfounded.benchmarks.output.colours import colour
from deconfounded.benchmarks.output.pictures import save_figure
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
    figure, panels = plt.subplots(3, 1, figsize=(8, 4.4), layout="constrained", sharex=True)
    colours = ListedColormap(COLOURS_OF_ARMS)
    for panel, (name, agent) in zip(panels, agents.items(), strict=True):
        trials = run_trials(env, agent, 1, seed=3).trials
        shifted = (trials.action[:, 0, :, 0] - env.theta) % len(COLOURS_OF_ARMS)  # 0: the best arm
        panel.imshow(shifted, cmap=colours, vmin=-0.5, vmax=4.5, aspect="auto", interpolation="nearest")
        panel.set(title=name, yticks=[])
    panels[-1].set(xlabel="step")
    save_figure(figure, file, 110)
    plt.close(figure)


def figure_3(finished: Finished, references: dict[str, dict[str, Any]], file: Path) -> None:
    """Panels a to d; shaded: standard error over seeds, smoothed over WINDOW steps; dashed: exact."""
    figure, panels = plt.subplots(1, 4, figsize=(16, 3.6), layout="constrained")
    titles = ["(a) on expert trajectories", "(b) online", "(c) imitation loss, held out", "(d) online, during training"]
    for panel, title in zip(panels, titles, strict=True):
        panel.set(title=title)
    for method, data in by_method(finished).items():
        share = np.linspace(0, 1, 101)
        for panel, key in zip(panels, ("on_expert", "online", "loss_curve", "pulls_curve"), strict=True):
            curves = np.array([entry[key] for entry in data], float)
            x: Array = np.arange(1, curves.shape[1] + 1)
            if key.endswith("curve"):  # at the updates that were watched, as a share of all
                curves = np.array(
                    [np.interp(share, e["at"] / e["at"][-1], c, left=np.nan) for e, c in zip(data, curves, strict=True)]
                )
                x = share
            else:
                curves = smoothed(curves)
            mean, error = curves.mean(0), curves.std(0, ddof=len(curves) > 1) / len(curves) ** 0.5
            (line,) = panel.plot(x, mean, color=colour(method), label=method)
            panel.fill_between(x, mean - error, mean + error, color=line.get_color(), alpha=0.3, lw=0)
    for name, entry in references.items():
        for panel, key in zip(panels[:2], ("on_expert", "online"), strict=True):
            panel.plot(np.arange(1, 101), smoothed(entry[key][None])[0], "--", color=colour(name), lw=1, label=name)
        for panel, key in zip(panels[2:], ("loss", "pulls"), strict=True):
            panel.axhline(entry[key], ls="--", color=colour(name), lw=1)
    for panel in panels[:2]:
        panel.set(xlabel="step", ylabel="P(best arm)", ylim=(0.15, 0.65))
    for panel in panels[2:]:
        panel.set(xlabel="share of training")
    panels[3].set(ylabel="best-arm pulls of 100")
    figure.legend(*panels[1].get_legend_handles_labels(), loc="outside right center", frameon=False, fontsize=8)
    save_figure(figure, file, 110)
    plt.close(figure)
