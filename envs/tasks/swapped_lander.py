"""A lander whose side engine may push the wrong way: only the expert knows its direction.

Tier 2. After the LunarLander of the published paper (Deconfounding Imitation Learning with Variational Inference, TMLR
2024), whose side engines are swapped with probability 1/2; read off its figure, the oracle and the deconfounded agent
returned about 235 there, the naive agent -20. The paper's lander is gym's, with discrete actions, dynamics without
noise and 500 steps. Here it is a planar body in MuJoCo with continuous thrust and process noise; an episode is 150
steps of .05 s, at the end of which it stands on the pad.

An agent with the wrong belief turns every correction into a push the wrong way, and tumbles. The side engine is weak: a
step shows its sign only through noise, a few seconds of steering reveal it. An agent that takes its own side thrust for
evidence never learns it.

Latent: swapped, 1 if the side engine pushes the other way. Noise a step: std .004 m and .05 m/s of the position, .008
rad and .16 rad/s of the pitch.

Action: main engine, from off (-1) to 5 N (1), about twice the weight on this moon; side engine at the top, 1 is .7 N to
the right. Reward: (1 + cos pitch) / 2 (.2 exp(-d / 2) + .8 exp(-(d / .5)^2 / 2)), d m from standing on the pad,
less .05 times the mean square of both thrusts, in units of the largest. An episode ends with a crash: tilted by more
than .8 rad, less than .1 m above the pad at more than 1 m/s, or 5 m off. The speed is that at the end of a step: a
foot that touches the ground before takes of it, so that a tilted lander may come down harder.
"""

import numpy as np
from gymnasium import spaces

from deconfounded.envs.physics import Edit, MujocoTask
from deconfounded.envs.task import Array, Latent, Mask, Streams

JOINTS = ("x", "z", "pitch")
MAIN = 5.0  # N
TILT, SPEED, LOW, FAR = 0.8, 1.0, 0.1, 5.0  # of a crash: rad, m/s, m, m


class SwappedLander(MujocoTask):
    """Joints `x` and `z` (m; at 0, the lander stands on the pad) and `pitch` (rad)."""

    name = "swapped_lander"
    latents = (Latent("swapped", "", 0, 1, "categorical"),)
    horizon = 150
    expert_noise = 0.02
    process_noise = {"x": (0.004, 0.05), "z": (0.004, 0.05), "pitch": (0.008, 0.16)}
    action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
    observation = {
        **{"x": (-8, 8), "z": (-2, 20), "pitch": (-4, 4)},
        **{"x_velocity": (-10, 10), "z_velocity": (-20, 20), "pitch_velocity": (-15, 15)},
    }

    def apply_latent(self, edit: Edit, theta: Array) -> None:
        edit.actuator_gain("side", 1 - 2 * float(theta[0]))

    def control(self, action: Array) -> Array:
        return np.stack([MAIN * (1 + action[..., 0]) / 2, action[..., 1]], -1)

    def init_state(self, rng: Streams) -> Array:
        spread = np.array((1.5, 0.5, 0.2, 0.3, 0.3, 0.2))
        x, z, pitch, *velocities = rng.uniform(-spread, spread)
        return self.state(**dict(zip(JOINTS, zip((x, 3.5 + z, pitch), velocities, strict=True), strict=True)))

    def reward(self, state: Array, action: Array, next_state: Array, theta: Array) -> Array:
        off = np.hypot(self.qpos(next_state, "x"), self.qpos(next_state, "z"))
        upright = (1 + np.cos(self.qpos(next_state, "pitch"))) / 2
        thrust = np.square(self.control(action) / (MAIN, 1)).mean(-1)
        return upright * (0.2 * np.exp(-off / 2) + 0.8 * np.exp(-0.5 * (off / 0.5) ** 2)) - 0.05 * thrust

    def terminated(self, state: Array) -> Mask:
        x, z, pitch = (self.qpos(state, joint) for joint in JOINTS)
        hard = (z < LOW) & (self.qvel(state, "z") < -SPEED)
        return hard | (np.abs(pitch) > TILT) | (np.hypot(x, z) > FAR)
