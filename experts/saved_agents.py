"""Saved agents: folders with agent.json and agent.safetensors, without pickle."""

import contextlib
import hashlib
import inspect
import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load as from_bytes
from safetensors.numpy import save as to_bytes

from deconfounded import __version__
from deconfounded.envs.support import outside
from deconfounded.envs.support.errors import InputError, error_line
from deconfounded.envs.support.files import as_json, check_folder, read_sealed, sealed, write_atomically
from deconfounded.experts.agent import Agent

OWN = "deconfounded."  # module names of this package's agents
OLDER = "another version of this package saved it; train it anew, or use that one"
ARRAYS = "agent.safetensors"
CODE = "agent.py"  # source of an agent from outside, kept beside its arrays


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def save(agent: Agent, folder: Path, **about: Any) -> None:
    """Save an agent: its class by name, its settings, its arrays; about: further entries of agent.json.

    With the sizes of `spaces` among these, an agent is tried: it must act as what is loaded in its place.

    The file of a class from outside is copied into the folder; what that file imports must be importable when the agent
    is loaded. Raises InputError for an agent that cannot be saved, and writes nothing.
    """
    cls, file, code = type(agent), folder / "agent.json", None
    if "." in cls.__qualname__:
        raise InputError(f"{cls.__qualname__} cannot be saved; its class must stand at the top of its file")
    if cls.__module__ in outside.SCRIPTS:
        raise InputError(f"{cls.__qualname__} cannot be saved; its class must be imported, from a file of its own")
    if cls.__module__.startswith(outside.PREFIX) and (source := outside.source(cls)) is not None:
        code = source.read_bytes()
    about = {"class": f"{cls.__module__ if code is None else CODE}:{cls.__qualname__}", **about}
    if code is not None:
        about["code"] = _sha256(code)
    about["versions"] = {"deconfounded-imitation": __version__, "numpy": np.__version__}
    try:
        about["settings"], named = agent.state()
        named = {key: x.copy() for key, x in named.items()}  # in C's order: safetensors writes memory as it lies
        content = to_bytes(named)
        described = as_json(file, sealed({**about, "arrays": _sha256(content)}))
    except InputError:
        raise
    except Exception as error:  # any error of the class's own `state`
        right = "its state() must return a dictionary for json and one of arrays"
        raise InputError(f"{cls.__qualname__} cannot be saved ({error_line(error)}); {right}") from None
    _check_loadable(cls, json.dumps(about["settings"]), named, content)
    if "spaces" in about:
        _check_alike(
            agent, cls.from_state(json.loads(json.dumps(about["settings"])), from_bytes(content)), about["spaces"]
        )
    check_folder(folder)
    files = {ARRAYS: content} if code is None else {CODE: code, ARRAYS: content}
    for name, data in files.items():
        write_atomically(_saved_aside(folder, name, _sha256(data)), data)
    write_atomically(file, described)  # from here on the folder holds this agent, before that the one it held
    for name, data in files.items():
        _put_in_place(folder, name, _sha256(data))
        for left in folder.glob(_saved_aside(Path(), name, "[0-9a-f]" * 64).name):  # of a save that was interrupted
            left.unlink(missing_ok=True)


def _saved_aside(folder: Path, name: str, sha: str) -> Path:
    """Where a file of an agent is until agent.json names it by its hash."""
    return folder / f".{name}.{sha}"


def _put_in_place(folder: Path, name: str, sha: str) -> None:
    """Give a file that `save` wrote aside its name: as the end of saving, or where an interrupt left that undone."""
    aside = _saved_aside(folder, name, sha)
    with contextlib.suppress(FileNotFoundError):
        if _sha256(aside.read_bytes()) == sha:
            aside.replace(folder / name)


def _check_loadable(cls: type[Agent], settings: str, named: dict[str, NDArray[Any]], content: bytes) -> None:
    """Raises InputError unless `from_state` makes an agent of the same settings, as JSON, and arrays, from its file."""
    try:
        again, made = cls.from_state(json.loads(settings), from_bytes(content)).state()
        same = json.loads(json.dumps(again)) == json.loads(settings) and made.keys() == named.keys()
        same = same and all(np.array_equal(made[key], x, equal_nan=True) for key, x in named.items())
        why = "" if same else "it makes an agent of another state"
    except Exception as error:  # any error of the class's own methods
        why = error_line(error)
    if why:
        right = "it must undo what state() gives"
        raise InputError(f"{cls.__qualname__} cannot be saved: from_state() fails ({why}); {right}")


