"""A quick check of a task, before anything is trained or measured: a slip in a task file is reported in one line."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
from gymnasium import spaces

from deconfounded.envs.batch import BatchEnv
from deconfounded.envs.blackbox import BlackBox
from deconfounded.envs.contract.probe import actions, beyond_bounds, observations, streams
from deconfounded.envs.physics import MujocoTask
from deconfounded.envs.streams import Array
from deconfounded.envs.support.errors import InputError, error_line
from deconfounded.envs.support.numbers import check_rounding
from deconfounded.envs.task import Task

TIERS = (1, 2, 3, None)
ALONE = 20  # steps of an environment alone, and beside another


def sentence(error: BaseException) -> str:
    """An error in one line: its message and, unless a check raised it, its type and its place in the source."""
    from_check = isinstance(error, AssertionError) and str(error)
    return " ".join(str(error).split()) if from_check else error_line(error)


@contextmanager
def _part(task: Task, name: str) -> Iterator[None]:
    try:
        yield
    except InputError:
        raise
    except (Exception, SystemExit) as error:
        raise InputError(f"{name} of {task.name}: {sentence(error)}") from error


def check_task(task: Task) -> None:
    """Build a task, take a step, then an episode of random actions. Raises InputError that names what does not fit."""
    if not isinstance(task, Task):
        raise InputError(f"task was {task!r}; it must be a Task, such as envs.get('tilted_cartpole')")
    _check_numbers(task)
    if isinstance(task, BlackBox):
        return _check_world(task)
    if isinstance(task, MujocoTask):
        _check_model(task)
    with _part(task, "action_space"):
        _check_actions(task)
    n, rng = 2, streams(0, 1)
    action = np.zeros((n, task.action_width))
    with _part(task, "observation"):
        _check_observation(task)
    with _part(task, "init_state"):
        state = np.asarray(task.init_state(rng))
        if state.ndim != 2 or len(state) != n:
            raise InputError(_shape(task, "init_state", state, f"({n}, S), a row for each"))
        state.flags.writeable = False  # what is changed in place would change the trial
    with _part(task, "sample_noise"):
        noise = np.asarray(task.sample_noise(rng))
        if noise.shape[:2] != (n, task.horizon):
            raise InputError(_shape(task, "sample_noise", noise, f"({n}, {task.horizon}, ...), of each step"))
    with _part(task, "apply_latent"):
        env = BatchEnv(task, n)
    with _part(task, "outcome"):
        env.simulator.outcome(state[:1], action[:1], np.arange(1))  # alone: a failure in a thread would end the process
        outcome = env.simulator.outcome(state, action)
    with _part(task, "apply_noise"):
        then = np.asarray(task.apply_noise(outcome, noise[:, 0]))
        then.flags.writeable = False
    for name, shape, ask in (
        ("apply_noise", state.shape, lambda: then),
        ("observe", (n, len(task.observation)), lambda: task.observe(state)),
        ("reward", (n,), lambda: task.reward(state, action, then, env.theta)),
        ("terminated", (n,), lambda: task.terminated(then)),
        *[("log_prob", (n,), lambda: task.log_prob(then, outcome))] * task.moves_state,
    ):
        with _part(task, name):
            given = np.asarray(ask())
            if given.shape != shape:
                raise InputError(_shape(task, name, given, shape))
            if not np.isfinite(given).all():
                raise InputError(f"{name} of {task.name} gave {given.tolist()}; it must be finite")
    with _part(task, "an episode"):
        _check_episodes(task)


def _shape(task: Task, name: str, given: Array, right: object) -> str:
    return f"{name} of {task.name} gave an array of shape {given.shape} for two environments; it must be {right}"


def _check_observation(task: Task) -> None:
    """Each observation has a name, and two bounds that its readings can move between."""
    bounds = task.observation
    if not isinstance(bounds, dict) or not bounds or not all(isinstance(name, str) for name in bounds):
        given = f"{bounds!r}"[:80]
        raise InputError(f"observation of {task.name} was {given}; it must be a dict of names and bounds (low, high)")
    for name, (low, high) in bounds.items():
        if not low < high:
            raise InputError(f"bounds of {name} of {task.name} were {low:g} and {high:g}; low must be below high")


def _check_world(task: BlackBox) -> None:
    """The expert acts, and an episode of random actions runs in two environments; errors name the world's part."""
    if (task.sample_theta(streams(0)) != task.sample_theta(streams(0))).any():
        right = "it must draw from `rng` alone, or methods that see theta get another one than the environments have"
        raise InputError(f"sample_theta of {task.name} gave two thetas for one state of its generator; {right}")
    _check_independence(task)
    acted = task.expert_probs if task.n_actions else task.expert_mean
    for by_expert in (False, True):  # it may have a memory that shows where it goes itself alone
        env, asked = BatchEnv(task, 2), list[tuple[Array, Array, Array]]()
        obs, states, masks = env.reset(0), [env.state], []
        for action in actions(task, env.n, task.horizon):
            masks.append(env.alive)
            asked.append((obs, env.theta, once := acted(obs, env.theta)))  # after an episode's end too, as in runs
            obs = env.step(_likeliest(task, once) if by_expert else action)[0]
            states.append(env.state)
            if not env.alive.any():
                break
        env.close()
        check_rounding(task.name, np.stack([task.observe(state) for state in states], 1), np.stack(masks, 1))
        check_expert(f"expert of {task.name}", acted, *(np.concatenate(each) for each in zip(*asked, strict=True)))


