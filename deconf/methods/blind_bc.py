"""Blind behavioural cloning: pi(a | s), without memory and without theta."""

from __future__ import annotations

from deconfounded.deconf.given import Given
from deconfounded.deconf.method import uses
from deconfounded.deconf.methods import cloning
from deconfounded.deconf.methods.cloning import AMOUNTS, MemorylessAgent


@uses("demonstrations", **AMOUNTS)
def fit(given: Given) -> MemorylessAgent:
    """Clone the expert step by step."""
    return cloning.train(given.demonstrations, given.config, given.rngs, monitor=given.monitor)
