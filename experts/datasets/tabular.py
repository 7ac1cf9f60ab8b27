"""Tables of csv and parquet files."""

import csv
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from deconfounded.envs.support.errors import InputError
from deconfounded.experts.datasets.table import EMPTY, EXTRA, WHOLE, Column, Table, number, spread

BLOCK = 1 << 16  # rows that are converted at once
DIGITS = 15  # that a float64 keeps of every decimal number


def read_csv(file: Path) -> Table:
    """A csv file with a header; separated by commas, semicolons or tabs, as its header is."""
    text, exact = set[str](), set[str]()  # names of columns that hold text; of those whose numbers are not all of it
    while True:
        names, blocks, late = *_header(file), set[str]()
        columns: dict[str, list[Column]] = {name: [] for name in names}
        written: dict[str, list[Column]] = {name: [] for name in names}
        places: dict[str, set[int]] = {name: set() for name in names}
        for rows in blocks:
            for name, cells in zip(names, zip(*rows, strict=True), strict=True):
                values = None if name in text else _numbers(cells)
                for kind, of_kind in (
                    (text, values is None),
                    (exact, values is not None and not _all_there(cells, values, places[name])),
                ):
                    if of_kind and name not in kind:
                        kind.add(name)
                        late |= {name} if columns[name] else set()  # blocks before this one were taken for others
                columns[name].append(np.array(cells, object) if values is None else values)
                if name in exact:
                    written[name].append(np.array([cell.strip() for cell in cells], object))
        if not late:
            break
    if not any(columns.values()):
        raise InputError(f"{file} holds no rows beside its header")
    as_written = {name: np.concatenate(written[name]) for name in exact - text}
    return Table(str(file), {name: np.concatenate(parts) for name, parts in columns.items()}, written=as_written)


def _header(file: Path) -> tuple[list[str], Iterator[list[list[str]]]]:
    """Names of columns, and blocks of rows. Raises InputError for a file that is no csv."""
    heads = {separator: _first_rows(file, separator) for separator in ",;\t"}
    separator = max(heads, key=lambda each: (1 < len(heads[each][0]) == len(heads[each][1]), len(heads[each][0])))
    names = [name.strip() for name in heads[separator][0]]
    if not any(names):
        raise InputError(f"{file} has no header; its first line must name the columns")
    _check_names(file, names)
    return names, _blocks(file, separator, len(names))


def _check_names(file: Path, names: list[str]) -> None:
    if twice := {name for name in names if names.count(name) > 1}:
        raise InputError(f"{file} has two columns that are called {min(twice)!r}; every name must be its own")


def _first_rows(file: Path, separator: str) -> tuple[list[str], list[str]]:
    """The header and the first row, which hold as many cells if the separator is the file's; empty if there is none."""
    try:
        with file.open(newline="", encoding="utf-8-sig") as opened:
            reader = csv.reader(opened, delimiter=separator)
            return next(reader, []), next(filter(None, reader), [])
    except UnicodeDecodeError as error:
        raise InputError(f"{file} is no csv in UTF-8 ({error.reason} at byte {error.start})") from None
    except csv.Error as error:
        raise InputError(f"{file} cannot be read near its first line: {error}") from None
    except OSError as error:
        raise InputError(f"{file} cannot be read: {error.strerror}") from None


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
    if any("_" in cell for cell in cells):  # which numpy reads over
        return None
    try:
        return np.array(cells, float)
    except ValueError:
        pass
    try:
        return np.array([*map(number, cells)])
    except ValueError:
        return None


def _all_there(cells: tuple[str, ...], values: Column, places: set[int]) -> bool:
    """Whether numbers are all that is in their cells: 007, 1e1, what float64 rounds, and 3.10 beside 3.1 are more.

    places: of decimals so far; this adds those of these cells, and 0 if one has a last digit that is no more than a 0.
    """
    held = values[~np.isnan(values)]
    if not np.isfinite(held).all():
        return True
    if (held != np.round(held)).any():
        places |= {len(cell) - cell.find(".") for cell in cells if "." in cell}
        if any(cell.endswith("0") and not cell.endswith(".0") and "e" not in cell.lower() for cell in cells):
            places.add(0)
        return 0 not in places or len(places) == 2  # all of as many digits
    texts = (cell.strip() for cell in {*cells})
    return all(text.lower() in EMPTY or text.removesuffix(".0") == f"{float(text):.0f}" for text in texts)


