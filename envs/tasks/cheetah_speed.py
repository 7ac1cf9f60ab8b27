"""The paper's HalfCheetah: a planar cheetah has to run at a hidden speed; a lamp says "too fast" or not, often wrongly.

Tier 2. theta acts through the reward and the lamp alone. The expert, which sees theta, reaches that speed within a
second and holds it: from then on its own speed reveals theta. A clone that takes its own speed for evidence keeps the
speed that it happened to reach. Only the lamp is true evidence: it says whether the present speed is above theta or
below, and is wrong a fifth of the time.

Latent: speed, m/s, uniform. Noise a step: std .1 m/s and .2 rad/s of the torso, 1 rad/s of the joints, none of
positions; the lamp is wrong with probability .2, each step anew. It reads 1 (too fast) or -1, and 0 at the start.

The MJCF is Gymnasium's own, from the installed package. Action: torques, in units of the MJCF's. Reward: .8 exp(-(d /
.6)^2 / 2) + .2 exp(-d), d = |v - theta|, v the torso's speed, m/s, less .1 times the mean square of the action. An
episode is 5 s, and nothing ends it.

The authors' version (Vuorio et al., TMLR 2024) has another engine, trials of a single episode of 1,000 steps, and the
reward -|v - theta| - .05 |a|^2, with the same optimum; its indicator starts at -1 and has the opposite sign.
"""

from statistics import NormalDist

import mujoco
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from deconfounded.envs import render
from deconfounded.envs.physics import Edit, MujocoTask
from deconfounded.envs.task import Array, Latent, Renderer, Streams
from deconfounded.envs.tasks import gymnasium_body

WRONG = 0.2  # probability
MASS = 14.0  # of the cheetah, kg
JOINTS = ("bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot")
ROOT = ("rootz", "rooty")


class CheetahSpeed(MujocoTask):
    """Joints rootx, rootz and rooty of the torso, and thigh, shin and foot of the back and the front leg."""

    name = "cheetah_speed"
    latents = (Latent("speed", "m/s", 0.0, 3.0),)
    horizon = 100
    substeps = 4
    readings = 1
    moves_state = False
    expert_noise = 0.05
    process_noise = {
        **{"rootx": (0, 0.1), "rootz": (0, 0.1), "rooty": (0, 0.2)},
        **{joint: (0, 1.0) for joint in JOINTS},
    }
    action_space = spaces.Box(-1.0, 1.0, (6,), np.float32)
    observation = {
        **{"height": (-2, 4), "pitch": (-20, 20), **{joint: (-4, 4) for joint in JOINTS}},
        **{"velocity": (-20, 20), **{f"{joint}_velocity": (-80, 80) for joint in (*ROOT, *JOINTS)}},
        "lamp": (-1, 1),
    }

    def spec(self) -> mujoco.MjSpec:
        """Gymnasium's half cheetah, scaled to its mass here, since MuJoCo will drop the MJCF's `settotalmass`."""
        spec = gymnasium_body.load("half_cheetah", 0.0125)
        spec.compiler.settotalmass = -1
        mass = spec.compile().body_mass.sum()
        for geom in spec.geoms:
            geom.density *= MASS / mass
        spec.camera("track").name = "view"
        return spec

    def apply_latent(self, edit: Edit, theta: Array) -> None:
        """No change: theta affects no state."""

    def init_state(self, rng: Streams) -> Array:
        z, pitch, *bend = rng.uniform(np.full(2 + len(JOINTS), -0.05), 0.05)
        legs = {joint: (bent, 0) for joint, bent in zip(JOINTS, bend, strict=True)}
        return self.state(rootz=(z, 0), rooty=(pitch, 0), **legs)

    def _off(self, state: Array, theta: Array) -> Array:
        return self.qvel(state, "rootx") - theta[..., 0]

    def sense(self, state: Array, theta: Array, noise: Array) -> Array:
        right = np.where(noise[..., -1] < NormalDist().inv_cdf(WRONG), -1, 1)
        state[..., -1] = right * np.where(self._off(state, theta) > 0, 1, -1)
        return state

    def log_sense(self, state: Array, theta: Array) -> Array:
        right = (state[..., -1] > 0) == (self._off(state, theta) > 0)
        return np.log(np.where(right, 1 - WRONG, WRONG))

    def observe(self, state: Array) -> Array:
        places = (self.qpos(state, joint) for joint in (*ROOT, *JOINTS))
        velocities = (self.qvel(state, joint) for joint in ("rootx", *ROOT, *JOINTS))
        return np.stack([*places, *velocities, state[..., -1]], -1)

    def reward(self, state: Array, action: Array, next_state: Array, theta: Array) -> Array:
        off = np.abs(self._off(next_state, theta))
        return 0.8 * np.exp(-0.5 * (off / 0.6) ** 2) + 0.2 * np.exp(-off) - 0.1 * np.square(action).mean(-1)

    def renderer(self, theta: Array) -> Renderer:
        """A picture with a post that moves at the hidden speed; it is the lamp: red for too fast, blue for too slow."""
        spec = self.spec()
        self.decorate(spec)
        render.chequer(spec, "MatPlane")
        post, colours = mujoco.mjtGeom.mjGEOM_CYLINDER, {1: (0.9, 0.3, 0.2), -1: (0.2, 0.4, 0.9), 0: (0.6, 0.6, 0.6)}
        spec.worldbody.add_site(name="lamp", type=post, size=[0.04, 0.5, 0], pos=[0, 1, 0.5])
        model = spec.compile()
        lamp, draw_model = model.site("lamp"), render.MujocoRenderer(model)

        def draw(state: Array, action: Array) -> NDArray[np.uint8]:
            lamp.pos[0], lamp.rgba[:3] = theta[0] * state[0], colours[int(state[-1])]
            return draw_model(state, action)

        return draw
