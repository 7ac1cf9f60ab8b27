"""A car in fog on a track of hidden grip has to come to a stop at a line that it sees only from near by.

Tier 2. The car must choose its speed before it sees the line: an agent that expects too much grip cannot stop in time
and runs into the wall behind the line, which ends the episode; one that expects too little creeps through the fog and
is late. At the least grip a car of 4 m/s needs 8.2 m, and the line is 5 to 8 m away: some starts are lost.

Latent: grip, the friction coefficient of tyre on track, log-uniform: times the weight, it is the `frictionloss` of a
tendon over car and wheel (N). Noise a step: std .004 m and .08 m/s of the car, .5 rad/s of the wheel, whose speed is a
servo's; none of the line, which theta does not touch, nor of the wheel's angle, which affects nothing.

Action: the speed of the wheel's rim, from 0 (at -1) to 6 m/s (at 1): there is no reverse. Reward: at d m from the line,
.9 exp(-8 d^2) + .1 exp(-|d| / 3). An episode is 5 s, and ends .5 m beyond the line.
"""

import numpy as np

from deconfounded.envs.physics import Edit, MujocoTask
from deconfounded.envs.task import Array, Latent, Mask, Streams

SPEED = 3.0  # m/s
RADIUS = 0.1  # of the wheel, m
WEIGHT = 9.81  # N
SIGHT = 2.0  # m
WALL = 0.5  # m beyond the line


class IcyStop(MujocoTask):
    """Joints `car` and `line` along x (m), `wheel` (rad)."""

    name = "icy_stop"
    latents = (Latent("grip", "", 0.1, 0.6, "loguniform"),)
    horizon = 100
    substeps = 5
    expert_noise = 0.02
    process_noise = {"car": (0.004, 0.08), "wheel": (0, 0.5), "line": (0, 0)}
    observation = {"speed": (-2, 10), "to_line": (-2, SIGHT + 0.1)}

    def apply_latent(self, edit: Edit, theta: Array) -> None:
        edit.tendon_friction("tyre", WEIGHT * float(theta[0]))

    def control(self, action: Array) -> Array:
        return SPEED * (1 + action) / RADIUS

    def init_state(self, rng: Streams) -> Array:
        speed, line = rng.uniform((2, 5), (4, 8))
        return self.state(car=(0, speed), wheel=(0, speed / RADIUS), line=(line, 0))

    def _to_line(self, state: Array) -> Array:
        return self.qpos(state, "line") - self.qpos(state, "car")

    def observe(self, state: Array) -> Array:
        """Speed, and the distance to the line, up to the range of sight."""
        return np.stack([self.qvel(state, "car"), np.minimum(self._to_line(state), SIGHT)], -1)

    def reward(self, state: Array, action: Array, next_state: Array, theta: Array) -> Array:
        off = np.abs(self._to_line(next_state))
        return 0.9 * np.exp(-0.5 * (off / 0.25) ** 2) + 0.1 * np.exp(-off / 3)

    def terminated(self, state: Array) -> Mask:
        return self._to_line(state) < -WALL
