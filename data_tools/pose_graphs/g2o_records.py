"""Records of the g2o format: their columns, and arrays of them.

    VERTEX_SE2 id x y heading                            VERTEX_SE3:QUAT id x y z qx qy qz qw
    EDGE_SE2 first second x y heading I                  EDGE_SE3:QUAT first second x y z qx qy qz qw I
    EDGE_PRIOR_SE2 pose x y heading I                    EDGE_SE3_PRIOR pose offset x y z qx qy qz qw I
    EDGE_PRIOR_SE2_XY pose x y I                         EDGE_SE3_XYZ_PRIOR pose offset x y z I
    VERTEX_XY id x y                                     VERTEX_TRACKXYZ id x y z
    EDGE_SE2_XY pose landmark x y I                      EDGE_SE3_TRACKXYZ pose landmark offset x y z I
    EDGE_BEARING_SE2_XY pose landmark bearing I          PARAMS_SE3OFFSET id x y z qx qy qz qw
    BR pose landmark bearing range sigma sigma           FIX id

m and rad. I is the upper triangle of an information matrix, row by row, ordered as the values before it are. BR is
GTSAM's, with standard deviations of bearing and range. EDGE_SE2_PRIOR is another spelling of EDGE_PRIOR_SE2.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_tools.files.error_messages import unknown_name
from data_tools.files.text_tables import LARGEST, TextTable, read_lines
from saga_fg.errors import InputError
from saga_fg.numerics import planar_poses
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import quaternion_norms, quaternion_rotation
from saga_fg.types.boxes import MAX_POSITION

_UNIT = 1e-3  # what the norm of a quaternion may be off 1
_SLIGHT = 1e-4  # share of the largest eigenvalue by which the smallest may be negative: four digits are rounded so
_LEAST = 1e-9  # share of the largest eigenvalue that it is then raised to
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Record:
    """Columns of a record in `dim` dimensions: ids, values, and their information matrix or standard deviations."""

    dim: int
    ids: tuple[str, ...]
    values: tuple[str, ...]
    weight: str = ""  # "information", "sigmas" or none

    @property
    def order(self) -> int:
        """Size of the information matrix."""
        return min(len(self.values), 6)  # a quaternion is a turn of three

    @property
    def columns(self) -> int:
        """Number of values on a line."""
        k = self.order
        return len(self.ids) + len(self.values) + {"": 0, "information": k * (k + 1) // 2, "sigmas": k}[self.weight]


_SE2 = ("x", "y", "heading")
_SE3 = ("x", "y", "z", "qx", "qy", "qz", "qw")
_OBSERVED = ("pose", "landmark")
RECORDS = {
    "VERTEX_SE2": Record(2, ("id",), _SE2),
    "EDGE_SE2": Record(2, ("first", "second"), _SE2, "information"),
    "VERTEX_SE3:QUAT": Record(3, ("id",), _SE3),
    "EDGE_SE3:QUAT": Record(3, ("first", "second"), _SE3, "information"),
    "EDGE_PRIOR_SE2": Record(2, ("pose",), _SE2, "information"),
    "EDGE_SE3_PRIOR": Record(3, ("pose", "offset"), _SE3, "information"),
    "EDGE_PRIOR_SE2_XY": Record(2, ("pose",), _SE2[:2], "information"),
    "EDGE_SE3_XYZ_PRIOR": Record(3, ("pose", "offset"), _SE3[:3], "information"),
    "VERTEX_XY": Record(2, ("id",), _SE2[:2]),
    "VERTEX_TRACKXYZ": Record(3, ("id",), _SE3[:3]),
    "EDGE_SE2_XY": Record(2, _OBSERVED, _SE2[:2], "information"),
    "EDGE_BEARING_SE2_XY": Record(2, _OBSERVED, ("bearing",), "information"),
    "BR": Record(2, _OBSERVED, ("bearing", "range"), "sigmas"),
    "EDGE_SE3_TRACKXYZ": Record(3, (*_OBSERVED, "offset"), _SE3[:3], "information"),
    "PARAMS_SE3OFFSET": Record(3, ("id",), _SE3),
}
_SPELLED = {"EDGE_SE2_PRIOR": "EDGE_PRIOR_SE2"}


def read_records(file: Path) -> tuple[dict[str, TextTable], list[int]]:
    """The lines of a file by their tag, and the ids of FIX. Raises `InputError` naming the line of a wrong one."""
    fixed: list[int] = []
    found: dict[str, tuple[list[list[str]], list[int]]] = {}
    for number, line in enumerate(read_lines(file), start=1):
        tag, *row = line.split() or [""]
        if not tag or tag.startswith("#"):
            continue
        if tag == "FIX":
            if not row or not all(name.isdecimal() and len(name) < 20 for name in row):
                raise InputError(f"{file}: line {number}: expected ids of poses after FIX, got {' '.join(row)!r:.40}")
            fixed += [int(name) for name in row]
            continue
        tag = _SPELLED.get(tag, tag)
        record = RECORDS.get(tag)
        if record is None:
            unknown = unknown_name("record", tag[:40], (*RECORDS, "FIX"))
            raise InputError(f"{file}: line {number}: {unknown}; lines that the graph can do without may be removed")
        if len(row) != record.columns:
            raise InputError(f"{file}: line {number}: expected {record.columns} values after {tag}, got {len(row)}")
        rows, lines = found.setdefault(tag, ([], []))
        rows.append(row)
        lines.append(number)
    return {tag: TextTable.of(file, rows, lines) for tag, (rows, lines) in found.items()}, fixed


def record_values(table: TextTable, record: Record) -> FloatArray:
    """The values (n, c) of a record."""
    start, names = len(record.ids), record.values
    largest = tuple(MAX_POSITION if name in ("x", "y", "z", "range") else LARGEST for name in names)
    return table.numbers(slice(start, start + len(names)), names, largest)


def transforms(table: TextTable, record: Record) -> FloatArray:
    """Poses (n, d + 1, d + 1) of a record. Raises `InputError` naming the line of a quaternion off the unit sphere."""
    values = record_values(table, record)
    if record.dim == 2:
        return planar_poses.transforms(values)
    quaternion = values[:, [6, 3, 4, 5]]
    norm = quaternion_norms(quaternion)
    bad = np.abs(norm - 1) > _UNIT
    if bad.any():
        row = int(np.argmax(bad))
        raise table.fault(row, f"qx qy qz qw: expected a unit quaternion, got norm {norm[row]:.6g}")
    T = np.tile(np.eye(4), (len(values), 1, 1))
    T[:, :3, :3] = quaternion_rotation(quaternion / norm[:, None])
    T[:, :3, 3] = values[:, :3]
    return T


def information(table: TextTable, record: Record) -> FloatArray:
    """Information matrices (n, k, k) of a record, ordered as in the file; nearly definite ones are projected."""
    k, start = record.order, len(record.ids) + len(record.values)
    if record.weight == "sigmas":
        names = tuple(f"sigma of the {name}" for name in record.values)
        sigmas = table.numbers(slice(start, start + k), names)
        if (sigmas <= 0).any():
            raise table.fault(int(np.argmax((sigmas <= 0).any(axis=1))), "expected standard deviations > 0")
        return np.asarray(np.eye(k) / sigmas[:, None] ** 2)
    upper = np.triu_indices(k)
    names = tuple(f"I{i + 1}{j + 1}" for i, j in zip(*upper, strict=True))
    entries = table.numbers(slice(start, start + len(names)), names)
    matrix = np.zeros((len(entries), k, k))
    matrix[:, upper[0], upper[1]] = matrix[:, upper[1], upper[0]] = entries
    return _definite(table, matrix)


def _definite(edges: TextTable, matrix: FloatArray) -> FloatArray:
    """Project matrices (M, k, k) that are nearly positive definite."""
    values, vectors = np.linalg.eigh(matrix)
    smallest, largest, k = values[:, 0], values[:, -1], matrix.shape[1]
    bad = (smallest < -_SLIGHT * largest) | (largest <= 0)
    if bad.any():
        row = int(np.argmax(bad))
        named = "I11" if k == 1 else f"I11 ... I{k}{k}"
        raise edges.fault(row, f"{named}: expected a positive definite matrix, smallest eigenvalue {smallest[row]:.3g}")
    near = np.flatnonzero(smallest <= 0)
    if len(near):
        example = edges.fault(int(near[0]), f"smallest eigenvalue {smallest[near[0]]:.3g}")
        log.warning("%s; so of %d information matrices, which are made positive definite", example, len(near))
        raised = np.maximum(values[near], _LEAST * largest[near, None])
        matrix[near] = (vectors[near] * raised[:, None]) @ vectors[near].swapaxes(1, 2)
    return matrix
