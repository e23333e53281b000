"""Logs of the robot navigation toolkit CARMEN: planar laser scans and wheel odometry, as text, perhaps compressed.

    FLASER n r_1 ... r_n  x y heading  odom_x odom_y odom_heading  time host logger_time
    ROBOTLASER1 type start fov step largest accuracy remission n r_1 ... r_n m i_1 ... i_m  x y heading
                odom_x odom_y odom_heading  tv rv forward side turn  time host logger_time

m, rad and s; readings run from right to left. The first pose is the laser's, the second one the robot's, both by
odometry; where they differ by the same transform throughout, that is where the laser is mounted. The number of
readings and their directions may change from record to record, as those of interlaced lasers do. FLASER means 180
degrees about the direction ahead, as CARMEN guesses: 180, 360 or 720 readings lack the last one of 181, 361 or 721, and
400 or 401 readings are of a quarter degree each. A value far more frequent than those near it, with hardly a reading
beyond, says that nothing was hit. Source: http://carmen.sourceforge.net/logger_playback.html.
"""

from __future__ import annotations

import bz2
import gzip
import logging
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from data_tools.files import isolated, read_text
from saga_fg.errors import InputError
from saga_fg.numerics import FloatArray, refuse, transforms, vectors

_RECORDS = ("FLASER", "ROBOTLASER1")
_UNPACK: dict[str, Callable[..., Any]] = {".bz2": bz2.open, ".gz": gzip.open}
_PIECE = 2**22  # characters
_TAG = "[A-Z][A-Z0-9_]*"
_OTHER_LASERS = {"RLASER", "ROBOTLASER2", *(f"{kind}{k}" for kind in ("LASER", "RAWLASER") for k in range(1, 6))}
_NAMED = 8  # records that are named where none can be read
_LEAST_READINGS = 10
_RECURS = 1e-3  # share of all readings that a value must have to mean that nothing was hit; beyond it there are fewer
_PEAK = 10.0  # how much more frequent it is than the values near it, on average
_RIGID = 1e-3  # m and rad, that the mounting may vary by
_LARGEST = 1e6  # m
_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class LaserLog:
    """time (n,) s, as logged, in the order of the file, not always sorted; ranges (n, m) m, NaN where nothing
    was hit; angles (n, m) rad from ahead; odometry (n, 3) of the robot, m and rad;
    robot_T_laser (3,): x, y, heading. Scans of fewer readings than others end in NaN.
    """

    time: FloatArray
    ranges: FloatArray
    angles: FloatArray
    odometry: FloatArray
    robot_T_laser: FloatArray

    def __len__(self) -> int:
        return len(self.time)

    def first(self, count: int) -> LaserLog:
        """The first scans."""
        columns = ("time", "ranges", "angles", "odometry")
        return replace(self, **{name: getattr(self, name)[:count] for name in columns})

    def points(self, row: int, largest_range: float = np.inf) -> FloatArray:
        """Points (n, 2) that a scan hit, m, in the laser's frame."""
        r, angles = self.ranges[row], self.angles[row]
        hit = r < largest_range
        return np.asarray(r[hit, None] * np.stack([np.cos(angles[hit]), np.sin(angles[hit])], axis=1))


def padded(rows: Sequence[FloatArray]) -> FloatArray:
    """Rows of several lengths as one table, NaN behind the shorter ones."""
    lengths = np.array([len(row) for row in rows])
    table = np.full((len(rows), int(lengths.max())), np.nan)
    table[np.arange(table.shape[1]) < lengths[:, None]] = np.concatenate(rows)
    return table


