"""A curling stone is pushed and let go, and has to come to rest in the house, on ice of hidden friction.

Tier 2. The speed at the hog line decides the throw: beyond it no push acts, and an agent that expects the wrong
friction lands short or long. The stone's deceleration shows the friction, through process noise that also moves the
stone: a throw determines it to about 10%. A trial is five throws.

Latent: friction, the coefficient of stone on ice, log-uniform, set as the Coulomb friction of a tendon along the sheet.
Noise a step: std .01 m and .04 m/s.

Action: how hard the arm pushes, from not at all (-1) to its full strength (1), which is 300 N at the start, 3 m before
the hog line, and falls to 0 there. Reward: exp(-(d / 1.7)^2 / 2) for a stone that comes to rest d m from the tee, 7 m
past the hog line, which ends the episode; 0 for one that is not there after 100 steps of .1 s. Every step costs up to
.001, by the square of the push.
"""

import numpy as np

from deconfounded.envs.physics import Edit, MujocoTask
from deconfounded.envs.task import Array, Latent, Mask, Streams

START, TEE = -3.0, 7.0  # m from the hog line
HOUSE = 1.7  # m
WEIGHT = 20 * 9.81  # of the stone, N
EFFORT = 0.001


class Curling(MujocoTask):
    """Joint `slide`, along the sheet (m from the hog line)."""

    name = "curling"
    latents = (Latent("friction", "", 0.025, 0.1, "loguniform"),)
    horizon = 100
    expert_noise = 0.02
    controls = (0.5, 0.5)
    process_noise = {"slide": (0.01, 0.04)}
    observation = {"x": (-10, 40), "velocity": (-4, 10)}

    def apply_latent(self, edit: Edit, theta: Array) -> None:
        edit.tendon_friction("ice", WEIGHT * float(theta[0]))

    def init_state(self, rng: Streams) -> Array:
        x, velocity = rng.uniform((START - 0.1, 0.0), (START + 0.1, 0.1))
        return self.state(slide=(x, velocity))

    def reward(self, state: Array, action: Array, next_state: Array, theta: Array) -> Array:
        off = self.qpos(next_state, "slide") - TEE
        landed = np.exp(-0.5 * (off / HOUSE) ** 2) * self.terminated(next_state)
        return landed - EFFORT * np.square(self.control(action)[:, 0])

    def terminated(self, state: Array) -> Mask:
        """Whether the stone is past the hog line and at rest."""
        return (self.qpos(state, "slide") > 0) & (self.qvel(state, "slide") <= 0)
