"""A quadrotor has to stay at a mark that it does not see, in hidden wind and with a load off its centre.

Tier 2. It observes its height, attitude and velocities, like a drone without satellite navigation: a slow drift of
position is not observed. It has to lean against the wind, and to compensate for a load that hangs ahead or behind, both
in advance: an agent that expects the wrong wind drifts off sideways, one that expects the wrong load lengthwise. A
control step shows either only through process noise.

Latents: wind along y, m/s, uniform, which drags on drone and load by the square of the relative air speed; load, m
along x from the middle at which .6 kg hang, uniform. Noise a step: std .003 m, .003 rad, .12 m/s and .16 rad/s on each
axis of the free joint.

Action: thrust, in units of 11 N around 12 N; torque to roll, to pitch and to yaw, in units of .22, .22 and .05 N m.
They are spread over four rotors of 0 to 6 N. Reward: .7 exp(-(d / .25)^2 / 2) + .3 exp(-d), d m off the mark. An
episode is 125 steps of .04 s, and ends 1.5 m off, or tilted by more than a right angle.
"""

from typing import ClassVar

import numpy as np
from gymnasium import spaces

from deconfounded.envs.physics import Edit, MujocoTask
from deconfounded.envs.task import Array, Latent, Mask, Streams

HEIGHT = 1.5  # of the mark, m
LOST = 1.5  # m
MIXING = np.array([[1, 1, -1, 1], [1, -1, -1, -1], [1, 1, 1, -1], [1, -1, 1, 1]])
# rotors: front left, front right, rear left, rear right; from thrust, roll (y rises), pitch (nose dips), yaw (left)
HOVER, SHARE = 3.0, np.array((2.75, 0.33, 0.33, 0.25))  # N, of each rotor


def upward(quaternion: Array) -> Array:
    """World coordinate z [...] of the z axis of a body with attitude [..., 4], a quaternion."""
    x, y = quaternion[..., 1], quaternion[..., 2]
    return 1 - 2 * (x * x + y * y)


def rotated(quaternion: Array) -> list[Array]:
    """World coordinates, six of [...], of the x and the z axis of a body with attitude [..., 4], a quaternion."""
    w, x, y, z = (quaternion[..., i] for i in range(4))
    forward = [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)]
    return [*forward, 2 * (x * z + w * y), 2 * (y * z - w * x), upward(quaternion)]


class WindyDrone(MujocoTask):
    """A free joint, `flight`; its position is measured from the ground, the observed height from the mark."""

    name = "windy_drone"
    latents: ClassVar[tuple[Latent, ...]] = (Latent("wind", "m/s", -16.0, 16.0), Latent("load", "m", -0.02, 0.02))
    horizon = 125
    expert_noise = 0.02
    process_noise = {"flight": (0.003, 0.003, 0.12, 0.16)}
    action_space = spaces.Box(-1.0, 1.0, (4,), np.float32)
    observation = {
        "height": (-4, 4),
        **{f"{part}_{axis}": (-1, 1) for part in ("forward", "up") for axis in "xyz"},
        **{f"velocity_{axis}": (-15, 15) for axis in "xyz"},
        **{f"turning_{axis}": (-30, 30) for axis in "xyz"},
    }

    def apply_latent(self, edit: Edit, theta: Array) -> None:
        edit.wind(0, float(theta[0]), 0)
        edit.body_shift("load", float(theta[1]))

    def control(self, action: Array) -> Array:
        return HOVER + (SHARE * action) @ MIXING.T

    def init_state(self, rng: Streams) -> Array:
        spread = np.repeat((0.05, 0.1, 0.1, 0.2), 3)
        drawn = rng.uniform(-spread, spread).T
        turn = np.concatenate([np.ones((len(drawn), 1)), drawn[:, 3:6] / 2], -1)
        place = drawn[:, :3] + (0, 0, HEIGHT)
        attitude = turn / np.linalg.norm(turn, axis=-1, keepdims=True)
        return self.state(flight=(np.concatenate([place, attitude], -1), drawn[:, 6:]))

    def observe(self, state: Array) -> Array:
        flight = self.qpos(state, "flight")
        velocities = self.qvel(state, "flight")
        axes = rotated(flight[..., 3:])
        return np.stack([flight[..., 2] - HEIGHT, *axes, *(velocities[..., i] for i in range(6))], -1)

    def _off(self, state: Array) -> Array:
        return np.linalg.norm(self.qpos(state, "flight")[..., :3] - (0, 0, HEIGHT), axis=-1)

    def reward(self, state: Array, action: Array, next_state: Array, theta: Array) -> Array:
        off = self._off(next_state)
        return 0.7 * np.exp(-0.5 * (off / 0.25) ** 2) + 0.3 * np.exp(-off)

    def terminated(self, state: Array) -> Mask:
        return (self._off(state) > LOST) | (upward(self.qpos(state, "flight")[..., 3:]) < 0)
