"""Deconfounded imitation with a discrete latent: a mixture of K dynamics models, with an exact posterior."""

from dataclasses import replace

from deconfounded.deconf.core.deployment import deployments
from deconfounded.deconf.core.latent_agent import DeconfoundedAgent
from deconfounded.deconf.given import Given
from deconfounded.deconf.method import uses
from deconfounded.deconf.methods import deconfounded
from deconfounded.deconf.methods.deconfounded import SHARED, USES, DeconfoundedConfig

ON_CONTROL = DeconfoundedConfig(
    model="discrete", latent=16, inference_updates=800, inference_batch=8, inference_rate=3e-3
)
ON_BANDIT = DeconfoundedConfig(
    model="discrete",
    latent=10,
    rounds=2,
    inference_updates=400,
    inference_batch=64,
    shortest=1.0,
    imitation_updates=200,
    final_updates=800,
    imitation_rate=3e-3,
    random_share=1.0,
)
PAPER = replace(ON_BANDIT, rounds=40, inference_updates=40, imitation_updates=40)
DEPLOYED = {**SHARED, "deployments": deployments("episode", "mode", "mean")}


@uses(*USES, version=3, cost=7, on_control=ON_CONTROL, on_bandit=ON_BANDIT, paper=PAPER, **DEPLOYED)
def fit(given: Given) -> DeconfoundedAgent:
    """Train by Algorithm 1 with the discrete model."""
    return deconfounded.fit(given)
