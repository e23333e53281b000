"""Corrections of labels by a person, as factors of the same graph.

A correction names an object by a place and a time, never by a number, so that it outlives another run of the detector:
it is about the object whose smoothed position is nearest there, within `REACH`. Objects of the class that the place
names come first. Where there is none, free detections near the place become one; a box needs not even these.

    exists    the object is kept, or goes
    class     its class
    same      the objects at two places are one, or the object at two times is two (cut at its least certain step)
    box       a measurement of position, height, heading and size with the deviations given
    standing  || v(k) ||_{d^2/dt I} from a time to another, as of stationary objects
    size      its size

The objects concerned are solved again: with the detections they then have, free ones near their new states, and the
edges to the objects around them, whose own states stay. Of corrections that contradict each other the later one counts.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

import numpy as np

from saga_fg.errors import InputError
from saga_fg.numerics import FloatArray
from saga_fg.types import LATEST, MAX_POSITION, MAX_SIZE

What = Literal["exists", "class", "same", "box", "standing", "size"]
SIZE = ("length", "width", "height")
LEAST, RADIANS = 1e-4, 2 * np.pi  # m and rad, of sizes and deviations; rad, beyond which headings are degrees
FARTHEST, FASTEST = 20.0, 60.0  # m from an object to its box, and m/s in the time between them
DEVIATIONS = {"position": 0.1, "height": 0.1, "yaw": 0.05, "size": 0.05}
"""Standard deviations of a person's box where it gives none: m, m, rad, m."""

UNKNOWN_SIZE = np.full(3, np.nan)
UNKNOWN_SIZE.flags.writeable = False


@dataclass(frozen=True)
class Place:
    """Where an object is: time, s, position in the world, m, and its class if that is known."""

    time: float
    x: float
    y: float
    label: str = ""

    def __str__(self) -> str:
        return f"{self.label or 'object'} at {self.time:g} s, x {self.x:.1f}, y {self.y:.1f}"


@dataclass(frozen=True)
class WholeObject:
    """Corrections of an object as a whole: existence, class, size (3,), m; None, "" and NaN where there are none."""

    exists: bool | None = None
    label: str = ""
    size: FloatArray = field(default_factory=lambda: UNKNOWN_SIZE)

    def updated(self, later: WholeObject) -> WholeObject:
        """With what was said later."""
        exists = self.exists if later.exists is None else later.exists
        return WholeObject(exists, later.label or self.label, np.where(np.isnan(later.size), self.size, later.size))


@dataclass(frozen=True)
class Correction:
    """One correction.

    at         the object
    other      for `same`: the other one
    value      for `exists` and `same`: whether it is so
    label      for `class`, and for the box of an object that nothing detected
    until      for `standing`, s; from the time of `at` on
    box        for `box` and `size`, by name: time, if not that of `at`, x, y, z, yaw, length, width, height
    deviation  of its parts, by name as in `DEVIATIONS`
    who, when  as given; scene: the recording, "" for any
    origin     what to call it in messages
    """

    what: What
    at: Place
    other: Place | None = None
    value: bool = True
    label: str = ""
    until: float = np.nan
    box: Mapping[str, float] = field(default_factory=dict)
    deviation: Mapping[str, float] = field(default_factory=lambda: DEVIATIONS)
    who: str = ""
    when: str = ""
    scene: str = ""
    origin: str = "correction"

    @property
    def size(self) -> FloatArray:
        """(3,) length, width and height, m; NaN where nothing is said."""
        return np.array([self.box.get(name, np.nan) for name in SIZE])

    @property
    def whole(self) -> WholeObject:
        """The part of the correction that holds for the object at all times."""
        exists = self.value if self.what == "exists" else True if self.what == "box" else None
        return WholeObject(exists, self.label, self.size if self.what == "size" else UNKNOWN_SIZE)

    @property
    def time(self) -> float:
        """When the box is, s."""
        return self.box.get("time", self.at.time)

    @property
    def too_far(self) -> str:
        """Why a box is not believed to be of its object, "" where it may be."""
        moved = float(np.hypot(self.box.get("x", self.at.x) - self.at.x, self.box.get("y", self.at.y) - self.at.y))
        limit = FARTHEST + FASTEST * abs(self.time - self.at.time)
        return f"the box is {moved:.1f} m from its object, expected at most {limit:g} m" if moved > limit else ""

    def __str__(self) -> str:
        return f"{self.origin}: {self.what}, {self.at}"


FIELDS = {
    "exists": ("value",),
    "class": ("label",),
    "same": ("value", "and"),
    "box": ("box", "deviation", "label"),
    "standing": ("until",),
    "size": ("box",),
}
COMMON = ("what", "at", "who", "when", "scene")


