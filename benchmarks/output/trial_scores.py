"""How uncertain a score of means over trials is, where agent, expert and random actions act in the same ones."""

import numpy as np

from deconfounded.benchmarks.output.scoring import normalise
from deconfounded.envs.streams import Array


def bootstrap_score(returns: Array, random: Array, expert: Array) -> Array | None:
    """The percentile-bootstrap interval [2] of the score of mean returns [N]; None for a single trial.

    Of trials under the same thetas, which are drawn together: random and expert are no less uncertain, and often vary
    with theta as the agent does. A draw of trials in which the expert is no better than random actions counts as none.
    """
    if len(returns) < 2:
        return None
    rng, of = np.random.default_rng(0), np.stack([returns, random, expert])
    mean, zero, one = np.array([of[:, rng.integers(len(returns), size=len(returns))].mean(1) for _ in range(2000)]).T
    better = one > zero
    return np.percentile(normalise(mean[better], zero[better], one[better]), [2.5, 97.5])


def standard_error(returns: Array, random: Array, expert: Array) -> float:
    """That of the score of mean returns [N], of trials under the same thetas; by the delta method."""
    zero, one = random.mean(), expert.mean()
    score = normalise(returns.mean(), zero, one)
    return float(((returns - score * expert - (1 - score) * random) / (one - zero)).std() / len(returns) ** 0.5)
