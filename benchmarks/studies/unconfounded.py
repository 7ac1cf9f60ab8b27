"""Tasks that are not confounded, each for a reason of its own, and their experts."""

from typing import Any

import numpy as np

from deconfounded import envs
from deconfounded.envs.edits import Edit
from deconfounded.envs.streams import Array
from deconfounded.envs.tasks.cartpole import Cartpole
from deconfounded.envs.tasks.slippery_cartpole import SlipperyCartpole
from deconfounded.envs.tasks.tilted_cartpole import TiltedCartpole


class NoStakes(Cartpole):
    """Hold a point against Coulomb friction of the rail: feedback alone is enough, so nothing is confounded."""

    name = "no_stakes"
    latents = (envs.Latent("friction", "N", 0.0, 3.0),)

    def spec(self) -> Any:
        spec = SlipperyCartpole().spec()
        for tendon in spec.tendons:
            spec.delete(tendon)
        tendon = spec.add_tendon(name="rail")
        tendon.wrap_joint("slider", 1.0)
        spec.actuator("spin").ctrlrange = [0, 0]
        return spec

    process_noise = SlipperyCartpole.process_noise
    observation = TiltedCartpole.observation

    def control(self, action: Array) -> Array:
        return np.concatenate([action, np.zeros_like(action)], -1)

    def apply_latent(self, edit: Edit, theta: Array) -> None:
        edit.tendon_friction("rail", float(theta[0]))


def feedback(obs: Array, theta: Array) -> Array:
    """A linear controller that adds the friction that it is given, in the direction of motion."""
    return _balance(obs) + 0.1 * theta * np.tanh(20 * obs[:, 3:4])


def _balance(obs: Array) -> Array:
    """Cart to the mark, pole upright: [N, 1]."""
    return (obs @ (1.0, 0.0, 12.0, 1.5, 3.0))[:, None] / 3


class ShownAtOnce(Cartpole):
    """The motor's gain is hidden, and decides; but with so little noise that one step betrays it."""

    name = "shown_at_once"
    latents = (envs.Latent("gain", "", 0.2, 5.0),)
    process_noise = {"slider": (0.0, 0.004), "hinge": (0.0, 0.004)}

    def spec(self) -> Any:
        return TiltedCartpole().spec()

    def apply_latent(self, edit: Edit, theta: Array) -> None:
        edit.actuator_gain("drive", float(theta[0]))


def compensating(obs: Array, theta: Array) -> Array:
    """The same controller, which divides by the gain that it is given."""
    return _balance(obs) / theta


class NothingHidden(Cartpole):
    """The cartpole of the tilted rail, which is level: its latent does nothing."""

    name = "nothing_hidden"
    latents = (envs.Latent("nothing", "", 0.0, 1.0),)

    def spec(self) -> Any:
        return TiltedCartpole().spec()

    def apply_latent(self, edit: Edit, theta: Array) -> None:
        """Nothing."""


def blind(obs: Array, theta: Array) -> Array:
    """The same controller, which is given nothing."""
    return _balance(obs)


EXPERTS = {
    f"{__name__}:{task.__name__}": f"{__name__}:{expert.__name__}"
    for task, expert in ((NoStakes, feedback), (ShownAtOnce, compensating), (NothingHidden, blind))
}
"""Of each task, its expert, both as references."""
