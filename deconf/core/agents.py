"""Checkpoints of training, and the agent of S seeds that learned methods return."""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from deconfounded.deconf.core.data import Batch, Draws, Signature, as_generators, copied
from deconfounded.deconf.core.monitor import Monitor, Training
from deconfounded.deconf.core.nets import ActionHead, Scales
from deconfounded.envs.streams import Array
from deconfounded.envs.support.errors import InputError
from deconfounded.envs.support.numbers import is_seed
from deconfounded.experts import saved_agents
from deconfounded.experts.agent import Agent, State
from deconfounded.experts.arrays import LARGEST

ROUNDING = 1e-6  # of an action at an end of its range


class Stateful(Protocol):
    """A network, an optimizer, or streams of random numbers."""

    def state_dict(self) -> dict[str, Any]: ...
    def load_state_dict(self, state: dict[str, Any], /) -> Any: ...


class Checkpoint:
    """Saves the parts of a training run with its monitor, and restores them."""

    def __init__(self, monitor: Monitor, rngs: Sequence[np.random.Generator], **parts: Stateful) -> None:
        self.monitor, self.rngs, self.parts = monitor, rngs, parts

    def save(self, **rest: Any) -> None:
        """Save parts and generators. rest: whatever else resuming needs."""
        self.monitor.save(
            lambda: {
                "rngs": [rng.bit_generator.state for rng in self.rngs],
                "parts": {name: part.state_dict() for name, part in self.parts.items()},
                "rest": rest,
            }
        )

    def load(self) -> Training | None:
        """Restore the parts and return the rest; None, without any change, if nothing was saved."""
        if (state := self.monitor.load()) is None:
            return None
        for rng, before in zip(self.rngs, state["rngs"], strict=True):
            rng.bit_generator.state = before
        for name, part in self.parts.items():
            part.load_state_dict(state["parts"][name])
        return state["rest"]


def ramp(done: int, until: float) -> float:
    """A linear warm-up from 0 to 1, over `until` updates."""
    return min(1.0, done / until) if until else 1.0


