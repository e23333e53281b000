"""Detections from tables of pandas, and tracks to them, with the columns of saga-fg's own files.

pandas is imported when a table is made; the extra `pandas` brings it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from saga_fg.errors import InputError, MissingExtraError
from saga_fg.numerics.arrays import BoolArray, FloatArray, StrArray, from_upper_triangle
from saga_fg.types.boxes import Boxes

Table = Any
"""A `pandas.DataFrame`; pandas may be missing, and its types are none of ours."""

PLACE = ("x", "y")
ANY_OF = {"score": ("score", "confidence"), "label": ("label", "class")}
"""Names under which a column is read."""

UNNAMED = "object"
"""Class of detections without a column of classes; any name will do."""


def boxes_of_table(table: Table) -> tuple[Boxes, FloatArray, FloatArray, FloatArray]:
    """Return the rows of a table as boxes (N), scores (N,), range rates (N,) and covariances (N, 2, 2) of positions.

    `Detections.from_pandas` has the columns. Raises `InputError` naming one that is missing or holds no numbers.
    """
    n = len(_checked(table, PLACE))
    score, z = (_numbers(table, name) for name in ("score", "z"))
    boxes = Boxes(
        _texts(table, "label", UNNAMED),
        np.column_stack([_numbers(table, "x"), _numbers(table, "y"), np.nan_to_num(z)]).reshape(n, 3),
        np.column_stack([_numbers(table, name) for name in ("length", "width", "height")]).reshape(n, 3),
        _numbers(table, "yaw"),
        np.column_stack([_numbers(table, name) for name in ("vx", "vy")]).reshape(n, 2),
    )
    covariance = np.column_stack([_numbers(table, name) for name in ("cov_xx", "cov_xy", "cov_yy")]).reshape(n, 3)
    return boxes, np.where(np.isnan(score), 1.0, score), _numbers(table, "range_rate"), from_upper_triangle(covariance)


def moments_of_table(table: Table) -> Iterator[tuple[float, str, Table]]:
    """Yield the rows of each time (s) and sensor, in order of time; `saga_fg.track` has the columns.

    Rows without a place are left out, so that there may be none. Raises `InputError` naming the column.
    """
    times = _seconds(_checked(table, ("timestamp", *PLACE)))
    sensors = _texts(table, "sensor", "sensor")
    there: BoolArray = ~(np.isnan(_numbers(table, "x")) & np.isnan(_numbers(table, "y")))
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


def _checked(table: Table, required: Sequence[str]) -> Table:
    if not hasattr(table, "columns") or not hasattr(table, "iloc"):
        raise InputError(f"expected a pandas.DataFrame, got {type(table).__name__}")
    missing = [name for name in required if name not in table.columns]
    if missing:
        there = ", ".join(map(str, table.columns))
        raise InputError(f"expected the columns {', '.join(required)}; {', '.join(missing)} missing, there are {there}")
    return table


def _column(table: Table, name: str) -> Any:
    return next((table[each] for each in ANY_OF.get(name, (name,)) if each in table.columns), None)


def _numbers(table: Table, name: str, default: float = np.nan) -> FloatArray:
    column = _column(table, name)
    if column is None:
        return np.full(len(table), default)
    try:
        return np.asarray(column.to_numpy(dtype=np.float64, na_value=np.nan))
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: expected numbers: {error}") from error


def _texts(table: Table, name: str, default: str) -> StrArray:
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
    return _numbers(table, "timestamp")