def read_carmen(path: str | Path) -> LaserLog:
    """Read the front laser of a log; .bz2 and .gz are unpacked. Warns of other lasers, which are left out.

    Each record has its own directions: interlaced lasers alternate between them. Raises `InputError` naming the line of
    a record with a wrong number of values, or a number that is none or too large.
    """
    file = Path(path)
    records, others, chosen = list[tuple[FloatArray, FloatArray, FloatArray, float]](), set[str](), ""
    for number, line in enumerate(_lines(file), start=1):
        tag = line[: line.find(" ")]
        if tag not in _RECORDS or (chosen and tag != chosen):  # a log with both says the same twice
            if re.fullmatch(_TAG, tag):
                others.add(tag)
            continue
        where = f"{file}: line {number}"
        fields = line.split()[1:]
        values, directions, most = _flaser(where, fields) if tag == "FLASER" else _robotlaser(where, fields)
        chosen, readings = tag, len(directions)
        rest = np.concatenate([values[:1], values[1 + readings :]])  # time and poses
        records.append((values[1 : 1 + readings], directions, rest, most))
    if not records:
        there = f"only {', '.join(sorted(others)[:_NAMED])}" if others else "none"
        raise InputError(f"{file}: expected records {' or '.join(_RECORDS)}, there are {there}")
    if ignored := sorted(others & _OTHER_LASERS):
        _log.warning("%s: the readings of %s are left out, %s are taken", file, ", ".join(ignored), chosen)
    ranges, angles, rests, largest = zip(*records, strict=True)
    table, measured = np.array(rests), padded(ranges)
    nothing = 0.999 * _nothing(measured)
    measured = np.where((measured > 0) & (measured < np.minimum(largest, nothing)[:, None]), measured, np.nan)
    laser, robot = table[:, 1:4], table[:, 4:]
    return LaserLog(table[:, 0], measured, padded(angles), robot, _mounting(robot, laser))


def _flaser(where: str, fields: list[str]) -> tuple[FloatArray, FloatArray, float]:
    n = _count(where, fields, 0)
    if len(fields) != n + 10:
        raise InputError(f"{where}: expected {n + 10} values after FLASER, for {n} readings, got {len(fields)}")
    quarter = n in (400, 401)
    step = np.deg2rad(0.25) if quarter else np.pi / (n if n in (180, 360, 720) else n - 1)
    values = _numbers(where, [fields[n + 7], *fields[1 : n + 7]])
    start = -np.deg2rad(50) if quarter else -np.pi / 2
    return values, np.asarray(start + step * np.arange(n), dtype=np.float64), np.inf


def _nothing(ranges: FloatArray) -> float:
    """The value of readings that hit nothing; infinite where there is none."""
    values = np.sort(ranges[ranges > 0])
    n = len(values)
    if not n:
        return np.inf
    for value in np.unique(values[-max(1, int(_RECURS * n)) - 1 :])[::-1]:  # beyond it few readings
        at, about = (np.searchsorted(values, [(1 - w) * value, (1 + w) * value]) for w in (1e-3, 0.1))
        peak, near = at[1] - at[0], about[1] - about[0]
        if peak > _RECURS * n and peak > _PEAK * (near - peak) / 100:  # those near it lie in a hundred times the width
            return float(value)
    return np.inf


def _robotlaser(where: str, fields: list[str]) -> tuple[FloatArray, FloatArray, float]:
    n = _count(where, fields, 7)
    m = _count(where, fields, 8 + n, 0)
    if len(fields) != n + m + 23:
        raise InputError(f"{where}: expected {n + m + 23} values after ROBOTLASER1, got {len(fields)}")
    _, start, _, step, largest, *_ = _numbers(where, fields[:7])
    at = 9 + n + m
    values = _numbers(where, [fields[at + 11], *fields[8 : 8 + n], *fields[at : at + 6]])
    return values, start + step * np.arange(n), float(largest)


def _count(where: str, fields: list[str], at: int, least: int = _LEAST_READINGS) -> int:
    text = fields[at] if at < len(fields) else "nothing"
    if not text.isdecimal() or len(text) > 6 or not least <= int(text) <= 10**5:
        raise InputError(f"{where}: expected a number of readings from {least}, got {text[:40]!r}")
    return int(text)


def _numbers(where: str, fields: list[str]) -> FloatArray:
    try:
        values = np.array(fields, dtype=np.float64)
    except ValueError as error:
        raise InputError(f"{where}: expected numbers, {error}") from error
    bad = ~(np.abs(values) < 1e15)
    bad[1:] |= np.abs(values[1:]) > _LARGEST
    expected = "expected finite numbers of the size of rooms"
    refuse(bad, lambda row: InputError(f"{where}: {expected}, got {fields[row]!r:.40}"))
    return values


