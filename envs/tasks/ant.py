"""Gymnasium's ant on position actuators: the body that several tasks share."""

import mujoco
import numpy as np

from deconfounded.envs.physics import MujocoTask
from deconfounded.envs.task import Array, Streams
from deconfounded.envs.tasks import gymnasium_body

STIFF, DAMPED = 150.0, 20.0  # of joints, N m/rad and N m s/rad
ANKLES = (1, -1, -1, 1)  # bent by, standing, rad
LEGS = {f"{part}_{i + 1}": angle for i, bent in enumerate(ANKLES) for part, angle in (("hip", 0), ("ankle", bent))}
ROOT = {"x": (-20, 20), "y": (-20, 20), "z": (-2, 5), **{f"rotation_{axis}": (-1, 1) for axis in "wxyz"}}
MOVES = {**{f"{axis}_velocity": (-20, 20) for axis in "xyz"}, **{f"{axis}_turn": (-50, 50) for axis in "xyz"}}
BODY = {
    **{**ROOT, **{joint: (-3, 3) for joint in LEGS}, **MOVES},
    **{f"{joint}_velocity": (-60, 60) for joint in LEGS},
}


class Ant(MujocoTask):
    """Joints root (free), and hip and ankle of each of four legs. An action has the fourth leg first."""

    substeps = 4

    def spec(self) -> mujoco.MjSpec:
        """Gymnasium's ant with position actuators and a cheaper integrator."""
        spec = gymnasium_body.load("ant", 0.015)
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        for actuator in spec.actuators:
            actuator.set_to_position(kp=STIFF, kv=DAMPED)
            actuator.gear[0], actuator.ctrllimited = 1, False
        spec.worldbody.add_camera(name="view", pos=[0, -3, 3], quat=[0.9239, 0.3827, 0, 0])
        return spec

    def init_state(self, rng: Streams) -> Array:
        x, y, *bend = rng.uniform(np.full(2 + len(LEGS), -0.05), 0.05)
        place = np.stack([x, y, np.full(len(x), 0.55), np.ones(len(x)), *np.zeros((3, len(x)))], -1)
        legs = {joint: (angle + bent, 0) for (joint, angle), bent in zip(LEGS.items(), bend, strict=True)}
        return self.state(root=(place, 0), **legs)

    def observe(self, state: Array) -> Array:
        """Positions, then velocities, of root and legs, as `BODY` names them."""
        angles, rates = ([read(state, joint) for joint in LEGS] for read in (self.qpos, self.qvel))
        root = (self.qpos(state, "root"), np.stack(angles, -1), self.qvel(state, "root"), np.stack(rates, -1))
        return np.concatenate(root, -1)
