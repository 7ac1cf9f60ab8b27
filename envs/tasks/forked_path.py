"""A puck at a fork: the goal is left or right, and only a bump where no expert ever goes shows which.

Tier 3. Experts turn left or right at once, and along their paths the dynamics are the same under either theta: nothing
can be inferred from expert trajectories, and Tier 2 methods clone a mixture. An undecided agent goes up the middle,
into a soft bump that is slightly off-centre, on the side away from the goal: its push reveals theta. An imitator that
can query the expert there (`dagger`) learns to use it.

Latent: side, 0 is left and 1 is right. Noise and reward as in `Puck`.
"""

import numpy as np

from deconfounded.envs.physics import Edit
from deconfounded.envs.task import Array, Latent
from deconfounded.envs.tasks.puck import Puck


class ForkedPath(Puck):
    """Goals at (-1, .8) and (1, .8) m; the bump at (.08, .8) or (-.08, .8)."""

    name = "forked_path"
    version = 1
    tier = 3
    latents = (Latent("side", "", 0, 1, "categorical"),)

    def apply_latent(self, edit: Edit, theta: Array) -> None:
        edit.body_shift("bump", 0.08 - 0.16 * float(theta[0]))

    def goal(self, theta: Array) -> Array:
        return np.stack([2 * theta[:, 0] - 1, np.full(len(theta), 0.8)], -1)
