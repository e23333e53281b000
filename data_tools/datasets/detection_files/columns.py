"""The columns of a table of detections, from whatever a format gives to checked arrays."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from saga_fg.errors import InputError
from saga_fg.numerics.arrays import BoolArray, FloatArray, StrArray

REQUIRED = ("timestamp", "x", "y")
BOX = ("z", "length", "width", "height", "yaw", "vx", "vy", "range_rate", "score")
POSE = ("ego_x", "ego_y", "ego_z", "ego_yaw")
TEXT = ("label", "sensor", "scene", "coordinates")
ODOMETRY = ("odometry_x", "odometry_y", "odometry_yaw", "odometry_dt")
GPS = ("gps_x", "gps_y", "gps_z")
COLUMNS = (*REQUIRED, *BOX, *TEXT, *POSE, *ODOMETRY, *GPS, "empty")
LONGEST_NAME = 256  # characters; NumPy stores all texts of an array as wide as the widest

Values = Sequence[Any] | np.ndarray[Any, Any]


@dataclass(frozen=True, eq=False)
class RawTable:
    """Columns of N values each as a format gives them; `where(row)` says where in the file a row is.

    A value is text, a number, or None for one that was left out; with `numerals`, numbers come as text.
    """

    path: Path
    columns: dict[str, Values]
    length: int
    where: Callable[[int], str]
    numerals: bool = False

    def fault(self, row: int, what: str) -> InputError:
        """An error about one row."""
        return InputError(f"{self.path}: {self.where(row)}: {what}")

    def present(self, name: str) -> BoolArray:
        """Rows (N,) that have a value in a column, as a mask."""
        if name not in self.columns:
            return np.zeros(self.length, dtype=bool)
        values = self.columns[name]
        if isinstance(values, np.ndarray):
            return np.ones(self.length, dtype=bool)
        return np.fromiter((value is not None for value in values), dtype=bool, count=self.length)

    def numbers(self, name: str, default: float = np.nan) -> FloatArray:
        """A column (N,) of finite numbers or NaN; `default` where left out. Raises `InputError` for anything else."""
        if name not in self.columns:
            return np.full(self.length, default)
        values = self.columns[name]
        if isinstance(values, np.ndarray):
            if values.dtype.kind not in "fiu":
                raise InputError(f"{self.path}: {name}: expected an array of numbers, got {values.dtype}")
            numbers = values.astype(np.float64)
        else:
            numbers = self._converted(name, values, default)
        if np.isinf(numbers).any():
            raise self.fault(int(np.argmax(np.isinf(numbers))), f"{name}: expected a finite number, got inf")
        return numbers

    def texts(self, name: str, default: str) -> StrArray:
        """A column (N,) of names; `default` where left out. Raises `InputError` for anything else."""
        if name not in self.columns:
            return np.full(self.length, default)
        values = self.columns[name]
        if isinstance(values, np.ndarray):
            if values.dtype.kind != "U":
                raise InputError(f"{self.path}: {name}: expected an array of strings, got {values.dtype}")
            return np.where(values == "", default, values)
        for row, value in enumerate(values):
            if value is not None and not isinstance(value, str):
                raise self.fault(row, f"{name}: expected a name, got {repr(value)[:40]}")
            if value is not None and len(value) > LONGEST_NAME:
                raise self.fault(row, f"{name}: expected a name of at most {LONGEST_NAME} characters, got {len(value)}")
        return np.array([value or default for value in values], dtype=np.str_)

    def flags(self, name: str) -> BoolArray:
        """A column (N,) of booleans, False where left out. Raises `InputError` for anything else."""
        values = self.columns.get(name)
        if values is None:
            return np.zeros(self.length, dtype=bool)
        if not isinstance(values, np.ndarray) or values.dtype.kind != "b":
            raise InputError(f"{self.path}: {name}: expected an array of booleans, in NumPy archives only")
        return np.asarray(values, dtype=bool)

    def _converted(self, name: str, values: Sequence[Any], default: float) -> FloatArray:
        kinds = (str,) if self.numerals else (int, float)
        if set(map(type, values)) <= {*kinds, type(None)}:
            try:
                return np.array([default if value is None else value for value in values], dtype=np.float64)
            except (ValueError, OverflowError):
                pass
        row = next(row for row, value in enumerate(values) if value is not None and not _is_number(value, kinds))
        raise self.fault(row, f"{name}: expected a number, got {str(values[row])[:40]!r}")


def _is_number(value: Any, kinds: tuple[type, ...]) -> bool:
    try:
        float(value)
    except (TypeError, ValueError, OverflowError):
        return False
    return type(value) in kinds
