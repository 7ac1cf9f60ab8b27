"""Experts, policies that see theta: the task's closed form if it has one, else a small network in safetensors."""

import hashlib
import json
from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file

from deconfounded.envs import BatchEnv, InputError, Task
from deconfounded.envs.contract.check import check_expert
from deconfounded.envs.support import outside
from deconfounded.envs.support.errors import error_line
from deconfounded.envs.task import ASSETS, Array, Streams
from deconfounded.envs.world import as_numbers

RandomSource = np.random.Generator | Streams


class Expert(ABC):
    """pi_exp(a | s, theta), batched and Markov."""

    def __init__(self, task: Task) -> None:
        self.task = task

    @abstractmethod
    def act(self, obs: Array, theta: Array, rng: RandomSource) -> Array:
        """Observation [N, O], theta [N, L] -> sampled action [N, A]."""

    @abstractmethod
    def log_prob(self, obs: Array, action: Array, theta: Array) -> Array:
        """log pi_exp(a | s, theta) [N]."""


def sample_rows(probs: Array, rng: RandomSource) -> NDArray[np.int64]:
    """Indices [N], drawn from each row of probabilities [N, K], which need not be normalised."""
    cumulative = probs.cumsum(-1)
    return (rng.random((len(probs), 1)) * cumulative[:, -1:] > cumulative).sum(-1)


class DiscreteExpert(Expert):
    """The closed-form expert that a task states as `expert_probs`."""

    def act(self, obs: Array, theta: Array, rng: RandomSource) -> Array:
        return sample_rows(self._probs(obs, theta), rng)[:, None].astype(float)

    def log_prob(self, obs: Array, action: Array, theta: Array) -> Array:
        return np.log(np.take_along_axis(self._probs(obs, theta), action.astype(int), -1)[:, 0])

    def _probs(self, obs: Array, theta: Array) -> Array:
        probs = self.task.expert_probs(obs, theta)
        assert probs is not None
        return np.broadcast_to(probs, (len(obs), probs.shape[-1]))


class BoxExpert(Expert):
    """A Gaussian expert, clip(mu(s, theta) + sigma eps, -1, 1), with the task's expert noise sigma."""

    @abstractmethod
    def mean(self, obs: Array, theta: Array, groups: int = 1) -> Array:
        """Mean action mu [N, A] in [-1, 1]. Rows in equal groups must give the bits that each group gives alone."""

    def act(self, obs: Array, theta: Array, rng: RandomSource) -> Array:
        mean = self.mean(obs, theta, getattr(rng, "groups", 1))
        return np.clip(mean + self.task.expert_noise * rng.standard_normal(mean.shape), -1, 1)

    def log_prob(self, obs: Array, action: Array, theta: Array) -> Array:
        """Log density [N] of a Gaussian censored at the action bounds: density inside, tail mass on -1 and 1."""
        from scipy.special import log_ndtr  # half a second

        sigma = self.task.expert_noise
        z = (action - self.mean(obs, theta)) / sigma
        inside = -0.5 * z**2 - np.log(sigma * np.sqrt(2 * np.pi))
        return np.where(action >= 1, log_ndtr(-z), np.where(action <= -1, log_ndtr(z), inside)).sum(-1)


