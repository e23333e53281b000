"""Parquet and Feather files, read with pyarrow (extra [parquet]) in a child process: its C++ trusts what it reads."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import date
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from data_tools.files.input_files import open_bytes
from data_tools.files.isolated_reading import isolated
from saga_fg.errors import InputError, MissingExtraError

SUFFIXES = (".parquet", ".feather", ".arrow")
NUMBERS, WHOLE = "iuf", "iu"  # kinds of NumPy's types
Choose = Callable[[list[str]], Sequence[str]]


def read_arrow_columns(path: Path, choose: Choose) -> dict[str, Any]:
    """The columns of a Parquet file (.parquet), or a Feather or Arrow file (other suffixes).

    A column of numbers that are all there is an array (N,); any other a list of N values, dates and times as text of
    ISO 8601, None where there is no value.

    choose  the columns to read from the names of all; it may raise `InputError`, as `all_of` does

    Raises `InputError` for a file that is not readable or has two columns of one name, `MissingExtraError` without
    pyarrow.
    """
    return {name: column for name, column, _ in _read(path, choose, False)}


def read_arrow_arrays(path: Path, choose: Choose, kinds: Mapping[str, str], filled: Sequence[str]) -> dict[str, Any]:
    """The columns of such a file as arrays (N,), NaN or None where there is no value.

    kinds   kinds of NumPy's types that a column may have, `NUMBERS` for those not named
    filled  columns that have a value in every row

    Raises as `read_arrow_columns` does, and `InputError` naming the file and the column.
    """
    columns = {}
    for name, column, missing in _read(path, choose, True):
        if missing and name in filled:
            raise InputError(f"{path}: {name}: expected a value in every row")
        allowed = kinds.get(name, NUMBERS)
        if column.dtype.kind not in allowed:
            expected = {NUMBERS: "numbers", WHOLE: "whole numbers"}.get(allowed, "text")
            raise InputError(f"{path}: {name}: expected {expected}, got {column.dtype}")
        columns[name] = column
    return columns


def all_of(path: Path, columns: Sequence[str]) -> Choose:
    """Choose these columns; raises `InputError` naming the first that is not there."""

    def choose(there: list[str]) -> Sequence[str]:
        for name in columns:
            if name not in there:
                raise InputError(f"{path}: {name}: expected this column, the file has {', '.join(there)[:200]}")
        return columns

    return choose


def _read(path: Path, choose: Choose, arrays: bool) -> Iterator[tuple[str, Any, int]]:
    """Names, values and numbers of missing values of the chosen columns."""
    kind = "Parquet" if path.suffix.lower() == ".parquet" else "Feather"
    if find_spec("pyarrow") is None:
        raise MissingExtraError(f"{path}: {kind} needs pyarrow: pip install 'saga-fg[parquet]'")
    problem = f"expected a readable {kind} file"
    (names,) = isolated(problem, _names, path)
    if len(set(names)) != len(names):
        raise InputError(f"{path}: expected every column once, got {', '.join(name[:40] for name in names)[:500]}")
    return isolated(problem, _columns, path, list(choose(names)), arrays)


def _names(path: Path) -> Iterator[list[str]]:
    from pyarrow import ArrowInvalid, feather, ipc, parquet

    with open_bytes(path) as file:
        if path.suffix.lower() == ".parquet":
            names = parquet.ParquetFile(file).schema_arrow.names
        else:
            try:
                names = ipc.open_file(file).schema.names
            except ArrowInvalid:  # the first version of Feather, or a file whose fault its reader tells
                file.seek(0)
                names = feather.read_table(file, memory_map=False).column_names
    yield list(names)


def _columns(path: Path, names: list[str], arrays: bool) -> Iterator[tuple[str, Any, int]]:
    from pyarrow import feather, parquet

    with open_bytes(path) as file:
        if path.suffix.lower() == ".parquet":
            table = parquet.ParquetFile(file).read(columns=names)
        else:
            table = feather.read_table(file, memory_map=False).select(names)
        table.validate(full=True)
    for name in names:
        yield name, table[name].to_numpy() if arrays else _values(table[name]), table[name].null_count


def _values(column: Any) -> np.ndarray[Any, Any] | list[Any]:
    kind = str(column.type)
    if kind.startswith("timestamp"):
        column = column.cast("timestamp[us]")
    elif not column.null_count and not kind.startswith(("string", "large_string", "null", "dictionary", "date")):
        return np.asarray(column.to_numpy())
    return [value.isoformat() if isinstance(value, date) else value for value in column.to_pylist()]
