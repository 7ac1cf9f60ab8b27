"""Trials as Minari data sets: episodes with the number of their trial in their metadata and, for scoring, theta."""

import os
import warnings
from collections.abc import Callable
from operator import index
from pathlib import Path
from typing import Any
from unittest.mock import patch

import gymnasium
import numpy as np
from gymnasium import spaces

from deconfounded.envs import BatchEnv, InputError, Task
from deconfounded.envs.streams import Array
from deconfounded.envs.support.spaces import action_sizes
from deconfounded.experts.rollout import Agent, Trials, run_trials

ARRAYS = ("observations", "actions", "rewards", "terminations", "truncations")
Collected = tuple[Trials, Array, list[list[list[Array]]]]  # trials, theta, and rewards and ends [N] by episode and step
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


def collect(task: Task, n: int, agent: Callable[[BatchEnv], Agent], seed: int) -> Collected:
    """Trials of the agent made for n environments, their theta [N, E, L], and each step's reward and ends."""
    env = _RecordingEnv(task, n)
    trials, _, theta = run_trials(env, agent(env), task.episodes, seed)
    return trials, theta, env.steps


def write(
    folder: Path, task: Task, name: str, collected: Collected, algorithm: str, scores: tuple[float, float]
) -> Path:
    """Write a Minari data set `deconf/<task>/<name>-v<version>` under a folder; returns its path.

    collected: the result of `collect`. scores: mean returns of an episode by random actions and by the expert, for
    Minari's normalisation. Raises InputError if the data set exists already.
    """
    folder = folder.resolve()  # Minari would join a relative path to itself
    with patch.dict(os.environ, MINARI_DATASETS_PATH=str(folder)), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # about authors and links, which are optional
        import minari
        from minari.data_collector import EpisodeBuffer

        trials, theta, steps = collected
        identity = f"deconf/{task.name}/{name}-v{task.version}"
        place = folder / identity
        if place.exists():
            raise InputError(f"{place} is there already; remove it, or give another --out")
        discrete, buffers, metadata = trials.actions > 0, list[EpisodeBuffer](), list[dict[str, Any]]()
        n, episodes, horizon = trials.mask.shape
        for b in range(n):
            for e in range(episodes):
                length = int(trials.mask[b, e].sum())
                obs, action = trials.obs[b, e, : length + 1], trials.action[b, e, :length]
                action = action[:, 0].astype(np.int64) if discrete else action
                ended = [np.array([step[i][b] for step in steps[e][:length]]) for i in range(3)]
                arrays = dict(zip(ARRAYS, (obs, action, *ended), strict=True))
                buffers.append(EpisodeBuffer(id=len(buffers), infos={}, **arrays))
                metadata.append({"trial": b, "episode": e, "theta": theta[b, e]})
        about: dict[str, Any] = {"algorithm_name": algorithm, "ref_min_score": scores[0], "ref_max_score": scores[1]}
        about["description"] = f"{task.name}: {n} trials, each of {episodes} episodes under one theta"
        spec = gymnasium.spec(task.gym_id)
        dataset = minari.create_dataset_from_buffers(identity, buffers, env=spec, data_format="hdf5", **about)
        dataset.storage.update_metadata({HORIZON: horizon})
        dataset.storage.update_episode_metadata(metadata)
    return place


