"""The three formats of tables of boxes: CSV, newline-delimited JSON, NumPy archives."""

from __future__ import annotations

import csv
import json
import logging
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import Any, TextIO, TypeVar

import numpy as np

from data_tools.detection_files.columns import COLUMNS, REQUIRED, RawTable, Values
from data_tools.located import located
from data_tools.numpy_files import load_archive
from saga_fg.errors import InputError

log = logging.getLogger(__name__)

Row = TypeVar("Row")


@dataclass(frozen=True)
class Layout:
    """The columns a table may have, and those it must."""

    columns: tuple[str, ...] = COLUMNS
    required: tuple[str, ...] = REQUIRED


def read_raw_table(path: Path, layout: Layout | None = None) -> RawTable:
    """Read a table, of detections unless another layout is given, by its suffix.

    Raises `InputError` for another suffix and for files that are not what it says.
    """
    (table,) = read_raw_parts(path, layout, sys.maxsize)
    return table


def read_raw_parts(path: Path, layout: Layout | None = None, rows: int = 50_000) -> Iterator[RawTable]:
    """The same in parts of about `rows` rows, in their order; rows of one scene and time stay together.

    A file without rows is one empty part, a NumPy archive is one part. Columns that nobody gives in a part are missing
    from it.
    """
    readers: dict[str, Callable[[Path, Layout, int], Iterator[RawTable]]] = {
        ".csv": _read_csv,
        ".ndjson": _read_ndjson,
        ".jsonl": _read_ndjson,
        ".npz": _read_npz,
    }
    if path.suffix.lower() not in readers:
        raise InputError(f"{path}: expected a file name that ends in {', '.join(readers)}")
    try:
        yield from readers[path.suffix.lower()](path, layout or Layout(), rows)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: expected text in UTF-8: {error}") from error


def _open(path: Path) -> TextIO:
    return path.open(encoding="utf-8-sig", newline="")


def _read_csv(path: Path, layout: Layout, most: int) -> Iterator[RawTable]:
    with _open(path) as file:
        reader = csv.reader(file)
        try:
            header = [name.strip() for name in next(reader, [])]
            if len(set(header)) != len(header):
                raise InputError(f"{path}: line 1: expected every column once, got {', '.join(header)}")
            _check_names(path, set(header), layout)
            moment = [header.index(name) for name in ("scene", "timestamp") if name in header]
            for lines, rows in _parts(
                _csv_rows(path, reader, len(header)), most, lambda row: [row[i].strip() for i in moment]
            ):
                columns: dict[str, Values] = {
                    name: [value.strip() or None for value in column]
                    for name, column in zip(
                        header, zip(*rows, strict=True) if rows else [()] * len(header), strict=True
                    )
                    if name in layout.columns
                }
                yield RawTable(path, columns, len(rows), partial(_line, lines), numerals=True)
        except csv.Error as error:
            raise InputError(f"{path}: line {reader.line_num}: expected comma-separated values: {error}") from error


def _csv_rows(path: Path, reader: Any, columns: int) -> Iterator[tuple[int, list[str]]]:
    for row in reader:
        if not row:
            continue
        if len(row) != columns:
            raise InputError(f"{path}: line {reader.line_num}: expected {columns} columns, got {len(row)}")
        yield reader.line_num, row


def _read_ndjson(path: Path, layout: Layout, most: int) -> Iterator[RawTable]:
    with _open(path) as file:
        for lines, rows in _parts(
            _json_rows(path, file), most, lambda row: [row.get(name) for name in ("scene", "timestamp")]
        ):
            names = set().union(*rows)
            columns: dict[str, Values] = {
                name: [row.get(name) for row in rows] for name in layout.columns if name in names
            }
            if not rows:
                columns = {name: [] for name in layout.columns}
            elif "x" not in columns and "y" not in columns:  # every frame is empty
                columns |= {"x": [None] * len(rows), "y": [None] * len(rows)}
            _check_names(path, names | columns.keys(), layout)
            yield RawTable(path, columns, len(rows), partial(_line, lines))


def _json_rows(path: Path, file: TextIO) -> Iterator[tuple[int, dict[str, Any]]]:
    for number, line in enumerate(file, start=1):
        if not line.strip():
            continue
        try:
            row = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise InputError(f"{path}: line {number}: broken or truncated JSON: {error}") from error
        if not isinstance(row, dict):
            raise InputError(f"{path}: line {number}: expected an object, got {line.strip()[:40]!r}")
        yield number, row


def _parts(
    numbered: Iterator[tuple[int, Row]], most: int, moment: Callable[[Row], list[Any]]
) -> Iterator[tuple[list[int], list[Row]]]:
    """Line numbers and rows, parted where the moment changes and there are enough; at least one part."""
    lines: list[int] = []
    rows: list[Row] = []
    for number, row in numbered:
        if len(rows) >= most and moment(row) != moment(rows[-1]):
            yield lines, rows
            lines, rows = [], []
        lines.append(number)
        rows.append(row)
    yield lines, rows


def _line(lines: list[int], row: int) -> str:
    return f"line {lines[row]}"


def _read_npz(path: Path, layout: Layout, most: int) -> Iterator[RawTable]:
    with located(str(path)):
        names, arrays = load_archive(path, layout.columns)
    columns: dict[str, Values] = dict(arrays)
    _check_names(path, names, layout)
    length = len(columns["timestamp"]) if np.ndim(columns.get("timestamp", 0.0)) == 1 else 0
    for name, column in columns.items():
        if np.shape(column) != (length,):
            raise InputError(f"{path}: {name}: expected shape ({length},) as timestamp has, got {np.shape(column)}")
    yield RawTable(path, columns, length, lambda row: f"row {row}")


def _check_names(path: Path, names: set[str], layout: Layout) -> None:
    """Columns that are missing, or look misspelt, are errors; others that have no meaning here get a warning."""
    unknown = sorted(names - set(layout.columns))
    for name in unknown:
        nearest = get_close_matches(name, set(layout.columns) - names, n=1, cutoff=0.75)
        if nearest:
            raise InputError(f"{path}: unknown column {name!r}; did you mean {nearest[0]!r}?")
    for name in layout.required:
        if name not in names:
            there = ", ".join(sorted(names)[:12]) or "none"
            raise InputError(f"{path}: expected a column {name!r}, the columns there are {there}")
    if unknown:
        log.warning("%s: columns without a meaning here, not read: %s", path, ", ".join(unknown))
