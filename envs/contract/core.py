"""The contract as a library of named checks, which any task can be tested by.

    for check in CONTRACT.values():
        check(task)

A check returns nothing; or it raises AssertionError or InputError with a message, or Skipped if it does not apply or
cannot be made here. Checks use the task alone, not the registry. Those of interfaces are in protocols.py, those of
densities in densities.py, those of MuJoCo tasks in physics.py.
"""

import re
from collections.abc import Callable
from typing import Any

import numpy as np

from deconfounded.envs.adapters import GymEnv, GymVectorEnv
from deconfounded.envs.batch import BatchEnv
from deconfounded.envs.contract import densities, physics, protocols
from deconfounded.envs.contract.probe import (
    Skipped,
    actions,
    far_thetas,
    needs_likelihood,
    observations,
    refused,
    require,
    same,
    streams,
)
from deconfounded.envs.physics import MujocoTask
from deconfounded.envs.task import Array, Task

STARTS = 12


def no_leak(task: Task) -> None:
    """First observations and infos are identical for the same seed under different thetas."""
    env = GymEnv(task)
    thetas = far_thetas(task)
    first = env.reset(seed=3, options={"theta": thetas[0]})[0]
    for theta in thetas:
        obs, info = env.reset(seed=3, options={"theta": theta})
        leaks = " ".join(name for name, x, y in zip(task.observation, obs, first, strict=True) if x != y)
        same(obs, first, f"first observations of theta {theta} and {thetas[0]}, of the same seed, ({leaks})")
        require(info == {}, f"the info of reset was {info}; it must be empty")
    info = env.step(env.action_space.sample())[4]
    require(info == {}, f"the info of step was {info}; it must be empty")


def effect(task: Task) -> None:
    """Different thetas give different trajectories for the same seed and actions; if the tier is None, identical ones.

    Actions are random, or constant along an axis, since a Tier 3 task may show theta only where one goes on purpose; an
    effect from one of several starts is enough, since latents may be those of places.
    """
    plans, thetas = actions(task, 1, task.horizon), far_thetas(task)
    alike = np.ones(len(thetas) - 1, bool)
    if isinstance(task, MujocoTask):
        constant = np.eye(task.action_width)[None]
        plans = np.concatenate([plans, np.repeat(constant, task.horizon, 0)], 1)
    j, p = len(thetas), plans.shape[1]
    for seed in range(3, 3 + (STARTS if task.tier else 1)):
        runs = observations(task, np.tile(plans, (1, j, 1)), [seed] * (j * p), theta=np.repeat(thetas, p, 0))
        runs = runs.reshape(len(runs), j, p, -1)
        alike &= (runs[:, 1:] == runs[:, :1]).all((0, 2, 3))
        if not alike.any():
            break
    if task.tier is None:
        require(alike.all(), "theta changes a trajectory, and the tier is None: nothing may depend on theta")
    else:
        of = f"thetas {thetas[1:][alike].tolist()} have the trajectories of {thetas[0].tolist()}"
        require(not alike.any(), f"{of}; theta must have an effect")


def privileged_view(task: Task) -> None:
    """The privileged view is the observation with what the expert sees of theta appended, encoded."""
    plain, privileged = GymEnv(task), GymEnv(task, privileged=True)
    obs, seen = plain.reset(seed=5)[0], privileged.reset(seed=5)[0]
    same(seen[: len(obs)], obs, "observations with and without the privileged view")
    encoded, appended = task.seen_theta(obs[None], plain.batch.theta)[0], seen[len(obs) :]
    equal = appended.shape == encoded.shape and np.allclose(appended, encoded, rtol=1e-6, atol=0)
    require(equal, f"the privileged view appends {appended}; it must be {encoded}, the encoded theta")


