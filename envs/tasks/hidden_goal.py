"""A puck whose goal on an arc is hidden, and has no effect but on the reward.

No tier: footnote 3 of the paper. The dynamics are independent of theta, so that no imitator can win: the interventional
policy never learns theta, and a naive clone follows its own first steps. A method that appears to win here has seen
theta. Latent: direction, rad from straight ahead, uniform. Noise and reward as in `Puck`.
"""

import numpy as np

from deconfounded.envs.physics import Edit
from deconfounded.envs.task import Array, Latent
from deconfounded.envs.tasks.puck import Puck


class HiddenGoal(Puck):
    """The goal is 1 m from the start."""

    name = "hidden_goal"
    version = 1
    tier = None
    latents = (Latent("direction", "rad", -2.0, 2.0),)

    def apply_latent(self, edit: Edit, theta: Array) -> None:
        """No change: theta affects the reward alone."""

    def goal(self, theta: Array) -> Array:
        return np.stack([np.sin(theta[:, 0]), np.cos(theta[:, 0])], -1)
