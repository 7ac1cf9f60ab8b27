"""Tasks that are not confounded, each for a reason of its own, and their experts."""

from __future__ import annotations

from typing import Any

import numpy as np

from deconfounded import envs
from deconfounded.envs.physics import Edit
from deconfounded.envs.task import Array
from deconfounded.envs.tasks.cartpole import Cartpole
from deconfounded.experts.policy import Expert, Random


class NoStakes(Cartpole):
    """Hold a point against Coulomb friction of the rail: feedback alone is enough, so nothing is confounded."""

    name = "no_stakes"
    latents = (envs.Latent("friction", "N", 0.0, 3.0),)

    def spec(self) -> Any:
        spec = envs.get("slippery_cartpole").spec()  # type: ignore[attr-defined]
        for tendon in spec.tendons:
            spec.delete(tendon)
        tendon = spec.add_tendon(name="rail")
        tendon.wrap_joint("slider", 1.0)
        spec.actuator("spin").ctrlrange = [0, 0]
        return spec

    process_noise = envs.get("slippery_cartpole").process_noise
    observation = envs.get("tilted_cartpole").observation

    def control(self, action: Array) -> Array:
        return np.concatenate([action, np.zeros_like(action)], -1)

    def apply_latent(self, edit: Edit, theta: Array) -> None:
        edit.tendon_friction("rail", float(theta[0]))


class Feedback(Expert):
    """A linear controller that adds what friction it is told of, in the direction of motion."""

    def mean(self, obs: Array, theta: Array) -> Array:
        x, _, sin, velocity, pole_velocity = obs.T
        force = 1.0 * x + 12 * sin + 1.5 * velocity + 3.0 * pole_velocity
        return np.clip(force[:, None] / 3 + 0.1 * theta * np.tanh(20 * velocity)[:, None], -1, 1)

    def act(self, obs: Array, theta: Array, rng: Random) -> Array:
        mean = self.mean(obs, theta)
        return np.clip(mean + 0.02 * rng.standard_normal(mean.shape), -1, 1)

    def log_prob(self, obs: Array, action: Array, theta: Array) -> Array:
        return -0.5 * (((action - self.mean(obs, theta)) / 0.02) ** 2).sum(-1)


class ShownAtOnce(Cartpole):
    """The motor's gain is hidden, and decides; but with so little noise that one step betrays it."""

    name = "shown_at_once"
    latents = (envs.Latent("gain", "", 0.2, 5.0),)
    process_noise = {"slider": (0.0, 0.004), "hinge": (0.0, 0.004)}

    def spec(self) -> Any:
        return envs.get("tilted_cartpole").spec()  # type: ignore[attr-defined]

    def apply_latent(self, edit: Edit, theta: Array) -> None:
        edit.actuator_gain("drive", float(theta[0]))


class Compensating(Feedback):
    """The same controller, which divides by the gain it is told of."""

    def mean(self, obs: Array, theta: Array) -> Array:
        x, _, sin, velocity, pole_velocity = obs.T
        force = 1.0 * x + 12 * sin + 1.5 * velocity + 3.0 * pole_velocity
        return np.clip(force[:, None] / 3 / theta, -1, 1)


class NothingHidden(Cartpole):
    """The cartpole of the tilted rail, which is level: its latent does nothing."""

    name = "nothing_hidden"
    latents = (envs.Latent("nothing", "", 0.0, 1.0),)

    def spec(self) -> Any:
        return envs.get("tilted_cartpole").spec()  # type: ignore[attr-defined]

    def apply_latent(self, edit: Edit, theta: Array) -> None:
        """Nothing."""


class Blind(Feedback):
    """The same controller, told of nothing."""

    def mean(self, obs: Array, theta: Array) -> Array:
        return super().mean(obs, 0 * theta)


EXPERTS = {NoStakes: Feedback, ShownAtOnce: Compensating, NothingHidden: Blind}
