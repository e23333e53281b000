"""Reading Parquet and Feather files with pyarrow (extra [parquet]), whose C++ trusts what it has read."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from data_tools.files.input_files import open_bytes
from saga_fg.errors import InputError, MissingExtraError

SUFFIXES = (".parquet", ".feather", ".arrow")
NUMBERS, WHOLE = "iuf", "iu"  # kinds of NumPy's types


def read_arrow_table(path: Path, choose: Callable[[list[str]], Sequence[str]]) -> Any:
    """The `pyarrow.Table` of a Parquet file (.parquet), or a Feather or Arrow file (other suffixes), validated.

    choose  the columns to read from the names of all; it may raise `InputError`, as `all_of` does

    Raises `InputError` for a file that is not readable, `MissingExtraError` without pyarrow.
    """
    arrow, parquet, feather = _pyarrow(path)
    with _readable(path, arrow), open_bytes(path) as file:
        if path.suffix.lower() == ".parquet":
            opened = parquet.ParquetFile(file)
            table = opened.read(columns=list(choose(list(opened.schema_arrow.names))))
        else:
            table = feather.read_table(file, memory_map=False)
            table = table.select(list(choose(list(table.column_names))))
        table.validate(full=True)
        return table


def all_of(path: Path, columns: Sequence[str]) -> Callable[[list[str]], Sequence[str]]:
    """Choose these columns; raises `InputError` naming the first that is not there."""

    def choose(there: list[str]) -> Sequence[str]:
        for name in columns:
            if name not in there:
                raise InputError(f"{path}: {name}: expected this column, the file has {', '.join(there)[:200]}")
        return columns

    return choose


def numpy_columns(path: Path, table: Any, kinds: Mapping[str, str], filled: Sequence[str]) -> dict[str, Any]:
    """The columns of a `pyarrow.Table` as arrays.

    kinds   kinds of NumPy's types that a column may have, `NUMBERS` for those not named
    filled  columns that have a value in every row

    Raises `InputError` naming the file and the column.
    """
    empty = [name for name in filled if table[name].null_count]
    if empty:
        raise InputError(f"{path}: {empty[0]}: expected a value in every row")
    columns = {name: table[name].to_numpy() for name in table.column_names}
    for name, column in columns.items():
        allowed = kinds.get(name, NUMBERS)
        if column.dtype.kind not in allowed:
            expected = {NUMBERS: "numbers", WHOLE: "whole numbers"}.get(allowed, "text")
            raise InputError(f"{path}: {name}: expected {expected}, got {column.dtype}")
    return columns


@contextmanager
def _readable(path: Path, arrow: Any) -> Iterator[None]:
    try:
        yield
    except (OSError, UnicodeDecodeError, arrow.ArrowException) as error:  # names of columns are decoded on demand
        kind = "Parquet" if path.suffix.lower() == ".parquet" else "Feather"
        reason = (str(error).splitlines() or ["empty"])[0]
        raise InputError(f"{path}: expected a readable {kind} file: {reason}") from error


def _pyarrow(path: Path) -> tuple[Any, Any, Any]:
    try:
        import pyarrow
        import pyarrow.feather
        import pyarrow.parquet
    except ImportError as error:
        what = "Parquet" if path.suffix.lower() == ".parquet" else "Feather"
        raise MissingExtraError(f"{path}: {what} needs pyarrow: pip install 'saga-fg[parquet]'") from error
    return pyarrow, pyarrow.parquet, pyarrow.feather
