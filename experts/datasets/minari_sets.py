"""Minari data sets. Ours have the number of each episode's trial in its metadata and, for scoring, theta."""

import os
import re
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from operator import index
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from deconfounded.envs import BatchEnv, InputError, Task
from deconfounded.envs.streams import Array
from deconfounded.envs.support.spaces import action_sizes
from deconfounded.experts.agent import Agent
from deconfounded.experts.datasets.table import EXTRA, Column, Table, of_episodes, spread
from deconfounded.experts.rollout import run_trials
from deconfounded.experts.trials import Trials

HORIZON = "deconf_horizon"  # key in the data set's metadata of T, which every episode may end before


class _RecordingEnv(BatchEnv):
    """Environments that record the rewards and ends [N] of each step, by episode, which Trials do not hold."""

    def reset(self, *args: Any, **kwargs: Any) -> Any:
        self.steps = [*getattr(self, "steps", []), []]
        return super().reset(*args, **kwargs)

    def step(self, action: object) -> Any:
        then, *ended = super().step(action)
        self.steps[-1].append(ended)
        return (then, *ended)


def collect(
    task: Task, n: int, agent: Callable[[BatchEnv], Agent], seed: int
) -> tuple[Trials, Array, list[list[list[Array]]]]:
    """Trials of an agent in n environments, their theta (`Rollout`), and the reward and ends of each step.

    agent: a function from the environments to the Agent.
    """
    env = _RecordingEnv(task, n)
    trials, _, theta = run_trials(env, agent(env), task.episodes, seed)
    return trials, theta, env.steps


def write(
    folder: Path,
    task: Task,
    name: str,
    collected: tuple[Trials, Array, Any],
    algorithm: str,
    scores: tuple[float, float],
) -> Path:
    """Write a Minari data set `deconf/<task>/<name>-v<version>` under a folder; returns its path.

    collected: the result of `collect`. scores: mean returns of an episode by random actions and by the expert, for
    Minari's normalisation. Raises InputError if the data set exists already.
    """
    if not re.fullmatch(r"[-\w]+", name, re.ASCII):
        raise InputError(f"name of the data set was {name!r}; it must be of letters, digits, - and _")
    folder = folder.resolve()  # Minari would join a relative path to itself
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".", dir=folder) as aside, _root(Path(aside)), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # about authors and links, which are optional
        import minari
        from minari.data_collector import EpisodeBuffer

        trials, theta, steps = collected
        identity = f"deconf/{task.name}/{name}-v{task.version}"
        place = folder / identity
        if place.exists():
            raise InputError(f"{place} is there already; remove it, or give another --out")
        discrete, buffers, metadata = trials.actions > 0, list[EpisodeBuffer](), list[dict[str, Any]]()
        for b in range(len(trials)):
            for e in range(trials.mask.shape[1]):
                length = int(trials.mask[b, e].sum())
                reward, terminated, truncated = (np.array([step[i][b] for step in steps[e][:length]]) for i in range(3))
                action = trials.action[b, e, :length]
                buffers.append(
                    EpisodeBuffer(
                        id=len(buffers),
                        observations=trials.obs[b, e, : length + 1],  # type: ignore[arg-type]
                        actions=action[:, 0].astype(np.int64) if discrete else action,  # type: ignore[arg-type]
                        rewards=reward,  # type: ignore[arg-type]
                        terminations=terminated,  # type: ignore[arg-type]
                        truncations=truncated,  # type: ignore[arg-type]
                        infos={},
                    )
                )
                metadata.append({"trial": b, "episode": e, "theta": theta[b, e]})
        dataset = minari.create_dataset_from_buffers(
            identity,
            buffers,
            env=gymnasium.spec(task.gym_id),
            algorithm_name=algorithm,
            description=f"{task.name}: {len(trials)} trials, each of {trials.mask.shape[1]} episodes under one theta",
            ref_min_score=scores[0],
            ref_max_score=scores[1],
            data_format="hdf5",
        )
        dataset.storage.update_metadata({HORIZON: trials.mask.shape[2]})
        dataset.storage.update_episode_metadata(metadata)
        place.parent.mkdir(parents=True, exist_ok=True)
        for described in Path(aside).rglob("namespace_metadata.json"):
            if not (there := folder / described.relative_to(aside)).exists():
                described.rename(there)
        (Path(aside) / identity).rename(place)  # whole, or not at all
    return place


