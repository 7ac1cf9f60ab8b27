"""Deconfounded imitation with the paper's own belief, a GRU over transitions, in place of a sum of evidence."""

from __future__ import annotations

from dataclasses import replace

from deconfounded.deconf.given import Given
from deconfounded.deconf.method import uses
from deconfounded.deconf.methods import deconfounded
from deconfounded.deconf.methods.deconfounded import DeconfoundedAgent


@uses(
    *("demonstrations", "exploration"),
    cost=14,
    on_control=replace(deconfounded.ON_CONTROL, model="gru"),
    on_bandit=replace(deconfounded.ON_BANDIT, model="gru"),
    smoke=deconfounded.SMOKE,
    smoke_bandit=deconfounded.SMOKE_BANDIT,
    paper=deconfounded.PAPER,
    many=deconfounded.many,
    ways={"episode": deconfounded.once},
)
def fit(given: Given) -> DeconfoundedAgent:
    """Algorithm 1 with that belief."""
    return deconfounded.fit(given)
