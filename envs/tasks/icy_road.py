"""A car on a winding road of hidden grip, from dry to icy: the paper's motivating example.

Tier 2. An expert takes the bends fast on a dry road, and slowly on ice. An agent that expects too much grip slides off
the road, which ends the episode; one that expects too little is slow. Engine and brakes are weak, so that a speed
cannot be corrected in a bend. Wheels also roll a little more freely on ice: that shows everywhere, slowly, through
process noise; without it a careful driver would never learn the grip.

Latent: grip, the friction coefficient of tyre on road, log-uniform: the road's, which has priority over the wheels'.
The wheels' rolling drag rises with it. Planar chassis (x, y, z, yaw) on four driven sphere wheels, the front ones
steered. Friction is soft (impratio .01), as a tyre's is: force grows with slip, up to grip times load. Every coordinate
has noise but the wheels' angles, which affect nothing. The chassis is damped vertically: its bounce would reveal the
grip at once.

Action: steering, in units of .5 rad; torque on each wheel, in units of .03 N m. Reward: speed along the road above .6
m/s, in units of 4 m/s, from 0 to 1. An episode is 10 s, and ends .35 m off the centreline, off the road.
"""

from typing import ClassVar

import mujoco
import numpy as np
from gymnasium import spaces

from deconfounded.envs import render
from deconfounded.envs.physics import Edit, MujocoTask
from deconfounded.envs.task import Array, Latent, Mask, Streams

AMPLITUDE, WAVE, HALF_WIDTH = 1.0, 8.0, 0.35  # m; the centreline is y = AMPLITUDE sin(2 pi x / WAVE)
STEERING, TORQUE = 0.5, 0.03  # rad; N m
CRAWL = 0.6  # m/s; driving more slowly does not pay
RADIUS = 0.05  # of a wheel, m
DRAG = 5e-4  # N m s of a wheel, times grip
AHEAD = (0.3, 0.8, 1.4)  # m, where the road's curvature is seen
WHEELS = ("front_left", "front_right", "rear_left", "rear_right")


def road(x: Array) -> tuple[Array, Array, Array]:
    """Centreline at x, m: y (m), direction (rad), and curvature (1/m, positive to the left)."""
    k = 2 * np.pi / WAVE
    slope = AMPLITUDE * k * np.cos(k * x)
    y = AMPLITUDE * np.sin(k * x)
    return y, np.arctan(slope), -(k**2) * y / (1 + slope**2) ** 1.5


class IcyRoad(MujocoTask):
    """Joints x, y, z, yaw of the chassis, two that steer, and one for each wheel."""

    name = "icy_road"
    latents: ClassVar[tuple[Latent, ...]] = (Latent("grip", "", 0.1, 0.6, "loguniform"),)
    horizon = 200
    substeps = 5
    expert_noise = 0.02
    stretch = WAVE  # m, of the road, on which episodes start
    process_noise = {
        **{"x": (0.003, 0.045), "y": (0.003, 0.045), "z": (4e-4, 0.05), "yaw": (0.006, 0.12)},
        **{joint: (0.002, 0.05) for joint in ("steer_left", "steer_right")},
        **{wheel: (0, 8) for wheel in WHEELS},
    }
    action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
    observation = {
        **{"lane_offset": (-2, 2), "heading_error": (-4, 4), "forward": (-10, 10), "sideways": (-10, 10)},
        **{"yaw_rate": (-20, 20), "front_slip": (-5, 5), "rear_slip": (-5, 5)},
        **{f"curvature_{i}": (-2, 2) for i in range(len(AHEAD))},
        "steering": (-0.6, 0.6),
    }

    def decorate(self, spec: mujoco.MjSpec) -> None:
        """Add the road under the car: a ribbon with white edges."""
        super().decorate(spec)
        x = np.linspace(-4, 70, 297)
        y, direction, _ = road(x)
        middle, across = np.stack([x, y], -1), np.stack([-np.sin(direction), np.cos(direction)], -1)
        ribbons = ("lane", 1, -1, 0.38), ("left_edge", 1.1, 1, 1.0), ("right_edge", -1, -1.1, 1.0)
        for name, left, right, grey in ribbons:
            render.ribbon(spec, name, middle + HALF_WIDTH * left * across, middle + HALF_WIDTH * right * across, grey)

    def apply_latent(self, edit: Edit, theta: Array) -> None:
        edit.geom_friction("road", float(theta[0]))
        for wheel in WHEELS:
            edit.joint_damping(wheel, DRAG * float(theta[0]))

    def control(self, action: Array) -> Array:
        return np.concatenate([STEERING * action[..., [0, 0]], TORQUE * action[..., [1, 1, 1, 1]]], -1)

    def init_state(self, rng: Streams) -> Array:
        x, offset, turn, speed = rng.uniform((0, -0.1, -0.1, 0.7), (self.stretch, 0.1, 0.1, 1.0))
        y, direction, _ = road(x)
        yaw = turn + direction
        rolling = {wheel: (0.0, speed / RADIUS) for wheel in WHEELS}
        return self.state(x=(x, speed * np.cos(yaw)), y=(y + offset, speed * np.sin(yaw)), yaw=(yaw, 0), **rolling)

    def _lane(self, state: Array) -> tuple[Array, Array]:
        """Offset to the left of the centreline (m), and the road's direction there (rad)."""
        y, direction, _ = road(self.qpos(state, "x"))
        return (self.qpos(state, "y") - y) * np.cos(direction), direction

    def observe(self, state: Array) -> Array:
        """Readings in the car's frame; slip is the speed of an axle's wheels above that of the chassis, m/s."""
        offset, direction = self._lane(state)
        yaw, x_velocity, y_velocity = self.qpos(state, "yaw"), self.qvel(state, "x"), self.qvel(state, "y")
        forward = x_velocity * np.cos(yaw) + y_velocity * np.sin(yaw)
        sideways = y_velocity * np.cos(yaw) - x_velocity * np.sin(yaw)
        spin = [self.qvel(state, wheel) for wheel in WHEELS]
        slips = (RADIUS * (spin[i] + spin[i + 1]) / 2 - forward for i in (0, 2))
        steering = (self.qpos(state, "steer_left") + self.qpos(state, "steer_right")) / 2
        error = (yaw - direction + np.pi) % (2 * np.pi) - np.pi
        ahead = (road(self.qpos(state, "x") + d * np.cos(direction))[2] for d in AHEAD)
        return np.stack([offset, error, forward, sideways, self.qvel(state, "yaw"), *slips, *ahead, steering], -1)

    def reward(self, state: Array, action: Array, next_state: Array, theta: Array) -> Array:
        _, direction = self._lane(state)
        x, y = (self.qpos(next_state, joint) - self.qpos(state, joint) for joint in ("x", "y"))
        speed = (x * np.cos(direction) + y * np.sin(direction)) / self.control_dt
        return np.clip((speed - CRAWL) / 4, 0, 1)

    def terminated(self, state: Array) -> Mask:
        return np.abs(self._lane(state)[0]) > HALF_WIDTH
