"""Tables of csv and parquet files."""

import csv
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from deconfounded.envs.support.errors import InputError
from deconfounded.experts.datasets.table import EXTRA, Column, Table, number, spread

BLOCK = 1 << 16  # rows that are converted at once


def read_csv(file: Path) -> Table:
    """A csv file with a header; separated by commas, semicolons or tabs, as its header is."""
    text: set[str] = set()
    while True:
        names, blocks, late = *_header(file), set[str]()
        columns: dict[str, list[Column]] = {name: [] for name in names}
        for rows in blocks:
            for name, cells in zip(names, zip(*rows, strict=True), strict=True):
                values = None if name in text else _numbers(cells)
                if values is None and name not in text:
                    text.add(name)
                    late |= {name} if columns[name] else set()  # blocks before this one were taken for numbers
                columns[name].append(np.array(cells, object) if values is None else values)
        if not late:
            break
    if not any(columns.values()):
        raise InputError(f"{file} holds no rows beside its header")
    return Table(str(file), {name: np.concatenate(parts) for name, parts in columns.items()})


def _header(file: Path) -> tuple[list[str], Iterator[list[list[str]]]]:
    """Names of columns, and blocks of rows. Raises InputError for a file that is no csv."""
    try:
        with file.open(newline="", encoding="utf-8-sig") as opened:
            line = opened.readline()
    except UnicodeDecodeError as error:
        raise InputError(f"{file} is no csv in UTF-8 ({error.reason} at byte {error.start})") from None
    separator = max(",;\t", key=line.count)
    names = [name.strip() for name in next(csv.reader([line], delimiter=separator), [])]
    if not any(names):
        raise InputError(f"{file} has no header; its first line must name the columns")
    if twice := {name for name in names if names.count(name) > 1}:
        raise InputError(f"{file} has two columns that are called {min(twice)!r}; every name must be its own")
    return names, _blocks(file, separator, len(names))


def _blocks(file: Path, separator: str, width: int) -> Iterator[list[list[str]]]:
    with file.open(newline="", encoding="utf-8-sig") as opened:
        reader = csv.reader(opened, delimiter=separator)
        next(reader)

        def rows() -> Iterator[list[str]]:
            for row in reader:
                if len(row) == width:
                    yield row
                elif row:
                    raise InputError(f"line {reader.line_num} of {file} has {len(row)} cells; its header has {width}")

        try:
            of_width = rows()
            while block := list(islice(of_width, BLOCK)):
                yield block
        except (UnicodeDecodeError, csv.Error) as error:
            raise InputError(f"{file} cannot be read near line {reader.line_num}: {error}") from None


def _numbers(cells: tuple[str, ...]) -> Column | None:
    """Cells as numbers; None if one is text."""
    try:
        return np.array(cells, float)
    except ValueError:
        pass
    try:
        return np.array([*map(number, cells)])
    except ValueError:
        return None


def read_parquet(file: Path) -> Table:
    """A parquet file."""
    return Table(str(file), parquet_columns(file))


def parquet_columns(file: Path, parts: dict[str, list[str]] | None = None) -> dict[str, Column]:
    """Columns of a parquet file; lists of one length are several, `name.0` on, or as `parts` names them.

    What is neither number, time, text nor such a list is left out.
    """
    try:
        import pyarrow
        from pyarrow import parquet
    except ModuleNotFoundError:
        raise InputError(f"{file} needs pyarrow; {EXTRA}") from None
    try:
        data = parquet.ParquetFile(file).read()
    except (OSError, pyarrow.ArrowException) as error:
        raise InputError(f"{file} cannot be read as parquet: {' '.join(str(error).split())}") from None
    columns: dict[str, Column] = {}
    for name, chunked in zip(data.column_names, data.columns, strict=True):
        column = pyarrow.concat_arrays(chunked.chunks) if chunked.num_chunks else pyarrow.array([], chunked.type)
        columns |= spread(name, values, (parts or {}).get(name, [])) if (values := _values(column)) is not None else {}
    if not len(data):
        raise InputError(f"{file} holds no rows")
    return columns


def _values(column: Any) -> Column | None:
    """An arrow array as [N] or [N, K]; None for what is neither number, time, text nor a list of one length."""
    from pyarrow import compute, types

    kind = column.type
    if types.is_dictionary(kind):
        return _values(column.dictionary_decode())
    if types.is_timestamp(kind) or types.is_duration(kind):
        per_second = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}[kind.unit]
        first = compute.min(column.cast("int64"))  # so that float64 keeps nanoseconds
        return np.asarray(compute.subtract(column.cast("int64"), first).to_numpy(False), float) / per_second
    if types.is_boolean(kind) or types.is_integer(kind) or types.is_floating(kind) or types.is_decimal(kind):
        return column.cast("float64").to_numpy(zero_copy_only=False)
    if types.is_string(kind) or types.is_large_string(kind):
        return np.array(["" if value is None else value for value in column.to_pylist()], object)
    if types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind):
        if column.null_count or not len(column):
            return None
        flat = _values(column.flatten())
        if flat is not None and flat.ndim == 1 and len(set(compute.list_value_length(column).to_pylist())) == 1:
            return flat.reshape(len(column), -1)
    return None
