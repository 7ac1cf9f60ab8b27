"""What training reports to, and where it leaves what it needs to go on after an interruption."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from deconfounded.experts.rollout import Agent

Training = dict[str, Any]
"""Tensors, numbers, strings, and lists and dictionaries of these."""


class Monitor:
    """What training reports to, and where it leaves what it needs to go on after an interruption. This one is deaf.

    `budget` counts the data that each seed used, by kind; whoever makes the data tells by `spend`.
    """

    def __init__(self) -> None:
        self.budget: dict[str, list[int]] = {}

    def spend(self, kind: str, each: Sequence[int]) -> None:
        """Each seed used so much more of a kind of data."""
        before = self.budget.get(kind, [0] * len(each))
        self.budget[kind] = [int(a + b) for a, b in zip(before, each, strict=True)]

    def update(self, done: int, total: int, losses: dict[str, float], agent: Agent | None = None) -> None:
        """Updates done, updates in all, losses by name (the mean over seeds), and the agent so far, if it can act."""

    def save(self, state: Callable[[], Training]) -> None:
        """Training could go on from here, given `state()`."""

    def load(self) -> Training | None:
        """What was saved, if training was interrupted."""
        return None
