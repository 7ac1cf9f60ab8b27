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

ON_CONTROL = DeconfoundedConfig(model="forgetting", inference_updates=500)
BANDIT = replace(ON_BANDIT, model="forgetting")


@uses(
    *USES, version=3, cost=6, on_control=ON_CONTROL, on_bandit=BANDIT, paper=BANDIT, large=deconfounded.large, **SHARED
)
def fit(given: Given) -> DeconfoundedAgent:
    """Train by Algorithm 1 with the belief that forgets."""
    return deconfounded.fit(given)