def read_minari(source: Path | str) -> Table:
    """A data set's folder: observations of numbers, actions, metadata of episodes; without theta.

    Observations of one number are one column, discrete ones are one-hot, those of a dictionary `key.0` on. Where every
    episode's metadata name its `trial` and `episode`, episodes are in that order, and `trial` says what a trial is.
    Raises InputError for anything else, and for spaces that are not a row of numbers a step.
    """
    dataset, metadata, episodes = _opened(source)
    places = [(entry["trial"], entry["episode"]) for entry in metadata if {"trial", "episode"} <= set(entry)]
    named, horizon = len(places) == len(metadata), 0
    if named:
        horizon = int(dataset.storage.metadata.get(HORIZON, 0))
        order = _order(source, places)
        episodes, metadata = [episodes[i] for i in order], [metadata[i] for i in order]
        if horizon and (longest := max(len(episode.rewards) for episode in episodes)) > horizon:
            raise InputError(
                f"an episode of {source} has {longest} steps; its {HORIZON}, {horizon}, must be at least that"
            )
    width, n_actions = action_sizes(dataset.action_space)
    action = ["action"] if width == 1 else [f"action.{i}" for i in range(width)]
    parts = list[dict[str, Column]]()
    for i, episode in enumerate(episodes):
        of = (
            f"of episode {i} in {source}"
            if not named
            else "of episode {1} of trial {0} in {2}".format(
                *(metadata[i][key] for key in ("trial", "episode")), source
            )
        )
        n = len(episode.rewards)
        seen = _observed(of, episode.observations, dataset.observation_space, n + 1)
        done = _rows(f"actions {of}", episode.actions, dataset.action_space, n, False)
        rows = np.append(np.asarray(done, float), np.full((1, done.shape[1]), np.nan), 0)
        parts.append(seen | dict(zip(action, rows.T, strict=True)))
    lengths = [len(next(iter(part.values()))) for part in parts]
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    obs = tuple(name for name in columns if name not in action)
    attributes = [{key: value for key, value in entry.items() if key != "theta"} for entry in metadata]
    columns |= {name: x for name, x in of_episodes(attributes, lengths).items() if name not in columns}
    limits = {}
    if isinstance(dataset.action_space, spaces.Box):
        bounds = zip(dataset.action_space.low, dataset.action_space.high, strict=True)
        limits = {
            name: (float(a), float(b)) for name, (a, b) in zip(action, bounds, strict=True) if np.isfinite([a, b]).all()
        }
    boundaries = np.repeat(np.arange(len(parts)), lengths)
    trial = "trial" if named else None
    return Table(str(source), columns, boundaries, obs, tuple(action), trial, limits, n_actions, horizon)


def read_theta(source: Path | str) -> Array | None:
    """Thetas of a data set that `write` wrote, as of a `Rollout`, for scoring alone; None if it has none."""
    _, metadata, _ = _opened(source)
    if not all({"trial", "episode", "theta"} <= set(entry) for entry in metadata):
        return None
    order = _order(source, [(entry["trial"], entry["episode"]) for entry in metadata])
    theta = [np.asarray(metadata[i]["theta"], float) for i in order]
    if len({value.shape for value in theta}) > 1:
        raise InputError(f"thetas of {source} are of several shapes; each must have a number for each latent")
    return np.stack(theta).reshape(1 + int(max(entry["trial"] for entry in metadata)), -1, *theta[0].shape)


