"""Episodes of a table: which rows they are, and what is wrong with them, in one line each."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deconfounded.envs.support.errors import InputError
from deconfounded.experts.datasets.table import EMPTY, Column, Odd, Table, number

CLOCKS = (  # in lower case
    *("step", "t", "time", "timestamp", "time_s", "frame", "frame_index", "seconds", "clock"),
    *("date", "datetime", "minutes", "minute", "ms", "tick", "ticks", "index"),
)
IN_CLOCKS = {"ts", "time", "timestamp", "timestep", "frame", "stamp", "sec", "elapsed", "tick"}  # words of other names
DOWN = {"left", "remaining", "until", "to"}  # words in names of time that runs down
NO_LABEL = EMPTY - {"none"}  # of a trial: "none" may be a condition
GAP = 1.5  # times the usual time between rows


@dataclass(frozen=True)
class Roles:
    """Names of columns, or patterns of them: what a trial and an episode is; what is observed, what is done."""

    trial: str | None = None
    episode: str | None = None
    obs: Sequence[str] = ()
    action: Sequence[str] = ()

    def __post_init__(self) -> None:
        for what, name in (("trial", self.trial), ("episode", self.episode)):
            if not isinstance(name, str | None):
                raise InputError(f"{what} was {name!r}; it must be the name of a column, or a pattern such as 'goal*'")


class Episode(NamedTuple):
    """Observations [n + 1, O] and actions [n, A] of an episode; actions are as in the log. trial: its trial's name."""

    trial: str
    obs: NDArray[np.float64]
    action: NDArray[Any]


class Episodes(NamedTuple):
    """Episodes of a table, names of observations and actions, and notes on what is odd.

    single: whether each is a trial of its own, as no column says what a trial is.
    """

    episodes: list[Episode]
    obs: tuple[str, ...]
    action: tuple[str, ...]
    notes: list[str]
    single: bool


def episodes_of(table: Table, roles: Roles) -> Episodes:
    """Episodes by the table's boundaries, or by columns. Raises InputError for what cannot be trials."""
    for what, given, default in (("obs", roles.obs, table.obs), ("action", roles.action, table.action)):
        if not given and not default:
            remedy = f"give --{what}, some of {', '.join(table.columns)}"
            raise InputError(f"{table.where} does not say which columns are {what}; {remedy}")
    if roles.episode is None and roles.trial is None and table.boundaries is None:
        raise InputError(
            f"{table.where} does not say where an episode begins; give --episode or --trial, of"
            f" {', '.join(table.columns)}"
        )
    names = table.select("obs", roles.obs) or table.obs, table.select("action", roles.action) or table.action
    action_names = names[1]
    groups = [() if name is None else table.select(what, [name]) for what, name in _groups(table, roles)]
    grouping = [name for group in groups for name in group]
    if twice := {*groups[0]} & {*groups[1]}:
        raise InputError(f"trial {min(twice)!r} of {table.where} is the episode too; a column has one role")
    for what, given, taken in (("obs", roles.obs, (*action_names, *grouping)), ("action", action_names, grouping)):
        if both := [name for name in given if name in taken]:
            role = "an action" if what == "obs" and both[0] in action_names else "what a trial or an episode is"
            raise InputError(f"{what} {both[0]!r} of {table.where} is {role} too; a column has one role")
    obs_names = tuple(name for name in names[0] if name not in action_names and name not in grouping)
    if not obs_names:
        raise InputError(f"no column of {table.where} is left for obs, beside the trial, the episode and the action")
    trial, labels = (_labels(table, group) if group else None for group in groups)
    used = [", ".join(group) for group in groups if group]
    first = _starts(table, used, [column for column in (trial, labels) if column is not None], roles)
    obs = np.stack([_numbers(table, name) for name in obs_names], 1)
    action, empty = _actions(table, action_names)
    bounds = list(zip(first, [*first[1:], len(table)], strict=True))
    late = sum(bool(empty[a].any() and not empty[b - 1].any()) for a, b in bounds if b - a > 1)
    if 2 * late > len(bounds):
        raise InputError(
            f"the action is empty in the first row of {late} episodes of {table.where}: it seems to stand beside the"
            " observation it led to; move it up by a row, to the observation it was chosen on"
        )
    episodes, single, lost = list[Episode](), 0, 0
    for i, (a, b) in enumerate(bounds):
        b -= int(np.isnan(obs[b - 1]).all())  # the observation after the last action is missing
        if b - a < 2:
            single += 1
            continue
        _check(table, obs_names, np.isnan(obs[a:b]), a, "holds no number")
        _check(table, obs_names, np.isinf(obs[a:b]), a, "is infinite")
        _check(table, action_names, empty[a : b - 1], a, "is empty")
        if action.dtype != object:
            _check(table, action_names, np.isinf(action[a : b - 1]), a, "is infinite")
        lost += not empty[b - 1].any()
        episodes.append(Episode(str(i) if trial is None else _text(trial[a]), obs[a:b], action[a : b - 1]))
    if not episodes:
        raise InputError(f"{table.where} holds no episode of two rows or more")
    notes = [*table.notes, *_notes(table, first, obs_names, action_names, single, lost)]
    if trial is None:
        shared = [
            name for name in table.columns if name not in (*obs_names, *action_names) and _repeats(table, name, first)
        ]
        hint = f" ({', '.join(shared[:5])} might say: --trial)" if shared else ""
        notes.append(f"No column says what a trial is: every episode counts as a trial of its own{hint}.")
    return Episodes(episodes, obs_names, action_names, notes, trial is None)


