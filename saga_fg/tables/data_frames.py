"""Tables of programs, of pandas, Polars or Arrow: detections in, tracks out as a table of the same kind."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from saga_fg.errors import InputError, require_type
from saga_fg.tables.column_names import Clock, TableImport, understood
from saga_fg.tables.columns import COLUMNS, NAMED, REQUIRED, RawTable, Values, as_names, clock_of
from saga_fg.tables.detections import DetectionTable, sorted_by_time
from saga_fg.types.dataset import Scene
from saga_fg.types.finding import Finding, refuse_contradictions
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
        names = [name for name in frame.columns if isinstance(name, str)]
        frame = frame.select(names)
    except TypeError as error:
        expected = "expected a table of pandas, Polars or Arrow"
        raise InputError(f"{expected}, got {type(table).__name__}") from error
    except nw.exceptions.NarwhalsError as error:
        raise InputError(f"{NAME}: expected every column once: {str(error).splitlines()[0]}") from error
    how = TableImport() if how is None else how
    require_type("how", how, TableImport)
    found = understood(names, columns, required, how.columns)
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

    Rows with the same time and sensor are a frame. Warns and raises as `saga_fg.track`, and for several recordings.
    """
    raw = raw_table(table, how)
    scenes = scenes_of(raw)
    if len(scenes) > 1:
        raise InputError(f"{NAME}: scene: expected one recording, got {', '.join(each.name for each in scenes[:6])}")
    tell([finding for scene in scenes for finding in scene.findings or ()], raw, 3)
    return [frame for scene in scenes for frame in scene.frames]


def tell(findings: Sequence[Finding], raw: RawTable, depth: int) -> None:
    """Warn of what is doubtful in a table, `depth` callers up, each kind once.

    Raises `InputError` for all that contradicts how it is read, with the arguments that mend it.
    """
    how, names = raw.how, raw.found.names
    known = {finding.kind: finding for finding in reversed(findings)}
    found = []
    for each in known.values():
        changes = {} if each.mend is None else how.changes(each.mend, names)
        option = ", ".join(f"{name}={value!r}" for name, value in changes.items())
        found.append(replace(each, what=each.what.removeprefix(f"{NAME}: "), option=option))
    refuse_contradictions(found, "as_given=True")
    for each in found:
        warnings.warn(str(each), stacklevel=depth)
    if raw.clock.guessed:
        unit = raw.clock.unit
        warnings.warn(f"times are read as {unit}, by their size; units={{'time': {unit!r}}} says so", stacklevel=depth)


def table_like(table: Table, parts: Sequence[Mapping[str, Any]]) -> Table:
    """Return a table of the same kind of columns that are given in parts, of which there is one at least."""
    import narwhals as nw

    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    backend = nw.from_native(table, eager_only=True).implementation
    listed = {name: each.tolist() if each.dtype.kind == "U" else each for name, each in columns.items()}
    return nw.from_dict(listed, backend=backend).to_native()
