"""Logs as Trials: files and folders of several formats, read to the same arrays."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deconfounded.envs.support.errors import InputError
from deconfounded.experts.arrays import LARGEST
from deconfounded.experts.datasets.hdf5 import read_hdf5
from deconfounded.experts.datasets.lerobot import read_lerobot
from deconfounded.experts.datasets.minari_sets import read_minari
from deconfounded.experts.datasets.rows import Episode, Episodes, Roles, episodes_of
from deconfounded.experts.datasets.table import Odd, Table
from deconfounded.experts.datasets.tabular import read_csv, read_parquet
from deconfounded.experts.datasets.units import Units
from deconfounded.experts.trials import Trials

READERS = {
    **{".csv": read_csv, ".tsv": read_csv, ".parquet": read_parquet, ".pq": read_parquet},
    **{".hdf5": read_hdf5, ".h5": read_hdf5},
}
KINDS = "a .csv, .parquet, .hdf5 (of robomimic or D4RL) or .npz file, or the folder of a LeRobot or Minari data set"
MOST_DISCRETE = 32  # actions: more whole numbers than these are a continuous action

Source = str | Path | Sequence[str | Path]
"""A file, the folder of a data set, or several files of the same columns."""


@dataclass(frozen=True, eq=False)
class Log(Trials):
    """Trials of a log: what columns are called, in which units, names of trials, and notes on what was read."""

    units: Units = field(default_factory=lambda: Units((), (), (), ()))
    names: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @staticmethod
    def of(trials: Trials, where: str = "") -> "Log":
        """A log of trials that have no names."""
        units = Units.plain(trials.obs.shape[-1], trials.action.shape[-1], trials.actions)
        names, notes = tuple(str(i) for i in range(len(trials))), (f"{where}: {_size(trials.mask)}.",) if where else ()
        return Log(trials.obs, trials.action, trials.mask, trials.actions, units, names, notes)


def read(
    source: Source,
    trial: str | None = None,
    episode: str | None = None,
    obs: Sequence[str] = (),
    action: Sequence[str] = (),
) -> Log:
    """Trials of a log.

    trial, episode: the column whose value says which trial, and which episode of it, a row is of; where no column says
    what a trial is, each episode is one. obs, action: columns, by name or pattern ('speed*'). HDF5, LeRobot and Minari
    data sets say all but the trial themselves. Each row holds an observation, and the action chosen on it; the last
    row's action has no next observation, and is dropped. Actions are discrete if they are texts, or one column of up to
    32 whole numbers in a row; else each one's range, of all files together, becomes [-1, 1]; `units` leads back. Raises
    InputError for what cannot be read.
    """
    return read_together([source], trial, episode, obs, action)[0]


def read_together(
    sources: Sequence[Source],
    trial: str | None = None,
    episode: str | None = None,
    obs: Sequence[str] = (),
    action: Sequence[str] = (),
) -> list[Log]:
    """Several logs of the same columns, an expert's and exploration, say, with one range of actions; as `read`."""
    for what, given in (("obs", obs), ("action", action)):
        if isinstance(given, str) or not isinstance(given, Sequence) or not all(isinstance(x, str) for x in given):
            right = f", [{given!r}]" if isinstance(given, str) else ""
            raise InputError(f"{what} was {given!r}; it must be a list of columns{right}")
    for what, name in (("trial", trial), ("episode", episode)):
        if name is not None and not (isinstance(name, str) and name.strip()):
            raise InputError(f"{what} was {name!r}; it must be the name of a column")
    if isinstance(sources, str | Path):
        raise InputError(f"logs were {str(sources)!r}; they must be a list of logs, [{str(sources)!r}]")
    roles = Roles(trial, episode, tuple(obs), tuple(action))
    files = [_files(source) for source in sources]
    if not files:
        raise InputError("no log was given; give one or several")
    if all(file.suffix.lower() == ".npz" for group in files for file in group) and max(map(len, files)) == 1:
        if roles != Roles(None, None, (), ()):
            raise InputError(
                f"{files[0][0]} has no columns to choose; --trial, --episode, --obs, --action are of tables"
            )
        return [Log.of(Trials.load(file), str(file)) for [file] in files]
    return trials_of([[_table(file) for file in group] for group in files], roles)


