"""Units of logs: what columns are called, and how actions of a log become actions of Trials and back."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deconfounded.envs.streams import Array, Mask, Obs
from deconfounded.envs.support import outside
from deconfounded.envs.support.errors import InputError
from deconfounded.experts import saved_agents
from deconfounded.experts.agent import Agent, AgentWrapper, State


@dataclass(frozen=True)
class Units:
    """Names of observations and actions; low, high: the range of each action, which becomes -1 to 1.

    values: the discrete actions, numbers or texts, by their number; empty for continuous ones.
    """

    obs: tuple[str, ...]
    action: tuple[str, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    values: tuple[Any, ...] = ()

    @staticmethod
    def plain(obs: int, action: int, n_actions: int) -> "Units":
        """Those of Trials that are no log."""
        names = [tuple(f"{what} {i}" for i in range(n)) for what, n in (("observation", obs), ("action", action))]
        return Units(names[0], names[1], (-1.0,) * action, (1.0,) * action, tuple(range(n_actions)))

    @property
    def raw(self) -> bool:
        """Whether actions of the log are others than those of Trials."""
        if self.values:
            return self.values != tuple(range(len(self.values)))
        return any(low != -1 or high != 1 for low, high in zip(self.low, self.high, strict=True))

    def scaled(self, action: NDArray[Any]) -> Array:
        """Actions [..., A] of the log as those of Trials; those beyond the log's range become its ends.

        Logs of exploration often go beyond it: `datasets.read_together` has one range for both. Raises InputError for
        an action that is none of `values`.
        """
        if self.values:
            numbers = {value: i for i, value in enumerate(self.values)}
            flat = np.asarray(action).ravel().tolist()
            if strange := [value for value in flat if value not in numbers]:
                raise InputError(f"an action was {strange[0]!r}; it must be one of {', '.join(map(str, self.values))}")
            return np.reshape([float(numbers[value]) for value in flat], np.shape(action))
        low, high = np.array(self.low), np.array(self.high)
        width = np.where(high > low, high - low, 1)
        given = np.asarray(action, float)
        scaled = np.where(high > low, (2 * (given - low) / width - 1).clip(-1, 1), 0)
        return np.where((low == -1) & (high == 1), given.clip(-1, 1), scaled)  # the same bits

    def unscaled(self, action: NDArray[Any]) -> NDArray[Any]:
        """The reverse of `scaled`; beyond -1 and 1 it is the end of the range."""
        if self.values:
            dtype = object if any(isinstance(value, str) for value in self.values) else float
            return np.array(self.values, dtype)[np.asarray(action).astype(int)]
        low, high, given = np.array(self.low), np.array(self.high), np.asarray(action, float).clip(-1, 1)
        return np.where((low == -1) & (high == 1), given, low + (given + 1) / 2 * (high - low))

    def agent(self, agent: Agent) -> Agent:
        """An agent that was trained on the log, acting in the log's units; itself, where these are those of Trials."""
        return RawAgent(agent, self) if self.raw else agent


class RawAgent(AgentWrapper):
    """An agent that acts, and is told of actions, in the units of the log it was trained on."""

    def __init__(self, agent: Agent, units: Units) -> None:
        super().__init__(agent)
        self.units = units

    def act(self, obs: Obs) -> Array:
        return self.units.unscaled(super().act(np.asarray(obs, np.float32)))

    def observe(self, obs: Obs, action: Array, next_obs: Obs, alive: Mask) -> None:
        obs, next_obs = np.asarray(obs, np.float32), np.asarray(next_obs, np.float32)
        super().observe(obs, self.units.scaled(action), next_obs, alive)

    def features(self) -> NDArray[np.float32] | None:
        return self.agent.features()

    def state(self) -> State:
        if not (reference := outside.reference(type(self.agent))):
            raise InputError(
                f"{type(self.agent).__name__} cannot be saved; its class must stand at the top of its file"
            )
        settings, arrays = self.agent.state()
        return {"units": asdict(self.units), "class": reference, "settings": settings}, arrays

    @classmethod
    def from_state(cls, settings: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> "RawAgent":
        units = Units(**{key: tuple(value) for key, value in settings["units"].items()})
        inner = outside.find("agent", settings["class"])
        return RawAgent(inner.from_state(settings["settings"], arrays), units)

    def save(self, folder: Path | str) -> None:
        """Save the agent in a folder, for `deconfounded.load`; a class in a file of the user's own must stay there."""
        saved_agents.save(self, Path(folder))
