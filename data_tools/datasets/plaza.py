"""Plaza 1 and 2, range-only SLAM (J. Djugash, B. Hamner and S. Roth, "Navigating with ranging radios: five data sets
with ground truth", Journal of Field Robotics 26, 2009), as text with GTSAM:

    NAME_DR.txt   time, distance travelled since the row before, heading change        s, m, rad
    NAME_TD.txt   time, antenna, beacon, range                                         s, -, -, m
    NAME_GT.txt   time, x, y, heading        (optional: the truth)                     s, m, m, rad
    NAME_TL.txt   beacon, x, y               (optional: the truth)                     m

Times of the odometry must not decrease; ranges may come in any order, and are sorted by time.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_tools.files.text_tables import TextTable, read_table
from data_tools.trajectories import Trajectory
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.geometry import yaw_transform


@dataclass(frozen=True, eq=False)
class BeaconRanges:
    """A drive with ranges to beacons.

    time      (N,) s, of each row of odometry; distance (N,) m and turn (N,) rad since the row before
    measured  (M,) s, when each range was, not decreasing; beacon (M,) its number; range (M,) m
    truth     the true trajectory, where there is one; beacons: true places (2,) by number, m
    """

    time: FloatArray
    distance: FloatArray
    turn: FloatArray
    measured: FloatArray
    beacon: IntArray
    range: FloatArray
    truth: Trajectory | None
    beacons: dict[int, FloatArray]


def read_plaza(path: str | Path) -> BeaconRanges:
    """Read a data set; `path` is its NAME_DR.txt or any other of its files.

    Raises `InputError` naming file and line of a broken record, a time that decreases or a range that is not positive.
    """
    file = Path(path)
    name, separator, kind = file.stem.rpartition("_")
    if not separator or kind not in ("DR", "TD", "GT", "TL"):
        raise InputError(f"{file}: expected one of the files NAME_DR.txt, NAME_TD.txt, NAME_GT.txt, NAME_TL.txt")
    files = {kind: file.with_name(f"{name}_{kind}.txt") for kind in ("DR", "TD", "GT", "TL")}
    odometry = _records(files["DR"], 3, "time, distance, heading change")
    ranges = _records(files["TD"], 4, "time, antenna, beacon, range")
    rows = odometry.numbers(slice(0, 3), ("time", "distance", "heading change"))
    measured = ranges.numbers(slice(0, 4), ("time", "antenna", "beacon", "range"))
    if (measured[:, 3] <= 0).any():
        row = int(np.argmax(measured[:, 3] <= 0))
        raise ranges.fault(row, f"range: expected a number > 0, got {measured[row, 3]:g}")
    order = np.argsort(measured[:, 0], kind="stable")
    return BeaconRanges(
        _increasing(odometry, rows[:, 0]),
        rows[:, 1],
        rows[:, 2],
        measured[order, 0],
        ranges.integers(2, "beacon", 0)[order],
        measured[order, 3],
        _truth(files["GT"]) if files["GT"].exists() else None,
        _places(files["TL"]) if files["TL"].exists() else {},
    )


def _records(file: Path, columns: int, what: str) -> TextTable:
    """The lines of a file that has some."""
    table = read_table(file, (columns,), what)
    if not len(table):
        raise InputError(f"{file}: expected records, there are none")
    return table


def _increasing(table: TextTable, time: FloatArray) -> FloatArray:
    late = np.flatnonzero(np.diff(time) < 0)
    if len(late):
        row = int(late[0]) + 1
        raise table.fault(row, f"time: expected {time[row - 1]:.6f} or later, got {time[row]:.6f}")
    return time


def _truth(file: Path) -> Trajectory:
    table = _records(file, 4, "time, x, y, heading")
    rows = table.numbers(slice(0, 4), ("time", "x", "y", "heading"))
    return Trajectory(rows[:, 0], np.stack([yaw_transform(x, y, 0.0, yaw) for _, x, y, yaw in rows]))


def _places(file: Path) -> dict[int, FloatArray]:
    table = read_table(file, (3,), "beacon, x, y")
    places = table.numbers(slice(1, 3), ("x", "y"))
    return dict(zip(table.integers(0, "beacon", 0).tolist(), places, strict=True))
