"""A table of logs, which every reader returns: columns by name, and episodes where the format has them."""

import difflib
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deconfounded.envs.support.errors import InputError

EXTRA = "`pip install deconfounded-imitation[data]` brings it"
EMPTY = {"", "na", "n/a", "nan", "null", "none"}  # cells, in lower case
WHOLE = 2**53  # up to which float64 holds every whole number
MAX_TEXT = 100  # characters of an attribute that may be a label

Column = NDArray[Any]
"""N numbers, or N texts; NaN is an empty cell."""


class Odd(str):
    """A note on what may mislead: trials may not be what they seem."""


@dataclass(frozen=True)
class Table:
    """Rows of logs in the order of time. A row holds an observation, and the action that was chosen on it.

    where: the file or folder. columns: each [N], by name. boundaries [N]: the number of each row's episode, or None
    where columns are to say it. obs, action, trial: names of columns that the format itself says are these. limits: the
    range of an action by its name, where the format declares it. discrete, horizon: the declared number of actions, T.
    written: texts of the columns whose numbers do not tell all of them apart, such as 007 and 7, or are `times`, which
    are counted from the file's first. unread: the types of columns that hold neither numbers, times nor text.
    """

    where: str
    columns: dict[str, Column]
    boundaries: NDArray[np.int64] | None = None
    obs: tuple[str, ...] = ()
    action: tuple[str, ...] = ()
    trial: str | None = None
    limits: dict[str, tuple[float, float]] = field(default_factory=dict)
    discrete: int = 0
    horizon: int = 0
    notes: tuple[str, ...] = ()
    written: dict[str, Column] = field(default_factory=dict)
    times: frozenset[str] = frozenset()
    unread: dict[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()))) if self.columns else 0

    def labels(self, name: str) -> Column:
        """A column [N] that is to tell trials or episodes apart."""
        return self.written.get(name, self.columns[name])

    def select(self, what: str, patterns: Sequence[str]) -> tuple[str, ...]:
        """Names of columns by name, by the first part of it (before a dot), or by a pattern such as 'speed*'.

        what: what they are for. Raises InputError for a pattern that no column matches.
        """
        names: list[str] = []
        for pattern in patterns:
            matches = [pattern] if pattern in self.columns else []
            matches = matches or [name for name in self.columns if name.startswith(f"{pattern}.")]
            matches = matches or [name for name in self.columns if fnmatchcase(name, pattern)]
            if pattern in self.unread:
                kind = self.unread[pattern]
                raise InputError(f"{what} {pattern!r} of {self.where} is of type {kind}; it must hold numbers or text")
            if not matches:
                raise InputError(
                    f"{what} {pattern!r} is no column of {self.where}; {suggestion(pattern, self.columns)}"
                )
            names += matches
        return tuple(dict.fromkeys(names))


def suggestion(name: str, names: Iterable[str]) -> str:
    """What was probably meant, or what there is."""
    names = list(names)
    if close := difflib.get_close_matches(name, names, 1) or [n for n in names if n.lower() == name.lower()]:
        return f"did you mean {close[0]!r}?"
    more = f" and {len(names) - 20} more" if len(names) > 20 else ""
    return f"there are {', '.join(names[:20])}{more}"


def spread(name: str, values: NDArray[Any], parts: Sequence[str] = ()) -> dict[str, Column]:
    """Columns of an array [N] or [N, K]: `name`, or `name.0` on, or `name.part`. None of one with more axes."""
    if values.ndim == 1:
        return {name: values}
    if values.ndim != 2:
        return {}
    suffixes = parts if len({*parts}) == len(parts) == values.shape[1] else [str(i) for i in range(values.shape[1])]
    return {f"{name}.{suffix}": values[:, i] for i, suffix in enumerate(suffixes)}


def number(cell: Any) -> float:
    """A cell as a number, NaN if it is empty. Raises ValueError for text, which 1_0 is, though Python reads 10."""
    text = str(cell).strip()
    if "_" in text:
        raise ValueError(text)
    return float("nan") if text.lower() in EMPTY else float(text)


def label(value: Any) -> Any:
    """A scalar attribute of an episode as a column's value; None for what is no number or short text."""
    value = value.decode(errors="replace") if isinstance(value, bytes) else value
    value = value.item() if isinstance(value, np.generic | np.ndarray) and np.size(value) == 1 else value
    if isinstance(value, list | tuple) and value and all(isinstance(item, str) for item in value):
        value = ", ".join(value)
    return value if isinstance(value, str | int | float) and len(str(value)) <= MAX_TEXT else None


def of_episodes(attributes: Sequence[dict[str, Any]], lengths: Sequence[int]) -> dict[str, Column]:
    """Columns of attributes of episodes, repeated over their rows; those that every episode has."""
    shared = [key for key in attributes[0] if all(key in other for other in attributes)] if attributes else []
    columns = {}
    for key in shared:
        values = [label(entry[key]) for entry in attributes]
        if None not in values:
            texts = any(isinstance(value, str) or abs(value) > WHOLE for value in values)
            array = np.array([str(value) for value in values], object) if texts else np.array(values, float)
            columns[key] = np.repeat(array, lengths)
    return columns


def natural(text: str) -> list[Any]:
    """A sort key by which demo_2 comes before demo_10."""
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", text)]
