"""Gymnasium's Reacher has to hold its fingertip at a mark, with hidden loads on joints whose motors it does not know.

Tier 2. Gusts shake the arm so much that its controller must be soft; a load that it does not know then bends the arm
away from the mark, and stays unknown for long, as gusts hide it in every step. A clone takes its own torques for signs
of the load. A motor's strength matters by what it has to hold and to accelerate.

Latents: load_0 and load_1, N m, uniform, constant torques on shoulder and elbow; strength_0 and strength_1, of their
motors in units of the nominal 200 N m, log-uniform. Noise a step: std .01 rad and 1 rad/s of each joint, none of the
mark, which theta does not touch.

The MJCF is Gymnasium's own, from the installed package, with a cheaper integrator; inertia and damping of a joint are 1
kg m^2 and 1 N m s. Action: both torques. Reward: .7 exp(-(d / .05)^2 / 2) + .3 exp(-d / .1), d m from the mark, which
is drawn anew in each episode, .06 to .19 m from the shoulder. An episode is 100 steps of .02 s; nothing ends it early.
"""

import mujoco
import numpy as np
from gymnasium import spaces

from deconfounded.envs.physics import Edit, MujocoTask
from deconfounded.envs.task import Array, Latent, Streams
from deconfounded.envs.tasks import gymnasium_body

TORQUE, LOAD = 200.0, 40.0  # N m
INNER, OUTER = 0.1, 0.11  # m, links
STIFFNESS, DAMPING = 50.0, 14.0  # of the expert's error dynamics: 1/s^2, 1/s
JOINTS = ("joint0", "joint1")


class LoadedArm(MujocoTask):
    """Joints joint0 (shoulder), joint1 (elbow), target_x and target_y (of the mark, from the shoulder)."""

    name = "loaded_arm"
    latents = (
        *(Latent(f"load_{i}", "N m", -LOAD, LOAD) for i in range(2)),
        *(Latent(f"strength_{i}", "", 0.4, 2.0, "loguniform") for i in range(2)),
    )
    horizon = 100
    expert_noise = 0.01
    process_noise = {**{joint: (0.01, 1.0) for joint in JOINTS}, "target_x": (0, 0), "target_y": (0, 0)}
    action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
    observation = {
        **{f"{part}_{joint}": (-1, 1) for part in ("cos", "sin") for joint in JOINTS},
        **{"target_x": (-0.3, 0.3), "target_y": (-0.3, 0.3)},
        **{f"velocity_{joint}": (-600, 600) for joint in JOINTS},
        **{"off_x": (-0.6, 0.6), "off_y": (-0.6, 0.6)},
    }

    def spec(self) -> mujoco.MjSpec:
        """Gymnasium's reacher, whose motors may pull by themselves."""
        spec = gymnasium_body.load("reacher", 0.01)
        spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO  # as `lean` drops geoms
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        for actuator in spec.actuators:
            actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        spec.worldbody.add_light(name="sun", pos=[0, 0, 2], dir=[0, 0, -1])
        spec.worldbody.add_camera(name="view", pos=[0, -0.35, 0.6], quat=[0.966, 0.259, 0, 0])
        return spec

    def apply_latent(self, edit: Edit, theta: Array) -> None:
        for joint, load, strength in zip(JOINTS, theta[:2], theta[2:], strict=True):
            edit.actuator_bias(joint, float(load) / TORQUE)
            edit.actuator_gain(joint, float(strength))

    def init_state(self, rng: Streams) -> Array:
        shoulder, elbow, bearing, distance = rng.uniform((-0.1, -0.1, -np.pi, 0.06), (0.1, 0.1, np.pi, 0.19))
        mark = {"target_x": (distance * np.cos(bearing), 0), "target_y": (distance * np.sin(bearing), 0)}
        return self.state(joint0=(shoulder, 0), joint1=(elbow, 0), **mark)

    def _off(self, state: Array) -> Array:
        """The way [..., 2] from the mark to the fingertip, m."""
        shoulder, hand = self.qpos(state, "joint0"), self.qpos(state, "joint0") + self.qpos(state, "joint1")
        x, y = INNER * np.cos(shoulder) + OUTER * np.cos(hand), INNER * np.sin(shoulder) + OUTER * np.sin(hand)
        return np.stack([x - self.qpos(state, "target_x"), y - self.qpos(state, "target_y")], -1)

    def observe(self, state: Array) -> Array:
        angles, speeds = (np.stack([read(state, joint) for joint in JOINTS], -1) for read in (self.qpos, self.qvel))
        mark = np.stack([self.qpos(state, joint) for joint in ("target_x", "target_y")], -1)
        return np.concatenate([np.cos(angles), np.sin(angles), mark, speeds, self._off(state)], -1)

    def expert_mean(self, obs: Array, theta: Array) -> Array:
        """Computed torque, to the joint angles at which the fingertip is at the mark."""
        angle, mark, speed = np.arctan2(obs[:, 2:4], obs[:, :2]), obs[:, 4:6].astype(float), obs[:, 6:8]
        cos = (np.square(mark).sum(-1) - INNER**2 - OUTER**2) / (2 * INNER * OUTER)
        elbow = np.arccos(cos.clip(-1, 1)).clip(max=2.9)
        bearing = np.arctan2(mark[:, 1], mark[:, 0])
        shoulder = bearing - np.arctan2(OUTER * np.sin(elbow), INNER + OUTER * np.cos(elbow))
        error = np.stack([shoulder, elbow], -1) - angle
        error[:, 0] = (error[:, 0] + np.pi) % (2 * np.pi) - np.pi
        return (STIFFNESS * error - DAMPING * speed + speed - theta[:, :2]) / (TORQUE * theta[:, 2:])

    def reward(self, state: Array, action: Array, next_state: Array, theta: Array) -> Array:
        off = np.linalg.norm(self._off(next_state), axis=-1)
        return 0.7 * np.exp(-0.5 * (off / 0.05) ** 2) + 0.3 * np.exp(-off / 0.1)
