"""Units of columns and of times: what they are called, and numbers in ours (s, m, m/s, rad, shares)."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from math import pi
from types import MappingProxyType
from typing import Any, Literal

import numpy as np

from saga_fg.errors import InputError
from saga_fg.numerics import FloatArray

Kind = Literal["time", "length", "speed", "angle", "score"]
FACTORS: Mapping[Kind, Mapping[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "length": {"m": 1.0, "cm": 0.01, "mm": 0.001, "km": 1000.0, "ft": 0.3048},
    "speed": {"m/s": 1.0, "km/h": 1 / 3.6, "mph": 0.44704, "ft/s": 0.3048},
    "angle": {"rad": 1.0, "deg": pi / 180, "clockwise": -1.0, "clockwise_deg": -pi / 180}
    | {"compass": -pi / 180, "compass_rad": -1.0},
    "score": {"share": 1.0, "percent": 0.01},
}
OFFSETS = {"compass": pi / 2, "compass_rad": pi / 2}
"""Offset of angles in these units, rad: a compass counts clockwise from the y axis, which is north."""
ISO = "iso8601"
UNITS: Mapping[str, Mapping[str, str]] = {
    "time": {"s": "s", "sec": "s", "secs": "s", "seconds": "s", "ms": "ms", "msec": "ms", "millis": "ms"}
    | {"us": "us", "usec": "us", "micros": "us", "ns": "ns", "nsec": "ns", "nanos": "ns", "utc": "s"},
    "length": {name: name for name in FACTORS["length"]} | {"meters": "m", "metres": "m", "feet": "ft"},
    "speed": {"mps": "m/s", "ms": "m/s", "m_s": "m/s", "kmh": "km/h", "kph": "km/h", "mph": "mph", "fps": "ft/s"},
    "angle": {"rad": "rad", "radians": "rad", "deg": "deg", "degrees": "deg", "degree": "deg"},
    "score": {"percent": "percent", "pct": "percent"},
}
"""Ends of the names of columns, by kind."""

_KINDS: dict[str, Kind] = {
    "timestamp": "time",
    **dict.fromkeys(("x", "y", "z", "length", "width", "height", "ego_x", "ego_y", "ego_z"), "length"),
    **dict.fromkeys(("gps_x", "gps_y", "gps_z", "odometry_x", "odometry_y"), "length"),
    **dict.fromkeys(("vx", "vy", "range_rate"), "speed"),
    **dict.fromkeys(("yaw", "ego_yaw", "odometry_yaw"), "angle"),
    "score": "score",
}
kind_of: Mapping[str, Kind] = MappingProxyType(_KINDS)
"""The quantity that the numbers of a column measure, by our name."""

_PER_SECOND = {"m": "m/s", "km": "km/h", "ft": "ft/s"}
_LARGEST_SECONDS = 1e11  # beyond, numbers are no seconds
_LONGEST_STEP = 10.0  # s between frames, beyond which a finer unit is likelier
_ISO_DAY = re.compile(r"\s*\d{4}-\d\d-\d\d\s*$")
_ISO_DATE = re.compile(r"\s*\d{4}-?\d\d-?\d\d[T ]\d\d")


def in_our_unit(name: str, numbers: FloatArray, unit: str, power: int = 1) -> FloatArray:
    """Numbers (n,) of a column of ours, in a unit to this power, in ours."""
    return numbers * FACTORS[kind_of[name]][unit] ** power + OFFSETS.get(unit, 0.0)


KINDS = ("time", "length", "speed", "angle", "score")


def unit_of_speed(length: str) -> str:
    """Unit of speeds where only that of lengths is given: the same per second."""
    return _PER_SECOND.get(length, "m/s") if length != "km" else "m/s"


@dataclass(frozen=True)
class Clock:
    """The clock of a column of times: its `unit` (s, ms, us, ns, iso8601, or frames at a rate such as 10Hz).

    guessed  True if the unit is neither given nor part of the column's name, and not s
    """

    unit: str = "s"
    guessed: bool = False

    def seconds(self, numbers: FloatArray) -> FloatArray:
        """Times (n,) as seconds."""
        if self.unit == ISO:
            return numbers
        rate = frame_rate(self.unit)
        if rate is not None:
            return numbers / rate
        return numbers if self.unit == "s" else numbers / round(1 / FACTORS["time"][self.unit])

    @classmethod
    def fitting(cls, numbers: FloatArray) -> Clock:
        """The clock that fits times (n,), NaN where there is none: s, unless they are too large for it.

        Of the finer units, that of times since 1970, or the first in which frames are not apart by 10 s and more.
        """
        known = np.unique(numbers[np.isfinite(numbers)])
        largest = float(np.abs(known).max(initial=0.0))
        if largest <= _LARGEST_SECONDS:
            return cls()
        with np.errstate(over="ignore"):  # damaged numbers
            step = float(np.median(np.diff(known))) if len(known) > 1 else 0.0
        likely = [unit for unit, most in (("ms", 1e14), ("us", 1e17), ("ns", np.inf)) if largest < most]
        fitting = [unit for unit in likely if step * FACTORS["time"][unit] <= _LONGEST_STEP]
        return cls((fitting or likely)[0], guessed=True)


def frame_rate(unit: str) -> float | None:
    """Frames per second of a unit such as 10Hz, None for another unit."""
    found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*[hH][zZ]", unit)
    return float(found[1]) if found and float(found[1]) > 0 else None


def quantity(name: str) -> str:
    """The quantity of a column of ours, or of that name itself."""
    return name if name in KINDS else kind_of.get(name, name)


def checked_unit(kind: str, unit: str) -> str:
    """A unit of a kind. Raises `InputError` for another."""
    if kind == "time" and (frame_rate(unit) is not None or unit == ISO):
        return unit
    known = FACTORS[kind]  # type: ignore[index]
    unit = UNITS.get(kind, {}).get(unit, unit)
    if unit not in known:
        rates = ", iso8601, or frames at a rate such as 10Hz" if kind == "time" else ""
        raise InputError(f"{kind}: expected one of {', '.join(known)}{rates}, got {unit[:40]!r}")
    return unit


def is_date(value: Any, to: Literal["day", "minute"] = "minute") -> bool:
    """True for a text that begins like a date with a time of ISO 8601, or is one without a time (`to` the day)."""
    return isinstance(value, str) and (_ISO_DATE if to == "minute" else _ISO_DAY).match(value) is not None


def seconds_of_dates(values: Sequence[Any]) -> FloatArray:
    """Seconds (n,) since 1970 of texts in ISO 8601, UTC where none says otherwise; NaN for None.

    Raises `ValueError` with the number of the row as its argument.
    """
    seconds = np.full(len(values), np.nan)
    for row, value in enumerate(values):
        if value is not None:
            try:
                seconds[row] = _seconds(value)
            except (AttributeError, TypeError, ValueError) as error:  # no text, or none of a date
                raise ValueError(row) from error
    return seconds


@cache
def _seconds(text: str) -> float:
    date = datetime.fromisoformat(text.strip())
    return (date if date.tzinfo is not None else date.replace(tzinfo=UTC)).timestamp()
