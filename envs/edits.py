"""Edits of MuJoCo models by a latent: in a compiled model, and in a specification before compilation."""

from typing import Protocol

import mujoco
import numpy as np

from deconfounded.envs.streams import Array


class Edit(Protocol):
    """Changes that a latent may make to a named element; a value is absolute, a scale multiplies the MJCF's value."""

    def body_tilt(self, name: str, angle: float) -> None:
        """Set a body's angle about its parent's y axis, in place of the MJCF's; rad."""

    def body_shift(self, name: str, x: float) -> None:
        """Set a body's x in its parent's frame; m."""

    def body_mass(self, name: str, scale: float) -> None:
        """Scale a body's mass and inertia."""

    def geom_friction(self, name: str, value: float) -> None:
        """Sliding friction coefficient of a geom."""

    def joint_damping(self, name: str, value: float) -> None:
        """Damping of a hinge or slide joint; N m s or N s/m."""

    def slope(self, angle: float) -> None:
        """Turn gravity about the y axis, so that the world rises along x; rad."""

    def wind(self, x: float, y: float, z: float) -> None:
        """Velocity of the medium, which the MJCF gives a density or a viscosity; m/s."""

    def joint_stiffness(self, name: str, value: float) -> None:
        """Spring of a hinge or slide joint; N m/rad or N/m."""

    def actuator_gain(self, name: str, scale: float) -> None:
        """Scale a motor's gain; -1 reverses it."""

    def tendon_friction(self, name: str, value: float) -> None:
        """Coulomb friction of a tendon; N, or N m for a tendon over hinges."""


def _tilt(angle: float) -> list[float]:
    return [np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0]


def _uphill(gravity: Array, angle: float) -> list[float]:
    return [gravity[2] * np.sin(angle), 0.0, gravity[2] * np.cos(angle)]


class ModelEdit:
    """Edits of a compiled model in place. Scales multiply the nominal model's values, so that they never compound.

    data: scratch space, which many models may share (an MjData takes megabytes).
    """

    def __init__(self, model: mujoco.MjModel, nominal: mujoco.MjModel, data: mujoco.MjData) -> None:
        self.model, self._nominal, self._data, self._stale = model, nominal, data, False

    def body_tilt(self, name: str, angle: float) -> None:
        self._stale = True
        self.model.body(name).quat[:] = _tilt(angle)

    def body_shift(self, name: str, x: float) -> None:
        self._stale = True
        self.model.body(name).pos[0] = x

    def body_mass(self, name: str, scale: float) -> None:
        self._stale = True
        self.model.body(name).mass[:] = self._nominal.body(name).mass * scale
        self.model.body(name).inertia[:] = self._nominal.body(name).inertia * scale

    def geom_friction(self, name: str, value: float) -> None:
        self.model.geom(name).friction[0] = value

    def joint_damping(self, name: str, value: float) -> None:
        self.model.joint(name).damping[0] = value

    def slope(self, angle: float) -> None:
        self.model.opt.gravity[:] = _uphill(self._nominal.opt.gravity, angle)

    def wind(self, x: float, y: float, z: float) -> None:
        self.model.opt.wind[:] = x, y, z

    def joint_stiffness(self, name: str, value: float) -> None:
        self.model.joint(name).stiffness[0] = value

    def actuator_gain(self, name: str, scale: float) -> None:
        self.model.actuator(name).gainprm[0] = self._nominal.actuator(name).gainprm[0] * scale

    def tendon_friction(self, name: str, value: float) -> None:
        self.model.tendon_frictionloss[self.model.tendon(name).id] = value

    def finish(self) -> None:
        """Recompute what MuJoCo derives from positions and masses (subtree masses, invweight0), if those changed."""
        if self._stale:
            mujoco.mj_setConst(self.model, self._data)
            self._stale = False


class SpecEdit:
    """The same edits before compilation: the reference for tests of ModelEdit."""

    def __init__(self, spec: mujoco.MjSpec) -> None:
        self.spec = spec

    def body_tilt(self, name: str, angle: float) -> None:
        self.spec.body(name).quat = _tilt(angle)

    def body_shift(self, name: str, x: float) -> None:
        self.spec.body(name).pos[0] = x

    def body_mass(self, name: str, scale: float) -> None:
        for geom in self.spec.body(name).geoms:
            geom.mass *= scale

    def geom_friction(self, name: str, value: float) -> None:
        self.spec.geom(name).friction[0] = value

    def joint_damping(self, name: str, value: float) -> None:
        self.spec.joint(name).damping[0] = value

    def slope(self, angle: float) -> None:
        self.spec.option.gravity = _uphill(self.spec.option.gravity, angle)

    def wind(self, x: float, y: float, z: float) -> None:
        self.spec.option.wind = x, y, z

    def joint_stiffness(self, name: str, value: float) -> None:
        self.spec.joint(name).stiffness[0] = value

    def actuator_gain(self, name: str, scale: float) -> None:
        self.spec.actuator(name).gainprm[0] *= scale

    def tendon_friction(self, name: str, value: float) -> None:
        self.spec.tendon(name).frictionloss = value
