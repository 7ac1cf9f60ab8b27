"""Deconfounded imitation for many latents: theta_hat has 16 dimensions, and networks have 128 units, on all tasks.

`deconfounded` has 8 dimensions, and 128 units where observations are large alone. Its dynamics are linear in theta_hat,
so that each latent needs a dimension, or several where its effect is not linear. On `patchy_road` six latents show in
six places: docs/baselines.md.

On control tasks the last round begins with new networks. Those of the earlier rounds were trained first on little
exploration, most of it by random actions, and do not recover when they get more: warm starts generalise worse (Ash and
Adams, 2020).
"""

from dataclasses import replace

from deconfounded.deconf.core.latent_agent import DeconfoundedAgent
from deconfounded.deconf.core.sizes import WIDE
from deconfounded.deconf.given import Given
from deconfounded.deconf.method import uses
from deconfounded.deconf.methods import deconfounded
from deconfounded.deconf.methods.deconfounded import ON_BANDIT, SHARED, USES, DeconfoundedConfig

LATENT = 16  # dimensions of theta_hat
ON_CONTROL = DeconfoundedConfig(latent=LATENT, width=WIDE, restart=True)
BANDIT = replace(ON_BANDIT, latent=LATENT, width=WIDE)


@uses(
    *USES, version=2, cost=5, on_control=ON_CONTROL, on_bandit=BANDIT, paper=BANDIT, large=deconfounded.large, **SHARED
)
def fit(given: Given) -> DeconfoundedAgent:
    """Train by Algorithm 1 with the larger sizes, and with new networks in the last round."""
    return deconfounded.fit(given)
