"""Oracle behavioural cloning: pi(a | s, theta), which sees theta in training and when it is deployed."""

from __future__ import annotations

from deconfounded.deconf.given import Given
from deconfounded.deconf.method import uses
from deconfounded.deconf.methods import cloning
from deconfounded.deconf.methods.cloning import AMOUNTS, MemorylessAgent


@uses("demonstrations", "theta", **AMOUNTS)
def fit(given: Given) -> MemorylessAgent:
    """Clone the expert step by step, given theta."""
    trials, theta = given.demonstrations, given.theta
    return cloning.train(trials, given.config, given.rngs, theta, given.acting_theta, given.monitor)
