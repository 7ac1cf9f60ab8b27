"""Deconfounded imitation with the paper's belief: a GRU over transitions, not a sum of evidence."""

from dataclasses import replace

from deconfounded.deconf.core.latent_agent import DeconfoundedAgent
from deconfounded.deconf.given import Given
from deconfounded.deconf.method import uses
from deconfounded.deconf.methods import deconfounded
from deconfounded.deconf.methods.deconfounded import ON_BANDIT, PAPER, SHARED, USES, DeconfoundedConfig

ON_CONTROL, BANDIT = DeconfoundedConfig(model="gru", inference_updates=500), replace(ON_BANDIT, model="gru")


@uses(
    *USES, version=2, cost=14, on_control=ON_CONTROL, on_bandit=BANDIT, paper=PAPER, large=deconfounded.large, **SHARED
)
def fit(given: Given) -> DeconfoundedAgent:
    """Train by Algorithm 1 with the GRU belief."""
    return deconfounded.fit(given)