def keep_theta(task: Task) -> None:
    """A trial keeps its theta, but for drift and switches, with new start or noise; the next one has a new theta."""
    batch = BatchEnv(task, 16)
    batch.reset(1)
    theta = batch.theta.copy()
    first = [batch.step(action)[0] for action in actions(task, 16, 3)]
    if task.switches:
        theta = batch.path[:, -1].copy()
    batch.reset(options={"keep_theta": True})
    for i, latent in enumerate(task.latents):
        before, after = theta[:, i], batch.theta[:, i]
        if latent.drift:
            require((before != after).all(), f"{latent.name}, which drifts, stood still from one episode to the next")
        else:
            same(after, before, f"{latent.name} before and after a reset with keep_theta")
    again = [batch.step(action)[0] for action in actions(task, 16, 3)]
    require((np.array(first) != np.array(again)).any(), "two episodes of a trial are the same: neither start nor noise")
    batch.reset()
    require((batch.theta != theta).any(), "a reset without keep_theta drew the theta of the trial before")


def theta_follows_its_distribution(task: Task) -> None:
    """Thetas, drawn or drifted, follow p(theta): Kolmogorov-Smirnov distance of 2,000 draws below .04 (p = .003)."""
    needs_likelihood(task)
    draws = task.sample_theta(streams(*range(2000)))
    if task.drifts:
        draws = task.drifted(draws, streams(*range(2000, 4000)))
    for i, latent in enumerate(task.latents):
        if latent.distribution == "categorical":
            counts = (draws[:, i, None] == latent.grid(0)).mean(0)
            off = np.abs(counts - 1 / latent.features).max()
        else:
            sorted_cdf = np.sort(latent.cdf(draws[:, i]))
            off = np.abs(sorted_cdf - (np.arange(2000) + 0.5) / 2000).max()
        require(off < 0.04, f"2,000 draws of {latent.name} are {off:.3f} off its distribution; it must be below .04")


def any_batch_size(task: Task) -> None:
    """An environment's run depends on its own seed alone, to the bit, whatever the batch size."""
    acts = actions(task, 5, task.horizon)
    together = observations(task, acts, 11)
    for i in (0, 4):
        alone = observations(task, acts[:, i : i + 1], 11 + i)
        same(together[:, i], alone[:, 0], f"runs of seed {11 + i} among five and alone")


def episodes_repeat(task: Task) -> None:
    """The same seeds give an environment the same episode again: nothing of the one before is left, to the bit.

    A simulator that draws from a generator of its own, which its `reset` does not seed, has another episode.
    """
    simulator, row, acts = task.simulator(1), np.arange(1), actions(task, 1, task.horizon)
    simulator.set_theta(0, task.sample_theta(streams(5))[0])

    def episode() -> tuple[list[Array], list[Array]]:
        start, noise = task.init_state(streams(6)), task.sample_noise(streams(7))
        states = [simulator.start(row, start, noise)]
        for action, drawn in zip(acts, noise[0], strict=True):
            states.append(task.apply_noise(simulator.outcome(states[-1], action, row), drawn[None]))
            if task.terminated(states[-1])[0] or task.truncated(states[-1])[0]:
                break
        moves = zip(states[:-1], acts, states[1:], strict=False)
        rewards = [task.reward(before, action, after, simulator.theta) for before, action, after in moves]
        return [task.observe(state) for state in states], rewards

    for what, first, again in zip(("observations", "rewards"), episode(), episode(), strict=True):
        same(first, again, f"{what} of two episodes of an environment with the same seeds")
    simulator.close()


def seed_streams(task: Task) -> None:
    """Environment i of seed s draws theta, start and noise from children of SeedSequence(s + i), in this order."""
    batch = BatchEnv(task, 2)
    batch.reset(20)
    for i in range(2):
        theta, start, _ = map(streams, np.random.SeedSequence(20 + i).spawn(3))  # type: ignore[arg-type]
        same(batch.theta[i], task.sample_theta(theta)[0], "theta and what the seed's first stream draws")
        if task.has_likelihood:  # else the stream draws a seed
            same(batch.state[i], task.init_state(start)[0], "the start and what the seed's second stream draws")


def seed_kinds(task: Task) -> None:
    """A seed is an integer from 0 up, of any type, or a sequence with a seed for each environment."""
    batch = BatchEnv(task, 2)
    first = batch.reset(3)
    kinds: tuple[Any, ...] = (np.int64(3), [3, 4])
    for kind in kinds:
        same(batch.reset(kind), first, f"first observations of seed 3 and {kind!r}")
    for wrong in ([1], -1):
        with refused(f"seed {wrong} of two environments", "seed was"):
            batch.reset(wrong)
    env = GymEnv(task)
    same(env.reset(seed=np.int64(3))[0], first[0], "first observations of seed 3 in a batch and in a GymEnv")  # type: ignore[arg-type]
    with refused("seed -1 of a GymEnv", "seed was"):
        env.reset(seed=-1)


