"""Experts: policies that see theta. A closed form where the task has one, else a small network in safetensors."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Protocol

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file
from scipy.special import log_ndtr

from deconfounded.envs import InputError, Task
from deconfounded.envs.task import ASSETS, Array


class Random(Protocol):
    """What is drawn from: a numpy generator, or demos.Streams, whose rows are in `groups` equal groups."""

    def random(self, size: tuple[int, ...]) -> Array: ...
    def standard_normal(self, size: tuple[int, ...]) -> Array: ...


class Expert(ABC):
    """pi_exp(a | s, theta), batched and Markov."""

    @abstractmethod
    def act(self, obs: Array, theta: Array, rng: Random) -> Array:
        """Observation [N, O], theta [N, L] -> sampled action [N, A]."""

    @abstractmethod
    def log_prob(self, obs: Array, action: Array, theta: Array) -> Array:
        """log pi_exp(a | s, theta) [N]."""


def sample_rows(probs: Array, rng: Random) -> NDArray[np.int64]:
    """One index [N] from each row of probabilities [N, K], which need not be normalised."""
    cumulative = probs.cumsum(-1)
    return (rng.random((len(probs), 1)) * cumulative[:, -1:] > cumulative).sum(-1)


class DiscreteExpert(Expert):
    """The closed form that a task states as `expert_probs`."""

    def __init__(self, task: Task) -> None:
        self.task = task

    def act(self, obs: Array, theta: Array, rng: Random) -> Array:
        return sample_rows(self._probs(obs, theta), rng)[:, None].astype(float)

    def log_prob(self, obs: Array, action: Array, theta: Array) -> Array:
        return np.log(np.take_along_axis(self._probs(obs, theta), action.astype(int), -1)[:, 0])

    def _probs(self, obs: Array, theta: Array) -> Array:
        probs = self.task.expert_probs(obs, theta)
        assert probs is not None
        return np.broadcast_to(probs, (len(obs), probs.shape[-1]))


class NetworkExpert(Expert):
    """clip(mu(s, theta) + sigma eps, -1, 1): a tanh network's mean with the task's expert noise sigma."""

    def __init__(self, task: Task, weights: dict[str, NDArray[np.float32]]) -> None:
        self.task, self.weights = task, weights

    def mean(self, obs: Array, theta: Array, groups: int = 1) -> Array:
        """mu [N, A], clipped to [-1, 1]. Rows in equal groups come out, bit for bit, as they would group by group."""
        w, last = self.weights, len(self.weights) // 2 - 1
        rows = np.concatenate([obs, self.task.encode_theta(theta)], -1).astype(np.float32)
        hidden = rows.reshape(groups, -1, rows.shape[1])
        for i in range(last):
            hidden = np.tanh(hidden @ w[f"{i}.weight"].T + w[f"{i}.bias"])
        out = hidden @ w[f"{last}.weight"].T + w[f"{last}.bias"]
        return np.clip(out.reshape(len(rows), -1), -1, 1).astype(float)

    def act(self, obs: Array, theta: Array, rng: Random) -> Array:
        mean = self.mean(obs, theta, getattr(rng, "groups", 1))
        return np.clip(mean + self.task.expert_noise * rng.standard_normal(mean.shape), -1, 1)

    def log_prob(self, obs: Array, action: Array, theta: Array) -> Array:
        """A Gaussian censored at the action bounds: density inside, tail mass on -1 and 1."""
        sigma = self.task.expert_noise
        z = (action - self.mean(obs, theta)) / sigma
        inside = -0.5 * z**2 - np.log(sigma * np.sqrt(2 * np.pi))
        return np.where(action >= 1, log_ndtr(-z), np.where(action <= -1, log_ndtr(z), inside)).sum(-1)


def path(task: Task) -> Path:
    """Where the weights of a task's expert lie; its card lies beside them as .json."""
    return ASSETS / "experts" / f"{task.name}.safetensors"


def load(task: Task, file: Path | None = None) -> Expert:
    """The task's expert. Raises InputError if its weights are missing, damaged or of the wrong shape."""
    if isinstance(task.action_space, spaces.Discrete):
        return DiscreteExpert(task)
    file = file or path(task)
    remedy = f"run `deconf train --task {task.name}`"
    if not file.is_file():
        raise InputError(f"no expert weights at {file}; {remedy}")
    try:
        weights = load_file(file)
    except (SafetensorError, OSError) as error:
        raise InputError(f"expert weights at {file} are damaged ({error}); {remedy}") from None
    width = len(task.observation) + sum(lat.features for lat in task.latents)
    for i in range(max(len(weights) // 2, 1)):
        weight, bias = weights.get(f"{i}.weight"), weights.get(f"{i}.bias")
        if weight is None or bias is None or weight.ndim != 2 or bias.shape != weight.shape[:1]:
            raise InputError(f"expert weights at {file} lack a whole layer {i}; {remedy}")
        if weight.shape[1] != width or not (np.isfinite(weight).all() and np.isfinite(bias).all()):
            raise InputError(f"layer {i} of {file} takes {weight.shape[1]} finite inputs, not {width}; {remedy}")
        width = len(bias)
    if width != task.action_space.shape[0]:
        raise InputError(f"expert weights at {file} give {width} actions, not {task.action_space.shape[0]}; {remedy}")
    return NetworkExpert(task, weights)


def fingerprint(task: Task) -> str:
    """SHA-256 of the weights, or `closed form`."""
    return hashlib.sha256(path(task).read_bytes()).hexdigest() if path(task).is_file() else "closed form"
