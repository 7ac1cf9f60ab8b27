"""One (method, seed): train, evaluate, write one file. What is in the file is finished; what is not is not there."""

from __future__ import annotations

import io
import json
import multiprocessing
import os
import signal
import threading
import time
import zipfile
import zlib
from dataclasses import dataclass
from multiprocessing.queues import Queue
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

import envs
from benchmarks.methods import COST, EVALUATION, LEARNED, METHODS, Context, Preset, stream
from envs.console import write_atomically
from envs.task import Array
from experts.demos import Agent, run_trials

CLIPPED = ("expert", "naive_rnn", "deconfounded")  # recorded for the video, in the first seed


@dataclass(frozen=True)
class Job:
    """What to run, and the folder that its file belongs in."""

    task: str
    preset: Preset
    method: str
    seed: int
    folder: Path

    @property
    def file(self) -> Path:
        """An .npz file."""
        return self.folder / f"{self.method}-{self.seed}.npz"

    @property
    def ticks(self) -> int:
        """Of progress: in proportion to how long a job takes."""
        return 100 * COST.get(self.method, 1)


class Recorder(Agent):
    """Passes everything on to an agent, and keeps states and actions of one trial's episode number task.episodes.

    The trial is the one whose first latent is nearest the quantile: the same for every method, as seeds are shared.
    """

    def __init__(self, agent: Agent, env: envs.BatchEnv, quantile: float = 0.85) -> None:
        self.agent, self.env, self.quantile = agent, env, quantile

    def begin(self, n: int, rng: np.random.Generator) -> None:
        self.agent.begin(n, rng)
        theta = self.env.theta[:, 0]
        self.trial = int(np.abs(theta - np.quantile(theta, self.quantile)).argmin())
        self.episode = 1
        self.states: list[Array] = []
        self.actions: list[Array] = []

    def reset(self) -> None:
        self.agent.reset()
        self.episode += 1

    def act(self, obs: NDArray[np.float32]) -> Array:
        action = self.agent.act(obs)
        if self.episode == self.env.task.episodes and self.env.alive[self.trial]:
            self.states.append(self.env.state[self.trial].copy())
            self.actions.append(action[self.trial])
        return action

    def observe(
        self, obs: NDArray[np.float32], action: Array, next_obs: NDArray[np.float32], alive: NDArray[np.bool_]
    ) -> None:
        self.agent.observe(obs, action, next_obs, alive)


_ticks: Queue[int]  # of this worker process, to the main one


def _die_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def start_worker(ticks: Queue[int]) -> None:
    """Prepare a worker process: one thread, progress to `ticks`, Ctrl-C left to the main process; it dies with that."""
    global _ticks
    threading.Thread(target=_die_with_parent, daemon=True).start()
    _ticks = ticks
    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def run_job(job: Job) -> str:
    """Train and evaluate one method with one seed, and write its file; returns a line that says how it went."""
    start, told = time.time(), 0
    curve: dict[str, list[tuple[int, float]]] = {}

    def progress(done: int, total: int, losses: dict[str, float]) -> None:
        nonlocal told
        if (now := int(0.8 * job.ticks * done / total)) > told:
            _ticks.put(now - told)
            told = now
        if done % max(total // 400, 1) == 0:
            for kind, loss in losses.items():
                curve.setdefault(kind, []).append((done, loss))

    task = envs.get(job.task)
    context = Context(task, job.preset, job.seed, progress)
    agents = METHODS[job.method](context)
    trained = time.time() - start
    arrays: dict[str, Any] = {}
    for name, agent in agents.items():
        # Learned agents go on for twice the episodes they were trained on.
        episodes = task.episodes * (2 if job.method in LEARNED and task.episodes > 1 else 1)
        recorder = Recorder(agent, context.env)
        _, returns = run_trials(context.env, recorder, episodes, stream(EVALUATION, job.seed))
        arrays[f"{name}/returns"] = returns
        if job.seed == 0 and name in CLIPPED:
            arrays[f"{name}/state"], arrays[f"{name}/action"] = np.array(recorder.states), np.array(recorder.actions)
            arrays[f"{name}/trial"] = np.array(recorder.trial)
    meta = {"agents": list(agents), "curve": curve, "train_s": trained, "span": (start, time.time())}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, theta=context.env.theta, meta=np.array(json.dumps(meta)), **arrays)
    write_atomically(job.file, buffer.getvalue())
    _ticks.put(job.ticks - told)
    return f"trained in {trained:.0f} s, all in {time.time() - start:.0f} s"


def load_job(job: Job) -> dict[str, Any] | None:
    """What a finished job wrote: arrays, and `meta` decoded. None if its file is missing or damaged."""
    try:
        with np.load(job.file, allow_pickle=False) as data:
            arrays = {key: data[key] for key in data.files}
        return {**arrays, "meta": json.loads(str(arrays["meta"]))}
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile, zlib.error):
        return None
