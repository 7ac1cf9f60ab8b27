"""What a reader asks first of the opponents, and what the records say, one sentence each."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from deconfounded.benchmarks.output import statistics
from deconfounded.benchmarks.output.score import two_decimals
from deconfounded.envs.streams import Array

NOTE = (
    "Scores in the last episode, of all tasks whose certificate is passed and where all three were run. Opponents were"
    " tuned on two of these tasks, with other seeds, to score best. naive_rnn kept its preset, though what else was"
    " tried scores higher, see opponents.md."
)
QUESTIONS = {
    "naive_transformer": "Does scale cure the delusion?",
    "naive_obs": "Is it enough not to see one's own past actions?",
    "gail": "Is it enough to practise in the world, and be taken for the expert?",
    "rma": "Is a student enough whose teacher sees theta, as robotics trains it?",
}
PEER, NAIVE = "deconfounded", "naive_rnn"
Scores = Mapping[str, Mapping[str, Mapping[int, float]]]
"""Of the last episode, by task, method and seed."""


def answers(scores: Scores) -> list[str]:
    """A sentence for each of QUESTIONS whose method has several seeds on a task of these, as PEER and NAIVE have."""
    return [told for method, question in QUESTIONS.items() if (told := _answer(scores, method, question))]


def _answer(scores: Scores, method: str, question: str) -> str | None:
    """By intervals of 95%: does the method's reach up to that of PEER, and does it keep clear of that of NAIVE?"""
    names = (method, NAIVE, PEER)
    tasks = [task for task, of in scores.items() if all(len(of.get(name, ())) > 1 for name in names)]
    if not tasks:
        return None
    runs = {name: {task: np.array(list(scores[task][name].values())) for task in tasks} for name in names}
    found = {name: _figure(statistics.iqm, runs[name]) for name in names}
    _, low, high = found[method]
    helps, enough = low > found[NAIVE][2], high >= found[PEER][1]
    if found[PEER][1] <= found[NAIVE][2] or (enough and not helps):
        word = "It cannot be told yet"
    else:
        word = "Yes" if enough else "It helps, but it is not enough" if helps else "No"
    told = (
        f"{name} {mean} ({low} to {high})" for name in names for mean, low, high in [map(two_decimals, found[name])]
    )
    better, *_ = _figure(statistics.improvement, runs[PEER], runs[method])
    return (
        f"{question} {word}: {', '.join(told)}, interquartile means over {len(tasks)} task{'s' * (len(tasks) > 1)} and"
        f" their 95% intervals. A run of {PEER} is better than one of {method} with probability {two_decimals(better)}."
    )


def _figure(figure: Callable[..., Array], *runs: statistics.Runs) -> tuple[float, float, float]:
    """Over tasks that all have: its value, and from where to where its interval reaches."""
    found = statistics.over_tasks(figure, *runs)
    assert found is not None
    assert found.interval is not None
    low, high = found.interval
    return float(found.value), float(low), float(high)
