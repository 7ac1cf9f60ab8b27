"""The five-armed bandit of the paper, Eq. (4): arm theta pays more often, and the expert knows which arm it is.

Tier 2. State and observation: the last pay-out (0 at the start). The reward counts pulls of the best arm, the paper's
score; the pay-out is in the observation.
"""

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from deconfounded.envs.task import Array, Latent, Renderer, Streams, Task

ARMS = 5


class Bandit(Task):
    """Outcomes are pay-out probabilities and noise is uniform, so that exact beliefs are Eq. (8) and (9)."""

    name = "bandit"
    latents = (Latent("best_arm", "", 0, ARMS - 1, "categorical"),)
    horizon = 100
    episodes = 1
    action_space = spaces.Discrete(ARMS)
    observation = {"payout": (0.0, 1.0)}

    def init_state(self, rng: Streams) -> Array:
        return np.zeros((rng.groups, 1))

    def sample_noise(self, rng: Streams) -> Array:
        return rng.random((rng.groups, self.horizon, 1))

    def outcome(self, state: Array, action: Array, theta: Array) -> Array:
        """Pay-out probability P(s' = 1 | a, theta) [N, 1]: 3/4 for the best arm, 1/4 for the others."""
        return np.where(action == theta, 0.75, 0.25)

    def apply_noise(self, outcome: Array, noise: Array) -> Array:
        return (noise < outcome).astype(float)

    def log_prob(self, next_state: Array, outcome: Array) -> Array:
        return np.log(np.where(next_state == 1, outcome, 1 - outcome))[..., 0]

    def observe(self, state: Array) -> Array:
        return state

    def reward(self, state: Array, action: Array, next_state: Array, theta: Array) -> Array:
        return (action == theta)[:, 0].astype(float)

    def expert_probs(self, obs: Array, theta: Array) -> Array:
        """Expert policy pi_exp(a | s, theta): 6/10 for the best arm, 1/10 for each of the others."""
        return np.where(np.arange(ARMS) == theta, 0.6, 0.1)

    def renderer(self, theta: Array) -> Renderer:
        """A picture of the arms: the best has a green base, the pulled arm is filled, in yellow if it paid."""

        def draw(state: Array, action: Array) -> NDArray[np.uint8]:
            picture = np.full((240, 320, 3), 255, np.uint8)
            for arm in range(ARMS):
                columns = slice(60 * arm + 22, 60 * arm + 58)
                picture[60:150, columns] = 225
                picture[165:180, columns] = (40, 160, 70) if arm == theta[0] else 200
                if arm == action[0]:
                    picture[60:150, columns] = (250, 190, 40) if state[0] == 1 else (110, 110, 110)
            return picture

        return draw
