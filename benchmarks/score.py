"""Scores from returns: 0 = random actions, 1 = the expert that sees theta. No training happens here."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import stats

from envs.task import Array


def normalise(returns: Array, random: float, expert: float) -> Array:
    """Returns of any shape -> scores; 0 = random actions, 1 = the expert."""
    return (returns - random) / (expert - random)


def bootstrap(values: Array) -> list[float] | None:
    """95% percentile-bootstrap interval of the mean over seeds; None for a single seed."""
    if len(values) < 2:
        return None
    if np.ptp(values) == 0:
        return [float(values[0])] * 2
    interval = stats.bootstrap((values,), np.mean, method="percentile", n_resamples=5000, rng=0).confidence_interval
    return [float(interval.low), float(interval.high)]


def summarise(returns: dict[str, dict[int, Array]], episodes: int) -> dict[str, Any]:
    """Returns by method and seed, [trials, E] each -> the `methods` entry of results.json.

    `episodes` is the length of the trials trained on; what agents did in later ones, if any, is told apart.
    """
    random, expert = (
        float(np.mean([r[:, :episodes] for r in returns[name].values()])) for name in ("random", "expert")
    )
    methods = {}
    for name, by_seed in returns.items():
        means = np.array([by_seed[seed].mean(0) for seed in sorted(by_seed)])
        scores = normalise(means, random, expert)
        methods[name] = {
            "seeds": sorted(by_seed),
            "return": means[:, :episodes].round(4).tolist(),
            "score": scores[:, :episodes].mean(0).round(4).tolist(),
            "score_last": round(float(scores[:, episodes - 1].mean()), 4),
            "ci95": bootstrap(scores[:, episodes - 1]),
        }
        if means.shape[1] > episodes:
            methods[name]["score_beyond"] = scores[:, episodes:].mean(0).round(4).tolist()
    return methods


def table(results: dict[str, Any]) -> str:
    """The results as a plain table, one row a method, best first."""
    rows = [("method", "return", "score of each episode", "last", "95% interval")]
    for name, entry in sorted(results["methods"].items(), key=lambda item: -item[1]["score_last"]):
        per_episode = " ".join(f"{value:5.2f}" for value in entry["score"])
        interval = "-" if entry["ci95"] is None else "{:.2f} .. {:.2f}".format(*entry["ci95"])
        last = np.mean(entry["return"], 0)[-1]
        rows.append((name, f"{last:.1f}", per_episode, f"{entry['score_last']:.2f}", interval))
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return "\n".join("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in rows)
