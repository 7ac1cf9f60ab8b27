"""N episodes of a task in lock step: seeding, theta, the time limit. Every protocol in adapters.py stands on this."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.task import Array, InputError, Task


class BatchEnv:
    """N environments of one task; each has its own theta and three random streams (theta, start, noise).

    Attributes: `theta` [N, L] and `state` [N, S], for experts and exact references alone; `alive` [N], whether the
    episode goes on. A dead environment keeps its place, earns nothing, and waits for `reset`.
    """

    def __init__(self, task: Task, n: int, privileged: bool = False) -> None:
        self.task, self.n, self.privileged = task, n, privileged
        self.simulator = task.simulator(n)
        self.alive = np.zeros(n, bool)
        self.state: Array = np.zeros((n, 0))
        self._steps = np.zeros(n, int)
        self._noise: Array = np.zeros((n, 0, 0))
        self._streams: list[list[np.random.Generator]] = []
        self._space = task.observation_space

    @property
    def theta(self) -> Array:
        """The hidden latents [N, L]."""
        return self.simulator.theta

    def seed(self, seed: int | Sequence[int | None] | None) -> None:
        """Environment i gets seed + i (or seed[i], or fresh entropy), and from it three independent streams."""
        if seed is None:
            seed = [None] * self.n
        elif isinstance(seed, int | np.integer):
            seed = [int(seed) + i for i in range(self.n)]
        if len(seed) != self.n or any(one is not None and one < 0 for one in seed):
            raise InputError(f"seed was {seed}; it must be None, a number from 0 up, or {self.n} of these")
        self._streams = [
            [np.random.Generator(np.random.PCG64(s)) for s in np.random.SeedSequence(one).spawn(3)] for one in seed
        ]

    def reset(
        self,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
        where: NDArray[np.bool_] | None = None,
    ) -> NDArray[np.float32]:
        """Start new episodes in all environments, or `where` [N]; returns observations [N, O].

        options: `keep_theta` True goes on with the theta at hand (the next episode of a trial); `theta` [L] or
        [N, L] forces one. Neither moves the start or the noise. Raises InputError for a theta out of bounds.
        """
        options = options or {}
        if unknown := set(options) - {"keep_theta", "theta"}:
            raise InputError(f"reset option {sorted(unknown)[0]!r} is unknown; there are keep_theta and theta")
        keep, forced = bool(options.get("keep_theta")), options.get("theta")
        if keep and forced is not None:
            raise InputError("reset was given keep_theta and theta; give one of them")
        first = not self.state.size
        if keep and first:
            raise InputError("keep_theta was given before the first reset; reset once without it")
        if forced is not None:
            forced = self.task.check_theta(forced, self.n)
        if seed is not None or not self._streams:
            self.seed(seed)
        for i in range(self.n) if where is None else np.flatnonzero(where).tolist():
            theta_rng, start_rng, noise_rng = self._streams[i]
            if not keep:
                self.simulator.set_theta(i, self.task.sample_theta(theta_rng) if forced is None else forced[i])
            start, noise = self.task.init_state(start_rng), self.task.sample_noise(noise_rng)
            if not self.state.size:
                self.state = np.zeros((self.n, len(start)))
                self._noise = np.zeros((self.n, *noise.shape))
            self.state[i], self._noise[i] = start, noise
            self._steps[i], self.alive[i] = 0, True
        return self.observe()

    def observe(self) -> NDArray[np.float32]:
        """Observations [N, O] of the present states; the privileged view appends the encoded theta."""
        obs = np.clip(self.task.observe(self.state).astype(np.float32), self._space.low, self._space.high)
        if self.privileged:
            obs = np.concatenate([obs, self.task.encode_theta(self.theta).astype(np.float32)], -1)
        return obs

    def step(self, action: object) -> tuple[NDArray[np.float32], Array, NDArray[np.bool_], NDArray[np.bool_]]:
        """Action [N, A] -> observation [N, O], reward [N], terminated [N], truncated [N].

        Actions out of [-1, 1] are clipped. Raises InputError for a wrong shape or NaN, and before the first reset.
        """
        if not self.state.size:
            raise InputError("step was called before the first reset; reset once")
        checked = self.task.check_action(action, self.n)
        state = self.state
        outcome = self.simulator.outcome(state, checked)
        noise = self._noise[np.arange(self.n), np.minimum(self._steps, self.task.horizon - 1)]
        self.state = self.task.apply_noise(outcome, noise)
        self._steps += 1
        reward = np.where(self.alive, self.task.reward(state, checked, self.state, self.theta), 0.0)
        if not np.isfinite(reward).all():
            raise InputError(f"reward of {self.task.name} was {reward[~np.isfinite(reward)][0]}; it must be finite")
        terminated = self.alive & self.task.terminated(self.state)
        truncated = self.alive & ~terminated & (self._steps >= self.task.horizon)
        self.alive = self.alive & ~terminated & ~truncated
        return self.observe(), reward, terminated, truncated