def _files(source: Source) -> list[Path]:
    given = [source] if isinstance(source, str | Path) else source
    if not isinstance(given, Sequence) or not given or not all(isinstance(file, str | Path) for file in given):
        raise InputError(f"a log was {source!r}; it must be {KINDS}")
    for file in map(Path, given):
        if not file.exists():
            raise InputError(f"there is no {file}; give {KINDS}")
    return [Path(file) for file in given]


def _table(path: Path) -> Table:
    """What a file or folder holds, by its kind."""
    if path.is_dir():
        return read_lerobot(path) if (path / "meta" / "info.json").is_file() else read_minari(path)
    if path.suffix.lower() == ".npz":
        raise InputError(f"{path} holds Trials, whose actions are in [-1, 1]; give it alone, or beside another .npz")
    if path.suffix.lower() not in READERS:
        raise InputError(f"{path} is of an unknown kind; give {KINDS}")
    return READERS[path.suffix.lower()](path)


def trials_of(sources: list[list[Table]], roles: Roles) -> list[Log]:
    """Trials of each source, whose tables are parts of one log. Raises InputError if columns differ."""
    read = [[episodes_of(table, roles) for table in tables] for tables in sources]
    tables, parts = [*chain(*sources)], [*chain(*read)]
    for table, part in zip(tables, parts, strict=True):
        if (part.obs, part.action) != (parts[0].obs, parts[0].action):
            differ = sorted({*part.obs, *part.action} ^ {*parts[0].obs, *parts[0].action}) or ["their order"]
            raise InputError(f"{table.where} and {tables[0].where} have other columns: {', '.join(differ[:5])}")
        if len(tables) > 1 and (times := [name for name in (*part.obs, *part.action) if name in table.times]):
            what = f"{times[0]!r} of {table.where} is a time, which each file counts from its own first"
            raise InputError(f"{what}; leave it out, or give all rows in one file")
    texts = [part.episodes[0].action.dtype == object for part in parts]
    if any(texts) and not all(texts):
        of_text, of_numbers = (tables[texts.index(kind)].where for kind in (True, False))
        what = f"{parts[0].action[0]!r} is text in {of_text}, and numbers in {of_numbers}"
        raise InputError(f"{what}; write it alike in both")
    units, said = _units(tables, parts)
    horizon = max(table.horizon for table in tables)
    logs = []
    for group, episodes in zip(sources, read, strict=True):
        own = all(part.single for part in episodes)
        logs.append(_log(group, episodes, units, said, horizon, own))
    return logs


def _units(tables: list[Table], parts: list[Episodes]) -> tuple[Units, str]:
    """Units of all tables together, and a note on them."""
    obs, action = parts[0].obs, parts[0].action
    taken = np.concatenate([episode.action for part in parts for episode in part.episodes])
    whole = len(action) == 1 and taken.dtype != object and bool((taken == np.round(taken)).all())
    values: tuple[Any, ...] = ()
    if n := max(table.discrete for table in tables):
        values = tuple(range(n))
    elif taken.dtype == object:
        values = tuple(sorted({str(value) for value in taken.ravel()}))
        if len(values) > MOST_DISCRETE:
            right = f"an action must be a number, or one of {MOST_DISCRETE} texts"
            raise InputError(f"{action[0]!r} holds {len(values)} texts, as {values[0]!r}; {right}")
    elif whole and 2 <= len(held := np.unique(taken)) <= MOST_DISCRETE and held[-1] - held[0] == len(held) - 1:
        values = tuple(int(value) for value in held)
    if values:
        said = f"Actions: {action[0]}, discrete: {', '.join(map(str, values))}"
        return Units(obs, action, (0.0,), (len(values) - 1.0,), values), said
    low, high = taken.astype(float).min(0), taken.astype(float).max(0)
    for table in tables:
        for i, name in enumerate(action):
            if name in table.limits:
                low[i], high[i] = min(low[i], table.limits[name][0]), max(high[i], table.limits[name][1])
    if far := [(name, x) for name, *ends in zip(action, low, high, strict=True) for x in ends if abs(x) > LARGEST]:
        raise InputError(f"an action, {far[0][0]}, was {far[0][1]:g}; it must be at most {LARGEST:g} in size")
    ranges = "; ".join(f"{name} {a:.6g} to {b:.6g}" for name, a, b in zip(action, low, high, strict=True))
    said = f"Actions, each range taken as -1 to 1: {ranges}"
    if whole and 2 < len(held := np.unique(taken)) <= MOST_DISCRETE:
        listed = ", ".join(f"{value:g}" for value in held)
        said = Odd(f"{said}. They are whole numbers with gaps ({listed}); discrete ones must be consecutive, or texts")
    return Units(obs, action, tuple(low.tolist()), tuple(high.tolist())), said


