"""Agents that last: a folder with agent.json and agent.safetensors, written by `save` and read by `load`; no pickle."""

from __future__ import annotations

import hashlib
import inspect
import shutil
from importlib.metadata import version
from pathlib import Path
from typing import Any

from safetensors.numpy import load as from_bytes
from safetensors.numpy import save as to_bytes

from deconfounded.envs import InputError, outside
from deconfounded.envs.files import check_folder, read_sealed, write_atomically, write_sealed
from deconfounded.experts.demos import Agent

ARRAYS = "agent.safetensors"
CODE = "agent.py"  # of an agent from outside, kept beside its arrays


def save(agent: Agent, folder: Path, **about: Any) -> None:
    """Keep an agent: its class by name, its settings, its arrays; about: what else to say of it, for json.

    Of a class that a file brought from outside, the file is kept too, so that the folder is whole; what else that file
    imports has to be there when it is loaded. Raises InputError for an agent that cannot be kept.
    """
    if "." in type(agent).__qualname__:
        raise InputError(f"{type(agent).__qualname__} cannot be saved; its class must stand at the top of its file")
    settings, arrays = agent.state()
    check_folder(folder)
    cls, code = type(agent), outside.source(type(agent))
    where = cls.__module__
    if where.startswith("outside_") and code is not None:
        shutil.copy(code, folder / CODE)
        where = CODE
    write_atomically(folder / ARRAYS, content := to_bytes(arrays))
    about["versions"] = {name: version(name) for name in ("deconfounded-imitation", "numpy")}
    about["arrays"] = hashlib.sha256(content).hexdigest()
    write_sealed(folder / "agent.json", {"class": f"{where}:{cls.__qualname__}", "settings": settings, **about})


def describe(folder: Path) -> dict[str, Any]:
    """agent.json. Raises InputError if there is none, or it is damaged."""
    try:
        about = read_sealed(folder / "agent.json")
    except OSError:
        raise InputError(f"{folder} holds no agent.json; give the folder of an agent, as a run leaves it") from None
    if [type(about.get(key)) for key in ("class", "settings", "arrays")] != [str, dict, str]:
        raise InputError(f"{folder / 'agent.json'} is of no agent; run the benchmark again")
    return about


def load(folder: Path | str) -> Agent:
    """The agent kept in a folder, ready for `begin`. Raises InputError if it is missing or damaged.

    The class that agent.json names is imported, so that loading an agent is running its code.
    """
    if not isinstance(folder, str | Path):
        raise InputError(f"the folder of an agent was {folder!r}; it must be a path")
    folder = Path(folder)
    about = describe(folder)
    try:
        where, _, name = about["class"].rpartition(":")
        cls = outside.find("agent", f"{folder / where if where == CODE else where}:{name}")
        if not (inspect.isclass(cls) and issubclass(cls, Agent)):
            raise InputError(f"the agent in {folder} is {cls!r}; it must be a subclass of Agent")
        content = (folder / ARRAYS).read_bytes()
        if hashlib.sha256(content).hexdigest() != about["arrays"]:
            raise InputError(f"{folder / ARRAYS} is damaged, or of another agent; run the benchmark again")
        return cls.from_state(about["settings"], from_bytes(content))
    except InputError:
        raise
    except Exception as error:  # whatever its class makes of arrays that are not its own
        raise InputError(f"the agent in {folder} is damaged ({outside.told(error)}); run the benchmark again") from None