def read_parquet(file: Path) -> Table:
    """A parquet file."""
    arrays = _arrays(file)
    written = {name: _texts(array) for name, array in arrays.items() if not _kept(array)}
    times = frozenset(name for name, array in arrays.items() if _is_time(array))
    columns = _columns(arrays)
    unread = {name: str(x.type) for name, x in arrays.items() if name not in columns and f"{name}.0" not in columns}
    return Table(str(file), columns, written=written, times=times, unread=unread)


def parquet_columns(file: Path, parts: dict[str, list[str]] | None = None) -> dict[str, Column]:
    """Columns of a parquet file; lists of one length are several, `name.0` on, or as `parts` names them.

    What is neither number, time, text nor such a list is left out.
    """
    return _columns(_arrays(file), parts)


def _arrays(file: Path) -> dict[str, Any]:
    """The arrow arrays of a parquet file, by name. Raises InputError if there are no rows."""
    try:
        import pyarrow
        from pyarrow import parquet
    except ModuleNotFoundError:
        raise InputError(f"{file} needs pyarrow; {EXTRA}") from None
    try:
        data = parquet.ParquetFile(file).read()
    except (OSError, pyarrow.ArrowException) as error:
        raise InputError(f"{file} cannot be read as parquet: {' '.join(str(error).split())}") from None
    if not len(data):
        raise InputError(f"{file} holds no rows")
    _check_names(file, data.column_names)
    columns = zip(data.column_names, map(_plain, data.columns), strict=True)
    return {name: pyarrow.concat_arrays(column.chunks) for name, column in columns}


def _plain(column: Any) -> Any:
    """A chunked array; dates as timestamps, times of a day as durations, and views of text as text."""
    import pyarrow
    from pyarrow import types

    kind = column.type
    if types.is_date(kind):
        return column.cast(pyarrow.timestamp("ms"))
    if types.is_time(kind):
        whole = column.cast("int32" if types.is_time32(kind) else "int64").cast("int64")
        return whole.cast(pyarrow.duration(kind.unit))
    return column.cast("string") if types.is_string_view(kind) else column


def _columns(arrays: dict[str, Any], parts: dict[str, list[str]] | None = None) -> dict[str, Column]:
    columns: dict[str, Column] = {}
    for name, array in arrays.items():
        if (values := _values(array)) is not None:
            columns |= spread(name, values, (parts or {}).get(name, []))
    return columns


def _kept(array: Any) -> bool:
    """Whether `_values` keep all that an arrow array holds: not of times, nor of more digits than a float64 has."""
    from pyarrow import compute, types

    if types.is_integer(array.type):
        ends = compute.min_max(array).as_py().values()
        return all(end is None or abs(end) <= WHOLE for end in ends)
    if types.is_decimal(array.type):
        return array.type.precision <= DIGITS
    return not _is_time(array)


def _is_time(array: Any) -> bool:
    from pyarrow import types

    return types.is_timestamp(array.type) or types.is_duration(array.type)


def _texts(array: Any) -> Column:
    """Texts of whole numbers and decimals, or of times as whole numbers in their unit."""
    from pyarrow import types

    whole = array if types.is_integer(array.type) or types.is_decimal(array.type) else array.cast("int64")
    return np.array(["" if value is None else str(value) for value in whole.to_pylist()], object)


def _values(column: Any) -> Column | None:
    """An arrow array as [N] or [N, K]; None for what is neither number, time, text nor a list of one length."""
    from pyarrow import compute, types

    kind = column.type
    if types.is_dictionary(kind):
        return _values(column.dictionary_decode())
    if _is_time(column):
        per_second = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}[kind.unit]
        first = compute.min(column.cast("int64"))  # so that float64 keeps nanoseconds
        return np.asarray(compute.subtract(column.cast("int64"), first).to_numpy(False), float) / per_second
    if types.is_boolean(kind) or types.is_integer(kind) or types.is_floating(kind) or types.is_decimal(kind):
        return column.cast("float64", safe=False).to_numpy(zero_copy_only=False)
    if types.is_string(kind) or types.is_large_string(kind):
        return np.array(["" if value is None else value for value in column.to_pylist()], object)
    if types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind):
        if column.null_count or not len(column):
            return None
        flat = _values(column.flatten())
        if flat is not None and flat.ndim == 1 and len(set(compute.list_value_length(column).to_pylist())) == 1:
            return flat.reshape(len(column), -1)
    return None
