"""Process noise: normal on every coordinate of a joint; for rotations, on the tangent space at the outcome."""

from collections.abc import Mapping
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from deconfounded.envs.streams import Array
from deconfounded.envs.support.errors import InputError

MAX_ROTATION_STD = 0.5  # rad; log_prob neglects noise of more than half a turn


class Kind(NamedTuple):
    """A type of joint: its numbers of columns in qpos and qvel, and the quantities that have a standard deviation."""

    name: str
    qpos: int
    qvel: int
    stds: tuple[str, ...]


TURN = ("rotation rad", "angular velocity rad/s")
KINDS = {
    mujoco.mjtJoint.mjJNT_FREE: Kind("free", 7, 6, ("position m", *TURN[:1], "velocity m/s", *TURN[1:])),
    mujoco.mjtJoint.mjJNT_BALL: Kind("ball", 4, 3, TURN),
    mujoco.mjtJoint.mjJNT_SLIDE: Kind("slide", 1, 1, ("position m", "velocity m/s")),
    mujoco.mjtJoint.mjJNT_HINGE: Kind("hinge", 1, 1, ("position rad", "velocity rad/s")),
}


def columns(model: mujoco.MjModel, joint: str) -> tuple[range, range]:
    """Columns of a joint's qpos and qvel in states [..., S]. Raises KeyError, with all joints' names, if unknown."""
    element = model.joint(joint)
    kind = KINDS[mujoco.mjtJoint(int(element.type[0]))]
    q, v = 1 + int(element.qposadr[0]), 1 + model.nq + int(element.dofadr[0])
    return range(q, q + kind.qpos), range(v, v + kind.qvel)


class ProcessNoise:
    """Independent normal noise with a standard deviation for each part of a joint, 0 for no noise.

    stds: joint -> (position, velocity) of a hinge or slide joint; (rotation, angular velocity) of a ball joint, and
    (position, rotation, velocity, angular velocity) of a free joint, each std on all three axes. Units are m, rad,
    m/s and rad/s. A rotation q becomes q exp(w / 2), for noise w [3] (rad) about the body's own axes.

    Attributes: `size`, Z, the width of a step's unit noise, in the order of stds; `columns` of the state with noise.
    Raises InputError for stds that do not fit the joint, or that are negative, and KeyError for an unknown joint.
    """

    def __init__(self, model: mujoco.MjModel, stds: Mapping[str, tuple[float, ...]]) -> None:
        self.size = 0
        plain: list[tuple[int, int, float]] = []  # of each coordinate: its column in the state, that in the noise, std
        self._rotations: list[tuple[list[int], list[int], float]] = []  # the same of quaternions
        for part, std in (pair for joint, given in stds.items() for pair in _parts(model, joint, given) if pair[1]):
            drawn = [*range(self.size, self.size + min(len(part), 3))]
            if len(part) == 4:
                self._rotations.append(([*part], drawn, std))
            else:
                plain += zip(part, drawn, [std] * len(part), strict=True)
            self.size += len(drawn)
        index, draws, sigma = zip(*plain, strict=True) if plain else ((), (), ())
        self._index, self._draws, self._sigma = np.array(index, int), np.array(draws, int), np.array(sigma, float)
        # `apply` takes the coordinates in the state's order, in which they are a slice as a rule, without a gather
        order = np.argsort(self._index)
        first, n = (int(self._index.min()), len(plain)) if plain else (0, 0)
        whole = (self._index[order] == np.arange(first, first + n)).all()
        self._place: slice | NDArray[np.int64] = slice(first, first + n) if whole else self._index[order]
        self._place_draws, self._place_sigma = self._draws[order], self._sigma[order]
        self.columns: NDArray[np.int64] = np.sort(np.concatenate([self._index, *(at for at, _, _ in self._rotations)]))

    def apply(self, outcome: Array, noise: Array) -> Array:
        """Outcome [N, S] and unit noise [N, Z] -> next state [N, S], in place; quaternions stay of unit length."""
        outcome[:, self._place] += self._place_sigma * noise[:, self._place_draws]
        for at, drawn, std in self._rotations:
            w = std * noise[:, drawn]  # rad
            half = np.linalg.norm(w, axis=-1, keepdims=True) / 2
            turn = np.concatenate([np.cos(half), 0.5 * np.sinc(half / np.pi) * w], -1)  # exp(w / 2)
            rotated = _product(outcome[:, at], turn)
            outcome[:, at] = rotated / np.linalg.norm(rotated, axis=-1, keepdims=True)
        return outcome

    def log_prob(self, next_state: Array, outcome: Array) -> Array:
        """Log density [...] of next states [..., S], given their outcome [..., S].

        The density of a rotation is with respect to the Haar measure, dw near the outcome and
        (sin(|w| / 2) / (|w| / 2))^2 dw further off, so that densities about different outcomes can be compared. q and
        -q are the same rotation.
        """
        z = (next_state[..., self._index] - outcome[..., self._index]) / self._sigma
        total = -0.5 * (z**2).sum(-1) - np.log(self._sigma).sum() - 0.5 * len(self._sigma) * np.log(2 * np.pi)
        for at, _, std in self._rotations:
            between = _product(outcome[..., at] * (1, -1, -1, -1), next_state[..., at])
            half = np.arctan2(np.linalg.norm(between[..., 1:], axis=-1), np.abs(between[..., 0]))  # |w| / 2
            normal = -0.5 * (2 * half / std) ** 2 - 3 * np.log(std) - 1.5 * np.log(2 * np.pi)
            total = total + normal - 2 * np.log(np.sinc(half / np.pi))
        return total


def _parts(model: mujoco.MjModel, joint: str, stds: tuple[float, ...]) -> list[tuple[range, float]]:
    """Pairs of columns of the state and their standard deviation, for each part of a joint."""
    q, v = columns(model, joint)
    parts = {1: [q, v], 4: [q, v], 7: [q[:3], q[3:], v[:3], v[3:]]}[len(q)]
    kind = KINDS[mujoco.mjtJoint(int(model.joint(joint).type[0]))]
    was = f"process_noise of joint {joint}, a {kind.name} joint, was {stds}; "
    if len(stds) != len(kind.stds):
        raise InputError(f"{was}it must be {len(kind.stds)} standard deviations: {', '.join(kind.stds)}")
    if not all(0 <= std < np.inf for std in stds):
        raise InputError(f"{was}it must be standard deviations, from 0 up")
    if any(std > MAX_ROTATION_STD for part, std in zip(parts, stds, strict=True) if len(part) == 4):
        raise InputError(f"{was}its rotation's must be at most {MAX_ROTATION_STD} rad")
    return list(zip(parts, stds, strict=True))


def _product(p: Array, q: Array) -> Array:
    """Product p q [..., 4] of quaternions [..., 4]: q's rotation, then p's."""
    a, b, c, d = (p[..., i] for i in range(4))
    e, f, g, h = (q[..., i] for i in range(4))
    real, x = a * e - b * f - c * g - d * h, a * f + b * e + c * h - d * g
    y, z = a * g - b * h + c * e + d * f, a * h + b * g - c * f + d * e
    return np.stack([real, x, y, z], -1)
