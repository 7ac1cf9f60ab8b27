"""Edits of MuJoCo models by a latent: in a compiled model, and in a specification before compilation."""

from abc import ABC, abstractmethod
from functools import cache

import mujoco
import numpy as np

from deconfounded.envs.streams import Array


def _uphill(gravity: Array, angle: float) -> list[float]:
    x, y, z = gravity
    return [x * np.cos(angle) + z * np.sin(angle), y, z * np.cos(angle) - x * np.sin(angle)]


class Edit(ABC):
    """Changes that a latent may make to a named element; a value is absolute, a scale multiplies the MJCF's value."""

    def __init__(self, target: "Elements | mujoco.MjSpec", option: mujoco.MjOption) -> None:
        self.target, self._option, self._gravity, self._stale = target, option, option.gravity.copy(), False

    def body_tilt(self, name: str, angle: float) -> None:
        """Set a body's angle about its parent's y axis, in place of the MJCF's; rad."""
        self._stale = True
        self.target.body(name).quat[:] = np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0

    def body_shift(self, name: str, *place: float) -> None:
        """Set a body's x, or x and y, in its parent's frame; m."""
        self._stale = True
        self.target.body(name).pos[: len(place)] = place

    @abstractmethod
    def body_mass(self, name: str, scale: float) -> None:
        """Scale a body's mass and inertia."""

    def geom_friction(self, name: str, value: float) -> None:
        """Sliding friction coefficient of a geom."""
        self.target.geom(name).friction[0] = value

    def joint_damping(self, name: str, value: float) -> None:
        """Damping of a hinge or slide joint; N m s or N s/m."""
        self.target.joint(name).damping[0] = value

    def joint_stiffness(self, name: str, value: float) -> None:
        """Spring of a hinge or slide joint; N m/rad or N/m."""
        self.target.joint(name).stiffness[0] = value

    def slope(self, angle: float) -> None:
        """Turn gravity about the y axis, so that the world rises along x; rad."""
        self._option.gravity[:] = _uphill(self._gravity, angle)

    def wind(self, x: float, y: float, z: float) -> None:
        """Velocity of the medium, which the MJCF gives a density or a viscosity; m/s."""
        self._option.wind[:] = x, y, z

    @abstractmethod
    def actuator_gain(self, name: str, scale: float) -> None:
        """Scale a motor's gain; -1 reverses it."""

    def actuator_bias(self, name: str, value: float) -> None:
        """Set the constant part of an actuator's force, whose bias is affine; in units of ctrl where its gain is 1."""
        self.target.actuator(name).biasprm[0] = value

    @abstractmethod
    def tendon_friction(self, name: str, value: float) -> None:
        """Coulomb friction of a tendon; N, or N m for a tendon over hinges."""


class Elements:
    """Named elements of a compiled model, each of which is looked up once: that takes longer than an edit."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.body, self.geom, self.joint = cache(model.body), cache(model.geom), cache(model.joint)
        self.actuator, self.tendon = cache(model.actuator), cache(model.tendon)


class ModelEdit(Edit):
    """Edits of a compiled model in place. Scales multiply the nominal model's values, so that they never compound.

    data: scratch space, which many models may share (an MjData takes megabytes).
    """

    def __init__(self, model: mujoco.MjModel, nominal: mujoco.MjModel, data: mujoco.MjData) -> None:
        super().__init__(Elements(model), model.opt)
        self.model, self._nominal, self._gravity, self._data = model, Elements(nominal), nominal.opt.gravity, data

    def body_mass(self, name: str, scale: float) -> None:
        self._stale = True
        self.target.body(name).mass[:] = self._nominal.body(name).mass * scale
        self.target.body(name).inertia[:] = self._nominal.body(name).inertia * scale

    def geom_friction(self, name: str, value: float) -> None:
        try:
            super().geom_friction(name, value)
        except KeyError:  # a model for stepping alone has no visual geoms
            self._nominal.geom(name)

    def actuator_gain(self, name: str, scale: float) -> None:
        self.target.actuator(name).gainprm[0] = self._nominal.actuator(name).gainprm[0] * scale

    def tendon_friction(self, name: str, value: float) -> None:
        self.model.tendon_frictionloss[self.target.tendon(name).id] = value

    def finish(self) -> None:
        """Recompute what MuJoCo derives from positions and masses (subtree masses, invweight0), if those changed."""
        if self._stale:
            mujoco.mj_setConst(self.model, self._data)
            self._stale = False


class SpecEdit(Edit):
    """The same edits before compilation: the reference for tests of ModelEdit.

    MJCF states a number in several ways: a mass by density or <inertial>, a position within <frame>s, an angle by
    euler, a spring by springdamper. Not all of them are the attribute that is edited, so that the specification is
    first rewritten to state what it compiles to.
    """

    def __init__(self, spec: mujoco.MjSpec) -> None:
        super().__init__(spec, spec.option)
        self.spec, model = spec, spec.compile()
        for joint in spec.joints:
            if joint.springdamper.any():
                joint.springdamper, joint.stiffness[0] = [0, 0], model.jnt_stiffness[joint.id]
                joint.damping[0] = model.dof_damping[model.jnt_dofadr[joint.id]]
        for actuator in spec.actuators:
            actuator.biasprm = model.actuator_biasprm[actuator.id]
        for tendon in spec.tendons:
            tendon.springlength = model.tendon_lengthspring[tendon.id]
        spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
        spec.compiler.settotalmass, spec.compiler.balanceinertia = -1, 0
        spec.compiler.boundmass = spec.compiler.boundinertia = 0
        for body, i in [(body, body.id) for body in spec.bodies[1:]]:  # a new frame takes ids away
            body.set_frame(body.parent.add_frame())
            body.alt.type = body.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
            body.explicitinertial, body.mass, body.fullinertia = True, model.body_mass[i], [np.nan] * 6
            for part in ("pos", "quat", "ipos", "iquat", "inertia"):
                setattr(body, part, getattr(model, f"body_{part}")[i])

    def body_mass(self, name: str, scale: float) -> None:
        self.spec.body(name).mass *= scale
        self.spec.body(name).inertia *= scale

    def actuator_gain(self, name: str, scale: float) -> None:
        self.spec.actuator(name).gainprm[0] *= scale

    def tendon_friction(self, name: str, value: float) -> None:
        self.spec.tendon(name).frictionloss = value
