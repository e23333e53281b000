"""The columns of a table of detections and of the vehicle's motion, as checked arrays."""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from saga_fg.errors import InputError
from saga_fg.numerics import (
    BoolArray,
    FloatArray,
    IntArray,
    StrArray,
    checked_quaternions,
    quaternion_rotation,
    refuse,
    yaw_of,
)
from saga_fg.tables.column_names import COMMAND, Columns, TableImport
from saga_fg.tables.plausibility import days_taken_for_times, frames_taken_for_seconds, seconds_taken_for_frames
from saga_fg.tables.units import ISO, Clock, frame_rate, in_our_unit, is_date, seconds_of_dates
from saga_fg.types import (
    FILL_IN,
    LATEST,
    MAX_POSITION,
    MAX_SIZE,
    MAX_SPEED,
    EgoMeasurements,
    Finding,
    GpsFix,
    OdometryIncrement,
)

REQUIRED = ("timestamp", "x", "y")
BOX = ("z", "length", "width", "height", "yaw", "vx", "vy", "range_rate", "score")
POSE = ("ego_x", "ego_y", "ego_z", "ego_yaw")
TEXT = ("label", "sensor", "scene", "coordinates")
NAMED = (*TEXT, "id", "source", "quality")
ODOMETRY = ("odometry_x", "odometry_y", "odometry_yaw", "odometry_dt")
GPS = ("gps_x", "gps_y", "gps_z")
QUATERNION = ("qw", "qx", "qy", "qz")
ROTATIONS = {"yaw": QUATERNION, "ego_yaw": tuple(f"ego_{name}" for name in QUATERNION)}
COVARIANCE = ("cov_xx", "cov_xy", "cov_yy")
COLUMNS = (*REQUIRED, *BOX, *COVARIANCE, *TEXT, *POSE, *ODOMETRY, *GPS, *QUATERNION, *ROTATIONS["ego_yaw"], "empty")
TRACK_COLUMNS = (
    *("scene", "timestamp", "id", "label", "x", "y", "z", "length", "width", "height", "yaw", "vx", "vy", "score"),
    *(*COVARIANCE, "cov_vxvx", "cov_vxvy", "cov_vyvy", "coasting"),
)
SETTLED = "settled"  # 1 or 0, the last column of results
PROBABILITIES = ("p_exists", "p_class", "p_identity", "p_heading")
LABEL_COLUMNS = (*TRACK_COLUMNS, "yaw_variance", "source", "quality", *PROBABILITIES)
REVIEW_COLUMNS = (
    *("scene", "gain", "why", "id", "label", "boxes", "timestamp", "x", "y"),
    *(*PROBABILITIES, "boxes_far_off"),
)
LIMITS = {
    "timestamp": LATEST,
    **dict.fromkeys(("x", "y", "z", *POSE[:3], *ODOMETRY[:2], *GPS), MAX_POSITION),
    **dict.fromkeys(("length", "width", "height"), MAX_SIZE),
    **dict.fromkeys(("vx", "vy", "range_rate"), MAX_SPEED),
}
"""Largest numbers of columns, in our units."""
_ARGOVERSE = {"log_id", "timestamp_ns", "category", "length_m", "qw", "qz", "tx_m", "ty_m", "tz_m"}
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+")
LONGEST_NAME = 256  # characters; NumPy stores all texts of an array as wide as the widest

Values = Sequence[Any] | np.ndarray[Any, Any]