class LearnedAgent(Agent):
    """An agent of S seeds: it acts in S equal groups of trials, each with its seed's networks and random numbers.

    Calls go in the order `begin`, `reset`, then `act` and `observe`, which raise InputError before. Where somebody else
    acts, `observe` alone takes in the steps.
    """

    def __init__(self, policy: ActionHead) -> None:
        parameter = next(policy.parameters())
        self.seeds, self.device = len(parameter), parameter.device
        self.policy = policy
        self._n, self._draws = 0, Draws([], self.device)

    def begin(self, n: int) -> None:
        if not isinstance(n, int | np.integer) or n < 1 or n % self.seeds:
            right = "it must be a multiple of the number of seeds, from that number up"
            raise InputError(f"an agent of {self.seeds} seeds was given {n} trials; {right}")
        self._n = n // self.seeds
        self._draws = Draws([], self.device)

    def reset(self, rngs: Sequence[np.random.Generator]) -> None:
        generators = as_generators(rngs)
        if not self._n:
            raise InputError("reset was called before begin; begin(n) says how many trials there are")
        if len(generators) != self.seeds:
            raise InputError(
                f"an agent of {self.seeds} seeds was given {len(generators)} generators; it needs one for each"
            )
        self._draws = Draws(generators, self.device)

    @torch.inference_mode()
    def act(self, obs: NDArray[np.float32]) -> Array:
        if not len(self._draws):
            raise InputError("act was called before begin and reset; begin(n) trials, reset([generator]), then act")
        seen = self._tensor(obs)
        if not (np.abs(obs) <= LARGEST).all():
            raise InputError(f"observations held NaN or infinity, or more than {LARGEST:g}, of which no action follows")
        action = self.choose(seen).double().cpu().numpy().reshape(len(obs), -1)
        if not np.isfinite(action).all():
            wrong = "an action was NaN: an observation far from those of training has overflowed the agent's memory"
            raise InputError(f"{wrong}; leave out such observations, and begin again")
        return action

    def _tensor(self, obs: NDArray[np.float32]) -> Tensor:
        shape, width = np.shape(obs), self.policy.signature.obs
        if shape != (self.seeds * self._n, width):
            raise InputError(
                f"observations had shape {shape}; they must be ({self.seeds * self._n}, {width}), a row a trial"
            )
        return copied(obs, self.device).view(self.seeds, self._n, width)

    @abstractmethod
    def choose(self, obs: Tensor) -> Tensor:
        """Observation [S, N, O] -> action [S, N, A]."""

    @torch.inference_mode()
    def observe(
        self, obs: NDArray[np.float32], action: Array, next_obs: NDArray[np.float32], alive: NDArray[np.bool_]
    ) -> None:
        if not len(self._draws):
            raise InputError("observe was called before begin and reset; begin(n) trials, reset([generator]), then act")
        shapes, signature = (np.shape(action), np.shape(alive)), self.policy.signature
        if shapes != ((len(obs), signature.action), (len(obs),)):
            raise InputError(
                f"actions and alive had shapes {shapes[0]} and {shapes[1]}; they must be"
                f" ({len(obs)}, {signature.action}) and ({len(obs)},), a row a trial"
            )
        before, after = self._tensor(obs), self._tensor(next_obs)
        if not (np.abs(np.concatenate([obs, action, next_obs], 1)) <= LARGEST).all():
            wrong = f"observations or actions held NaN or infinity, or more than {LARGEST:g}"
            raise InputError(f"{wrong}, which a memory would never lose")
        if signature.actions and (action.min() < 0 or action.max() >= signature.actions or (action % 1).any()):
            raise InputError(f"an action was none of 0 to {signature.actions - 1}")
        if not signature.actions and (most := np.abs(action).max()) > 1 + ROUNDING:
            raise InputError(
                f"an action was of size {most:g}; agents act in [-1, 1], and `units.agent` in a log's units"
            )
        self.remember(Batch.step(before, action, after, alive))

    def remember(self, step: Batch) -> None:
        """Update the memory with a transition of each trial; nothing, for agents without memory."""

    def features(self) -> NDArray[np.float32] | None:
        if not self._n:
            raise InputError("features was called before begin; begin(n) says how many trials there are")
        return self.remembered()

    def remembered(self) -> NDArray[np.float32] | None:
        """The `features`; None for agents without memory."""
        return None

    @abstractmethod
    def parts(self) -> dict[str, nn.Module]:
        """Networks by name."""

    @abstractmethod
    def shape(self) -> dict[str, Any]:
        """Sizes from which `blank` makes networks of the same shape."""

    @classmethod
    @abstractmethod
    def blank(cls, shape: dict[str, Any], scales: Scales, draws: Draws) -> "LearnedAgent":
        """An untrained agent with networks of that shape."""

    def state(self) -> State:
        settings = {"seeds": self.seeds, "signature": asdict(self.policy.signature), "shape": self.shape()}
        named = ((f"{name}.{key}", x) for name, part in self.parts().items() for key, x in part.state_dict().items())
        return settings, {key: x.cpu().numpy().copy() for key, x in named}

    @classmethod
    def from_state(cls, settings: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> "LearnedAgent":
        signature, seeds = Signature(**settings["signature"]), settings["seeds"]
        draws = Draws([np.random.default_rng(0) for _ in range(seeds)], "cpu")
        agent = cls.blank(settings["shape"], Scales.plain(signature, seeds), draws)
        for name, part in agent.parts().items():
            own = {key.removeprefix(f"{name}."): x for key, x in arrays.items() if key.startswith(f"{name}.")}
            part.load_state_dict({key: torch.tensor(x) for key, x in own.items()})
            part.eval()  # the moments of a belief's evidence stay as they are
        return agent

    def of_seed(self, i: int) -> "LearnedAgent":
        """The agent of the i-th seed alone, on the CPU. Raises InputError for a seed that there is not."""
        if not is_seed(i) or i >= self.seeds:
            raise InputError(
                f"seed {i!r} of an agent of {self.seeds} was asked for; it must be from 0 to {self.seeds - 1}"
            )
        settings, arrays = self.state()
        own = {key: x[i : i + 1] if x.ndim else x for key, x in arrays.items()}  # the first axis is of seeds
        return self.from_state({**settings, "seeds": 1}, own)

    def save(self, folder: Path | str) -> None:
        """Save the agent in a folder, for `deconfounded.load`."""
        saved_agents.save(self, Path(folder))
