"""A lander of hidden thrust descends through dust and has to stop at a mark that its radar detects late.

Tier 2. The lander must choose its speed before it detects the mark: an agent that expects a stronger thruster cannot
stop in time and crashes on the ground below the mark, which ends the episode; one that expects a weaker thruster creeps
down and is late. A control step shows the strength only through process noise.

Latent: strength, of the thruster, in units of its nominal 16 N, log-uniform. Noise a step: std .008 m and .2 m/s.

Action: throttle, from -1 for none to 1 for all; the lander weighs 9.81 N. Reward: at d m from the mark, .9 exp(-8 d^2)
+ .1 exp(-|d| / 3). An episode is 3.5 s, and ends .5 m below the mark.
"""

import numpy as np

from deconfounded.envs.physics import Edit, MujocoTask
from deconfounded.envs.task import Array, Latent, Mask, Streams

RADAR = 2.0  # m, as far as it reaches
GROUND = -0.5  # m


class WeakThruster(MujocoTask):
    """Joint `height` (m, 0 is the mark)."""

    name = "weak_thruster"
    latents = (Latent("strength", "", 0.8, 2.0, "loguniform"),)
    horizon = 70
    expert_noise = 0.02
    controls = (0.5, 0.5)
    process_noise = {"height": (0.008, 0.2)}
    observation = {"radar": (-2, RADAR + 0.1), "velocity": (-30, 30)}

    def apply_latent(self, edit: Edit, theta: Array) -> None:
        edit.actuator_gain("thruster", float(theta[0]))

    def init_state(self, rng: Streams) -> Array:
        height, speed = rng.uniform((8, 3), (11, 6))
        return self.state(height=(height, -speed))

    def observe(self, state: Array) -> Array:
        """Height up to the range of the radar, and velocity."""
        return np.stack([np.minimum(self.qpos(state, "height"), RADAR), self.qvel(state, "height")], -1)

    def reward(self, state: Array, action: Array, next_state: Array, theta: Array) -> Array:
        off = np.abs(self.qpos(next_state, "height"))
        return 0.9 * np.exp(-0.5 * (off / 0.25) ** 2) + 0.1 * np.exp(-off / 3)

    def terminated(self, state: Array) -> Mask:
        return self.qpos(state, "height") < GROUND