@dataclass(frozen=True, eq=False)
class RawTable:
    """Columns of N values each, by our names; `where(row)` says where in the file a row is.

    A value is text, a number, or None for one that was left out; with `numerals`, numbers come as text. `found` has the
    file's names and units, `how` what was asked for, `clock` the unit of times, `within` how options are named, as of
    `option_text`. Numbers come out in s, m, m/s and rad.
    """

    path: Path
    columns: dict[str, Values]
    length: int
    where: Callable[[int], str]
    numerals: bool = False
    found: Columns = field(default_factory=Columns)
    how: TableImport = field(default_factory=TableImport)
    clock: Clock = field(default_factory=Clock)
    within: str = COMMAND
    _read: dict[str, FloatArray] = field(default_factory=dict)

    def fault(self, row: int, what: str) -> InputError:
        """An error about one row."""
        return InputError(f"{self.path}: {self.where(row)}: {what}")

    def title(self, name: str) -> str:
        """The name of a column for people: ours, and that of the file where it is another."""
        theirs = self.found.names.get(name, name)
        return name if theirs == name else f"{name} (column {theirs[:40]!r})"

    def present(self, name: str) -> BoolArray:
        """Rows (N,) that have a value in a column, as a mask."""
        if name not in self.columns:
            parts = ROTATIONS.get(name, ())
            return self.present(parts[0]) if parts else np.zeros(self.length, dtype=bool)
        values = self.columns[name]
        if isinstance(values, np.ndarray):
            return np.ones(self.length, dtype=bool)
        return np.fromiter((value is not None for value in values), dtype=bool, count=self.length)

    def numbers(self, name: str, default: float = np.nan) -> FloatArray:
        """A column (N,) of finite numbers or NaN, in our units; `default` where left out.

        A yaw may come from the columns of a quaternion. Raises `InputError` for anything else.
        """
        if name not in self.columns:
            if any(part in self.columns for part in ROTATIONS.get(name, ())):
                return self._yaw_of_quaternions(name)
            return np.full(self.length, default)
        if name not in self._read:
            self._read[name] = self._in_our_unit(name)
        return np.where(self.present(name), self._read[name], default)

    def check_numbers(self, names: Sequence[str]) -> None:
        """Raise one `InputError` for all of these columns that hold anything but finite numbers."""
        faults = self.faults_of_numbers(names)
        if faults:
            raise InputError(f"{self.path}: {'; '.join(faults.values())}")

    def faults_of_numbers(self, names: Sequence[str]) -> dict[tuple[str, ...], str]:
        """Why columns hold anything but finite numbers, by those that share a reason, such as decimal commas."""
        faults: dict[tuple[str, ...], str] = {}
        commas: dict[str, int] = {}
        for name in names:
            try:
                self.numbers(name)
            except InputError as error:
                texts = enumerate(self.columns.get(name, ()))
                row = next((row for row, text in texts if _DECIMAL_COMMA.fullmatch(str(text))), None)
                if row is None:
                    faults[name,] = str(error).removeprefix(f"{self.path}: ")
                else:
                    commas[name] = row
        if commas:
            name, row = next(iter(commas.items()))
            got = f"expected decimal points, got {str(self.columns[name][row])[:40]!r}; replace the decimal commas"
            faults[tuple(commas)] = f"{self.where(row)}: {', '.join(commas)}: {got}"
        return faults

    def findings(self) -> list[Finding]:
        """Findings about columns as they are given, which cannot be seen in frames."""
        findings: list[Finding | None] = []
        if self.clock.unit == ISO:
            findings.append(days_taken_for_times(self.numbers("timestamp")))
        if "timestamp" in self.columns and self.how.unit("timestamp", None) is None and self.clock.unit == "s":
            findings.append(frames_taken_for_seconds(self.found.names.get("timestamp", ""), self.numbers("timestamp")))
        if "timestamp" in self.columns and frame_rate(self.clock.unit) is not None:
            findings.append(seconds_taken_for_frames(self.plain_numbers("timestamp")))
        command = self.argoverse_command()
        if command:
            what = "these are boxes of Argoverse 2, in the frame of the vehicle, and are taken for the world"
            findings.append(Finding("argoverse2", what, f"read them with the poses of their logs: {command}"))
        return [finding for finding in findings if finding is not None]

    def argoverse_command(self) -> str:
        """The command for a file in Argoverse's format without poses, "" for another."""
        if not {*self.found.names.values(), *self.found.unread} >= _ARGOVERSE:
            return ""
        if self.how.coordinates or "coordinates" in self.columns or self.present("ego_x").any():
            return ""
        name = shlex.quote(str(self.path))
        if "track_id" in self.found.names.values() or "track_id" in self.found.unread:
            return f"saga-fg evaluate argoverse2 {name} --dataroot {FILL_IN}"
        return f"saga-fg track argoverse2 --dataroot {FILL_IN} --detections {name} --output tracks.feather"

    def texts(self, name: str, default: str) -> StrArray:
        """A column (N,) of names; `default` where left out. A whole number is a name too, but in NumPy archives.

        Raises `InputError` for anything else.
        """
        if name not in self.columns:
            return np.full(self.length, default)
        values = self.columns[name]
        if isinstance(values, np.ndarray):
            if values.dtype.kind != "U":
                raise InputError(f"{self.path}: {self.title(name)}: expected an array of strings, got {values.dtype}")
            return np.where(values == "", default, values)
        for row, value in enumerate(values):
            if value is not None and not isinstance(value, str):
                raise self.fault(row, f"{self.title(name)}: expected a name, got {repr(value)[:40]}")
            if value is not None and len(value) > LONGEST_NAME:
                expected = f"expected a name of at most {LONGEST_NAME} characters"
                raise self.fault(row, f"{self.title(name)}: {expected}, got {len(value)}")
        return np.array([value or default for value in values], dtype=np.str_)

    def labels(self) -> tuple[StrArray, BoolArray]:
        """The class (N,) of each row by our names, and the rows whose class is to be left out, as a mask."""
        theirs, of_row = np.unique(self.texts("label", "object"), return_inverse=True)
        ours = [self.how.classes.get(name, name) for name in theirs.tolist()]
        out = np.array([name == "" for name in ours], dtype=np.bool_)
        return np.array([name or "object" for name in ours], dtype=np.str_)[of_row], out[of_row]

    def identities(self, name: str) -> StrArray:
        """A column (N,) of names or whole numbers of objects, as names. Raises `InputError` for anything else."""
        values = self.columns[name]
        names = []
        for row, value in enumerate(values.tolist() if isinstance(values, np.ndarray) else values):
            if isinstance(value, str) and self.numerals and value.endswith(".0"):
                value = value[:-2]
            if type(value) is float and value.is_integer():
                value = int(value)
            text = str(value) if type(value) in (int, str) else ""
            if not 0 < len(text) <= LONGEST_NAME:
                got = "it is left out" if value is None else f"got {str(value)[:40]!r}"
                raise self.fault(row, f"{self.title(name)}: expected a name or a whole number, {got}")
            names.append(text)
        return np.array(names, dtype=np.str_)

    def flags(self, name: str) -> BoolArray:
        """A column (N,) of booleans, False where left out. Raises `InputError` for anything else."""
        values = self.columns.get(name)
        if values is None:
            return np.zeros(self.length, dtype=bool)
        if not isinstance(values, np.ndarray) or values.dtype.kind != "b":
            raise InputError(f"{self.path}: {name}: expected an array of booleans, in NumPy archives only")
        return np.asarray(values, dtype=bool)

    def _in_our_unit(self, name: str) -> FloatArray:
        numbers = self.plain_numbers(name)
        with np.errstate(over="ignore"):  # is infinite then
            if name == "timestamp":
                numbers = self.clock.seconds(numbers)
            else:
                of, power = _unit_column(name)
                unit = self.how.unit(of, self.found.units.get(of))
                numbers = numbers if unit is None else in_our_unit(of, numbers, unit, power)
        large = np.abs(numbers) > LIMITS.get(name, sys.float_info.max)

        def fault(row: int) -> InputError:
            within = f" within {LIMITS[name]:g}" if np.isfinite(numbers[row]) else ""
            return self.fault(row, f"{self.title(name)}: expected a finite number{within}, got {numbers[row]:g}")

        refuse(large, fault)
        return numbers

    def plain_numbers(self, name: str) -> FloatArray:
        """A column (N,) in the unit of the file, NaN where left out; dates as s. Raises as `numbers`."""
        values = self.columns[name]
        if isinstance(values, np.ndarray):
            if values.dtype.kind not in "fiu":
                kind = "list" if values.dtype.kind == "O" else values.dtype
                raise InputError(f"{self.path}: {self.title(name)}: expected an array of numbers, got {kind}")
            return values.astype(np.float64)
        if name == "timestamp" and self.clock.unit == ISO:
            try:
                return seconds_of_dates(values)
            except ValueError as error:
                row = int(error.args[0])
                got = f"got {str(values[row])[:40]!r}"
                raise self.fault(row, f"{self.title(name)}: expected a date and time of ISO 8601, {got}") from error
        if name == "timestamp" and is_date(next((value for value in values if value is not None), None), "day"):
            got = "got dates without one, of which all rows of a day would be one frame"
            raise InputError(f"{self.path}: {self.title(name)}: expected times with the time of day, {got}")
        return self._converted(name, values)

    def _converted(self, name: str, values: Sequence[Any]) -> FloatArray:
        kinds = (str,) if self.numerals else (int, float)
        if set(map(type, values)) <= {*kinds, type(None)}:
            try:
                return np.array([np.nan if value is None else value for value in values], dtype=np.float64)
            except (ValueError, OverflowError):
                pass
        given = [row for row, value in enumerate(values) if value is not None]
        nonsense = [row for row in given if not _is_number(values[row], (str, int, float))]
        row = (nonsense or [row for row in given if not _is_number(values[row], kinds)])[0]
        dated = name == "timestamp" and isinstance(values[row], str)
        dates = ", or a date and time of ISO 8601 (2026-11-28T14:00:00)" if dated else ""
        raise self.fault(row, f"{self.title(name)}: expected a number{dates}, got {str(values[row])[:40]!r}")

    def _yaw_of_quaternions(self, name: str) -> FloatArray:
        """Heading (N,) of rotations w, x, y, z, of which x and y may be missing; NaN where one is left out."""
        names = ROTATIONS[name]
        w, _, _, z = (part in self.columns for part in names)
        if not (w and z):
            there = next(part for part in names if part in self.columns)
            theirs = self.found.names.get(there, there)
            mend = f"if it is the heading: --columns {name}={theirs}"
            raise InputError(f"{self.path}: {self.title(there)}: expected {' '.join(names)} with it; {mend}")
        parts = np.stack([self.numbers(part, np.nan if part in self.columns else 0.0) for part in names], axis=-1)
        known = np.flatnonzero(np.isfinite(parts).all(axis=1))
        yaw = np.full(self.length, np.nan)
        with np.errstate(over="ignore"):  # is odd then
            norm = np.linalg.norm(parts[known], axis=1)
        expected = f"{' '.join(names)}: expected a quaternion of length 1"
        refuse(np.abs(norm - 1) > 0.01, lambda row: self.fault(int(known[row]), f"{expected}, got {norm[row]:g}"))
        unit = checked_quaternions(" ".join(names), parts[known] / norm[:, None])
        yaw[known] = yaw_of(quaternion_rotation(unit))
        return yaw