Acted = Callable[[Array, Array], Array | None]  # actions [N, A] for observations [N, O] under thetas [N, L]


def check_expert(name: str, acted: Acted, obs: Array, theta: Array, once: Array) -> None:
    """Raise InputError unless an expert's actions `once` are those that it gives if rows come in another order.

    Then it draws no random numbers, remembers nothing, and heeds nothing of other rows.
    """
    order = slice(None, None, -1)
    again = acted(obs[order].copy(), theta[order].copy())
    if again is None or not np.allclose(again, once[order], atol=1e-4):
        right = "it must give the action without noise, by that row of its arguments alone"
        raise InputError(f"{name} gave two actions for one observation; {right}")


def _check_independence(task: BlackBox) -> None:
    """An environment has the same trial alone and beside another one, which is under another theta."""
    acts = actions(task, 2, min(task.horizon, ALONE))
    beside, alone = observations(task, acts, 0)[:, 0], observations(task, acts[:, :1], 0)[:, 0]
    if not np.array_equal(beside, alone, equal_nan=True):
        right = "`make` must give a new one each time, which shares nothing with others and draws from its np_random"
        raise InputError(f"an environment of {task.name} has another trial alone than beside another one; {right}")


def _check_numbers(task: Task) -> None:
    """Amounts that are stated as plain numbers."""
    least = {"horizon": 1, "episodes": 1, "version": 0, **({"substeps": 1} if isinstance(task, MujocoTask) else {})}
    for name, low in least.items():
        value = getattr(task, name)
        if isinstance(value, bool) or not isinstance(value, int) or value < low:
            raise InputError(f"{name} of {task.name} was {value!r}; it must be a whole number, an int, from {low} up")
    if task.tier not in TIERS or isinstance(task.tier, bool):
        raise InputError(f"tier of {task.name} was {task.tier!r}; it must be 1, 2, 3 or None")


