"""A cartpole on a ship's deck, whose list is hidden and drifts: each episode of a trial has another one, not far off.

Tier 2. As on tilted_cartpole, whoever expects the wrong list loses the pole, and one control step shows it only through
process noise. But what an episode taught is worth less in the next one: a belief that only ever grows surer is sure of
a list that is gone.

Latent: list, rad, uniform; from episode to episode its quantile walks by N(0, .25^2), reflected at both ends. Noise,
reward and end as in `Cartpole`.
"""

from __future__ import annotations

from deconfounded.envs.latent import Latent
from deconfounded.envs.tasks.tilted_cartpole import TiltedCartpole


class RollingDeck(TiltedCartpole):
    """Turns the deck, a body called rail."""

    name = "rolling_deck"
    version = 0
    latents = (Latent("list", "rad", -0.3, 0.3, drift=0.25),)
