"""Tasks whose latents are places: the same property in each of L patches of the ground, of which one acts at a time."""

from abc import abstractmethod

import numpy as np
from numpy.typing import NDArray

from deconfounded.envs.physics import MujocoTask, Physics
from deconfounded.envs.support.errors import InputError
from deconfounded.envs.task import Array


class PatchedPhysics(Physics):
    """Models of n environments, each of which has the latent of the patch that its state is in."""

    def __init__(self, task: "PatchedTask", n: int) -> None:
        self._patched, self._held = task, np.zeros(n)
        super().__init__(task, n)

    def set_theta(self, i: int, theta: Array) -> None:
        super().set_theta(i, theta)
        self._held[i] = theta[0]

    def rollout(self, state: Array, action: Array) -> Array:
        raise InputError(f"{self.task.name} has a theta for each place; mujoco.rollout holds one for all steps")

    def outcome(self, state: Array, action: Array, rows: NDArray[np.int64] | None = None) -> Array:
        which = np.arange(len(state)) if rows is None else np.asarray(rows)
        patches, outcome = self._patched.patch(state), np.empty_like(state)
        for patch in np.unique(patches):
            here = patches == patch
            for i in np.unique(which[here]):
                if self._held[i] != (value := self.theta[i, patch]):
                    self._held[i] = value
                    self._patched.apply_latent(self._edits[i], np.array([value]))
                    self._edits[i].finish()
            outcome[here] = super().outcome(state[here], action[here], which[here])
        return outcome


class PatchedTask(MujocoTask):
    """A task of L independent latents alike, of which that of the present patch acts, and the expert heeds one.

    `apply_latent` is given the acting latent first.
    """

    @abstractmethod
    def patch(self, state: Array) -> NDArray[np.int64]:
        """The latent [N] that acts on a step from states [N, S]."""

    @abstractmethod
    def heeded(self, obs: Array) -> NDArray[np.int64]:
        """The latent [N] by which the expert acts at observations [N, O]."""

    def patch_at(self, place: Array) -> NDArray[np.int64]:
        """The patch [N] at places [N] along patches in a ring, in units of a patch."""
        return (np.floor(place) % len(self.latents)).astype(int)

    def theta_grid(self, k: int) -> Array:
        """Thetas [K, L] whose patches are all alike, with k equally likely values: as one patch acts at a time."""
        return np.repeat(self.latents[0].grid(k)[:, None], len(self.latents), 1)

    def transition(self, k: int) -> Array:
        """Transition matrix [K, K] of one patch."""
        return self.latents[0].transition(k)

    def switching(self, k: int) -> Array:
        """Transition matrix [K, K] of one patch."""
        return self.latents[0].switching(k)

    def acting_theta(self, theta: Array, state: Array) -> Array:
        return np.take_along_axis(theta, self.patch(state)[:, None], -1)

    def heeded_theta(self, obs: Array, theta: Array) -> Array:
        """The value [N], of latents [N, L], by which the expert acts at observations [N, O]."""
        return np.take_along_axis(theta, self.heeded(obs)[:, None], -1)[:, 0]

    def seen_theta(self, obs: Array, theta: Array) -> Array:
        return self.latents[0].encode(self.heeded_theta(obs, theta))

    @property
    def seen_width(self) -> int:
        return self.latents[0].features

    def simulator(self, n: int) -> PatchedPhysics:
        return PatchedPhysics(self, n)
