"""The monitor of training: progress, checkpoints, and the amounts of data used."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from deconfounded.experts.agent import Agent

Training = dict[str, Any]
"""Tensors, numbers, strings, and lists and dictionaries of these."""


class Monitor:
    """Receives the progress and the checkpoints of training. This base class keeps neither.

    `budget`: the data that each seed has used, by kind; what makes the data counts it with `spend`.
    """

    def __init__(self) -> None:
        self.budget: dict[str, list[int]] = {}

    def spend(self, kind: str, amounts: Sequence[int]) -> None:
        """Add each seed's amount of a kind of data to the budget."""
        before = self.budget.get(kind, [0] * len(amounts))
        self.budget[kind] = [int(a + b) for a, b in zip(before, amounts, strict=True)]

    def update(self, done: int, total: int, losses: dict[str, float], agent: "Agent | None" = None) -> None:
        """Report updates done and in all, losses by name (means over seeds), and the agent so far, if it can act."""

    def save(self, state: Callable[[], Training]) -> None:
        """Offer a checkpoint, `state()`, from which training can resume."""

    def load(self) -> Training | None:
        """The checkpoint of an interrupted training, or None."""
        return None
