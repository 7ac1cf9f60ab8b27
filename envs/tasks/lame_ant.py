"""An ant, lame in a hidden leg or several, has to keep up with a mark that moves along a road at a set pace.

Tier 2. A hip turns by its command times its motor's strength. Legs of unequal strength turn the ant aside, weak ones
let it fall behind: commands have to be larger or smaller in advance, as the expert's steering by heading and distance
is soft. Process noise shakes the joints, and hides in every step how far a hip follows. A clone takes its own commands,
large ones for a weak leg, for signs of the strengths.

Latents: strength_1 to strength_4, of the hips' motors of front left, rear left, rear right and front right leg, in
units of the nominal one, log-uniform: a motor's torque is 150 (strength u - q) - 20 q' N m, u its command and q the
angle, rad. Noise a step: std .01 m, .015 rad, .15 m/s and .4 rad/s on each axis of the torso, .06 rad and 1 rad/s of
hips, .01 rad and .5 rad/s of ankles.

Action: commands to hips, rad, and to ankles, in units of .35 rad, lower if positive. The expert trots, two legs across
at a time: its cycle of ten steps is observed as a phase, which depends on time alone. An episode is 120 steps of .06 s,
and ends 1.5 m off the mark, or with the ant on its back. Reward: .7 exp(-(d / .25)^2 / 2) + .3 exp(-d / .5), d m from
the mark.
"""

import mujoco
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from deconfounded.envs import render
from deconfounded.envs.physics import Edit
from deconfounded.envs.task import Array, Latent, Mask, Renderer
from deconfounded.envs.tasks.ant import BODY, LEGS, Ant
from deconfounded.envs.tasks.windy_drone import upward

PACE, LOST = 0.5, 1.5  # m/s, m
CYCLE = 10  # steps of a trot
STRIDE, LEAD, DOWN = 0.34, 0.9, 0.15  # rad of hips; rad of the cycle, by which commands precede legs; sin
KEEP_UP, STEER, RETURN = 0.6, 0.6, 0.8  # of the expert: 1/m, 1/rad, rad/m
SIDE = np.array((-1, 1, 1, -1))  # of legs in the order of actions, fourth first: left is 1
DIAGONAL = np.array((np.pi, 0, np.pi, 0))  # rad of the cycle


class LameAnt(Ant):
    """The ant walks along x, beside it the mark, which is no body."""

    name = "lame_ant"
    latents = tuple(Latent(f"strength_{i}", "", 0.4, 2.4, "loguniform") for i in range(1, 5))
    horizon = 120
    expert_noise = 0.02
    controls = np.array([0, 0.9, 0, 0.9, 0, -0.9, 0, -0.9]), np.array([1, 0.35, 1, 0.35, 1, -0.35, 1, -0.35])  # rad
    process_noise = {
        "root": (0.01, 0.015, 0.15, 0.4),
        **{leg: (0.06, 1.0) if "hip" in leg else (0.01, 0.5) for leg in LEGS},
    }
    action_space = spaces.Box(-1.0, 1.0, (8,), np.float32)
    observation = {
        **{"phase_sin": (-1, 1), "phase_cos": (-1, 1), "ahead": (-20, 20), "aside": (-20, 20)},
        **{name: bounds for name, bounds in BODY.items() if name not in "xy"},
    }

    def spec(self) -> mujoco.MjSpec:
        """The ant, with a camera that goes along."""
        spec = super().spec()
        spec.delete(spec.camera("view"))
        camera = spec.camera("track")
        camera.name, camera.pos, camera.alt.xyaxes = "view", [0, -3.6, 2.6], [1, 0, 0, 0, 0.6, 0.8]
        return spec

    def apply_latent(self, edit: Edit, theta: Array) -> None:
        for i, strength in enumerate(theta):
            edit.actuator_gain(f"hip_{i + 1}", float(strength))

    def _off(self, state: Array) -> Array:
        """The way [..., 2] from the mark to the ant, m."""
        return self.qpos(state, "root")[..., :2] - np.stack([PACE * state[..., 0], 0 * state[..., 0]], -1)

    def observe(self, state: Array) -> Array:
        phase = 2 * np.pi * state[..., :1] / (CYCLE * self.control_dt)
        return np.concatenate([np.sin(phase), np.cos(phase), self._off(state), super().observe(state)[..., 2:]], -1)

    def expert_mean(self, obs: Array, theta: Array) -> Array:
        """A trot whose strides allow for the legs' strengths, longer if the ant is late, shorter on the inner side."""
        sin, cos, ahead, aside, _, w, x, y, z = obs[:, :9].astype(float).T
        heading = np.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))
        turn = STEER * (heading + RETURN * aside)
        stride = STRIDE * (1 - KEEP_UP * ahead[:, None] + SIDE * turn[:, None]).clip(-0.2, 1.6)
        phase = np.arctan2(sin, cos)[:, None] + DIAGONAL
        hips = -SIDE * stride * np.cos(phase + LEAD) / np.roll(theta, 1, -1)
        ankles = np.where(np.sin(phase) > DOWN, 0, -1)
        return np.stack([hips, ankles], -1).reshape(len(obs), -1)

    def reward(self, state: Array, action: Array, next_state: Array, theta: Array) -> Array:
        off = np.linalg.norm(self._off(next_state), axis=-1)
        return 0.7 * np.exp(-0.5 * (off / 0.25) ** 2) + 0.3 * np.exp(-off / 0.5)

    def terminated(self, state: Array) -> Mask:
        return (np.linalg.norm(self._off(state), axis=-1) > LOST) | (upward(self.qpos(state, "root")[..., 3:]) < 0)

    def renderer(self, theta: Array) -> Renderer:
        """A picture in which a red disc is the mark."""
        spec = self.spec()
        self.decorate(spec)
        render.chequer(spec, "MatPlane")
        disc, place = mujoco.mjtGeom.mjGEOM_CYLINDER, [0, 0, 0.002]
        spec.worldbody.add_site(name="mark", type=disc, size=[0.3, 0.002, 0], pos=place, rgba=[0.9, 0.3, 0.2, 1])
        model = self.edited(spec.compile(), theta)
        mark, draw_model = model.site("mark"), render.MujocoRenderer(model)

        def draw(state: Array, action: Array) -> NDArray[np.uint8]:
            mark.pos[0] = PACE * state[0]
            return draw_model(state, action)

        return draw
