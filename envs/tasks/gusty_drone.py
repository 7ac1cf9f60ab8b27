"""The quadrotor of windy_drone in gusts: the wind changes at random steps of an episode, and the load stays.

Tier 2. Each gust has to be inferred while the drone drifts off, within a few steps of its start: a belief has to forget
the wind at once, and must not forget the load with it. A belief that only ever grows surer holds on to the mean of all
winds so far, and a clone that reads its own actions leans against a gust that is gone.

Latents: wind along y, m/s, uniform, drawn anew after a step with probability .02, which is every two seconds on
average; load, m along x, uniform, the same in all episodes of a trial. Drone, noise, action, reward and end are those
of `windy_drone`, and so is the expert, which feels the present wind.
"""

import mujoco

from deconfounded.envs.task import ASSETS, Latent
from deconfounded.envs.tasks.windy_drone import WindyDrone


class GustyDrone(WindyDrone):
    """A free joint, `flight`, in a wind that switches."""

    name = "gusty_drone"
    latents = (Latent("wind", "m/s", -16.0, 16.0, switch=0.02), Latent("load", "m", -0.02, 0.02))

    def spec(self) -> mujoco.MjSpec:
        return mujoco.MjSpec.from_file(str(ASSETS / "windy_drone.xml"))