def as_names(values: Values) -> Values:
    """Whole numbers as text, where names are expected."""
    values = values.tolist() if isinstance(values, np.ndarray) else values
    return [str(value) if type(value) is int else value for value in values]


def _unit_column(name: str) -> tuple[str, int]:
    """The column whose unit a column has, and its power: covariances have the square of what varies."""
    if name.startswith("cov_"):
        return ("vx" if name.startswith("cov_v") else "x"), 2
    return name, 1


def clock_of(table: RawTable) -> Clock:
    """The clock of a table: that which is given, that of the column's name, or that which fits the times."""
    values = table.columns.get("timestamp", ())
    given = table.how.unit("timestamp", None)
    first = next((value for value in values if value is not None), None) if not isinstance(values, np.ndarray) else None
    if given is not None:
        return Clock(given)
    if is_date(first):
        return Clock(ISO)
    if "timestamp" in table.found.units:
        return Clock(table.found.units["timestamp"])
    try:
        return Clock.fitting(table.plain_numbers("timestamp"))
    except (InputError, KeyError):  # named with its row, when the column is read
        return Clock()


def _is_number(value: Any, kinds: tuple[type, ...]) -> bool:
    try:
        float(value)
    except (TypeError, ValueError, OverflowError):
        return False
    return type(value) in kinds