def _opened(source: Path | str) -> tuple[Any, list[dict[str, Any]], list[Any]]:
    """The data set, and the metadata and data of its episodes."""
    if not isinstance(source, str | Path):
        raise InputError(f"a data set was {source!r}; it must be the path of its folder")
    try:
        import minari
    except ModuleNotFoundError:
        raise InputError(f"{source} needs Minari; {EXTRA}") from None
    folders = [file.parent for file in sorted(Path(source).rglob("metadata.json")) if file.parent.name == "data"]
    if len(folders) != 1:
        raise InputError(f"{source} holds {len(folders)} Minari data sets; give the folder of one")
    try:
        dataset = minari.MinariDataset(folders[0])
        metadata = list(dataset.storage.get_episode_metadata(dataset.episode_indices))
        episodes = list(dataset.iterate_episodes())
    except Exception as error:
        raise InputError(f"the data set in {source} cannot be read: {' '.join(str(error).split())}") from None
    if not episodes:
        raise InputError(f"the data set in {source} holds no episodes")
    return dataset, metadata, episodes


def _order(source: Path | str, named: list[tuple[Any, Any]]) -> list[int]:
    """Indices of episodes by trial and episode. Raises InputError unless every trial has each episode once."""
    try:
        places = [(index(trial), index(episode)) for trial, episode in named]
    except TypeError as error:
        raise InputError(f"the data set in {source} cannot be read: {error}") from None
    b, e = (1 + max(numbers) for numbers in zip(*places, strict=True))
    if sorted(places) != [(i, j) for i in range(b) for j in range(e)]:
        raise InputError(f"{source} holds {len(places)} episodes; every trial of {b} must have each of {e} once")
    return sorted(range(len(places)), key=places.__getitem__)


def _observed(of: str, values: Any, space: spaces.Space[Any], n: int, name: str = "observation") -> dict[str, Column]:
    """Columns of n observations; of a dictionary, parts that are rows of numbers."""
    if not isinstance(space, spaces.Dict):
        return spread(name, _rows(f"observations {of}", values, space, n, True))
    columns: dict[str, Column] = {}
    for key, part in space.items():
        if len(part.shape or ()) < 2:
            columns |= _observed(of, values[key], part, n, f"{name}.{key}")
    if not columns:
        raise InputError(f"observations {of} are of {space}; one must be of Box of one axis or none")
    return columns


def _rows(what: str, values: Any, space: spaces.Space[Any], n: int, observed: bool) -> Array:
    """n values in a space -> [n, K]. Raises InputError for values and spaces that are not one row a step.

    observed: a discrete value is then one-hot, and else, as an action, one column.
    """
    axes = (0, 1) if observed else (1,)
    box = isinstance(space, spaces.Box) and len(space.shape) in axes
    if not box and not (isinstance(space, spaces.Discrete) and space.start == 0):
        right = "Box of one axis or none" if observed else "Box of one axis"
        raise InputError(f"{what} are of {space}; they must be of {right}, or Discrete from 0 up")
    if np.shape(values) != (n, *space.shape):  # type: ignore[misc]
        raise InputError(f"{what} have shape {np.shape(values)}; it must be {(n, *space.shape)}")  # type: ignore[misc]
    rows = np.reshape(values, (n, -1))
    if not (observed and isinstance(space, spaces.Discrete)):
        return rows
    if not np.isin(rows, np.arange(space.n)).all():
        raise InputError(f"{what} hold a number that is not one of 0..{space.n - 1}")
    return np.eye(int(space.n))[rows[:, 0].astype(int)]


@contextmanager
def _root(folder: Path) -> Iterator[None]:
    """Context in which Minari's folder of data sets is the given one."""
    before = os.environ.get("MINARI_DATASETS_PATH")
    os.environ["MINARI_DATASETS_PATH"] = str(folder)
    try:
        yield
    finally:
        if before is None:
            del os.environ["MINARI_DATASETS_PATH"]
        else:
            os.environ["MINARI_DATASETS_PATH"] = before
