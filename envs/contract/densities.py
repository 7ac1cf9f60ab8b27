"""Checks of densities: those that a task states are the densities of what its noise and its sensors draw."""

import numpy as np

from deconfounded.envs.batch import BatchEnv
from deconfounded.envs.contract.probe import Skipped, actions, needs_likelihood, require, same, streams
from deconfounded.envs.physics import MujocoTask
from deconfounded.envs.task import Array, Task

FEW = 32  # next states


def _noise(task: Task, m: int) -> Array:
    return np.concatenate(task.sample_noise(streams(*range(m // task.horizon + 1))))[:m]


def _outcomes(task: Task) -> tuple[Array, Array]:
    """The outcome [1, S] of a state, an action and a theta, and others [K, S] that are near and far.

    Theta and the action are other ones, by the whole range of the first latent or the whole action, or by 1/2, 1/4, ...
    """
    first, parts = task.latents[0], 0.5 ** np.arange(16)
    low, high = first.grid(9)[[0, -1]]
    values = [high] if first.distribution == "categorical" else [low + part * (high - low) for part in parts]
    thetas = [[value, *(lat.low for lat in task.latents[1:])] for value in (low, *values, *[low] * len(parts))]
    batch, action = BatchEnv(task, len(thetas)), np.repeat(actions(task, 1, 1)[0], len(thetas), 0)
    last = action[-len(parts) :]
    last[:] = np.arange(len(parts))[:, None] % task.n_actions if task.n_actions else last * (1 - parts)[:, None]
    batch.reset([0] * batch.n, {"theta": thetas})
    p, candidates = np.split(batch.simulator.outcome(batch.state, action), [1])
    return p, candidates[(candidates != p).any(-1)]


def _density_ratio(what: str, fall: Array, pair: str) -> None:
    """Densities q / p = exp(-fall) at draws from p have mean 1, and are not all the same. what, pair: for messages."""
    ratio = np.exp(-fall)
    off, error = abs(ratio.mean() - 1), ratio.std() / np.sqrt(len(ratio))
    require(off < 4 * error + 1e-9, f"{what}: the mean ratio of densities is {ratio.mean():.4f}, not 1")
    require(error > 0, f"{what} is the same for two {pair}")


def log_prob_is_the_density_of_the_noise(task: Task) -> None:
    """Log_prob is the density of apply_noise: E_p[q(s') / p(s')] = 1 for another outcome's q, over 4,000 draws."""
    needs_likelihood(task)
    m, p, candidates = 4000, *_outcomes(task)
    if not len(candidates):
        raise Skipped("neither theta nor the action changes the first step's outcome")
    drawn = task.apply_noise(np.repeat(p, m, 0), _noise(task, m))
    few = drawn[:100]
    spread = [(task.log_prob(few, p) - task.log_prob(few, each[None])).std() for each in candidates]
    q = candidates[[np.abs(np.log(np.maximum(spread, 1e-9))).argmin()]]  # about a standard deviation off
    if isinstance(task, MujocoTask):  # at most one, so that the ratio's variance is finite
        distance = np.sqrt(2 * (task.log_prob(p, p) - task.log_prob(p, q)))
        q = p + (q - p) / max(1, distance[0])
    then, counts = np.unique(drawn, axis=0, return_counts=True)
    if len(then) <= FEW:  # these have probabilities, which do not need another outcome
        stated, share = np.exp(task.log_prob(then, p)), counts / m
        i = np.abs(share - stated).argmax()
        often = f"{stated[i]:.3f} to {then[i].tolist()}, which is {share[i]:.3f} of {m:,} next states"
        error = np.sqrt(share[i] * (1 - share[i]) / m)
        require(abs(share[i] - stated[i]) < 5 * error + 1e-9, f"log_prob of {task.name} gives {often}")
    ratio = task.log_prob(drawn, p) - task.log_prob(drawn, q)
    _density_ratio(f"log_prob of {task.name}", ratio, "outcomes that differ")
    if isinstance(task, MujocoTask):  # half of a chi-squared, a degree of freedom for each noisy coordinate
        fall = task.log_prob(p, p) - task.log_prob(drawn, p)
        right, bound = task.noise.size / 2, 4 * fall.std() / np.sqrt(m)
        message = f"log_prob of {task.name} falls by {fall.mean():.3f} under its own noise; it must be {right:g}"
        require(abs(fall.mean() - right) < bound, message)


def log_sense_is_the_density_of_the_readings(task: Task) -> None:
    """Log_sense is normalised, and is the density of what sensors read, under two nearby thetas in 4,000 states.

    A task that states that theta moves no state must hold to it, and have readings that depend on theta.
    """
    needs_likelihood(task)
    batch, m = BatchEnv(task, 50), 4000
    thetas = task.theta_grid(9)[[0, -1]]
    batch.reset(0)
    action = actions(task, 1, 1)[0]
    outcomes = task.outcome(np.repeat(batch.state[:1], 2, 0), np.repeat(action, 2, 0), thetas)
    if not task.moves_state:
        same(outcomes[1], outcomes[0], f"outcomes of thetas {thetas.tolist()}, which is said to move no state,")
    state = np.zeros((0, batch.state.shape[1]))
    for action in actions(task, batch.n, m // batch.n):
        batch.step(action)
        state = np.concatenate([state, batch.state])
    drawn = task.sense(state.copy(), np.repeat(thetas[:1], m, 0), _noise(task, m))
    if (drawn == state).all():
        require(task.moves_state, f"theta of {task.name} moves no state, and its sensors read nothing")
        raise Skipped("this task has no sensors of theta")
    near = thetas[1]
    for _ in range(30):  # until the ratio's variance is small
        fall = task.log_sense(drawn, thetas[0]) - task.log_sense(drawn, near)
        if fall.mean() < 0.3:
            break
        near = thetas[0] + (near - thetas[0]) / 2
    _density_ratio(f"log_sense of {task.name}", fall, "thetas")


CHECKS = (log_prob_is_the_density_of_the_noise, log_sense_is_the_density_of_the_readings)