def _mounting(robot: FloatArray, laser: FloatArray) -> FloatArray:
    """The laser's pose on the robot, if it is the same throughout; corrected logs have other poses there."""
    c, s = np.cos(robot[:, 2]), np.sin(robot[:, 2])
    dx, dy = (laser - robot)[:, :2].T
    turned = laser[:, 2] - robot[:, 2]
    about = turned - turned[0]  # one that looks back is turned by pi or by -pi
    turn = turned[0] + np.arctan2(np.sin(about), np.cos(about))
    offset = np.stack([c * dx + s * dy, c * dy - s * dx, turn], axis=1)
    middle = np.median(offset, axis=0)
    return middle if np.abs(offset - middle).max() < _RIGID else np.zeros(3)


def _lines(file: Path) -> Iterator[str]:
    if file.suffix not in _UNPACK:
        yield from read_text(file).splitlines()
        return
    for lines in isolated("cannot be read", _unpacked, file):
        yield from lines


def _unpacked(file: Path) -> Iterator[list[str]]:
    """The lines of a compressed log, many at a time."""
    with _UNPACK[file.suffix](file, "rt", encoding="utf-8", errors="replace") as log:
        while lines := log.readlines(_PIECE):
            yield lines


_SLACK = 1.0  # m that a step of the wheels may be longer than the largest speed allows: logs come in bursts
_STILL, _CHANGED, _MANY = 1e-6, 0.3, 0.3  # m of the wheels; m of a reading, and the share of a scan, that show motion


def without_jumps(log: LaserLog, largest_speed: float) -> tuple[FloatArray, int]:
    """Poses (n, 3) of the wheels, where steps faster than `largest_speed` (m/s) count as standing still; their number.

    Steps may be 1 m longer than that speed allows. Warns of the first one.
    """
    wheels = transforms(log.odometry)
    step = np.linalg.inv(wheels[:-1]) @ wheels[1:]
    travelled, seconds = np.hypot(step[:, 0, 2], step[:, 1, 2]), np.maximum(np.diff(log.time), 0.0)
    jumps = np.flatnonzero(travelled > largest_speed * seconds + _SLACK)
    if not len(jumps):
        return log.odometry, 0
    first = int(jumps[0])
    _log.warning(
        "scan %d: the wheels moved %.3g m in %.3g s, more than largest_speed, %g m/s, allows; "
        "so in %d steps, which count as standing still",
        first + 2, travelled[first], seconds[first], largest_speed, len(jumps),
    )  # fmt: skip
    for row in jumps.tolist():  # what follows moves by what the jump did
        wheels[row + 1 :] = wheels[row] @ np.linalg.inv(wheels[row + 1]) @ wheels[row + 1 :]
    return vectors(wheels), len(jumps)


def warn_of_times(time: FloatArray) -> None:
    """Warns where times (n,), s, run backwards, as those of logs that are written by several processes do, or stay."""
    same = np.flatnonzero(np.diff(time) == 0)
    if len(same):
        _log.warning(
            "scan %d: its time is that of the scan ahead of it; so for %d of %d scans, "
            "of which the files have the pose of the first at each time",
            int(same[0]) + 2, len(same), len(time),
        )  # fmt: skip
    back = np.flatnonzero(np.diff(time) < 0)
    if len(back):
        _log.warning(
            "scan %d: its time is %.3g s before that of the scan ahead of it; so for %d of %d scans, "
            "which are taken in the order of the log, with poses written in the order of time",
            int(back[0]) + 2, time[back[0]] - time[back[0] + 1], len(back), len(time),
        )  # fmt: skip


def check_wheels(log: LaserLog) -> None:
    """Raise `InputError` where the wheels say one pose throughout while what the laser sees changes."""
    if len(log) < 2 or np.ptp(log.odometry, axis=0).max() > _STILL:
        return
    alike = np.isclose(log.angles, log.angles[0])  # not so of interlaced lasers
    changed = (alike & (np.abs(log.ranges - log.ranges[0]) > _CHANGED)).sum(axis=1) / np.maximum(alike.sum(axis=1), 1)
    if (moved := int(np.argmax(changed > _MANY))) > 0:
        raise InputError(
            f"scan {moved + 1}: {100 * changed[moved]:.0f} % of the readings differ from those of the first scan, but "
            "the wheels stand still throughout: expected odometry"
        )
