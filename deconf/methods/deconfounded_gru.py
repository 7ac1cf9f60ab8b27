"""Deconfounded imitation with the paper's own belief, a GRU over transitions, in place of a sum of evidence."""

from __future__ import annotations

from dataclasses import replace

from deconfounded.deconf.given import Given
from deconfounded.deconf.method import uses
from deconfounded.deconf.methods import deconfounded
from deconfounded.deconf.methods.deconfounded import (
    FAMILY,
    ON_BANDIT,
    PAPER,
    USES,
    DeconfoundedAgent,
    DeconfoundedConfig,
)

ON_CONTROL, BANDIT = DeconfoundedConfig(model="gru"), replace(ON_BANDIT, model="gru")


@uses(*USES, cost=14, on_control=ON_CONTROL, on_bandit=BANDIT, paper=PAPER, many=deconfounded.many, **FAMILY)
def fit(given: Given) -> DeconfoundedAgent:
    """Algorithm 1 with that belief."""
    return deconfounded.fit(given)
