"""Tables for notebooks: detections and tracks from and to pandas, and as HTML.

Detections from tables of pandas, and tracks to them, with the columns of saga-fg's own files.

pandas is imported when a table is made; the extra `pandas` brings it.
"""

from __future__ import annotations

import html
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from saga_fg.errors import InputError, MissingExtraError
from saga_fg.numerics.arrays import BoolArray, FloatArray, StrArray, from_upper_triangle
from saga_fg.types.boxes import MAX_POSITION, MAX_SIZE, MAX_SPEED, Boxes

Table = Any
"""A `pandas.DataFrame`; pandas may be missing, and its types are not known here."""

PLACE = ("x", "y")
SIZE = ("length", "width", "height")
COVARIANCE = ("cov_xx", "cov_xy", "cov_yy")
LARGEST = {
    **dict.fromkeys((*PLACE, "z"), MAX_POSITION),
    **dict.fromkeys(SIZE, MAX_SIZE),
    **dict.fromkeys(("vx", "vy", "range_rate"), MAX_SPEED),
}
ANY_OF = {"score": ("score", "confidence"), "label": ("label", "class")}
"""Names under which a column is read."""

UNNAMED = "object"
"""Class of detections without a column of classes; any name will do."""


def boxes_of_table(table: Table) -> tuple[Boxes, FloatArray, FloatArray, FloatArray]:
    """Return the rows of a table as boxes (N), scores (N,), range rates (N,) and covariances (N, 2, 2) of positions.

    `Detections.from_pandas` has the columns. Raises `InputError` naming a column that is missing, or column and row (by
    its label in the index) of a value that can't be used.
    """
    n = len(checked_table(table, PLACE))
    score, z = (_usable(table, name) for name in ("score", "z"))
    boxes = Boxes(
        texts(table, "label", UNNAMED),
        np.column_stack([_usable(table, "x"), _usable(table, "y"), np.nan_to_num(z)]).reshape(n, 3),
        np.column_stack([_usable(table, name) for name in SIZE]).reshape(n, 3),
        _usable(table, "yaw"),
        np.column_stack([_usable(table, name) for name in ("vx", "vy")]).reshape(n, 2),
    )
    xx, xy, yy = (_usable(table, name) for name in COVARIANCE)
    given = ~(np.isnan(xx) & np.isnan(xy) & np.isnan(yy))
    _refuse(
        table, ", ".join(COVARIANCE), given & ~((xx > 0) & (yy > 0) & (xx * yy > xy**2)), "a positive definite matrix"
    )
    covariance = from_upper_triangle(np.column_stack([xx, xy, yy]).reshape(n, 3))
    return boxes, np.where(np.isnan(score), 1.0, score), _usable(table, "range_rate"), covariance


def moments_of_table(table: Table) -> Iterator[tuple[float, str, Table]]:
    """Yield the rows of each time (s) and sensor, in order of time; `saga_fg.track` has the columns.

    Rows without a place are left out, so that there may be none. Raises `InputError` naming the column.
    """
    times = _seconds(checked_table(table))
    sensors = texts(table, "sensor", "sensor")
    there: BoolArray = ~(np.isnan(numbers(table, "x")) & np.isnan(numbers(table, "y")))
    order = np.lexsort((sensors, times))
    new = np.ones(len(order), dtype=np.bool_)
    new[1:] = (np.diff(times[order]) > 0) | (sensors[order][1:] != sensors[order][:-1])
    for rows in np.split(order, np.flatnonzero(new)[1:]) if len(order) else ():
        yield float(times[rows[0]]), str(sensors[rows[0]]), table.iloc[rows[there[rows]]]


def new_table(parts: Sequence[Mapping[str, Any]]) -> Table:
    """Return a table of columns, given in parts of which there is one at least.

    Raises `MissingExtraError` without pandas.
    """
    return _pandas().DataFrame({name: np.concatenate([part[name] for part in parts]) for name in parts[0]})


def _pandas() -> Any:
    try:
        import pandas
    except ImportError as error:
        raise MissingExtraError("tables need pandas: pip install 'saga-fg[pandas]'") from error
    return pandas