def correction_from(record: Any, origin: str = "correction") -> Correction:
    """Check a record of plain values, as in a file of corrections. Raises `InputError` naming the field."""
    if not isinstance(record, Mapping):
        raise InputError(f"{origin}: expected an object with what and at, got {type(record).__name__}")
    what: Any = record.get("what")
    if what not in get_args(What):
        raise InputError(f"{origin}: what: expected one of {', '.join(get_args(What))}, got {what!r}")
    unknown = [name for name in record if name not in (*COMMON, *FIELDS[what])]
    if unknown:
        raise InputError(f"{origin}: {unknown[0]}: expected {', '.join((*COMMON, *FIELDS[what]))} only")
    texts: dict[str, Any] = {
        name: _text(record, name, origin) for name in ("who", "when", "scene", "label") if name in record
    }
    at, value = _place(record, "at", origin), record.get("value", True)
    if not isinstance(value, bool):
        raise InputError(f"{origin}: value: expected true or false, got {value!r}")
    found = Correction(what, at, value=value, origin=origin, **texts)
    if what == "class" and not found.label:
        raise InputError(f"{origin}: label: expected the class")
    if what == "same":
        found = replace(found, other=_place(record, "and", origin))
    if what == "standing":
        found = replace(found, until=_number(record, "until", origin, LATEST))
        if found.until < at.time:
            raise InputError(f"{origin}: until: expected a time from {at.time:g} s on, got {found.until:g}")
    if what in ("box", "size"):
        names = SIZE if what == "size" else ("time", "x", "y", "z", "yaw", *SIZE)
        box = _numbers(record, "box", origin, names, SIZE)
        required = SIZE if what == "size" else ("x", "y")
        if any(name not in box for name in required):
            raise InputError(f"{origin}: box: expected {', '.join(required)}, got {', '.join(box) or 'nothing'}")
        given = _numbers(record, "deviation", origin, tuple(DEVIATIONS), tuple(DEVIATIONS))
        found = replace(found, box=box, deviation={**DEVIATIONS, **given})
    return found


def corrections_in(scene: str, corrections: Iterable[Correction]) -> tuple[Correction, ...]:
    """The corrections of a recording: those that name it, and those that name none."""
    return tuple(one for one in corrections if one.scene in ("", scene))


def checked_corrections(corrections: Iterable[Correction | Mapping[str, Any]]) -> tuple[Correction, ...]:
    """Corrections, of which some may be records as in a file."""
    return tuple(
        one if isinstance(one, Correction) else correction_from(one, f"corrections: {number}")
        for number, one in enumerate(corrections, 1)
    )


def unfit(corrections: Iterable[Correction], outcomes: Iterable[tuple[str, str]]) -> list[str]:
    """A line for each correction that holds in no scene; outcomes: by `origin`, why it does
    not hold in a scene, "" where it does."""
    found: dict[str, list[str]] = {}
    for origin, why in outcomes:
        found.setdefault(origin, []).append(why)
    lines = []
    for one in corrections:
        there = found.get(one.origin)
        if there is None:
            lines.append(f"{one}: no scene {one.scene} among the recordings" if one.scene else f"{one}: no recordings")
        elif all(there):
            lines.append(f"{one}: {there[0]}")
    return lines


def _text(record: Mapping[str, Any], name: str, origin: str) -> str:
    if not isinstance(record[name], str):
        raise InputError(f"{origin}: {name}: expected a text, got {record[name]!r:.40}")
    return str(record[name])


def _number(record: Mapping[str, Any], name: str, origin: str, largest: float, positive: bool = False) -> float:
    value = record.get(name)
    usable = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= largest
    if not usable or (positive and not value >= LEAST):  # type: ignore[operator]
        expected = f"a number from {LEAST:g} on" if positive else "a number"
        raise InputError(f"{origin}: {name}: expected {expected}, of at most {largest:g}, got {value!r:.40}")
    return float(value)  # type: ignore[arg-type]


def _place(record: Mapping[str, Any], name: str, origin: str) -> Place:
    place = record.get(name)
    if not isinstance(place, Mapping):
        raise InputError(f"{origin}: {name}: expected time, x, y and perhaps label, got {place!r:.40}")
    where = f"{origin}: {name}"
    if extra := [key for key in place if key not in ("time", "x", "y", "label")]:
        raise InputError(f"{where}: {extra[0]}: expected time, x, y and label only")
    x, y = (_number(place, axis, where, MAX_POSITION) for axis in ("x", "y"))
    return Place(_number(place, "time", where, LATEST), x, y, _text(place, "label", where) if "label" in place else "")


def _numbers(
    record: Mapping[str, Any], name: str, origin: str, known: Sequence[str], positive: Sequence[str]
) -> dict[str, float]:
    values = record.get(name, {})
    if not isinstance(values, Mapping) or any(key not in known for key in values):
        raise InputError(f"{origin}: {name}: expected {', '.join(known)} only, got {values!r:.60}")
    largest = {**dict.fromkeys(known, MAX_POSITION), "time": LATEST, "yaw": RADIANS, **dict.fromkeys(SIZE, MAX_SIZE)}
    return {key: _number(values, key, f"{origin}: {name}", largest[key], key in positive) for key in values}
