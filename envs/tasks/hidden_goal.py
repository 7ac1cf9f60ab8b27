"""A puck whose goal, somewhere on an arc, is hidden, and nothing else: theta tells the expert where to go, no more.

No tier: footnote 3 of the paper. The dynamics say nothing of theta, so that nobody who does not see it can win: the
interventional policy never learns, and naive cloning runs after its own first steps. A method that appears to win here
has seen theta. Latent: direction, rad from straight ahead, uniform. Noise and reward as in `Puck`.
"""

from __future__ import annotations

import numpy as np

from deconfounded.envs.edits import Edit
from deconfounded.envs.latent import Latent
from deconfounded.envs.streams import Array
from deconfounded.envs.tasks.puck import Puck


class HiddenGoal(Puck):
    """The goal is 1 m from the start."""

    name = "hidden_goal"
    version = 1
    tier = None
    latents = (Latent("direction", "rad", -2.0, 2.0),)

    def apply_latent(self, edit: Edit, theta: Array) -> None:
        """Nothing: that is the point."""

    def goal(self, theta: Array) -> Array:
        return np.stack([np.sin(theta[:, 0]), np.cos(theta[:, 0])], -1)