def checked_table(table: Table, required: Sequence[str] = ("timestamp", *PLACE)) -> Table:
    """The table itself. Raises `InputError` for something else, and for missing columns."""
    if not hasattr(table, "columns") or not hasattr(table, "iloc"):
        raise InputError(f"expected a pandas.DataFrame, got {type(table).__name__}")
    missing = [name for name in required if name not in table.columns]
    if missing:
        there = ", ".join(map(str, table.columns))
        raise InputError(f"expected the columns {', '.join(missing)} as well, there are {there or 'none'}")
    return table


def _names(table: Table, name: str) -> list[str]:
    """The names of a column that the table has; the first of them is read."""
    return [each for each in ANY_OF.get(name, (name,)) if each in table.columns][:1]


def _column(table: Table, name: str) -> Any:
    return next((table[each] for each in _names(table, name)), None)


def _usable(table: Table, name: str) -> FloatArray:
    """A column of numbers, NaN where unknown. Raises `InputError` naming column and row of one that can't be used."""
    values, largest = numbers(table, name), LARGEST.get(name, np.inf)
    bad = np.isinf(values) | (np.abs(values) > largest)
    limit = f" of at most {largest:g}" if np.isfinite(largest) else ""
    if name in PLACE:
        _refuse(table, name, bad | np.isnan(values), f"a finite number{limit}")
    if name in SIZE:
        _refuse(table, name, bad | (values <= 0), f"a size above 0 m{limit}, or nothing for unknown")
    _refuse(table, name, bad, f"a finite number{limit}, or nothing for unknown")
    return values


def _refuse(table: Table, name: str, bad: BoolArray, expected: str) -> None:
    if bad.any():
        row = int(np.argmax(bad))
        there = [each for column in name.split(", ") for each in _names(table, column)]
        got = ", ".join(str(table[each].iloc[row]) for each in there)
        raise InputError(f"{', '.join(there)}: row {table.index[row]}: expected {expected}, got {got}")


def numbers(table: Table, name: str, default: float = np.nan) -> FloatArray:
    """A column as numbers (N,), `default` where there is none. Raises `InputError` where it holds others."""
    column = _column(table, name)
    if column is None:
        return np.full(len(table), default)
    try:
        return np.asarray(column.to_numpy(dtype=np.float64, na_value=np.nan))
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: expected numbers: {error}") from error


def texts(table: Table, name: str, default: str) -> StrArray:
    """A column as texts (N,), `default` where there is none."""
    column = _column(table, name)
    if column is None:
        return np.full(len(table), default)
    return np.where(column.isna().to_numpy(), default, column.astype(str).to_numpy().astype(np.str_)).astype(np.str_)


def _seconds(table: Table) -> FloatArray:
    column = table["timestamp"]
    if column.dtype.kind == "M":  # since 1970
        return np.asarray(column.to_numpy(dtype="datetime64[ns]").astype(np.int64) / 1e9)
    if column.dtype.kind == "m":
        return np.asarray(column.to_numpy(dtype="timedelta64[ns]").astype(np.int64) / 1e9)
    return numbers(table, "timestamp")


LONGEST = 20
"""Rows that are shown."""


def html_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str | float | int]]) -> str:
    """Return a title and the first rows of a table; NaN is left empty."""
    head = "".join(f"<th>{html.escape(name)}</th>" for name in columns)
    body = "".join(f"<tr>{''.join(f'<td>{_cell(value)}</td>' for value in row)}</tr>" for row in rows[:LONGEST])
    more = f"<p>and {len(rows) - LONGEST} more</p>" if len(rows) > LONGEST else ""
    return f"<p>{html.escape(title)}</p><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>{more}"


def text_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str | float | int]]) -> str:
    """Return the same for a terminal."""
    cells = [columns, *([_text(value) for value in row] for row in rows[:LONGEST])]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = ("  ".join(text.rjust(width) for text, width in zip(row, widths, strict=True)) for row in cells)
    more = [f"and {len(rows) - LONGEST} more"] if len(rows) > LONGEST else []
    return "\n".join([title, *lines, *more])


def _text(value: str | float | int) -> str:
    if isinstance(value, float):
        return f"{value:.2f}" if value == value else ""
    return str(value)


def _cell(value: str | float | int) -> str:
    return html.escape(_text(value))
