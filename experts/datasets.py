"""Trials as Minari data sets, so that data travels: episodes that know their trial and, for scoring, its theta."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from deconfounded.envs import BatchEnv, InputError, Task
from deconfounded.envs.streams import Array
from deconfounded.envs.task import action_sizes
from deconfounded.experts.rollout import Agent, Trials, run_trials

HORIZON = "deconf_horizon"  # of the data set's metadata: T, which no episode need last


class _Noting(BatchEnv):
    """Keeps what Trials do not: rewards and ends [N] of each step, and where episodes began."""

    def reset(self, *args: Any, **kwargs: Any) -> Any:
        self.steps = [*getattr(self, "steps", []), []]
        return super().reset(*args, **kwargs)

    def step(self, action: object) -> Any:
        then, *ended = super().step(action)
        self.steps[-1].append(ended)
        return (then, *ended)


def collect(task: Task, n: int, agent: Any, seed: int) -> tuple[Trials, Array, list[list[list[Array]]]]:
    """n trials of an agent, made for an environment -> Trials, theta [N, E, L], and reward and ends of each step."""
    env = _Noting(task, n)
    made: Agent = agent(env)
    trials, _, theta = run_trials(env, made, task.episodes, seed)
    return trials, theta, env.steps


def write(
    folder: Path,
    task: Task,
    name: str,
    collected: tuple[Trials, Array, Any],
    algorithm: str,
    scores: tuple[float, float],
) -> Path:
    """A Minari data set `deconf/<task>/<name>-v<version>` under a folder; returns where it is.

    scores: mean returns of an episode by random actions and by the expert, which Minari normalises with. Raises
    InputError if it is there already.
    """
    folder = folder.resolve()  # Minari joins a relative one to itself
    with _root(folder), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of authors and links that it would like to be told
        import minari
        from minari.data_collector import EpisodeBuffer

        trials, theta, steps = collected
        identity = f"deconf/{task.name}/{name}-v{task.version}"
        place = folder / identity
        if place.exists():
            raise InputError(f"{place} is there already; remove it, or give another --out")
        discrete, buffers, about = trials.actions > 0, list[EpisodeBuffer](), list[dict[str, Any]]()
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
                about.append({"trial": b, "episode": e, "theta": theta[b, e]})
        made = minari.create_dataset_from_buffers(
            identity,
            buffers,
            env=gymnasium.spec(task.gym_id),
            algorithm_name=algorithm,
            description=f"{task.name}: {len(trials)} trials, each of {trials.mask.shape[1]} episodes under one theta",
            ref_min_score=scores[0],
            ref_max_score=scores[1],
            data_format="hdf5",
        )
        made.storage.update_metadata({HORIZON: trials.mask.shape[2]})
        made.storage.update_episode_metadata(about)
    return place


def read(source: Path | str) -> tuple[Trials, Array | None]:
    """The Trials of a data set's folder, and its thetas [B, E, L] if it has them: those are for scoring alone.

    Raises InputError if there is no data set, or if its episodes do not say which trial they belong to.
    """
    import minari

    places = [file.parent for file in sorted(Path(source).rglob("metadata.json")) if file.parent.name == "data"]
    if len(places) != 1:
        raise InputError(f"{source} holds {len(places)} Minari data sets; give the folder of one")
    try:
        found = minari.MinariDataset(places[0])
        about = list(found.storage.get_episode_metadata(found.episode_indices))
        episodes = list(found.iterate_episodes())
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"the data set in {source} cannot be read: {' '.join(str(error).split())}") from None
    if not episodes or any("trial" not in one or "episode" not in one for one in about):
        raise InputError(f"episodes of {source} do not say which `trial` and `episode` they are, in their metadata")
    b = 1 + max(int(one["trial"]) for one in about)
    e = 1 + max(int(one["episode"]) for one in about)
    if len({(int(one["trial"]), int(one["episode"])) for one in about}) != b * e or len(about) != b * e:
        raise InputError(f"{source} holds {len(about)} episodes; every trial of {b} must have each of {e} once")
    t = int(found.storage.metadata.get(HORIZON, max(len(episode.rewards) for episode in episodes)))
    width, n_actions = action_sizes(found.action_space)
    obs = np.zeros((b, e, t + 1, np.shape(episodes[0].observations)[-1]), np.float32)
    action, mask = np.zeros((b, e, t, width), np.float32), np.zeros((b, e, t), bool)
    for one, episode in zip(about, episodes, strict=True):
        at, n = (int(one["trial"]), int(one["episode"])), len(episode.rewards)
        obs[at][: n + 1], obs[at][n + 1 :] = episode.observations, episode.observations[-1]
        action[at][:n] = np.reshape(episode.actions, (n, width))
        mask[at][:n] = True
    told = {(int(one["trial"]), int(one["episode"])): one.get("theta") for one in about}
    whole = all(value is not None for value in told.values())
    theta = np.array([[told[i, j] for j in range(e)] for i in range(b)]) if whole else None
    return Trials(obs, action, mask, n_actions), theta


@contextmanager
def _root(folder: Path) -> Iterator[None]:
    """Minari keeps its data sets in this folder meanwhile."""
    before = os.environ.get("MINARI_DATASETS_PATH")
    os.environ["MINARI_DATASETS_PATH"] = str(folder)
    try:
        yield
    finally:
        if before is None:
            del os.environ["MINARI_DATASETS_PATH"]
        else:
            os.environ["MINARI_DATASETS_PATH"] = before
