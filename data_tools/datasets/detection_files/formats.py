"""The three formats of tables of boxes: CSV, newline-delimited JSON, NumPy archives."""

from __future__ import annotations

import csv
import logging
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import Any, TextIO, TypeVar

import numpy as np

from data_tools.datasets.detection_files.columns import COLUMNS, REQUIRED, RawTable, Values
from data_tools.files.error_messages import error_context
from data_tools.files.input_files import open_bytes, open_text
from data_tools.files.json_stream import parsed_json
from data_tools.files.numpy_files import load_archive
from saga_fg.errors import InputError

log = logging.getLogger(__name__)

Row = TypeVar("Row")
_OPEN_QUOTE = "a quote is opened and not closed on this line"


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
    """Read a table in parts of about `rows` rows, in their order; rows of one scene and time stay together.

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


def _read_csv(path: Path, layout: Layout, most: int) -> Iterator[RawTable]:
    with open_text(path, encoding="utf-8-sig", newline="") as file:
        numbered = _csv_rows(path, file)
        header = [name.strip() for name in next(numbered, (1, []))[1]]
        if len(set(header)) != len(header):
            got = ", ".join(name[:40] for name in header)
            raise InputError(f"{path}: line 1: expected every column once, got {got}")
        _check_names(path, set(header), layout)
        moment = [header.index(name) for name in ("scene", "timestamp") if name in header]
        for lines, rows in _parts(
            _full_rows(path, numbered, len(header)), most, lambda row: [row[i].strip() for i in moment]
        ):
            columns: dict[str, Values] = {
                name: [value.strip() or None for value in column]
                for name, column in zip(header, zip(*rows, strict=True) if rows else [()] * len(header), strict=True)
                if name in layout.columns
            }
            yield RawTable(path, columns, len(rows), partial(_line, lines), numerals=True)


def _csv_rows(path: Path, file: TextIO) -> Iterator[tuple[int, list[str]]]:
    """Line numbers and values; a value in quotes ends on its line, so that a stray quote swallows no others."""
    reader = csv.reader(file, strict=True)
    while True:
        number = reader.line_num + 1
        try:
            row = next(reader, None)
        except csv.Error as error:
            reason = _OPEN_QUOTE if reader.line_num > number else str(error)
            raise InputError(f"{path}: line {number}: expected comma-separated values: {reason}") from error
        if row is None:
            return
        if reader.line_num > number:
            raise InputError(f"{path}: line {number}: expected comma-separated values: {_OPEN_QUOTE}")
        yield number, row


def _full_rows(path: Path, numbered: Iterator[tuple[int, list[str]]], columns: int) -> Iterator[tuple[int, list[str]]]:
    for number, row in numbered:
        if not row:
            continue
        if len(row) != columns:
            raise InputError(f"{path}: line {number}: expected {columns} columns, got {len(row)}")
        yield number, row


def _read_ndjson(path: Path, layout: Layout, most: int) -> Iterator[RawTable]:
    with open_text(path, encoding="utf-8-sig", newline="") as file:
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
        row = parsed_json(line, f"{path}: line {number}")
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
    with open_bytes(path) as file, error_context(str(path)):
        names, arrays = load_archive(file, layout.columns)
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
            raise InputError(f"{path}: unknown column {name[:40]!r}; did you mean {nearest[0]!r}?")
    for name in layout.required:
        if name not in names:
            there = ", ".join(name[:40] for name in sorted(names)[:12]) or "none"
            raise InputError(f"{path}: expected a column {name!r}, the columns there are {there}")
    if unknown:
        log.warning("%s: columns without a meaning here, not read: %s", path, ", ".join(name[:40] for name in unknown))