def _log(tables: list[Table], parts: list[Episodes], units: Units, said: str, horizon: int, single: bool) -> Log:
    """The padded arrays. single: every episode is a trial."""
    by_trial: dict[str, list[Episode]] = {}
    for number, part in enumerate(parts):
        for episode in part.episodes:
            name = f"{tables[number].where}: {episode.trial}" if single and len(parts) > 1 else episode.trial
            by_trial.setdefault(name, []).append(episode)
    b, e = len(by_trial), max(map(len, by_trial.values()))
    t = max(horizon, max(len(episode.action) for part in parts for episode in part.episodes))
    obs, action = np.zeros((b, e, t + 1, len(units.obs))), np.zeros((b, e, t, len(units.action)))
    mask = np.zeros((b, e, t), bool)
    for i, episodes in enumerate(by_trial.values()):
        for j, episode in enumerate(episodes):
            n = len(episode.action)
            obs[i, j, : n + 1] = episode.obs
            obs[i, j, n + 1 :] = episode.obs[-1]
            action[i, j, :n] = units.scaled(episode.action)
            mask[i, j, :n] = True
    try:
        trials = Trials(obs, action, mask, len(units.values))  # type: ignore[arg-type]
    except InputError as error:
        listed = "; ".join(
            f"observation {i} is {name}" for i, name in enumerate(units.obs) if f"observation {i} " in str(error)
        )
        raise InputError(f"{error}{f' ({listed})' if listed else ''}") from None
    where = tables[0].where if len(tables) == 1 else f"{len(tables)} files"
    notes = [f"{where}: {_size(mask)}.", type(said)(f"{said}.")]
    files = Counter(name for part in parts for name in dict.fromkeys(episode.trial for episode in part.episodes))
    if not single and (shared := [name for name, count in files.items() if count > 1]):
        names = ", ".join(shared[:5]) + ", ..." * (len(shared) > 5)
        what = f"Rows of trial {names} are in several files, and are taken for one trial of each name"
        notes.append(Odd(f"{what}; if they are different trials, give these different names."))
    notes += [note for part in parts for note in part.notes]
    return Log(
        *(trials.obs, trials.action, trials.mask, trials.actions), units, tuple(by_trial), tuple(dict.fromkeys(notes))
    )


def _size(mask: NDArray[np.bool_]) -> str:
    """Numbers of trials, episodes and steps."""
    episodes, steps = mask.any(2).sum(1), mask.sum(2)[mask.any(2)]

    def span(values: NDArray[np.int64], what: str) -> str:
        low, high = int(values.min()), int(values.max())
        return f"{low:,} {what}{'s' * (low != 1)}" if low == high else f"{low:,} to {high:,} {what}s"

    return (
        f"{len(mask):,} trial{'s' * (len(mask) != 1)} of {span(episodes, 'episode')}, each of {span(steps, 'step')},"
        f" {mask.sum():,} in all"
    )