def _check_model(task: MujocoTask) -> None:
    """The model compiles, every joint has its noise stated, and there is a camera for pictures."""
    with _part(task, f"the model ({task.name}.xml, or what `spec` makes)"):
        model = task.model
    with _part(task, "process_noise"):
        noise = task.noise
        for i in range(model.njnt):
            if (joint := model.joint(i).name) not in task.process_noise:
                named = f"joint {joint}" if joint else f"joint number {i}, which has no name"
                raise InputError(f"process_noise of {task.name} lacks {named}; it must have every joint, 0 if no noise")
        if not noise.size:
            raise InputError(f"process_noise of {task.name} was 0 throughout; one step must not give theta away")
    cameras = [model.camera(i).name for i in range(model.ncam)]
    if "view" not in cameras:
        given = ", ".join(cameras) or "none"
        raise InputError(f"cameras of {task.name} were {given}; one must be called view, for pictures")


def _check_actions(task: Task) -> None:
    """The action space is one that all agents act in, and the expert's actions have a density."""
    space = task.action_space
    if isinstance(space, spaces.Discrete):
        if space.start != 0:
            raise InputError(f"action_space of {task.name} was {space}; its actions must begin at 0")
        return
    if not isinstance(space, spaces.Box) or len(space.shape) != 1 or (space.low != -1).any() or (space.high != 1).any():
        given, right = " ".join(str(space).split()), "Box(-1, 1, (A,)), which `control` scales, or Discrete"
        raise InputError(f"action_space of {task.name} was {given}; it must be {right}")
    if not 0 < task.expert_noise < np.inf:
        right = "above 0, and finite, or the expert's log_prob is NaN"
        raise InputError(f"expert_noise of {task.name} was {task.expert_noise:g}; it must be {right}")


def _check_episodes(task: Task) -> None:
    """Rewards and observations are within their bounds, in episodes of 16 environments.

    One is of random actions, another of the expert's if that is a closed form, which must act by its arguments alone.
    """
    name, acted = ("expert_probs", task.expert_probs) if task.n_actions else ("expert_mean", task.expert_mean)
    for by_expert in (False, True)[: 1 + task.has_closed_expert]:
        env, asked = BatchEnv(task, 16), list[tuple[Array, Array, Array]]()
        obs = env.reset(0)
        for action in actions(task, 16, task.horizon):
            if beyond := beyond_bounds(task, env.state[env.alive]):
                raise InputError(beyond)
            if by_expert:
                once = _of_expert(task, name, acted, obs, env.theta)
                asked.append((obs.copy(), env.theta.copy(), once))
                action = _likeliest(task, once)
            obs, reward, *_ = env.step(action)
            if (most := reward.max()) > 1 + 1e-9:
                raise InputError(f"reward of {task.name} was {most:g}; it must be at most 1 a step")
            if not env.alive.any():
                break
        if by_expert:
            check_expert(f"{name} of {task.name}", acted, *map(np.concatenate, zip(*asked, strict=True)))


def _likeliest(task: Task, once: Array) -> Array:
    """The actions [N, A] that an expert takes without noise, by its probabilities or means."""
    return once.argmax(-1)[:, None].astype(float) if task.n_actions else once.clip(-1, 1)


def _of_expert(task: Task, name: str, acted: Acted, obs: Array, theta: Array) -> Array:
    """What a closed-form expert gives for each observation: a finite mean, or probabilities of all actions.

    An action of probability 0 would make log-likelihoods infinite.
    """
    with _part(task, name):
        given = acted(obs.copy(), theta.copy())
        rows = np.empty(0) if given is None else np.asarray(given, float)
    shape = len(obs), task.n_actions or task.action_width
    right = f"{shape}, a row for each observation"
    if given is None:
        raise InputError(f"{name} of {task.name} was None, as where a class has no {name}; it must be {right}")
    if rows.shape != shape:
        raise InputError(f"{name} of {task.name} had shape {rows.shape}; it must be {right}")
    fits = (rows > 0).all(-1) & np.isclose(rows.sum(-1), 1) if task.n_actions else np.isfinite(rows).all(-1)
    if not fits.all():
        right = "each must be above 0, and their sum 1" if task.n_actions else "it must be finite"
        raise InputError(f"{name} of {task.name} gave {rows[fits.argmin()].tolist()}; {right}")
    return rows
