"""The g2o format of pose graphs, in the plane and in space.

The g2o format of pose graphs, in the plane and in space (https://github.com/RainerKuemmerle/g2o/wiki/File-Format).

A measurement is first_T_second; landmarks are measured
in the frame of the pose, and ids of poses and landmarks are of one numbering, up to 2^63 - 1, as GTSAM's symbols are.
g2o means the vector part of a quaternion by a rotation in space; like GTSAM, which everybody compares with, we read the
matrix as that of a rotation vector. Offsets of sensors (PARAMS_SE3OFFSET) are taken into the measurements, but for
EDGE_SE3_XYZ_PRIOR: g2o means it of the pose itself. FIX names poses to hold; the first pose is always held unless there
are priors, and others are not: reading warns of them. Empty lines and those that begin with # are left out.

Records of the g2o format: their columns, and arrays of them.

    VERTEX_SE2 id x y heading                            VERTEX_SE3:QUAT id x y z qx qy qz qw
    EDGE_SE2 first second x y heading I                  EDGE_SE3:QUAT first second x y z qx qy qz qw I
    EDGE_PRIOR_SE2 pose x y heading I                    EDGE_SE3_PRIOR pose offset x y z qx qy qz qw I
    EDGE_PRIOR_SE2_XY pose x y I                         EDGE_SE3_XYZ_PRIOR pose offset x y z I
    VERTEX_XY id x y                                     VERTEX_TRACKXYZ id x y z
    EDGE_SE2_XY pose landmark x y I                      EDGE_SE3_TRACKXYZ pose landmark offset x y z I
    FIX id                                               PARAMS_SE3OFFSET id x y z qx qy qz qw

m and rad. I is the upper triangle of an information matrix, row by row, ordered as the values before it are.
EDGE_SE2_PRIOR is another spelling of EDGE_PRIOR_SE2.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_tools.files import LARGEST, TextTable, read_lines, write_text
from saga_fg.errors import InputError, unknown_name
from saga_fg.numerics import (
    FloatArray,
    IntArray,
    adjoint,
    geometry,
    quaternion_norms,
    quaternion_rotation,
    rigid_transforms,
    rotation_quaternion,
)
from saga_fg.slam.pose_graph import (
    PointLandmarks,
    PoseGraph,
    PosePriors,
    PositionPriors,
)
from saga_fg.types import MAX_POSITION

_UNIT = 1e-3  # what the norm of a quaternion may be off 1
_SLIGHT = 1e-4  # share of the largest eigenvalue by which the smallest may be negative: four digits are rounded so
_MIN_SHARE = 1e-9  # share of the largest eigenvalue that it is then raised to


@dataclass(frozen=True)
class Record:
    """Columns of a record in `dim` dimensions: ids, values, and their information matrix if it has one."""

    dim: int
    ids: tuple[str, ...]
    values: tuple[str, ...]
    weighed: bool = False

    @property
    def order(self) -> int:
        """Size of the information matrix."""
        return min(len(self.values), 6)  # a quaternion is a turn of three

    @property
    def columns(self) -> int:
        """Number of values on a line."""
        k = self.order
        return len(self.ids) + len(self.values) + self.weighed * k * (k + 1) // 2


_SE2 = ("x", "y", "heading")
_SE3 = ("x", "y", "z", "qx", "qy", "qz", "qw")
_OBSERVED_VERTICES = ("pose", "landmark")
RECORDS = {
    "VERTEX_SE2": Record(2, ("id",), _SE2),
    "EDGE_SE2": Record(2, ("first", "second"), _SE2, True),
    "VERTEX_SE3:QUAT": Record(3, ("id",), _SE3),
    "EDGE_SE3:QUAT": Record(3, ("first", "second"), _SE3, True),
    "EDGE_PRIOR_SE2": Record(2, ("pose",), _SE2, True),
    "EDGE_SE3_PRIOR": Record(3, ("pose", "offset"), _SE3, True),
    "EDGE_PRIOR_SE2_XY": Record(2, ("pose",), _SE2[:2], True),
    "EDGE_SE3_XYZ_PRIOR": Record(3, ("pose", "offset"), _SE3[:3], True),
    "VERTEX_XY": Record(2, ("id",), _SE2[:2]),
    "VERTEX_TRACKXYZ": Record(3, ("id",), _SE3[:3]),
    "EDGE_SE2_XY": Record(2, _OBSERVED_VERTICES, _SE2[:2], True),
    "EDGE_SE3_TRACKXYZ": Record(3, (*_OBSERVED_VERTICES, "offset"), _SE3[:3], True),
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
    return {tag: TextTable.from_rows(file, rows, lines) for tag, (rows, lines) in found.items()}, fixed


def record_values(table: TextTable, record: Record) -> FloatArray:
    """The values (n, c) of a record."""
    start, names = len(record.ids), record.values
    largest = tuple(MAX_POSITION if name in ("x", "y", "z") else LARGEST for name in names)
    return table.numbers(slice(start, start + len(names)), names, largest)


def transforms(table: TextTable, record: Record) -> FloatArray:
    """Poses (n, d + 1, d + 1) of a record. Raises `InputError` naming the line of a quaternion off the unit sphere."""
    values = record_values(table, record)
    if record.dim == 2:
        return geometry.transforms(values)
    quaternion = values[:, [6, 3, 4, 5]]
    norm = quaternion_norms(quaternion)
    table.check(
        np.abs(norm - 1) <= _UNIT, lambda row: f"qx qy qz qw: expected a unit quaternion, got norm {norm[row]:.6g}"
    )
    return rigid_transforms(quaternion_rotation(quaternion / norm[:, None]), values[:, :3])


def information(table: TextTable, record: Record, project: bool = False) -> FloatArray:
    """Information matrices (n, k, k) of a record, those of poses in the order of our tangent.

    Nearly definite ones are projected; project: others too.
    """
    k, start = record.order, len(record.ids) + len(record.values)
    upper = np.triu_indices(k)
    names = tuple(f"I{i + 1}{j + 1}" for i, j in zip(*upper, strict=True))
    entries = table.numbers(slice(start, start + len(names)), names)
    matrix = np.zeros((len(entries), k, k))
    matrix[:, upper[0], upper[1]] = matrix[:, upper[1], upper[0]] = entries
    matrix = _definite(table, matrix, project)
    return matrix[:, _SPATIAL[:, None], _SPATIAL] if k == len(_SPATIAL) else matrix


def _definite(edges: TextTable, matrix: FloatArray, project: bool) -> FloatArray:
    """Project matrices (M, k, k) that are nearly positive definite, or all that have a positive eigenvalue."""
    values, vectors = np.linalg.eigh(matrix)
    smallest, largest, k = values[:, 0], values[:, -1], matrix.shape[1]
    expected = f"I11 ... I{k}{k}: expected a positive definite matrix, smallest eigenvalue"
    good = (project | (smallest >= -_SLIGHT * largest)) & (largest > 0)
    hint = "; --project (Python: project) makes it one"
    edges.check(good, lambda row: f"{expected} {smallest[row]:.3g}{hint if largest[row] > 0 else ''}")
    near = np.flatnonzero(smallest <= 0)
    if len(near):
        example = edges.fault(int(near[0]), f"smallest eigenvalue {smallest[near[0]]:.3g}")
        log.warning("%s; so of %d information matrices, which are made positive definite", example, len(near))
        raised = np.maximum(values[near], _MIN_SHARE * largest[near, None])
        matrix[near] = (vectors[near] * raised[:, None]) @ vectors[near].swapaxes(1, 2)
    return matrix


Tables = Mapping[str, TextTable]
Weights = Mapping[str, FloatArray]
_POSE = {2: "VERTEX_SE2", 3: "VERTEX_SE3:QUAT"}
_EDGE = {2: "EDGE_SE2", 3: "EDGE_SE3:QUAT"}
_PRIOR = {2: "EDGE_PRIOR_SE2", 3: "EDGE_SE3_PRIOR"}
_PLACE = {2: "EDGE_PRIOR_SE2_XY", 3: "EDGE_SE3_XYZ_PRIOR"}
_LANDMARK = {2: "VERTEX_XY", 3: "VERTEX_TRACKXYZ"}
_OBSERVED = {2: "EDGE_SE2_XY", 3: "EDGE_SE3_TRACKXYZ"}
_SPATIAL = np.array([3, 4, 5, 0, 1, 2])  # where each entry of our tangent in space is found in the file's
_OFFSET, _LARGEST_ID = "PARAMS_SE3OFFSET", 2**63 - 1
log = logging.getLogger(__name__)


def read_g2o(path: str | Path, project: bool = False) -> PoseGraph:
    """Read a pose graph; poses and landmarks come in the order of their ids.

    A file of measurements alone starts at dead reckoning along them. An information matrix with an eigenvalue that is
    0 or slightly negative, as rounded ones have, is projected to a positive definite one, with a warning of how many;
    project: also where it is clearly negative, as sums of outer products with wrong signs have.
    Raises `InputError` naming the line for an unknown record, a wrong number of columns, a number that is none or too
    large, a quaternion off the unit sphere, a pose given twice or missing, or an information matrix with an eigenvalue
    that is clearly negative.
    """
    file = Path(path)
    tables, fixed = read_records(file)
    dims = {RECORDS[tag].dim for tag in tables}
    if len(dims) != 1:
        raise InputError(f"{file}: expected poses and edges, all in the plane (SE2) or all in space (SE3:QUAT)")
    (d,) = dims
    if _EDGE[d] not in tables:
        raise InputError(f"{file}: expected {_EDGE[d]} records, there are none")
    edges = tables[_EDGE[d]]
    weights = {
        tag: information(table, each, project) for tag, table in tables.items() if (each := RECORDS[tag]).weighed
    }
    between = transforms(edges, RECORDS[_EDGE[d]])
    whole = _POSE[d] in tables
    ids, order = _unique_ids(tables[_POSE[d]]) if whole else (_all_ends(edges), np.arange(0))
    first, second = (_rows(edges, column, name, ids) for column, name in enumerate(("first", "second")))
    edges.check(first != second, lambda row: "second: expected another pose than the first")
    priors, places = _priors(tables, weights, d, ids), _places(tables, weights, d, ids)
    _warn_of_fixed(file, fixed, ids, priors is not None or places is not None)
    if whole:
        poses = transforms(tables[_POSE[d]], RECORDS[_POSE[d]])[order]
        graph = PoseGraph(ids, poses, first, second, between, weights[_EDGE[d]], priors=priors, places=places)
    else:
        graph = PoseGraph.of_measurements(ids, first, second, between, weights[_EDGE[d]], priors, places)
    marks = _landmarks(tables, weights, graph, whole)
    _warn_of_unseen(file, tables, d, marks)
    return graph.with_landmarks(marks)


def _all_ends(edges: TextTable) -> IntArray:
    """Ids of the poses between which was measured, in increasing order."""
    return np.unique([edges.integers(column, name, 0, _LARGEST_ID) for column, name in enumerate(("first", "second"))])


def _warn_of_unseen(file: Path, tables: Tables, d: int, marks: PointLandmarks | None) -> None:
    """Warn once of landmarks that no measurement is of."""
    if (tag := _LANDMARK[d]) not in tables:
        return
    unseen = np.setdiff1d(_unique_ids(tables[tag])[0], [] if marks is None else marks.ids)
    if len(unseen):
        log.warning("%s: %s %d is left out, no measurement is of it (%d so)", file, tag, unseen[0], len(unseen))


def _warn_of_fixed(file: Path, fixed: Sequence[int], ids: IntArray, anchored: bool) -> None:
    """Warn once of poses that the file holds and we do not."""
    held = [] if anchored else [int(ids[0])]
    if others := [named for named in fixed if named not in held]:
        holds = "the priors hold the graph" if anchored else f"pose {held[0]}, the first, is held"
        log.warning("%s: FIX %d has no effect, as %s (%d poses so)", file, others[0], holds, len(others))


def _priors(tables: Tables, information: Weights, d: int, ids: IntArray) -> PosePriors | None:
    if (tag := _PRIOR[d]) not in tables:
        return None
    table = tables[tag]
    rows = _rows(table, 0, "pose", ids)
    poses, weights = transforms(table, RECORDS[tag]), information[tag]
    if d == 3:  # measured is pose T offset, with errors in the sensor's frame
        sensor_T_pose = np.linalg.inv(_offsets(tables, table, 1))
        Ad = adjoint(np.asarray(sensor_T_pose, dtype=np.float64))
        poses, weights = poses @ sensor_T_pose, Ad.swapaxes(1, 2) @ weights @ Ad
    return PosePriors(rows, poses, weights)


def _places(tables: Tables, information: Weights, d: int, ids: IntArray) -> PositionPriors | None:
    if (tag := _PLACE[d]) not in tables:
        return None
    table, record = tables[tag], RECORDS[tag]
    rows = _rows(table, 0, "pose", ids)
    return PositionPriors(rows, record_values(table, record), information[tag])


def _landmarks(tables: Tables, information: Weights, graph: PoseGraph, guessed: bool) -> PointLandmarks | None:
    """The landmarks; their places are those of the file if all of them and the poses are in it."""
    d, tag = graph.dim, _OBSERVED[graph.dim]
    if tag not in tables:
        return None
    table, position = tables[tag], None
    named = table.integers(1, "landmark", 0, _LARGEST_ID)
    ids, landmark = np.unique(named, return_inverse=True)
    if (vertex := _LANDMARK[d]) in tables:
        given, order = _unique_ids(tables[vertex])
        _rows(table, 1, "landmark", given)
        if guessed:
            position = record_values(tables[vertex], RECORDS[vertex])[order][np.searchsorted(given, ids)]
    table.check(~np.isin(named, graph.ids), lambda row: f"landmark: {named[row]} is a pose")
    pose = _rows(table, 0, "pose", graph.ids)
    z, weights = record_values(table, RECORDS[tag]), information[tag]
    if d == 3:
        T = _offsets(tables, table, 2)
        R = T[:, :3, :3]
        z, weights = (R @ z[:, :, None])[:, :, 0] + T[:, :3, 3], R @ weights @ R.swapaxes(1, 2)
    position = np.full((len(ids), d), np.nan) if position is None else position
    return PointLandmarks(ids, position, pose, landmark.astype(np.int64), z, weights)


def _offsets(tables: Tables, table: TextTable, column: int) -> FloatArray:
    """Poses (n, 4, 4) of the sensors that a column names."""
    if _OFFSET not in tables:  # but the one that every file has
        return np.eye(4)[None][_rows(table, column, "offset", np.zeros(1, dtype=np.int64))]
    ids, order = _unique_ids(tables[_OFFSET])
    return transforms(tables[_OFFSET], RECORDS[_OFFSET])[order][_rows(table, column, "offset", ids)]


def write_g2o(path: str | Path, graph: PoseGraph) -> None:
    """Write a pose graph, whole or not at all. Raises `InputError` where that is not possible."""
    d, names, marks = graph.dim, graph.ids, graph.landmarks
    lines = _lines(_POSE[d], names[:, None], pose_columns(graph.world_T_pose))
    if marks is not None:
        lines += _lines(_LANDMARK[d], marks.ids[:, None], marks.position)
    if d == 3 and (marks is not None or graph.anchored):
        lines.append(f"{_OFFSET} 0 0 0 0 0 0 0 1")
    ends = np.stack([names[graph.first], names[graph.second]], axis=1)
    lines += _lines(_EDGE[d], ends, pose_columns(graph.first_T_second), _in_file_order(graph.information))
    if (priors := graph.priors) is not None:
        poses, weights = pose_columns(priors.world_T_pose), _in_file_order(priors.information)
        lines += _lines(_PRIOR[d], _without_offset(d, names[priors.pose]), poses, weights)
    if (places := graph.places) is not None:
        lines += _lines(_PLACE[d], _without_offset(d, names[places.pose]), places.position, places.information)
    if marks is not None:
        seen = _without_offset(d, names[marks.pose], marks.ids[marks.landmark])
        lines += _lines(_OBSERVED[d], seen, marks.z, marks.information)
    write_text(path, "\n".join(lines) + "\n")


def _lines(tag: str, ids: IntArray, values: FloatArray, weights: FloatArray | None = None) -> list[str]:
    """Records of ids (n, i), values (n, c) and the upper triangles of matrices (n, k, k)."""
    if weights is not None:
        i, j = np.triu_indices(weights.shape[1])
        values = np.hstack([values, weights[:, i, j]])
    rows = zip(ids.tolist(), values, strict=True)
    return [f"{tag} {' '.join(map(str, named))} {' '.join(f'{x:.17g}' for x in row)}" for named, row in rows]


def _without_offset(d: int, *ids: IntArray) -> IntArray:
    """Columns of ids, in space with that of the sensor without an offset."""
    return np.column_stack([*ids, np.zeros_like(ids[0])])[:, : len(ids) + d - 2]


def _in_file_order(matrices: FloatArray) -> FloatArray:
    """Information matrices of poses in the order of the file."""
    return matrices[:, _SPATIAL[:, None], _SPATIAL] if matrices.shape[1] == len(_SPATIAL) else matrices


def _unique_ids(table: TextTable) -> tuple[IntArray, IntArray]:
    """Ids in increasing order, and their rows."""
    ids = table.integers(0, "id", 0, _LARGEST_ID)
    order = np.argsort(ids, kind="stable")
    new = np.ones(len(ids), dtype=np.bool_)
    new[order[1:]] = np.diff(ids[order]) > 0
    table.check(new, lambda row: f"id: {ids[row]} is given twice")
    return ids[order], order.astype(np.int64)


def _rows(table: TextTable, column: int, name: str, ids: IntArray) -> IntArray:
    """Rows of what a column of a table names."""
    named = table.integers(column, name, 0, _LARGEST_ID)
    rows = np.minimum(np.searchsorted(ids, named), len(ids) - 1)
    what = name if name in ("landmark", "offset") else "pose"
    table.check(ids[rows] == named, lambda row: f"{name}: there is no {what} {named[row]}")
    return rows.astype(np.int64)


def pose_columns(T: FloatArray) -> FloatArray:
    """Poses as the columns of records: x y heading (n, 3), or x y z qx qy qz qw (n, 7)."""
    if T.shape[1] == 3:
        return geometry.vectors(T)
    return np.column_stack([T[:, :3, 3], rotation_quaternion(T[:, :3, :3])[:, [1, 2, 3, 0]]])
