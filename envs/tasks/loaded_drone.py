"""A quadrotor with a weak rotor and a load off its centre has to stay at a mark that it does not see, in hidden wind.

Tier 2. As in `windy_drone`, what it does not know it has to compensate in advance, as its position is not observed: but
in all directions, and five unknowns at once, of which several act alike. A weak rotor turns the drone as a load near it
does; what tells them apart is a slow turn about the vertical.

No command holds every drone level: with a weak rotor and a load off its centre, a fifth of all thetas take more torque
than the action has, about the vertical above all. The drone turns then, and the expert loses it in many episodes.

Latents: wind_x and wind_y, m/s, uniform; load_x and load_y, m from the middle at which .6 kg hang, uniform; rotor, the
strength of the front left rotor in units of the others', uniform. Drone, noise, action, reward and end are those of
`windy_drone`.
"""

import mujoco

from deconfounded.envs.physics import Edit
from deconfounded.envs.task import ASSETS, Array, Latent
from deconfounded.envs.tasks.windy_drone import WindyDrone

WIND, SHIFT = 12.0, 0.02


class LoadedDrone(WindyDrone):
    """A free joint, `flight`."""

    name = "loaded_drone"
    latents = (
        *(Latent(f"wind_{axis}", "m/s", -WIND, WIND) for axis in "xy"),
        *(Latent(f"load_{axis}", "m", -SHIFT, SHIFT) for axis in "xy"),
        Latent("rotor", "", 0.75, 1.0),
    )

    def spec(self) -> mujoco.MjSpec:
        return mujoco.MjSpec.from_file(str(ASSETS / "windy_drone.xml"))

    def apply_latent(self, edit: Edit, theta: Array) -> None:
        edit.wind(float(theta[0]), float(theta[1]), 0)
        edit.body_shift("load", float(theta[2]), float(theta[3]))
        edit.actuator_gain("front_left", float(theta[4]))
