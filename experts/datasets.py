"""Trials as Minari data sets: episodes with the number of their trial in their metadata and, for scoring, theta."""

import os
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import patch

import gymnasium
import numpy as np

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

    Raises InputError if there is no data set, or if its episodes' metadata do not name their trial.
    """
    import minari

    folders = [file.parent for file in sorted(Path(source).rglob("metadata.json")) if file.parent.name == "data"]
    if len(folders) != 1:
        raise InputError(f"{source} holds {len(folders)} Minari data sets; give the folder of one")
    try:
        dataset = minari.MinariDataset(folders[0])
        metadata = list(dataset.storage.get_episode_metadata(dataset.episode_indices))
        episodes = list(dataset.iterate_episodes())
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"the data set in {source} cannot be read: {' '.join(str(error).split())}") from None
    if not episodes or any("trial" not in entry or "episode" not in entry for entry in metadata):
        raise InputError(f"episodes of {source} do not say which `trial` and `episode` they are, in their metadata")
    places = [(int(entry["trial"]), int(entry["episode"])) for entry in metadata]
    b, e = (1 + max(numbers) for numbers in zip(*places, strict=True))
    if len(set(places)) != b * e or len(places) != b * e:
        raise InputError(f"{source} holds {len(places)} episodes; every trial of {b} must have each of {e} once")
    t = int(dataset.storage.metadata.get(HORIZON, max(len(episode.rewards) for episode in episodes)))
    width, n_actions = action_sizes(dataset.action_space)
    obs = np.zeros((b, e, t + 1, np.shape(episodes[0].observations)[-1]), np.float32)
    action, mask = np.zeros((b, e, t, width), np.float32), np.zeros((b, e, t), bool)
    for at, episode in zip(places, episodes, strict=True):
        n = len(episode.rewards)
        obs[at][: n + 1], obs[at][n + 1 :] = episode.observations, episode.observations[-1]
        action[at][:n] = np.reshape(episode.actions, (n, width))
        mask[at][:n] = True
    thetas = {at: entry.get("theta") for at, entry in zip(places, metadata, strict=True)}
    complete = all(value is not None for value in thetas.values())
    theta = np.array([[thetas[i, j] for j in range(e)] for i in range(b)]) if complete else None
    return Trials(obs, action, mask, n_actions), theta
