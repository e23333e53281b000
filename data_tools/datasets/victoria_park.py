"""Victoria Park as distributed with GTSAM (examples/Data/victoria_park.txt), after E. Nebot, University of Sydney.

    ODOMETRY i j dx dy dheading P11 P12 P13 P22 P23 P33      pose j in the frame of pose i, m and rad
    LANDMARK i l x y P11 P12 P22                             tree l in the frame of pose i, m

P is the upper triangle of a covariance (by size; the file calls it noise). Poses and trees share one numbering. The
odometry must be one chain, each row starting at the pose where the one before ended; observations follow the row that
leads to their pose.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_tools.files.text_tables import TextTable, read_lines
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, IntArray

_COLUMNS = {"ODOMETRY": 11, "LANDMARK": 7}
_ODOMETRY = ("dx", "dy", "dheading", "P11", "P12", "P13", "P22", "P23", "P33")
_LANDMARK = ("x", "y", "P11", "P12", "P22")


@dataclass(frozen=True, eq=False)
class TreeObservations:
    """A drive of N + 1 poses past trees.

    a_T_b                (N, 3, 3) increments; odometry_covariance (N, 3, 3) of (x, y, heading)
    pose                 (M,) index from 0 of the pose of each observation, not decreasing
    place                (M, 2) m, in the frame of that pose; covariance (M, 2, 2)
    tree                 (M,) which tree the file says it is: for evaluation alone
    """

    a_T_b: FloatArray
    odometry_covariance: FloatArray
    pose: IntArray
    place: FloatArray
    covariance: FloatArray
    tree: IntArray


def read_victoria_park(path: str | Path) -> TreeObservations:
    """Read the file. Raises `InputError` naming the line of a broken record, or an observation from an unknown pose."""
    file = Path(path)
    odometry, observations = _records(file)
    first, second = (odometry.integers(column, name, 0) for column, name in ((0, "i"), (1, "j")))
    broken = np.flatnonzero(first[1:] != second[:-1])
    if len(broken):
        row = int(broken[0]) + 1
        raise odometry.fault(row, f"i: expected pose {second[row - 1]}, where the row before ended, got {first[row]}")
    chain = np.concatenate([first[:1], second])
    order = np.argsort(chain, kind="stable")
    if len(np.unique(chain)) != len(chain):
        raise InputError(f"{file}: expected every pose once in the chain of odometry")
    named = observations.integers(0, "i", 0)
    found = np.minimum(np.searchsorted(chain[order], named), len(chain) - 1)
    pose = order[found]
    if (chain[pose] != named).any():
        row = int(np.argmax(chain[pose] != named))
        raise observations.fault(row, f"i: there is no pose {named[row]} in the odometry")
    steps = odometry.numbers(slice(2, 11), _ODOMETRY)
    seen = observations.numbers(slice(2, 7), _LANDMARK)
    turn = np.argsort(pose, kind="stable")
    return TreeObservations(
        _increments(steps[:, :3]),
        _covariances(odometry, steps[:, 3:], 3),
        pose[turn].astype(np.int64),
        seen[turn, :2],
        _covariances(observations, seen[:, 2:], 2)[turn],
        observations.integers(1, "l", 0)[turn],
    )


def _records(file: Path) -> tuple[TextTable, TextTable]:
    rows: dict[str, list[list[str]]] = {tag: [] for tag in _COLUMNS}
    lines: dict[str, list[int]] = {tag: [] for tag in _COLUMNS}
    for number, line in enumerate(read_lines(file), start=1):
        tag, *row = line.split() or [""]
        if not tag:
            continue
        if tag not in _COLUMNS:
            raise InputError(f"{file}: line {number}: expected ODOMETRY or LANDMARK, got {tag[:40]!r}")
        if len(row) != _COLUMNS[tag]:
            raise InputError(f"{file}: line {number}: expected {_COLUMNS[tag]} values after {tag}, got {len(row)}")
        rows[tag].append(row)
        lines[tag].append(number)
    empty = [tag for tag in _COLUMNS if not rows[tag]]
    if empty:
        raise InputError(f"{file}: expected {empty[0]} records, there are none")
    odometry, landmarks = (TextTable.of(file, rows[tag], lines[tag]) for tag in _COLUMNS)
    return odometry, landmarks


def _increments(steps: FloatArray) -> FloatArray:
    c, s = np.cos(steps[:, 2]), np.sin(steps[:, 2])
    T = np.tile(np.eye(3), (len(steps), 1, 1))
    T[:, :2, :2] = np.stack([c, -s, s, c], axis=1).reshape(-1, 2, 2)
    T[:, :2, 2] = steps[:, :2]
    return T


def _covariances(table: TextTable, entries: FloatArray, d: int) -> FloatArray:
    P = np.zeros((len(entries), d, d))
    upper = np.triu_indices(d)
    P[:, upper[0], upper[1]] = P[:, upper[1], upper[0]] = entries
    smallest = np.linalg.eigvalsh(P)[:, 0]
    if (smallest <= 0).any():
        row = int(np.argmax(smallest <= 0))
        raise table.fault(row, f"P11 ... P{d}{d}: expected a positive definite matrix")
    return P