def _check_alike(agent: Agent, loaded: Agent, sizes: dict[str, int]) -> None:
    """Raises InputError if an agent acts differently from what is loaded in its place, on observations of noise.

    Nothing is said of an agent that cannot act on them, or that acts differently itself when it is asked again.
    """
    try:
        acted, again = (_actions(agent, sizes["observations"]) for _ in range(2))
    except Exception:  # any error of the class's own methods
        return
    if np.array_equal(acted, again, equal_nan=True):
        try:
            same = np.array_equal(acted, _actions(loaded, sizes["observations"]), equal_nan=True)
            why = "acts differently" * (not same)
        except Exception as error:
            why = f"fails ({error_line(error)})"
        if why:
            right = "state() must give all that its actions depend on"
            raise InputError(f"{type(agent).__qualname__} cannot be saved: what from_state() makes {why}; {right}")


def _actions(agent: Agent, width: int) -> NDArray[np.float64]:
    """Actions [10, 2, A] in two episodes of five steps of two trials, on observations of this width."""
    noise, actions = np.random.default_rng(0), []
    agent.begin(2)
    for _ in range(2):
        agent.reset([np.random.default_rng(0)])
        for obs, next_obs in pairwise(noise.standard_normal((6, 2, width), dtype=np.float32)):
            actions.append(np.array(agent.act(obs.copy()), np.float64))
            agent.observe(obs, actions[-1].copy(), next_obs, np.ones(2, bool))
    return np.array(actions)


def describe(folder: Path) -> dict[str, Any]:
    """Read agent.json. Raises InputError if there is none, or it is damaged, or the agent's code is another one."""
    try:
        about = read_sealed(folder / "agent.json")
    except OSError:
        raise InputError(f"{folder} holds no agent.json; give the folder of an agent, as a run leaves it") from None
    if [type(about.get(key)) for key in ("class", "settings", "arrays")] != [str, dict, str]:
        raise InputError(f"{folder / 'agent.json'} is of no agent; run the benchmark again")
    for name, key in ((ARRAYS, "arrays"), (CODE, "code")):
        if isinstance(sha := about.get(key), str) and sha.isalnum():
            with contextlib.suppress(OSError):  # a folder that cannot be written: what is missing is said below
                _put_in_place(folder, name, sha)
    if "code" in about and (not (code := folder / CODE).is_file() or _sha256(code.read_bytes()) != about["code"]):
        raise InputError(f"{code} is missing, damaged, or of another agent; run the benchmark again")
    return about


def arrays(folder: Path, about: dict[str, Any]) -> bytes:
    """The file of an agent's arrays; about: its agent.json. Raises InputError if it is damaged or missing."""
    try:
        content = (folder / ARRAYS).read_bytes()
    except OSError as error:
        raise InputError(f"{folder / ARRAYS} cannot be read: {error.strerror}") from None
    if _sha256(content) != about["arrays"]:
        raise InputError(f"{folder / ARRAYS} is damaged, or of another agent; run the benchmark again")
    return content


def load(folder: Path | str) -> Agent:
    """Load the agent in a folder, ready for `begin`. Raises InputError if it is missing or damaged.

    The class that agent.json names is imported: loading an agent runs its code.
    """
    if not isinstance(folder, str | Path):
        raise InputError(f"the folder of an agent was {folder!r}; it must be a path")
    about = describe(folder := Path(folder))
    stored = arrays(folder, about)
    try:
        content = from_bytes(stored)
        where, _, name = about["class"].rpartition(":")
        cls, settings = outside.find("agent", f"{folder / where if where == CODE else where}:{name}"), about["settings"]
    except InputError as error:
        if isinstance(error.__cause__, ModuleNotFoundError):
            raise InputError(f"{error}; modules that it imports must be importable, as by PYTHONPATH") from None
        if about["class"].startswith(OWN):
            raise InputError(f"{error}; {OLDER}") from None
        raise
    except Exception as error:
        raise InputError(f"the agent in {folder} is damaged ({error_line(error)}); run the benchmark again") from None
    if not (inspect.isclass(cls) and issubclass(cls, Agent)):
        raise InputError(f"the agent in {folder} is {cls!r}; it must be a subclass of Agent")
    try:
        return cls.from_state(settings, content)
    except InputError:
        raise
    except Exception as error:  # what was saved is whole, by its sha256
        what = f"from_state of {cls.__qualname__} fails on the agent in {folder}"
        right = OLDER if about["class"].startswith(OWN) else "it must undo what state() gives"
        raise InputError(f"{what}: {error_line(error)}; {right}") from None