def _actions(table: Table, names: tuple[str, ...]) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Actions [N, A], numbers or, of one column alone, texts; and which of them are empty."""
    column = table.columns[names[0]]
    if len(names) > 1 or column.dtype != object:
        action = np.stack([_numbers(table, name) for name in names], 1)
        return action, np.isnan(action)
    cells = [str(cell).strip() for cell in column]
    empty = np.array([cell.lower() in EMPTY for cell in cells])
    if any(_is_number(cell) for cell, missing in zip(cells, empty, strict=True) if not missing):
        _numbers(table, names[0])  # which names the text among them
    return np.array(cells, object)[:, None], empty[:, None]


def _is_number(cell: str) -> bool:
    try:
        number(cell)
    except ValueError:
        return False
    return True


def _labels(table: Table, names: Sequence[str]) -> Column:
    """What tells trials or episodes apart [N]: a column, or the values of several together."""
    columns = [table.labels(name) for name in names]
    for name, column in zip(names, columns, strict=True):
        texts = column.dtype == object
        empty = np.array([str(cell).strip().lower() in NO_LABEL for cell in column]) if texts else np.isnan(column)
        _check(table, [name], empty[:, None], 0, "is empty")
    if len(columns) == 1:
        return columns[0]
    return np.array([", ".join(map(_text, row)) for row in zip(*columns, strict=True)], object)


def _groups(table: Table, roles: Roles) -> list[tuple[str, str | None]]:
    return [("trial", roles.trial or (None if roles.episode else table.trial)), ("episode", roles.episode)]


def _text(value: Any) -> str:
    """A trial's name; whole numbers without a point."""
    if not isinstance(value, float):
        return str(value)
    return f"{value:.0f}" if value.is_integer() else repr(float(value))


def _starts(table: Table, used: list[str], columns: list[Column], roles: Roles) -> list[int]:
    """The first row of each episode. used: names of the columns. Raises InputError for rows of one that stand apart."""
    own = table.boundaries is not None and roles.episode is None
    grouping = [table.boundaries] if own else columns
    keys = [np.unique(column, return_inverse=True)[1] for column in grouping if column is not None]
    changes = np.any([np.diff(key) != 0 for key in keys], 0)
    first = [0, *(1 + np.flatnonzero(changes)).tolist()]
    if own:
        for name, column in zip(used, columns, strict=True):
            inside = (column[1:] != column[:-1]) & ~changes
            if inside.any():
                row = int(np.flatnonzero(inside)[0]) + 2
                what = f"{name!r} of {table.where} changes within an episode, in row {row}"
                raise InputError(f"{what}; an episode is of one trial")
        return first
    seen: dict[tuple[int, ...], int] = {}
    for row in first:
        key = tuple(int(k[row]) for k in keys)
        if key in seen:
            what = ", ".join(f"{name} {_text(column[row])}" for name, column in zip(used, columns, strict=True))
            raise InputError(
                f"rows of {what} stand apart in {table.where}, from row {seen[key] + 1} and again from row {row + 1};"
                f" sort it by {', '.join(used)} and time{'' if roles.episode else ', or give --episode'}"
            )
        seen[key] = row
    return first


