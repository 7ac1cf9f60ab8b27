"""A cartpole on a rail that is tilted by a hidden angle.

Tier 2. Gravity pulls cart and pole down the rail, so that theta changes both the angle at which the pole balances and
the force that holds the cart: an agent that expects the wrong tilt loses the pole. A control step shows the tilt only
through process noise.

Latent: tilt, rad, uniform. Noise per control step: see `process_noise`. Reward: upright * (.3 + .7 at the mark).
"""

from deconfounded.envs.physics import Edit
from deconfounded.envs.task import Array, Latent
from deconfounded.envs.tasks.cartpole import Cartpole


class TiltedCartpole(Cartpole):
    """A cartpole with a tilted body `rail`."""

    name = "tilted_cartpole"
    version = 1
    latents = (Latent("tilt", "rad", -0.3, 0.3),)

    def apply_latent(self, edit: Edit, theta: Array) -> None:
        edit.body_tilt("rail", float(theta[0]))