def read(source: Path | str) -> tuple[Trials, Array | None]:
    """Trials of a data set's folder, and its thetas [B, E, L], for scoring alone, or None if it has none.

    Observations of one number are one column, discrete ones are one-hot. Raises InputError if there is no data set, if
    its episodes' metadata do not name their trial, and for what cannot be [B, E, T + 1, O] and [B, E, T, A].
    """
    if not isinstance(source, str | Path):
        raise InputError(f"a data set was {source!r}; it must be the path of its folder")
    try:
        import minari
    except ModuleNotFoundError:
        raise InputError(f"{source} needs Minari; `pip install deconfounded-imitation[data]` brings it") from None

    folders = [file.parent for file in sorted(Path(source).rglob("metadata.json")) if file.parent.name == "data"]
    if len(folders) != 1:
        raise InputError(f"{source} holds {len(folders)} Minari data sets; give the folder of one")
    try:
        dataset = minari.MinariDataset(folders[0])
        metadata = list(dataset.storage.get_episode_metadata(dataset.episode_indices))
        episodes = list(dataset.iterate_episodes())
        named = [entry for entry in metadata if {"trial", "episode"} <= set(entry)]
        places = [(index(entry["trial"]), index(entry["episode"])) for entry in named]
        t = int(dataset.storage.metadata.get(HORIZON, max((len(episode.rewards) for episode in episodes), default=0)))
        theta = [np.asarray(entry["theta"], float) for entry in metadata if entry.get("theta") is not None]
    except Exception as error:
        raise InputError(f"the data set in {source} cannot be read: {' '.join(str(error).split())}") from None
    if not places or len(places) < len(metadata):
        raise InputError(f"episodes of {source} do not say which `trial` and `episode` they are, in their metadata")
    b, e = (1 + max(numbers) for numbers in zip(*places, strict=True))
    if sorted(places) != [(i, j) for i in range(b) for j in range(e)]:
        raise InputError(f"{source} holds {len(metadata)} episodes; every trial of {b} must have each of {e} once")
    if (longest := max(len(episode.rewards) for episode in episodes)) > t:
        raise InputError(f"an episode of {source} has {longest} steps; its {HORIZON}, {t}, must be at least that")
    if len({value.shape for value in theta}) > 1:
        raise InputError(f"thetas of {source} are of several shapes; each must have a number for each latent")
    obs, action = [np.zeros(0)] * len(metadata), [np.zeros(0)] * len(metadata)
    mask = np.zeros((b, e, t), bool)
    for episode, (i, j) in zip(episodes, places, strict=True):
        n = len(episode.rewards)
        mask[i, j, :n] = True
        of = f"of episode {j} of trial {i} in {source}"
        seen = _rows(f"observations {of}", episode.observations, dataset.observation_space, n + 1, True)
        obs[i * e + j] = np.pad(seen, ((0, t - n), (0, 0)))
        done = _rows(f"actions {of}", episode.actions, dataset.action_space, n, False)
        action[i * e + j] = np.pad(done, ((0, t - n), (0, 0)))
    _, n_actions = action_sizes(dataset.action_space)
    trials = Trials(np.reshape(obs, (b, e, t + 1, -1)), np.reshape(action, (b, e, t, -1)), mask, n_actions)
    if len(theta) < len(metadata):
        return trials, None
    return trials, np.stack([theta[places.index((i, j))] for i in range(b) for j in range(e)]).reshape(b, e, -1)


def _rows(what: str, values: Any, space: spaces.Space[Any], n: int, observed: bool) -> Array:
    """n values in a space -> [n, K]. Raises InputError for values and spaces that are not one row a step.

    observed: a discrete value is then one-hot, and else, as an action, one column.
    """
    axes = (0, 1) if observed else (1,)
    box = isinstance(space, spaces.Box) and len(space.shape) in axes
    if not box and not (isinstance(space, spaces.Discrete) and space.start == 0):
        right = "Box of one axis or none" if observed else "Box(-1, 1, (A,))"
        raise InputError(f"{what} are of {space}; they must be of {right}, or Discrete from 0 up")
    if np.shape(values) != (n, *space.shape):  # type: ignore[misc]
        raise InputError(f"{what} have shape {np.shape(values)}; it must be {(n, *space.shape)}")  # type: ignore[misc]
    rows = np.reshape(values, (n, -1))
    if not (observed and isinstance(space, spaces.Discrete)):
        return rows
    if not np.isin(rows, np.arange(space.n)).all():
        raise InputError(f"{what} hold a number that is not one of 0..{space.n - 1}")
    return np.eye(int(space.n))[rows[:, 0].astype(int)]
