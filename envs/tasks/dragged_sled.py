"""A hand drags a sled by an elastic cord, and the sled has to follow a target; its runners' friction is hidden.

Tier 2. Sliding friction is the same at any speed, and stretches the cord by friction / 10 m, .3 m to 1.8 m: an agent
that expects less friction lags behind, one that expects more overtakes the target. The hand acts on the sled only
through the cord, on which the sled bounces, so that feedback is slow and the stretch must be known in advance. A
control step shows the friction only through process noise. The cord's damping, .2 N s/m, acts on a slack cord, too.

Latent: friction of the runners, N, log-uniform: Coulomb's, of a tendon along the ground. Noise a step: std .004 m and
.4 m/s of the sled, .004 m and .05 m/s of the hand; none of the target, which theta does not touch.

Action: the hand's speed, in units of 3 m/s around 2 m/s. Reward: .8 exp(-12.5 d^2) + .2 exp(-d), d m off the target,
which goes at 1.5 to 2.5 m/s. An episode is 5 s, and ends with the sled 1.2 m off the target.
"""

import mujoco
import numpy as np

from deconfounded.envs import render
from deconfounded.envs.physics import Edit, MujocoTask
from deconfounded.envs.task import Array, Latent, Mask, Streams

LOST = 1.2  # m
STRETCH = 0.9  # of the cord at the start, whatever the friction, m


class DraggedSled(MujocoTask):
    """Joints `hand`, `sled` and `target`, all along x (m); all at 0, the cord is just taut."""

    name = "dragged_sled"
    latents = (Latent("friction", "N", 3.0, 18.0, "loguniform"),)
    horizon = 125
    expert_noise = 0.02
    controls = (2.0, 3.0)  # of the hand, m/s
    process_noise = {"sled": (0.004, 0.4), "hand": (0.004, 0.05), "target": (0, 0)}
    observation = {
        **{"off_target": (-4, 4), "stretch": (-6, 6)},
        **{"sled_velocity": (-15, 20), "hand_velocity": (-15, 20), "target_velocity": (0, 4)},
    }

    def decorate(self, spec: mujoco.MjSpec) -> None:
        """Add a chequered ground."""
        super().decorate(spec)
        render.chequer(spec, "ground")

    def apply_latent(self, edit: Edit, theta: Array) -> None:
        edit.tendon_friction("runners", float(theta[0]))

    def init_state(self, rng: Streams) -> Array:
        pace, off, stretch = rng.uniform((1.5, -0.1, -0.1), (2.5, 0.1, 0.1))
        places = {"target": np.zeros_like(off), "sled": off, "hand": off + STRETCH + stretch}
        return self.state(**{joint: (place, pace) for joint, place in places.items()})

    def observe(self, state: Array) -> Array:
        hand, sled, target = (self.qpos(state, joint) for joint in ("hand", "sled", "target"))
        velocities = (self.qvel(state, joint) for joint in ("sled", "hand", "target"))
        return np.stack([sled - target, hand - sled, *velocities], -1)

    def _off(self, state: Array) -> Array:
        return np.abs(self.qpos(state, "sled") - self.qpos(state, "target"))

    def reward(self, state: Array, action: Array, next_state: Array, theta: Array) -> Array:
        off = self._off(next_state)
        return 0.8 * np.exp(-0.5 * (off / 0.2) ** 2) + 0.2 * np.exp(-off)

    def terminated(self, state: Array) -> Mask:
        return self._off(state) > LOST
