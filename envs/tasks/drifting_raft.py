"""A raft has to stay at a mark that crosses six streams, in each of which a hidden current flows.

Tier 2. The thrusters have to push against the current of the stream that the raft enters, and they take their time, so
that the push has to begin before the current shows: an agent that expects another current is carried off. Waves hide
it, too. What was found out in a stream has to be remembered until the mark comes back there, in this episode or a later
one.

Latents: current_0 to current_5, m/s along y, uniform and independent, of streams along y, each 2 m wide; after 12 m
along x they come again. The stream under the middle of the raft acts on it; the expert heeds the stream into which the
mark's speed takes the raft within the thrusters' lag. The raft weighs 1 kg, and water drags on it by 1 N for each m/s
between it and the current. Noise a step: std .02 m and .08 m/s along each axis; none of the mark, which theta does not
touch.

Action: thrust along x and y, in units of 4 N, which the thrusters approach with a lag (time constant) of .8 s. The
expert, in closed form, asks for what the mark's speed and the current need, and .5 N more for each m off the mark and
for each m/s of difference in speed. Reward: .8 exp(-(d / .3)^2 / 2) + .2 exp(-d), d m off the mark, which goes straight
on at .9 to 1.4 m/s, at most 45 degrees off the x axis. An episode is 12 s, and ends 1.5 m off the mark.

The place along x is observed as an angle, by cosines and sines of one, two and three times it: with these a clone that
sees theta tells the streams apart.
"""

import mujoco
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from deconfounded.envs import render
from deconfounded.envs.patches import PatchedTask
from deconfounded.envs.physics import Edit
from deconfounded.envs.task import Array, Latent, Mask, Streams

STREAMS, WIDTH = 6, 2.0  # m
HARMONICS = np.arange(1, 4)  # of the angle that a place along x is
THRUST, LAG = 4.0, 0.8  # N; s, as in the MJCF
STEERING = 0.5  # of the expert, N/m and N s/m
LOST = 1.5  # m


class DriftingRaft(PatchedTask):
    """Joints `x` and `y` of the raft, `mark_x` and `mark_y`, m; the state ends with the thrusters' present force, N."""

    name = "drifting_raft"
    latents = tuple(Latent(f"current_{i}", "m/s", -1.2, 1.2) for i in range(STREAMS))
    horizon = 150
    expert_noise = 0.02
    process_noise = {"x": (0.02, 0.08), "y": (0.02, 0.08), "mark_x": (0, 0), "mark_y": (0, 0)}
    action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
    observation = {
        **{"to_mark_x": (-3, 3), "to_mark_y": (-3, 3)},
        **{f"{body}_velocity_{axis}": (-8, 8) for body in ("raft", "mark") for axis in "xy"},
        **{f"thrust_{axis}": (-5, 5) for axis in "xy"},
        **{f"place_{part}_{i}": (-1, 1) for part in ("cos", "sin") for i in HARMONICS},
    }

    def decorate(self, spec: mujoco.MjSpec) -> None:
        """Add water, chequered in squares as wide as a stream."""
        super().decorate(spec)
        render.chequer(spec, "water")

    def apply_latent(self, edit: Edit, theta: Array) -> None:
        edit.actuator_bias("current", float(theta[0]))

    def control(self, action: Array) -> Array:
        return np.concatenate([THRUST * action, np.zeros_like(action[..., :1])], -1)

    def init_state(self, rng: Streams) -> Array:
        low, high = (0, -np.pi / 4, -1, 0.9, -0.1, -0.1), (STREAMS * WIDTH, np.pi / 4, 1, 1.4, 0.1, 0.1)
        x, course, side, speed, off_x, off_y = rng.uniform(low, high)
        along, across = np.sign(side) * speed * np.cos(course), speed * np.sin(course)
        state = self.state(x=(x + off_x, along), y=(off_y, across), mark_x=(x, along), mark_y=(0, across))
        state[:, -2:] = np.stack([along, across], -1)
        return state

    def _to_mark(self, state: Array) -> Array:
        return np.stack([self.qpos(state, f"mark_{axis}") - self.qpos(state, axis) for axis in "xy"], -1)

    def observe(self, state: Array) -> Array:
        velocities = np.stack([self.qvel(state, joint) for joint in self.process_noise], -1)
        angles = 2 * np.pi / (STREAMS * WIDTH) * self.qpos(state, "x")[..., None] * HARMONICS
        return np.concatenate([self._to_mark(state), velocities, state[..., -2:], np.cos(angles), np.sin(angles)], -1)

    def patch(self, state: Array) -> NDArray[np.int64]:
        return self.patch_at(self.qpos(state, "x") / WIDTH)

    def heeded(self, obs: Array) -> NDArray[np.int64]:
        streams = np.arctan2(obs[:, 11], obs[:, 8]).astype(float) * STREAMS / (2 * np.pi)
        return self.patch_at(streams + LAG * obs[:, 4] / WIDTH)

    def expert_mean(self, obs: Array, theta: Array) -> Array:
        to_mark, velocity, pace = obs[:, :2], obs[:, 2:4], obs[:, 4:6]
        push = pace + STEERING * (to_mark + pace - velocity)
        push[:, 1] -= self.heeded_theta(obs, theta)
        return np.clip(push / THRUST, -1, 1)

    def _off(self, state: Array) -> Array:
        return np.linalg.norm(self._to_mark(state), axis=-1)

    def reward(self, state: Array, action: Array, next_state: Array, theta: Array) -> Array:
        off = self._off(next_state)
        return 0.8 * np.exp(-0.5 * (off / 0.3) ** 2) + 0.2 * np.exp(-off)

    def terminated(self, state: Array) -> Mask:
        return self._off(state) > LOST
