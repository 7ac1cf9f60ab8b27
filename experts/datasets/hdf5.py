"""Tables of HDF5 files: robomimic's, with a group for each demonstration, and D4RL's, with flat arrays."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from deconfounded.envs.support.errors import InputError
from deconfounded.experts.datasets.table import EXTRA, Column, Table, natural, of_episodes, spread

FLAGS = ("terminals", "timeouts")  # of D4RL: of a row after which an episode ends


def read_hdf5(file: Path) -> Table:
    """An HDF5 file as robomimic or D4RL writes it. Raises InputError for another."""
    try:
        import h5py
    except ModuleNotFoundError:
        raise InputError(f"{file} needs h5py; {EXTRA}") from None
    try:
        with h5py.File(file) as opened:
            if "data" in opened and isinstance(opened["data"], h5py.Group):
                return _robomimic(file, opened["data"])
            if all(isinstance(opened.get(name), h5py.Dataset) for name in ("observations", "actions")):
                return _d4rl(file, opened)
            hint = "; give the folder of the Minari data set" if "episode_0" in opened else ""
            raise InputError(
                f"{file} holds {', '.join(list(opened)[:8]) or 'nothing'}; it must hold `data/demo_0` as of robomimic,"
                f" or `observations` and `actions` as of D4RL{hint}"
            )
    except OSError as error:
        raise InputError(f"{file} cannot be read as HDF5: {' '.join(str(error).split())}") from None


def _arrays(group: Any, prefix: str = "") -> dict[str, Any]:
    """Arrays of a group and of groups in it, by their path."""
    arrays: dict[str, Any] = {}
    for name, item in group.items():
        if item is None:
            raise InputError(f"{prefix}{name} of {group.file.filename} is a link to nothing")
        arrays |= _arrays(item, f"{prefix}{name}/") if isinstance(item, Mapping) else {f"{prefix}{name}": item}
    return arrays


def _rows(where: str, arrays: dict[str, Any], n: int) -> dict[str, Column]:
    """Columns of the arrays with n rows and at most two axes; text is left out."""
    columns: dict[str, Column] = {}
    for name, array in arrays.items():
        if array.ndim in (1, 2) and array.dtype.kind in "biuf" and len(array) == n:
            columns |= spread(name, np.asarray(array, float))
    if not _of("actions", columns):
        raise InputError(f"{where} has no `actions` of numbers, a row a step")
    return columns


def _of(array: str, names: Iterable[str]) -> tuple[str, ...]:
    """Names of an array's columns: its own, or that and a part after a dot."""
    return tuple(name for name in names if name.split(".")[0] == array)


def _ending(name: str, x: Column, later: dict[str, Column]) -> Column:
    """What a column would hold in a row of the next observation: no action, and what is neither stays."""
    return np.full_like(x, np.nan) if _of("actions", [name]) else later.get(name, x)


def _robomimic(file: Path, data: Any) -> Table:
    """`data/demo_i` with `actions`, `obs/...` and perhaps `next_obs/...`; attributes of a demonstration are columns.

    Pictures are left out. Without `next_obs` of all observations, the last one of each demonstration is missing.
    """
    names = sorted(data, key=natural)
    if not names:
        raise InputError(f"{file} holds no demonstrations under `data`")
    demos, attributes = list[dict[str, Column]](), list[dict[str, Any]]()
    for name in names:
        where, demo = f"{name} of {file}", data.get(name)  # None for a link to nothing
        if not isinstance(demo, Mapping) or not {"actions", "obs"} <= set(demo):
            raise InputError(f"{where} must hold `actions` and `obs`")
        arrays = {key: array for key, array in _arrays(demo).items() if array.ndim}
        if not (n := len(arrays.get("actions", ()))):
            raise InputError(f"{where} must hold `actions` [N, A] of at least one step")
        if short := [key for key, array in arrays.items() if key.startswith("obs/") and array.shape[:1] != (n,)]:
            raise InputError(f"{short[0]} of {where} has {len(arrays[short[0]])} rows; its actions have {n}")
        columns = _rows(where, arrays, n)
        later = {key[5:]: columns.pop(key) for key in list(columns) if key.startswith("next_obs/")}
        if later.keys() >= {key for key in columns if key.startswith("obs/")}:
            columns = {key: np.append(x, _ending(key, x, later)[-1]) for key, x in columns.items()}
        demos.append(columns)
        attributes.append({"demo": name, **data[name].attrs})
    if strange := next((i for i, demo in enumerate(demos) if set(demo) != set(demos[0])), None):
        differ = min(set(demos[strange]) ^ set(demos[0]))
        raise InputError(f"{names[strange]} and {names[0]} of {file} hold different arrays; {differ} is in one alone")
    columns = {key: np.concatenate([demo[key] for demo in demos]) for key in demos[0]}
    lengths = [len(next(iter(demo.values()))) for demo in demos]
    obs = tuple(key for key in columns if key.startswith("obs/"))
    if not obs:
        raise InputError(f"demonstrations of {file} hold no observations of numbers; pictures alone are not enough")
    action = _of("actions", columns)
    columns |= {key: x for key, x in of_episodes(attributes, lengths).items() if key not in columns}
    return Table(str(file), columns, np.repeat(np.arange(len(demos)), lengths), obs, action)


def _d4rl(file: Path, opened: Any) -> Table:
    """`observations`, `actions` [N, ...], `terminals` and `timeouts` [N], perhaps `next_observations`, `infos/...`."""
    arrays = {name: array for name, array in _arrays(opened).items() if array.ndim}
    if strange := {"observations", "actions"} - set(arrays):
        raise InputError(f"{min(strange)} of {file} is a single number; it must have a row a step")
    n = len(arrays["actions"])
    if len(arrays["observations"]) != n:
        raise InputError(f"{file} has {len(arrays['observations'])} observations and {n} actions; they must be as many")
    if strange := {name for name in FLAGS if name in arrays and arrays[name].shape not in ((n,), (n, 1))}:
        what = f"{min(strange)} of {file} has shape {arrays[min(strange)].shape}"
        raise InputError(f"{what}; it must be ({n},), a row an action")
    flat = {name: np.ravel(array) for name, array in arrays.items() if array.shape == (n, 1) and name in FLAGS}
    columns = _rows(str(file), arrays | flat, n)
    flags = [columns[name] for name in FLAGS if name in columns]
    if not flags:
        raise InputError(f"{file} has neither `terminals` nor `timeouts`; they must say where its episodes end")
    ends = np.any([flag != 0 for flag in flags], 0)
    episode = np.append(0, np.cumsum(ends)[:-1])
    shapes = [arrays[name].shape for name in ("observations", "next_observations") if name in arrays]
    if len(set(shapes)) > 1:
        raise InputError(f"next_observations of {file} have shape {shapes[1]}; it must be {shapes[0]}, as observations")
    later = {key[5:]: columns.pop(key) for key in list(columns) if key.startswith("next_observations")}
    if later:
        last = np.flatnonzero(np.append(np.diff(episode) != 0, True))
        at = last + 1  # after each episode's last row, a row of its last observation
        columns = {key: np.insert(x, at, _ending(key, x, later)[last]) for key, x in columns.items()}
        episode = np.insert(episode, at, episode[last])
    obs = _of("observations", columns)
    if not obs:
        raise InputError(f"observations of {file} have shape {arrays['observations'].shape}; they must be [N, O]")
    action = _of("actions", columns)
    return Table(str(file), columns, episode, obs, action)
