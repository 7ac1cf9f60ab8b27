"""A circuit of six bends, each of hidden grip: what a bend is like shows only to those who drive through it.

Tier 2. On entering a bend its grip has to be known, since neither engine nor brakes can correct a speed in it: an agent
that expects too much grip leaves the road, one that expects too little is slow. A bend that was driven through has to
be remembered until the next lap, and in the next episode, which starts anywhere on the circuit.

Latents: grip_0 to grip_5, friction coefficients of six patches of 4 m, one for each bend, log-uniform, and independent;
the patch under the middle of the car acts on all wheels. The car, its noise, action, reward and end are those of
`icy_road`, of which the expert is, too: it heeds the grip of the patch that it will be in a metre ahead. Beyond
icy_road's observations, the car observes its place on the circuit of 24 m, as an angle.
"""

import mujoco
import numpy as np
from numpy.typing import NDArray

from deconfounded.envs.patches import PatchedTask
from deconfounded.envs.streams import Array
from deconfounded.envs.task import ASSETS, Latent
from deconfounded.envs.tasks.icy_road import WAVE, IcyRoad

PATCHES, LENGTH = 6, WAVE / 2  # m
AHEAD = 1.0  # m; the expert heeds the patch there


class PatchyRoad(PatchedTask, IcyRoad):
    """The joints of IcyRoad."""

    name = "patchy_road"
    version = 1
    latents = tuple(Latent(f"grip_{i}", "", 0.15, 0.6, "loguniform") for i in range(PATCHES))
    observation = IcyRoad.observation | {"circuit_cos": (-1, 1), "circuit_sin": (-1, 1)}
    stretch = PATCHES * LENGTH

    def spec(self) -> mujoco.MjSpec:
        return mujoco.MjSpec.from_file(str(ASSETS / "icy_road.xml"))

    def patch(self, state: Array) -> NDArray[np.int64]:
        return self.patch_at(self.qpos(state, "x") / LENGTH)

    def heeded(self, obs: Array) -> NDArray[np.int64]:
        turns = np.arctan2(obs[:, -1], obs[:, -2]).astype(float) / (2 * np.pi)
        return self.patch_at(turns * PATCHES + AHEAD / LENGTH)

    def observe(self, state: Array) -> Array:
        angle = 2 * np.pi * self.qpos(state, "x") / (PATCHES * LENGTH)
        return np.concatenate([super().observe(state), np.cos(angle)[:, None], np.sin(angle)[:, None]], -1)
