"""A hoist carries a load of hidden mass on an elastic cable, and has to follow a target that swings up and down.

Tier 2. The cable stretches by mass x g / 10 m, 1 m to 3 m: an agent that expects a lighter load lets it hang too low,
one that expects a heavier load throws it up. The hook acts on the load only through the cable, on which the load
bounces, so that feedback is slow and the stretch must be known in advance. A control step shows the mass only through
process noise.

Latent: mass, kg, log-uniform, set with its inertia (a cube of that mass). Noise a step: std .004 m and .45 m/s of the
load, .004 m and .05 m/s of the hook; none of the target, which theta does not touch.

The stretch is observed up to 4 m: beyond, where a heavy load is being lost, nobody sees how far it hangs.

Action: the hook's speed, in units of 3 m/s. Reward: .8 exp(-12.5 d^2) + .2 exp(-d), d m off the target. An episode ends
with a load dropped or thrown, 1.2 m off the target.
"""

import numpy as np

from deconfounded.envs.physics import Edit, MujocoTask
from deconfounded.envs.task import Array, Latent, Mask, Streams

LOST = 1.2  # m
PACE = 2.1  # of the target, rad/s
STRETCH = 1.7  # of the cable at the start, whatever the load, m


class HeavyPayload(MujocoTask):
    """Joints `hook`, `load` and `target`, all along z (m); all at 0, the cable is just taut."""

    name = "heavy_payload"
    version = 1
    latents = (Latent("mass", "kg", 1.0, 3.0, "loguniform"),)
    horizon = 150
    expert_noise = 0.02
    controls = (0.0, 3.0)  # of the hook, m/s
    process_noise = {"load": (0.004, 0.45), "hook": (0.004, 0.05), "target": (0, 0)}
    observation = {
        **{"off_target": (-4, 4), "stretch": (-4, 4), "target": (-2, 2)},
        **{"load_velocity": (-15, 15), "hook_velocity": (-15, 15), "target_velocity": (-4, 4)},
    }

    def apply_latent(self, edit: Edit, theta: Array) -> None:
        edit.body_mass("load", float(theta[0]))  # the MJCF's load has 1 kg

    def init_state(self, rng: Streams) -> Array:
        phase, swing, off, stretch = rng.uniform((0, 0.3, -0.1, -0.1), (2 * np.pi, 0.5, 0.1, 0.1))
        target, velocity = swing * np.sin(phase), PACE * swing * np.cos(phase)
        heights = {"target": target, "load": target + off, "hook": target + off + STRETCH + stretch}
        return self.state(**{joint: (height, velocity) for joint, height in heights.items()})

    def observe(self, state: Array) -> Array:
        load, hook, target = (self.qpos(state, joint) for joint in ("load", "hook", "target"))
        velocities = (self.qvel(state, joint) for joint in ("load", "hook", "target"))
        return np.stack([load - target, hook - load, target, *velocities], -1)

    def _off(self, state: Array) -> Array:
        return np.abs(self.qpos(state, "load") - self.qpos(state, "target"))

    def reward(self, state: Array, action: Array, next_state: Array, theta: Array) -> Array:
        off = self._off(next_state)
        return 0.8 * np.exp(-0.5 * (off / 0.2) ** 2) + 0.2 * np.exp(-off)

    def terminated(self, state: Array) -> Mask:
        return self._off(state) > LOST
