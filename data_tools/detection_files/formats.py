"""The three formats of tables of boxes: CSV, newline-delimited JSON, NumPy archives."""

from __future__ import annotations

import csv
import json
import logging
from collections.abc import Callable
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from data_tools.detection_files.columns import COLUMNS, REQUIRED, RawTable, Values
from data_tools.located import located
from data_tools.numpy_files import load_archive
from saga_fg.errors import InputError

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Layout:
    """The columns a table may have, and those it must."""

    columns: tuple[str, ...] = COLUMNS
    required: tuple[str, ...] = REQUIRED


def read_raw_table(path: Path, layout: Layout | None = None) -> RawTable:
    """Read a table, of detections unless another layout is given, by its suffix.

    Raises `InputError` for another suffix and for files that are not what it says.
    """
    readers: dict[str, Callable[[Path, Layout], RawTable]] = {
        ".csv": _read_csv,
        ".ndjson": _read_ndjson,
        ".jsonl": _read_ndjson,
        ".npz": _read_npz,
    }
    if path.suffix.lower() not in readers:
        raise InputError(f"{path}: expected a file name that ends in {', '.join(readers)}")
    try:
        return readers[path.suffix.lower()](path, layout or Layout())
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: expected text in UTF-8: {error}") from error


def _open(path: Path) -> TextIO:
    return path.open(encoding="utf-8-sig", newline="")


def _read_csv(path: Path, layout: Layout) -> RawTable:
    rows: list[list[str]] = []
    lines: list[int] = []
    with _open(path) as file:
        reader = csv.reader(file)
        try:
            header = [name.strip() for name in next(reader, [])]
            if len(set(header)) != len(header):
                raise InputError(f"{path}: line 1: expected every column once, got {', '.join(header)}")
            for row in reader:
                if not row:
                    continue
                if len(row) != len(header):
                    raise InputError(f"{path}: line {reader.line_num}: expected {len(header)} columns, got {len(row)}")
                rows.append(row)
                lines.append(reader.line_num)
        except csv.Error as error:
            raise InputError(f"{path}: line {reader.line_num}: expected comma-separated values: {error}") from error
    columns: dict[str, Values] = {
        name: [value.strip() or None for value in column]
        for name, column in zip(header, zip(*rows, strict=True) if rows else [()] * len(header), strict=True)
        if name in layout.columns
    }
    _check_names(path, set(header), layout)
    return RawTable(path, columns, len(rows), lambda row: f"line {lines[row]}", numerals=True)


def _read_ndjson(path: Path, layout: Layout) -> RawTable:
    rows: list[dict[str, Any]] = []
    lines: list[int] = []
    with _open(path) as file:
        for number, line in enumerate(file, start=1):
            if not line.strip():
                continue
            try:
                row = json.loads(line)
            except (ValueError, RecursionError) as error:
                raise InputError(f"{path}: line {number}: broken or truncated JSON: {error}") from error
            if not isinstance(row, dict):
                raise InputError(f"{path}: line {number}: expected an object, got {line.strip()[:40]!r}")
            rows.append(row)
            lines.append(number)
    names = set().union(*rows)
    columns: dict[str, Values] = {name: [row.get(name) for row in rows] for name in layout.columns if name in names}
    if not rows:
        columns = {name: [] for name in layout.columns}
    elif "x" not in columns and "y" not in columns:  # every frame is empty
        columns |= {"x": [None] * len(rows), "y": [None] * len(rows)}
    _check_names(path, names | columns.keys(), layout)
    return RawTable(path, columns, len(rows), lambda row: f"line {lines[row]}")


def _read_npz(path: Path, layout: Layout) -> RawTable:
    with located(str(path)):
        names, arrays = load_archive(path, layout.columns)
    columns: dict[str, Values] = dict(arrays)
    _check_names(path, names, layout)
    length = len(columns["timestamp"]) if np.ndim(columns.get("timestamp", 0.0)) == 1 else 0
    for name, column in columns.items():
        if np.shape(column) != (length,):
            raise InputError(f"{path}: {name}: expected shape ({length},) as timestamp has, got {np.shape(column)}")
    return RawTable(path, columns, length, lambda row: f"row {row}")


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
