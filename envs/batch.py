"""N episodes of a task in lock step: seeding, theta, the time limit. All interfaces in adapters.py are built on it."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from deconfounded.envs.streams import Array, Obs, Streams, generators
from deconfounded.envs.support.errors import InputError
from deconfounded.envs.support.numbers import check_number, is_seed
from deconfounded.envs.task import Mask, Task

MAX_ENVS = 10_000_000
Seed = int | Sequence[int | None] | None


class BatchEnv:
    """N environments of one task; each has its own theta and four random streams (theta, start, noise, switches).

    Attributes: `theta` [N, L] and `state` [N, S], for experts and exact references alone; `path` [N, T + 1, L], where
    theta switches: that of each step of the episode, and of the next episode's first; `action` [N, A], the last one
    taken in this episode, or NaN, for pictures; `alive` [N], whether the episode goes on. An environment whose episode
    has ended keeps its row, has reward 0, and waits for `reset`.
    """

    def __init__(self, task: Task, n: int, privileged: bool = False) -> None:
        """Raises InputError for an invalid number of environments."""
        check_number("environments", n, MAX_ENVS)
        self.task, self.n, self.privileged = task, n, privileged
        self.simulator = task.simulator(n)
        self.alive = np.zeros(n, bool)
        self.state: Array = np.zeros((n, 0))
        self.action = np.zeros((n, task.action_width))
        self._steps, self._all_rows = np.zeros(n, int), np.arange(n)
        self._noise: Array = np.zeros((n, 0, 0))
        self.path: Array = np.zeros((n, task.horizon + 1 if task.switches else 0, len(task.latents)))
        self._streams: list[list[np.random.Generator]] = []
        self._space = task.observation_space

    @property
    def theta(self) -> Array:
        """The hidden latents [N, L]."""
        return self.simulator.theta

    def seed(self, seed: Seed) -> None:
        """Environment i gets seed + i (or seed[i], or fresh entropy), and from it four independent streams."""
        if seed is None:
            seed = [None] * self.n
        elif isinstance(seed, int | np.integer) and is_seed(seed):
            seed = [int(seed) + i for i in range(self.n)]
        listed = (len(seed),) if isinstance(seed, Sequence) and not isinstance(seed, str | bytes) else None
        shape = seed.shape if isinstance(seed, np.ndarray) else listed
        if isinstance(seed, int) or shape != (self.n,) or not all(value is None or is_seed(value) for value in seed):
            raise InputError(f"seed was {seed}; it must be None, a number from 0 up, or {self.n} of these")
        self._streams = [generators(value) for value in seed]

    def reset(self, seed: Seed = None, options: dict[str, Any] | None = None, where: Mask | None = None) -> Obs:
        """Start new episodes in all environments, or `where` [N]; returns observations [N, O].

        options: `keep_theta`, True or a mask [N], keeps theta but for drift and switches, for the next episode of a
        trial; other environments draw a new theta. `theta` [L] or [N, L] sets theta. Neither changes the start or the
        noise. Raises InputError for a theta out of bounds and for an invalid mask.
        """
        options = {} if options is None else options
        if not isinstance(options, dict):
            raise InputError(f"reset options were {options!r}; they must be a dictionary")
        if unknown := set(options) - {"keep_theta", "theta"}:
            raise InputError(f"reset option {min(map(repr, unknown))} is unknown; there are keep_theta and theta")
        keep, forced = self._mask("keep_theta", options.get("keep_theta", False)), options.get("theta")
        if keep.any() and forced is not None:
            raise InputError("reset was given keep_theta and theta; give one of them")
        rows = self._all_rows if where is None else np.flatnonzero(self._mask("where", where))
        if (keep & ~self.alive & (self._steps == 0))[rows].any():
            raise InputError("keep_theta was given before the first reset; reset once without it")
        first = not self.state.size
        if forced is not None:
            forced = self.task.check_theta(forced, self.n)
        if seed is not None or not self._streams:
            self.seed(seed)
        if not len(rows) and first:
            raise InputError("reset was given a mask `where` without any environment before the first reset")
        if not len(rows):
            return self.observe()
        theta_rng, start_rng, noise_rng, switch_rng = zip(*(self._streams[i] for i in rows.tolist()), strict=True)
        new, task = ~keep[rows], self.task
        for which, is_new in ((new, True), (~new, False)):
            if not which.any() or not (is_new or task.drifts or task.switches):
                continue
            drawing = Streams([rng for rng, draws in zip(theta_rng, which, strict=True) if draws])
            if is_new:
                theta = task.sample_theta(drawing) if forced is None else forced[rows]
            else:
                theta = (self.path[:, -1] if task.switches else self.theta)[rows[which]]
                theta = task.drifted(theta, drawing) if task.drifts else theta
            for i, row in zip(rows[which].tolist(), theta, strict=True):
                self.simulator.set_theta(i, row)
        if task.switches:
            self.path[rows] = task.theta_path(self.theta[rows], Streams(switch_rng))
        start, noise = self.task.init_state(Streams(start_rng)), self.task.sample_noise(Streams(noise_rng))
        start = self.simulator.start(rows, start, noise)
        if first:
            self.state, self._noise = np.zeros((self.n, start.shape[1])), np.zeros((self.n, *noise.shape[1:]))
        self.state[rows], self._noise[rows] = start, noise
        self._steps[rows], self.alive[rows], self.action[rows] = 0, True, np.nan
        return self.observe()

    def close(self) -> None:
        """Close what the simulator holds; another reset opens it again."""
        self.simulator.close()

    def _mask(self, name: str, given: object) -> Mask:
        """True, False or booleans [N] -> booleans [N]. Raises InputError for anything else."""
        try:
            mask = np.asarray(given)
        except ValueError:  # rows of many lengths
            mask = np.asarray(given, object)
        if mask.dtype != bool or mask.shape not in ((), (self.n,)):
            right = f"True, False, or bool of shape ({self.n},), one for each environment"
            raise InputError(f"{name} was {mask.dtype} of shape {mask.shape}; it must be {right}")
        return mask if mask.shape else np.full(self.n, mask)

    def observe(self) -> Obs:
        """Observations [N, O] of the present states; the privileged view appends what experts see of theta."""
        obs = self.task.observe(self.state).astype(np.float32).clip(self._space.low, self._space.high)
        if self.privileged:
            obs = np.concatenate([obs, self.task.seen_theta(obs, self.theta).astype(np.float32)], -1)
        return obs

    def step(self, action: object) -> tuple[Obs, Array, Mask, Mask]:
        """Action [N, A] -> observation [N, O], reward [N], terminated [N], truncated [N].

        Environments whose episode is over are not stepped, whatever their action. Actions out of [-1, 1] are clipped.
        Raises InputError for a wrong shape or NaN, and before the first reset.
        """
        ended = self.advance(action)
        return self.observe(), *ended

    def advance(self, action: object) -> tuple[Array, Mask, Mask]:
        """`step` without the observation, for a caller that resets ended episodes before it observes."""
        if not self.state.size:
            raise InputError("step was called before the first reset; reset once")
        task, over = self.task, ~self.alive
        checked = task.check_action(action, self.n, over)
        rows = np.flatnonzero(self.alive) if over.any() else None
        on = slice(None) if rows is None else rows
        before, taken, noise = self.state[on], checked[on], self._noise[self._all_rows[on], self._steps[on]]
        theta = self.theta[on]
        self.action[on] = taken
        after = task.apply_noise(self.simulator.outcome(before, taken, rows), noise)
        after = task.sense(after, theta, noise)
        reward, terminated, truncated = np.zeros(self.n), np.zeros(self.n, bool), np.zeros(self.n, bool)
        reward[on] = task.reward(before, taken, after, theta)
        terminated[on] = task.terminated(after)
        self._steps[on] += 1
        truncated[on] = (self._steps[on] >= task.horizon) | task.truncated(after)
        if not np.isfinite(reward).all():
            raise InputError(f"reward of {task.name} was {reward[~np.isfinite(reward)][0]}; it must be finite")
        self.state = self.state.copy()  # agents may hold the array before
        self.state[on] = after
        self.alive = ~(over | terminated | truncated)
        if task.switches:
            now = self.path[self._all_rows, self._steps]
            for i in np.flatnonzero((now != self.theta).any(-1)).tolist():
                self.simulator.set_theta(i, now[i])
        return reward, terminated, truncated
