"""Deconfounded imitation for a latent that may change at any step: a belief that forgets, and a latent for every step.

Evidence is summed over the whole history and, beside that, over its last steps (`core/beliefs.py: ForgettingBelief`).
The expert acts on the latent of the moment, so that each of its steps is cloned given the latent inferred from what
lies around it, before and after, and not given one latent a trial.
"""

from dataclasses import replace

from deconfounded.deconf.core.latent_agent import DeconfoundedAgent
from deconfounded.deconf.given import Given
from deconfounded.deconf.method import uses
from deconfounded.deconf.methods import deconfounded
from deconfounded.deconf.methods.deconfounded import ON_BANDIT, SHARED, USES, DeconfoundedConfig

BANDIT = replace(ON_BANDIT, model="forgetting")
AMOUNTS = {
    "on_control": DeconfoundedConfig(model="forgetting", inference_updates=500),
    "on_bandit": BANDIT,
    "paper": BANDIT,
}


@uses(*USES, version=3, cost=6, large=deconfounded.large, **AMOUNTS, **SHARED)
def fit(given: Given) -> DeconfoundedAgent:
    """Train by Algorithm 1 with the belief that forgets."""
    return deconfounded.fit(given)
