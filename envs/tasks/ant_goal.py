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
from deconfounded.envs.physics import Edit
from deconfounded.envs.task import Array, Latent, Renderer
from deconfounded.envs.tasks.ant import BODY, LEGS, Ant

FAR = 1.0  # of goals, m
BLUR = 1.6  # of bearings


class AntGoal(Ant):
    """The ant with bearings of its goal."""

    name = "ant_goal"
    latents = (Latent("goal_x", "m", -FAR, FAR), Latent("goal_y", "m", -FAR, FAR))
    horizon = 100
    readings = 3
    moves_state = False
    expert_noise = 0.05
    controls = np.array([0, 0.9, 0, 0.9, 0, -0.9, 0, -0.9]), np.array([0.5, 0.35] * 4)  # rad; fourth leg first
    process_noise = {"root": (0, 0, 0.05, 0.15), **{joint: (0, 0.5) for joint in LEGS}}
    action_space = spaces.Box(-1.0, 1.0, (8,), np.float32)
    observation = {**BODY, "goal_distance": (-15, 30), "goal_cos": (-15, 15), "goal_sin": (-15, 15)}

    def apply_latent(self, edit: Edit, theta: Array) -> None:
        """No change: theta affects no state."""

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
        return np.concatenate([super().observe(state), state[..., -3:]], -1)

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
