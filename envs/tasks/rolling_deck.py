"""A cartpole on a ship's deck, whose list is hidden and drifts: each episode of a trial has a list near the last.

Tier 2. As on tilted_cartpole, an agent that expects the wrong list loses the pole, and a control step shows the list
only through process noise. But evidence from earlier episodes loses its value: a belief that never forgets becomes
certain of a list that is gone.

Latent: list, rad, uniform; from episode to episode its quantile walks by N(0, .25^2), reflected at both ends. Noise,
reward and end as in `Cartpole`.
"""

from deconfounded.envs.task import Latent
from deconfounded.envs.tasks.tilted_cartpole import TiltedCartpole


class RollingDeck(TiltedCartpole):
    """A cartpole with a tilted deck, the body `rail`."""

    name = "rolling_deck"
    version = 0
    latents = (Latent("list", "rad", -0.3, 0.3, drift=0.25),)