class NetworkExpert(BoxExpert):
    """An expert whose mean is a tanh network of the observation and of what it sees of theta."""

    def __init__(self, task: Task, weights: dict[str, NDArray[np.float32]]) -> None:
        super().__init__(task)
        self.weights = weights

    def mean(self, obs: Array, theta: Array, groups: int = 1) -> Array:
        w, last = self.weights, len(self.weights) // 2 - 1
        rows = np.concatenate([obs, self.task.seen_theta(obs, theta)], -1).astype(np.float32)
        hidden = rows.reshape(groups, len(rows) // groups, rows.shape[1])
        for i in range(last):
            hidden = np.tanh(hidden @ w[f"{i}.weight"].T + w[f"{i}.bias"])
        out = hidden @ w[f"{last}.weight"].T + w[f"{last}.bias"]
        return np.clip(out.reshape(len(rows), out.shape[-1]), -1, 1).astype(float)


class CallableExpert(BoxExpert):
    """An expert whose mean is any callable from observation [N, O] and theta [N, L], in its units, to [N, A]."""

    def __init__(self, task: Task, call: Callable[[Array, Array], Array | None], name: str) -> None:
        super().__init__(task)
        self.call, self.name = call, name

    def mean(self, obs: Array, theta: Array, groups: int = 1) -> Array:
        """Mean action, clipped to [-1, 1]. Raises InputError unless it is a finite row for each observation."""
        parts = zip(np.split(obs, groups), np.split(theta, groups), strict=True)
        try:  # on copies, as the callable may change them in place
            rows = [as_numbers(self.call(np.array(o), np.array(t)), f"expert {self.name}") for o, t in parts]
            given = np.concatenate([np.atleast_1d(row) for row in rows])
        except InputError:
            raise
        except Exception as error:
            raise InputError(f"expert {self.name}: {error_line(error)}") from error
        if given.shape != (shape := (len(obs), self.task.action_width)) or not np.isfinite(given).all():
            what = f"shape {given.shape}" if given.shape != shape else "NaN or infinity"
            raise InputError(f"expert {self.name} gave {what} for {len(obs)} observations; it must be {shape}, finite")
        return np.clip(given, -1, 1)


def path(task: Task) -> Path:
    """Path of the weights of a task's expert; its card is the .json beside them."""
    folder = ASSETS / "experts" if task.home == ASSETS else task.home
    return folder / f"{task.name}.safetensors"


def has_card(file: Path) -> bool:
    """Whether what is in the place of the card of a file of weights, if anything is there, is a card."""
    return not file.with_suffix(".json").exists() or "sha256" in _card(file)


def _card(file: Path) -> dict[str, Any]:
    """The card beside a file of weights; {} if there is none, as it is optional, or no object is in it."""
    try:
        card = json.loads(file.with_suffix(".json").read_bytes())
    except (OSError, ValueError):
        card = None
    return card if isinstance(card, dict) else {}


def names_callable(source: str) -> bool:
    """Whether an expert's source is path/file.py:name or package.module:name, not a file of weights."""
    return outside.is_outside(source) and not source.endswith(".safetensors")


def load(task: Task, source: str | Path | None = None) -> Expert:
    """Load a task's expert: the closed form, the weights that come with the task, or those of a .safetensors file.

    source: the file, or the reference of a callable (`CallableExpert`). Raises InputError if it does not fit the task.
    """
    if task.n_actions:
        if source is not None:
            own = "its closed form, `expert_probs`" if task.has_likelihood else "the world's own `expert`"
            raise InputError(f"expert was {source}; that of {task.name} is {own}, as actions are discrete")
        return DiscreteExpert(task)
    if source is not None and (not isinstance(source, str | Path) or not str(source).strip()):
        raise InputError(f"expert was {source!r}; it must be weights.safetensors, or path/file.py:name of a callable")
    if isinstance(source, str) and names_callable(source):
        expert = CallableExpert(task, outside.find("expert", source), source)
        if not callable(expert.call):
            raise InputError(f"expert {source} is {expert.call!r}; it must be a callable (obs, theta) -> mean action")
        env = BatchEnv(task, 2)
        obs = env.reset(0)  # not of zeros, which it may never see
        check_expert(f"expert {source}", expert.mean, obs, env.theta, expert.mean(obs, env.theta))
        return expert
    if source is None and task.has_closed_expert:
        return CallableExpert(task, task.expert_mean, f"of {task.name}")
    file = path(task) if source is None else Path(source)
    if file.suffix != ".safetensors":
        raise InputError(f"expert was {source}; it must be weights.safetensors, or path/file.py:name of a callable")
    train = f"`deconf train --task {task.reference or task.name} --out {file}` makes such a file"
    remedy = f"the expert of {task.name} itself is a closed form" if task.has_closed_expert else train
    return NetworkExpert(task, _weights(task, file, remedy))


def _weights(task: Task, file: Path, remedy: str) -> dict[str, NDArray[np.float32]]:
    if not file.is_file():
        raise InputError(f"no expert weights at {file}; {remedy}")
    try:
        if _card(file).get("sha256") not in (None, hashlib.sha256(file.read_bytes()).hexdigest()):
            raise OSError(f"their sha256 is not that of {file.with_suffix('.json').name}")
        weights = load_file(file)
    except (SafetensorError, OSError, TypeError) as error:  # TypeError: numpy has no bfloat16
        raise InputError(f"expert weights at {file} are damaged ({error}); {remedy}") from None
    width = len(task.observation) + task.seen_width
    for i in range(max((len(weights) + 1) // 2, 1)):  # an odd number has a layer too many
        weight, bias = weights.get(f"{i}.weight"), weights.get(f"{i}.bias")
        if weight is None or bias is None or weight.ndim != 2 or bias.shape != weight.shape[:1]:
            raise InputError(f"expert weights at {file} lack a whole layer {i}; {remedy}")
        if weight.shape[1] != width:
            raise InputError(f"layer {i} of {file} takes {weight.shape[1]} inputs, not {width}; {remedy}")
        if not (np.isfinite(weight).all() and np.isfinite(bias).all()):
            raise InputError(f"layer {i} of {file} holds NaN or infinity; {remedy}")
        if weight.dtype.kind != "f" or bias.dtype.kind != "f":
            raise InputError(f"layer {i} of {file} is of {weight.dtype} and {bias.dtype}, not of float32; {remedy}")
        width = len(bias)
    if width != task.action_width:
        raise InputError(f"expert weights at {file} give {width} actions, not {task.action_width}; {remedy}")
    return weights


def _is_closed(task: Task, source: str | Path | None) -> bool:
    return bool(task.n_actions) or (source is None and task.has_closed_expert)


def fingerprint(task: Task, source: str | Path | None = None) -> str:
    """SHA-256 of a file of weights, by default the task's own, or `closed form`. Raises OSError if there is no file."""
    if _is_closed(task, source):
        return "closed form"
    return hashlib.sha256((path(task) if source is None else Path(source)).read_bytes()).hexdigest()


def version(task: Task, source: str | Path | None = None) -> int:
    """Version of an expert, raised by hand when its actions change: in the weights' card, or a closed form's task's."""
    if _is_closed(task, source):
        return task.version
    stated = _card(path(task) if source is None else Path(source)).get("version")
    return stated if isinstance(stated, int) else 0
