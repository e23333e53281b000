"""Tables of programs, of pandas, Polars or Arrow: detections in, tracks out as a table of the same kind."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from saga_fg.errors import InputError
from saga_fg.tables.column_names import Clock, TableImport, understood
from saga_fg.tables.columns import COLUMNS, NAMED, REQUIRED, RawTable, Values, as_names, clock_of
from saga_fg.tables.detections import DetectionTable, sorted_by_time
from saga_fg.types.dataset import Scene
from saga_fg.types.frame import Frame

Table = Any
"""A `pandas.DataFrame`, `polars.DataFrame` or `pyarrow.Table`; none of them need be installed."""

NAME = "table"  # in errors


def raw_table(
    table: Table,
    how: TableImport | None = None,
    columns: Sequence[str] = COLUMNS,
    required: Sequence[str] = REQUIRED,
) -> RawTable:
    """Return the columns of a table that have a meaning among `columns`, in order of time if they have times.

    how: what it takes to understand it; what is left out is found by the names of the columns

    Raises `InputError` for something else, and for columns that are missing, misspelt, or could be either of two.
    """
    import narwhals as nw

    try:
        frame = nw.from_native(table, eager_only=True)
    except TypeError as error:
        expected = "expected a table of pandas, Polars or Arrow"
        raise InputError(f"{expected}, got {type(table).__name__}") from error
    how = how or TableImport()
    found = understood(frame.columns, columns, required, how.columns)
    if found.faults:
        raise InputError(f"{NAME}: {'; '.join(found.faults)}")
    index, clock = nw.maybe_get_index(frame), None
    values: dict[str, Values] = {}
    for ours, theirs in found.names.items():
        column = frame[theirs]
        if isinstance(column.dtype, nw.Datetime | nw.Duration):
            is_time = isinstance(column.dtype, nw.Datetime)
            column, clock = column.dt.timestamp("ns") if is_time else column.dt.total_nanoseconds(), Clock("ns")
        values[ours] = as_names(_plain(column)) if ours in NAMED else _plain(column)

    def where(row: int) -> str:
        return f"row {row if index is None else index[row]}"

    raw = RawTable(Path(NAME), values, len(frame), where, False, found, how)
    raw = replace(raw, clock=clock or (clock_of(raw) if len(frame) else Clock()))
    return sorted_by_time(raw) if "timestamp" in values and len(frame) else raw


def _plain(column: Any) -> list[Any]:
    """Plain values of a column; None where one is missing."""
    missing = column.is_null().to_list()
    values = [value.item() if isinstance(value, np.generic) else value for value in column.to_list()]
    return [None if gone or value != value else value for value, gone in zip(values, missing, strict=True)]


def scenes_of(raw: RawTable) -> list[Scene]:
    """The recordings of a table of detections. Raises `InputError` naming row and column."""
    if raw.length == 0:
        return []
    table = DetectionTable(raw)
    return [table.scene(name) for name in table.scenes]


def frames_of(table: Table, how: TableImport | None = None) -> list[Frame]:
    """The frames of a table of detections of one recording, in order of time; `saga_fg.track` has the columns.

    Rows with the same time and sensor are a frame. Raises `InputError` naming row and column.
    """
    return [frame for scene in scenes_of(raw_table(table, how)) for frame in scene.frames]


def table_like(table: Table, parts: Sequence[Mapping[str, Any]]) -> Table:
    """Return a table of the same kind of columns that are given in parts, of which there is one at least."""
    import narwhals as nw

    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    backend = nw.from_native(table, eager_only=True).implementation
    return nw.from_dict({name: _listed(each) for name, each in columns.items()}, backend=backend).to_native()


def _listed(column: Any) -> Any:
    return column.tolist() if column.dtype.kind == "U" else column