def _numbers(table: Table, name: str) -> NDArray[np.float64]:
    column = table.columns[name]
    if column.dtype != object:
        return column
    numbers = np.full(len(column), np.nan)
    for i, cell in enumerate(column):
        try:
            numbers[i] = number(cell)
        except ValueError:
            right = "a number, with a decimal point" if re.fullmatch(r"-?\d+,\d+", cell.strip()) else "a number"
            raise InputError(f"{name!r} of {table.where} is {cell!r} in row {i + 1}; it must be {right}") from None
    return numbers


def _check(table: Table, names: Sequence[str], bad: NDArray[np.bool_], offset: int, what: str) -> None:
    if bad.any():
        row, column = np.argwhere(bad)[0]
        cell = table.columns[names[column]][offset + row]
        held = f" ({cell.strip()!r})" if isinstance(cell, str) and cell.strip() else ""
        raise InputError(f"{names[column]!r} of {table.where} {what}{held} in row {offset + row + 1}")


def _inside(n: int, first: list[int]) -> NDArray[np.bool_]:
    """Which of n - 1 pairs of neighbouring rows [n - 1] are of one episode. first: the first row of each episode."""
    inside = np.ones(n - 1, bool)
    inside[np.array(first[1:], int) - 1] = False
    return inside


def _repeats(table: Table, name: str, first: list[int]) -> bool:
    """Whether a column is constant in episodes, and the same in several, but not in all."""
    column = table.columns[name]
    if name.lower() in CLOCKS or not 1 < len(first) < len(column):
        return False
    inside = _inside(len(column), first)
    return bool((column[1:] == column[:-1])[inside].all()) and 1 < len({*column[first].tolist()}) < len(first)


def _notes(
    table: Table, first: list[int], obs: Sequence[str], action: Sequence[str], single: int, lost: int
) -> list[str]:
    """What is odd, but can be worked with."""
    notes = []
    if single:
        notes.append(f"Episodes of one row, without a step, are left out: {single}.")
    if lost:
        notes.append(f"In {lost} episodes the last action has no next observation; it is dropped.")
    constant = [name for name in (*obs, *action) if _constant(table.columns[name])]
    if constant:
        notes.append(f"Constant: {', '.join(constant)}.")
    if {*action} <= {*constant}:
        notes.append("The action is always the same: there is nothing to imitate.")
    inside = _inside(len(table), first)
    rows = np.stack([table.columns[name] for name in (*obs, *action)], 1)
    same = (rows[1:] == rows[:-1]).all(1) & inside
    unused = [name for name in table.columns if name not in (*obs, *action)]
    clock = next((name for like in (_is_clock, _may_be_clock) for name in unused if like(name)), None)
    if clock is not None and (times := _times(table.columns[clock])) is not None:
        notes += _of_time(table, clock, np.diff(times), inside)
    elif same.any():
        notes.append(f"{same.sum():,} rows repeat the row before them (the first: row {np.flatnonzero(same)[0] + 2}).")
    return notes


def _is_clock(name: str) -> bool:
    return name.lower() in CLOCKS


def _may_be_clock(name: str) -> bool:
    words = {*re.findall("[a-z]+", name.lower())}
    return bool(words & IN_CLOCKS) and not words & DOWN


def _times(column: Column) -> NDArray[np.float64] | None:
    """A column of time as numbers, in seconds where it is of ISO 8601 texts; None for other texts."""
    if column.dtype != object:
        return column
    try:
        times = [datetime.fromisoformat(str(text).strip()) for text in column]
    except ValueError:
        return None
    return np.array([(time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp() for time in times])


def _constant(column: Column) -> bool:
    held = column[column != ""] if column.dtype == object else column[~np.isnan(column)]
    return bool((held == held[:1]).all())


def _of_time(table: Table, clock: str, passed: NDArray[np.float64], inside: NDArray[np.bool_]) -> list[str]:
    """Gaps, rows of the same time, and time that runs backwards, by a column of time."""
    forward = inside & (passed > 0)
    usual = float(np.median(passed[forward])) if forward.any() else 0.0
    kinds = {
        f"{{}} gaps: more than {GAP:g} times the usual {usual:.4g} of {clock} passes": passed > GAP * usual,
        f"{{}} rows have the {clock} of the row before them: duplicates?": (passed == 0) & (usual > 0),
        Odd(f"{clock} runs backwards {{}} times; are rows of several episodes taken for one, or unsorted?"): passed < 0,
    }
    notes = []
    for text, where in kinds.items():
        if (rows := np.flatnonzero(where & inside)).size:
            note = f"{text.format(f'{len(rows):,}')} (the first: row {rows[0] + 2} of {table.where})."
            notes.append(type(text)(note))
    return notes
