"""A cartpole whose pole rides on a spinning axle; hidden Coulomb friction in the bearing drags the pole round.

Tier 2. A motor in the cart spins the axle at 10 rad/s. A slippery bearing leaves the pole alone; a sticky one drags it
with a torque of theta N m, and the pole must lean against the drag (its m g l is .49 N m). An agent that expects the
wrong friction loses the mark or the pole. A control step shows the friction only through process noise.

Latent: friction, N m, uniform: the `frictionloss` of a fixed tendon over pole and axle joints (coefficients 1, -1). The
axle turns faster than the pole ever does, so that the drag keeps its sign. Its angle is not observed and affects
nothing, and has no noise. Velocities of the pole and of the axle have noise of .2 and .1 rad/s; noise otherwise and
reward are as in `Cartpole`.
"""

import numpy as np

from deconfounded.envs.physics import Edit
from deconfounded.envs.task import Array, Latent, Streams
from deconfounded.envs.tasks.cartpole import Cartpole

SPIN = 10.0  # rad/s


class SlipperyCartpole(Cartpole):
    """The third joint, `axle` (rad), turns at `SPIN`; its reaction force is taken by the cart's rail."""

    name = "slippery_cartpole"
    version = 1
    latents = (Latent("friction", "N m", 0.0, 0.3),)
    process_noise = {"slider": (0.004, 0.1), "hinge": (0.004, 0.2), "axle": (0, 0.1)}
    observation = {**Cartpole.observation, "slip": (-10, 10)}

    def apply_latent(self, edit: Edit, theta: Array) -> None:
        edit.tendon_friction("bearing", float(theta[0]))

    def control(self, action: Array) -> Array:
        return np.concatenate([action, np.full_like(action, SPIN)], -1)

    def init_state(self, rng: Streams) -> Array:
        start = super().init_state(rng)
        self.qvel(start, "axle")[...] = SPIN
        return start

    def observe(self, state: Array) -> Array:
        """The cartpole's observation, and the deviation of the axle's speed from its set point, rad/s."""
        return np.append(super().observe(state), self.qvel(state, "axle")[..., None] - SPIN, -1)
