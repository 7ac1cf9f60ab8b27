"""Trials as Minari data sets: episodes with the number of their trial in their metadata and, for scoring, theta."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from deconfounded.envs import BatchEnv, InputError, Task
from deconfounded.envs.streams import Array
from deconfounded.envs.support.spaces import action_sizes
from deconfounded.experts.rollout import Agent, Trials, run_trials

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
    """Trials of an agent in n environments, their theta [N, E, L], and the reward and ends of each step.

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
    folder = folder.resolve()  # Minari would join a relative path to itself
    with _root(folder), warnings.catch_warnings():
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