@dataclass(frozen=True, eq=False)
class EgoColumns:
    """Odometry (N, 4), x, y, yaw and the time they took, and gps (N, 3) of N rows; NaN where nothing was measured."""

    odometry: FloatArray
    gps: FloatArray

    @classmethod
    def from_table(cls, raw: RawTable) -> EgoColumns | None:
        """Read those of a table, None where it has none. Raises `InputError` for a row with a part of them."""
        columns = []
        for names, least in ((ODOMETRY, 4), (GPS, 2)):
            values = np.stack([raw.numbers(name) for name in names], axis=-1)
            given = np.isfinite(values)
            part = given.any(axis=1) & ~given[:, :least].all(axis=1)
            if part.any():
                row = int(np.argmax(part))
                missing, there = names[int(np.argmin(given[row]))], names[int(np.argmax(given[row]))]
                raise raw.fault(row, f"{missing}: expected a number, since {there} is given")
            columns.append(values)
        took = columns[0][:, 3]
        refuse(took <= 0, lambda row: raw.fault(row, f"odometry_dt: expected seconds > 0, got {took[row]:g}"))
        return cls(*columns) if any(np.isfinite(values).any() for values in columns) else None

    def measured(self, rows: IntArray) -> EgoMeasurements:
        """Return what the rows of a frame measured, by the first of them that did."""
        odometry, gps = (_first(column[rows]) for column in (self.odometry, self.gps))
        fix = None if gps is None else GpsFix(gps[np.isfinite(gps)])
        return EgoMeasurements(None if odometry is None else _increment(*odometry.tolist()), fix)


def _increment(x: float, y: float, yaw: float, dt: float) -> OdometryIncrement:
    c, s = np.cos(yaw), np.sin(yaw)
    return OdometryIncrement(np.array([[c, -s, x], [s, c, y], [0.0, 0.0, 1.0]]), dt)


def _first(values: FloatArray) -> FloatArray | None:
    given = np.isfinite(values[:, 0])
    return values[int(np.argmax(given))] if given.any() else None
