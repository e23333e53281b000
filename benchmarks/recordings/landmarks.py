"""Drives past landmarks, by what they say of these: places of trees (Victoria Park), or ranges to beacons (Plaza).

Victoria Park as distributed with GTSAM (examples/Data/victoria_park.txt), after E. Nebot, University of Sydney:

    ODOMETRY i j dx dy dheading P11 P12 P13 P22 P23 P33      pose j in the frame of pose i, m and rad
    LANDMARK i l x y P11 P12 P22                             tree l in the frame of pose i, m

P is the upper triangle of a covariance (by size; the file calls it noise). Poses and trees share one numbering. The
odometry must be one chain, each row starting at the pose where the one before ended; observations follow the row that
leads to their pose.

Plaza 1 and 2, range-only SLAM (J. Djugash, B. Hamner and S. Roth, "Navigating with ranging radios: five data sets
with ground truth", Journal of Field Robotics 26, 2009), as text with GTSAM:

    NAME_DR.txt   time, distance travelled since the row before, heading change        s, m, rad
    NAME_TD.txt   time, antenna, beacon, range                                         s, -, -, m
    NAME_GT.txt   time, x, y, heading        (optional: the truth)                     s, m, m, rad
    NAME_TL.txt   beacon, x, y               (optional: the truth)                     m

Times of the odometry must not decrease; ranges may come in any order, and are sorted by time.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from data_tools.files import TextTable, read_lines, read_table
from data_tools.trajectories import Trajectory
from saga_fg.errors import InputError
from saga_fg.numerics import FloatArray, IntArray, transforms, yaw_transform

DISTANCE_NOISE, MIN_NOISE = 0.05, 0.005  # of a step of Plaza: share of its length; at least, and sideways, m
TURN_NOISE = 0.01  # of its heading change, rad
RANGE_NOISE = 0.5  # m
_PLAZA = {
    "DR": ("time", "distance", "heading change"),
    "TD": ("time", "antenna", "beacon", "range"),
    "GT": ("time", "x", "y", "heading"),
    "TL": ("beacon", "x", "y"),
}
_PARK = {
    "ODOMETRY": ("i", "j", "dx", "dy", "dheading", "P11", "P12", "P13", "P22", "P23", "P33"),
    "LANDMARK": ("i", "l", "x", "y", "P11", "P12", "P22"),
}


@dataclass(frozen=True, eq=False)
class LandmarkLog:
    """A drive of N poses with M measurements of landmarks.

    time                 (N,) s, of each pose; its number where there are no times
    a_T_b                (N - 1, 3, 3) increments; odometry_covariance (N - 1, 3, 3) of (x, y, heading)
    pose                 (M,) index from 0 of the pose of each measurement, not decreasing where values are places
    landmark             (M,) which landmark it is
    value                (M, 2) place in the frame of that pose, or (M, 1) range, m; covariance (M, d, d)
    truth, places        the true trajectory, where there is one, and true places (2,) of landmarks by number, m
    """

    time: FloatArray
    a_T_b: FloatArray
    odometry_covariance: FloatArray
    pose: IntArray
    landmark: IntArray
    value: FloatArray
    covariance: FloatArray
    truth: Trajectory | None = None
    places: dict[int, FloatArray] = field(default_factory=dict)


def read_landmark_log(path: Path) -> LandmarkLog:
    """Read a drive: Plaza from any of its files NAME_DR.txt, NAME_TD.txt, NAME_GT.txt, NAME_TL.txt, else Victoria Park.

    Raises `InputError` naming file and line of a broken record.
    """
    name, _, kind = path.stem.rpartition("_")
    return _plaza(path, name) if name and kind in _PLAZA else _park(path)


def _plaza(path: Path, name: str) -> LandmarkLog:
    files = {kind: path.with_name(f"{name}_{kind}.txt") for kind in _PLAZA}
    there = [kind for kind in files if kind in ("DR", "TD") or files[kind].exists()]
    tables = {kind: read_table(files[kind], (len(_PLAZA[kind]),), ", ".join(_PLAZA[kind])) for kind in there}
    for kind, table in tables.items():
        if not len(table) and kind != "TL":
            raise InputError(f"{files[kind]}: expected records, there are none")
    rows = {kind: table.numbers(slice(None), _PLAZA[kind]) for kind, table in tables.items()}
    time, distance, turn = rows["DR"].T
    late = np.flatnonzero(np.diff(time) < 0)
    if len(late):
        row = int(late[0]) + 1
        raise tables["DR"].fault(row, f"time: expected {time[row - 1]:.6f} or later, got {time[row]:.6f}")
    low = rows["TD"][:, 3] <= 0
    if low.any():
        raise tables["TD"].fault(int(np.argmax(low)), f"range: expected a number > 0, got {rows['TD'][low, 3][0]:g}")
    order = np.argsort(rows["TD"][:, 0], kind="stable")
    measured, value = rows["TD"][order, 0], rows["TD"][order, 3:]
    # half the turn, the distance, the other half
    steps = transforms(np.column_stack([distance * np.cos(turn / 2), distance * np.sin(turn / 2), turn]))[1:]
    along = np.maximum(DISTANCE_NOISE * np.abs(distance[1:]), MIN_NOISE)
    noise = np.column_stack([along, np.full((len(along), 2), (MIN_NOISE, TURN_NOISE))])
    at = np.clip(np.searchsorted(time, measured), 0, len(time) - 1)
    truth, places = None, {}
    if "GT" in rows:
        poses = np.stack([yaw_transform(x, y, 0.0, yaw) for _, x, y, yaw in rows["GT"]])
        truth = Trajectory(rows["GT"][:, 0], poses)
    if "TL" in rows:
        places = dict(zip(tables["TL"].integers(0, "beacon", 0).tolist(), rows["TL"][:, 1:], strict=True))
    beacon, R = tables["TD"].integers(2, "beacon", 0)[order], np.full((len(value), 1, 1), RANGE_NOISE**2)
    return LandmarkLog(
        time=time,
        a_T_b=steps,
        odometry_covariance=noise[:, None] ** 2 * np.eye(3),
        pose=at,
        landmark=beacon,
        value=value,
        covariance=R,
        truth=truth,
        places=places,
    )


def _park(file: Path) -> LandmarkLog:
    rows: dict[str, dict[int, list[str]]] = {tag: {} for tag in _PARK}
    for number, line in enumerate(read_lines(file), start=1):
        tag, *row = line.split() or [""]
        if not tag:
            continue
        if tag not in _PARK:
            raise InputError(f"{file}: line {number}: expected ODOMETRY or LANDMARK, got {tag[:40]!r}")
        if len(row) != len(_PARK[tag]):
            raise InputError(f"{file}: line {number}: expected {len(_PARK[tag])} values after {tag}, got {len(row)}")
        rows[tag][number] = row
    empty = [tag for tag in _PARK if not rows[tag]]
    if empty:
        raise InputError(f"{file}: expected {empty[0]} records, there are none")
    odometry, seen = (TextTable.from_rows(file, list(found.values()), list(found)) for found in rows.values())
    first, second = (odometry.integers(column, name, 0) for column, name in ((0, "i"), (1, "j")))
    broken = np.flatnonzero(first[1:] != second[:-1])
    if len(broken):
        k = int(broken[0]) + 1
        raise odometry.fault(k, f"i: expected pose {second[k - 1]}, where the row before ended, got {first[k]}")
    index = {name: row for row, name in enumerate([*first[:1].tolist(), *second.tolist()])}
    if len(index) != len(second) + 1:
        raise InputError(f"{file}: expected every pose once in the chain of odometry")
    pose = np.array([index.get(name, -1) for name in seen.integers(0, "i", 0).tolist()], dtype=np.int64)
    if (pose < 0).any():
        k = int(np.argmax(pose < 0))
        raise seen.fault(k, f"i: there is no pose {seen.values[k, 0]} in the odometry")
    steps, values = (t.numbers(slice(2, None), _PARK[tag][2:]) for tag, t in zip(_PARK, (odometry, seen), strict=True))
    order, trees = np.argsort(pose, kind="stable"), seen.integers(1, "l", 0)
    Q, R = _covariances(odometry, steps[:, 3:], 3), _covariances(seen, values[:, 2:], 2)
    time = np.arange(len(index), dtype=np.float64)
    return LandmarkLog(time, transforms(steps[:, :3]), Q, pose[order], trees[order], values[order, :2], R[order])


def _covariances(table: TextTable, entries: FloatArray, d: int) -> FloatArray:
    P = np.zeros((len(entries), d, d))
    upper = np.triu_indices(d)
    P[:, upper[0], upper[1]] = P[:, upper[1], upper[0]] = entries
    wrong = np.linalg.eigvalsh(P)[:, 0] <= 0
    if wrong.any():
        raise table.fault(int(np.argmax(wrong)), f"P11 ... P{d}{d}: expected a positive definite matrix")
    return P