def forced_theta_moves_nothing_else(task: Task) -> None:
    """Start and noise depend on the seed alone: setting the theta that would have been drawn changes no bit."""
    acts, batch = actions(task, 4, 10), BatchEnv(task, 4)
    batch.reset(2)
    drawn, forced = observations(task, acts, 2), observations(task, acts, 2, theta=batch.theta)
    same(drawn, forced, "runs of the same seed with theta drawn and forced")


def starts_vary_and_nothing_is_constant(task: Task) -> None:
    """No observation is constant over whole episodes, and MuJoCo tasks have random initial states."""
    seen = observations(task, actions(task, 8, task.horizon), 0)
    still = [name for name, ptp in zip(task.observation, np.ptp(seen, (0, 1)), strict=True) if not ptp > 0]
    if still and not task.has_likelihood:
        raise Skipped(f"observation {', '.join(still)} never moved; it tells nothing")
    require(not still, f"observation {', '.join(still)} of {task.name} never moved; it must tell something")
    varied = not isinstance(task, MujocoTask) or (seen[0] != seen[0, 0]).any()
    require(varied, "eight episodes started with the same observations; init_state must vary")


def observations_share_no_memory(task: Task) -> None:
    """Later steps do not change an observation that was returned before."""
    env = GymEnv(task)
    first, _ = env.reset(seed=0)
    copy = first.copy()
    for _ in range(3):
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:  # as where an episode is one step
            env.reset()
    same(first, copy, "the first observation before and after three steps")


def theta_out_of_bounds(task: Task) -> None:
    """A theta out of bounds, NaN or of the wrong length is refused; the message gives the bounds."""
    needs_likelihood(task)
    env, latent = GymEnv(task), task.latents[0]
    says = rf"^{re.escape(latent.name)} of {task.name} was .*must be .*{re.escape(f'{latent.high:g}')}"
    for wrong in (latent.high + 1, latent.low - 1, float("nan")):
        with refused(f"{latent.name} {wrong:g}", says):
            env.reset(options={"theta": [wrong] + [lat.low for lat in task.latents[1:]]})
    with refused("a theta of too many numbers", "must be"):
        env.reset(options={"theta": [0.0] * (len(task.latents) + 6)})
    if len(task.latents) > 1:
        for few in (latent.low, [latent.low]):
            with refused("a theta of too few numbers", "must be"):
                env.reset(options={"theta": few})


def wrong_actions(task: Task) -> None:
    """Actions of a wrong shape, NaN, or that are no numbers are refused."""
    env = GymVectorEnv(task, 2)
    env.reset(seed=0)
    good = actions(task, 2, 1)[0]
    for wrong, says in ((good[:1], "shape"), (np.full_like(good, np.nan), "NaN"), ("left", "must be numbers")):
        with refused(f"action {wrong!r} of two environments", says):
            env.step(wrong)


def reset_options(task: Task) -> None:
    """Unknown options, keep_theta and step before the first reset are refused."""
    env = GymEnv(task)
    with refused("keep_theta", "before the first reset"):
        env.reset(options={"keep_theta": True})
    with refused("option thetas", "unknown"):
        env.reset(options={"thetas": [0]})
    with refused("step", "before the first reset"):
        GymEnv(task).step(env.action_space.sample())


CONTRACT: dict[str, Callable[[Task], None]] = {
    check.__name__: check
    for check in (
        *protocols.CHECKS,
        *(no_leak, effect, privileged_view, keep_theta, theta_follows_its_distribution),
        *(any_batch_size, episodes_repeat, seed_streams, seed_kinds, forced_theta_moves_nothing_else),
        *(starts_vary_and_nothing_is_constant, observations_share_no_memory),
        *(theta_out_of_bounds, wrong_actions, reset_options),
        *densities.CHECKS,
        *physics.CHECKS,
    )
}
