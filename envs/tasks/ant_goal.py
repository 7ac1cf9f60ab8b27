"""The paper's AntGoal: an ant has to walk to a hidden goal, of which it has very noisy bearings alone.

Tier 2. theta acts through the reward and the bearings alone. The expert, which sees theta, walks straight to the goal:
its first steps already reveal theta. A clone that takes its own actions for evidence keeps the direction in which it
happened to start, and stays at the wrong place. Only the bearings are true evidence, a little in each step.

Latents: goal_x and goal_y, m, uniform, from where the ant starts. Noise a step: std .05 m/s and .15 rad/s of the torso,
.5 rad/s of the joints, none of positions. Bearings, new each step: the distance of the goal, m, and its direction as a
unit vector, each number with normal noise of std 1.6; at the start all are 0.

The MJCF is Gymnasium's own, from the installed package, with a cheaper integrator and position actuators: an action is
the joints' target angles, by which PPO learns to walk much sooner than by torques. Reward: .6 / (1 + (d / .5)^4) + .4
exp(-d^2 / 2), d m from the goal, less .05 times the mean square of the action. An episode is 6 s; nothing ends it.

The authors' version (Vuorio et al., TMLR 2024) has torques, goals in a disc of 10 m, trials of a single episode of 200
steps, and the reward -|dx| - |dy| less a small cost of contacts, with the same optimum; distance and heading, an angle,
have noise of std .1. With goals as near as here, so little noise would reveal theta at once: with std .7, a clone
without memory scored .91.
"""

import mujoco
import numpy as np
from gymnasium import spaces

from deconfounded.envs import render
from deconfounded.envs.physics import Edit, MujocoTask
from deconfounded.envs.task import Array, Latent, Renderer, Streams
from deconfounded.envs.tasks import gymnasium_body

FAR = 1.0  # of goals, m
STIFF, DAMPED = 150.0, 20.0  # of joints, N m/rad and N m s/rad
BLUR = 1.6  # of bearings
ANKLES = (1, -1, -1, 1)  # bent by, standing, rad
LEGS = {f"{part}_{i + 1}": angle for i, bent in enumerate(ANKLES) for part, angle in (("hip", 0), ("ankle", bent))}
ROOT = {"x": (-20, 20), "y": (-20, 20), "z": (-2, 5), **{f"rotation_{axis}": (-1, 1) for axis in "wxyz"}}
MOVES = {**{f"{axis}_velocity": (-20, 20) for axis in "xyz"}, **{f"{axis}_turn": (-50, 50) for axis in "xyz"}}


class AntGoal(MujocoTask):
    """Joints root (free), and hip and ankle of each of four legs."""

    name = "ant_goal"
    latents = (Latent("goal_x", "m", -FAR, FAR), Latent("goal_y", "m", -FAR, FAR))
    horizon = 100
    substeps = 4
    readings = 3
    moves_state = False
    expert_noise = 0.05
    controls = np.array([0, 0.9, 0, 0.9, 0, -0.9, 0, -0.9]), np.array([0.5, 0.35] * 4)  # rad; fourth leg first
    process_noise = {"root": (0, 0, 0.05, 0.15), **{joint: (0, 0.5) for joint in LEGS}}
    action_space = spaces.Box(-1.0, 1.0, (8,), np.float32)
    observation = {
        **{**ROOT, **{joint: (-3, 3) for joint in LEGS}, **MOVES},
        **{f"{joint}_velocity": (-60, 60) for joint in LEGS},
        **{"goal_distance": (-15, 30), "goal_cos": (-15, 15), "goal_sin": (-15, 15)},
    }

    def spec(self) -> mujoco.MjSpec:
        """Gymnasium's ant with position actuators."""
        spec = gymnasium_body.load("ant", 0.015)
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        for actuator in spec.actuators:
            actuator.set_to_position(kp=STIFF, kv=DAMPED)
            actuator.gear[0], actuator.ctrllimited = 1, False
        spec.worldbody.add_camera(name="view", pos=[0, -3, 3], quat=[0.9239, 0.3827, 0, 0])
        return spec

    def apply_latent(self, edit: Edit, theta: Array) -> None:
        """No change: theta affects no state."""

    def init_state(self, rng: Streams) -> Array:
        x, y, *bend = rng.uniform(np.full(2 + len(LEGS), -0.05), 0.05)
        place = np.stack([x, y, np.full(len(x), 0.55), np.ones(len(x)), *np.zeros((3, len(x)))], -1)
        legs = {joint: (angle + bent, 0) for (joint, angle), bent in zip(LEGS.items(), bend, strict=True)}
        return self.state(root=(place, 0), **legs)

    def _bearings(self, state: Array, theta: Array) -> Array:
        """Distance of the goal, m, and cosine and sine of its direction [..., 3]."""
        away = theta - self.qpos(state, "root")[..., :2]
        distance = np.linalg.norm(away, axis=-1, keepdims=True)
        return np.concatenate([distance, away / np.maximum(distance, 1e-9)], -1)

    def sense(self, state: Array, theta: Array, noise: Array) -> Array:
        state[..., -3:] = self._bearings(state, theta) + BLUR * noise[..., -3:]
        return state

    def log_sense(self, state: Array, theta: Array) -> Array:
        off = (state[..., -3:] - self._bearings(state, theta)) / BLUR
        return -0.5 * np.square(off).sum(-1) - 3 * np.log(BLUR * np.sqrt(2 * np.pi))

    def observe(self, state: Array) -> Array:
        angles, rates = ([read(state, joint) for joint in LEGS] for read in (self.qpos, self.qvel))
        root = (self.qpos(state, "root"), np.stack(angles, -1), self.qvel(state, "root"), np.stack(rates, -1))
        return np.concatenate([*root, state[..., -3:]], -1)

    def reward(self, state: Array, action: Array, next_state: Array, theta: Array) -> Array:
        distance = self._bearings(next_state, theta)[..., 0]
        there, near = 1 / (1 + (distance / 0.5) ** 4), np.exp(-0.5 * distance**2)
        return 0.6 * there + 0.4 * near - 0.05 * np.square(action).mean(-1)

    def renderer(self, theta: Array) -> Renderer:
        """A picture in which a red disc marks the goal."""
        spec = self.spec()
        self.decorate(spec)
        render.chequer(spec, "MatPlane")
        disc, place = mujoco.mjtGeom.mjGEOM_CYLINDER, [*theta, 0.002]
        spec.worldbody.add_site(name="goal", type=disc, size=[0.3, 0.002, 0], pos=place, rgba=[0.9, 0.3, 0.2, 1])
        return render.MujocoRenderer(spec.compile())
