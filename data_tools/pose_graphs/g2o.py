"""The g2o format of pose graphs, in the plane and in space (https://github.com/RainerKuemmerle/g2o/wiki/File-Format).

    VERTEX_SE2 id x y heading
    EDGE_SE2 first second dx dy dheading I11 I12 I13 I22 I23 I33
    VERTEX_SE3:QUAT id x y z qx qy qz qw
    EDGE_SE3:QUAT first second dx dy dz qx qy qz qw I11 I12 ... I16 I22 ... I66
    FIX id

m and rad; a measurement is first_T_second; I is the upper triangle of the information matrix, row by row, ordered as
the pose is: (x, y, heading) or (translation, rotation). g2o means the vector part of a quaternion by a rotation in
space; like GTSAM, which everybody compares with, we read the matrix as that of a rotation vector. FIX names a pose to
hold; as the first pose is always held, it has no effect. Empty lines and those that begin with # are left out.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_tools.files.atomic_files import write_text
from data_tools.files.text_tables import LARGEST, TextTable, read_lines
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.geometry import quaternion_norms, quaternion_rotation, rotation_quaternion
from saga_fg.slam.pose_graph import PoseGraph
from saga_fg.types.boxes import MAX_POSITION

_UNIT = 1e-3  # what the norm of a quaternion may be off 1
_SLIGHT = 1e-4  # share of the largest eigenvalue by which the smallest may be negative: four digits are rounded so
_LEAST = 1e-9  # share of the largest eigenvalue that it is then raised to
_ENDS = ((0, "first"), (1, "second"))
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Layout:
    """The records of one dimension: their tags, the columns of a pose, where each entry of our tangent is found."""

    vertex: str
    edge: str
    pose: tuple[str, ...]
    tangent: tuple[int, ...]


_PLANAR = _Layout("VERTEX_SE2", "EDGE_SE2", ("x", "y", "heading"), (0, 1, 2))
_SPATIAL = _Layout("VERTEX_SE3:QUAT", "EDGE_SE3:QUAT", ("x", "y", "z", "qx", "qy", "qz", "qw"), (3, 4, 5, 0, 1, 2))
_TAGS = {tag: layout for layout in (_PLANAR, _SPATIAL) for tag in (layout.vertex, layout.edge)}


def read_g2o(path: str | Path) -> PoseGraph:
    """Read a pose graph; poses come in the order of their ids.

    A file of measurements alone starts at dead reckoning along them. An information matrix with an eigenvalue that is
    0 or slightly negative, as rounded ones have, is projected to a positive definite one, with a warning.
    Raises `InputError` naming the line for an unknown record, a wrong number of columns, a number that is none or too
    large, a quaternion off the unit sphere, a pose given twice or missing, or an information matrix with an eigenvalue
    that is clearly negative.
    """
    file = Path(path)
    tables = _records(file)
    planar = {tag for tag in tables if _TAGS[tag] is _PLANAR}
    if not tables or len(planar) not in (0, len(tables)):
        raise InputError(f"{file}: expected poses and edges, all in the plane (SE2) or all in space (SE3:QUAT)")
    layout = _PLANAR if planar else _SPATIAL
    if layout.edge not in tables:
        raise InputError(f"{file}: expected {layout.edge} records, there are none")
    edges, n = tables[layout.edge], len(layout.pose)
    between, information = _transforms(edges, 2, layout), _information(edges, 2 + n, layout)
    if layout.vertex not in tables:
        named = np.stack([edges.integers(column, name, 0, 2**62) for column, name in _ENDS])
        ids, rows = np.unique(named, return_inverse=True)
        first, second = rows.reshape(named.shape)
        _check_ends(edges, first, second)
        return PoseGraph.of_measurements(ids, first, second, between, information)
    vertices = tables[layout.vertex]
    ids = vertices.integers(0, "id", 0, 2**62)
    order = np.argsort(ids, kind="stable")
    twice = np.flatnonzero(ids[order][1:] == ids[order][:-1])
    if len(twice):
        row = int(order[twice[0] + 1])
        raise vertices.fault(row, f"id: pose {ids[row]} is given twice")
    first, second = (_rows(edges, column, name, ids[order]) for column, name in _ENDS)
    _check_ends(edges, first, second)
    return PoseGraph(ids[order], _transforms(vertices, 1, layout)[order], first, second, between, information)


def write_g2o(path: str | Path, graph: PoseGraph) -> None:
    """Write a pose graph, whole or not at all. Raises `InputError` where that is not possible."""
    layout = _PLANAR if graph.dim == 2 else _SPATIAL
    k = len(layout.tangent)
    upper = np.triu_indices(k)
    back = np.argsort(layout.tangent)
    information = graph.information[:, back[:, None], back][:, upper[0], upper[1]]
    lines = [
        f"{layout.vertex} {id_} {_numbers(row)}"
        for id_, row in zip(graph.ids.tolist(), _columns(graph.world_T_pose), strict=True)
    ]
    lines += [
        f"{layout.edge} {first} {second} {_numbers(row)} {_numbers(entries)}"
        for first, second, row, entries in zip(
            graph.ids[graph.first].tolist(),
            graph.ids[graph.second].tolist(),
            _columns(graph.first_T_second),
            information,
            strict=True,
        )
    ]
    write_text(path, "\n".join(lines) + "\n")


def _records(file: Path) -> dict[str, TextTable]:
    """The lines of a file by their tag."""
    found: dict[str, tuple[list[list[str]], list[int]]] = {}
    for number, line in enumerate(read_lines(file), start=1):
        tag, *row = line.split() or [""]
        if not tag or tag.startswith("#") or tag == "FIX":
            continue
        layout = _TAGS.get(tag)
        if layout is None:
            raise InputError(f"{file}: line {number}: expected one of {', '.join(_TAGS)}, FIX, got {tag[:40]!r}")
        k = len(layout.tangent)
        columns = 1 + len(layout.pose) if tag == layout.vertex else 2 + len(layout.pose) + k * (k + 1) // 2
        if len(row) != columns:
            raise InputError(f"{file}: line {number}: expected {columns} values after {tag}, got {len(row)}")
        rows, lines = found.setdefault(tag, ([], []))
        rows.append(row)
        lines.append(number)
    return {tag: TextTable.of(file, rows, lines) for tag, (rows, lines) in found.items()}


def _check_ends(edges: TextTable, first: IntArray, second: IntArray) -> None:
    if (first == second).any():
        raise edges.fault(int(np.argmax(first == second)), "second: expected another pose than the first")


def _rows(edges: TextTable, column: int, name: str, ids: IntArray) -> IntArray:
    """Rows of the poses that a column of the edges names."""
    named = edges.integers(column, name, 0, 2**62)
    rows = np.minimum(np.searchsorted(ids, named), len(ids) - 1)
    if (ids[rows] != named).any():
        row = int(np.argmax(ids[rows] != named))
        raise edges.fault(row, f"{name}: there is no pose {named[row]}")
    return rows.astype(np.int64)


def _transforms(table: TextTable, column: int, layout: _Layout) -> FloatArray:
    largest = tuple(MAX_POSITION if name in ("x", "y", "z") else LARGEST for name in layout.pose)
    values = table.numbers(slice(column, column + len(layout.pose)), layout.pose, largest)
    if layout is _PLANAR:
        c, s = np.cos(values[:, 2]), np.sin(values[:, 2])
        T = np.tile(np.eye(3), (len(values), 1, 1))
        T[:, :2, :2] = np.stack([c, -s, s, c], axis=1).reshape(-1, 2, 2)
        T[:, :2, 2] = values[:, :2]
        return T
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


def _information(edges: TextTable, column: int, layout: _Layout) -> FloatArray:
    k = len(layout.tangent)
    upper = np.triu_indices(k)
    names = tuple(f"I{i + 1}{j + 1}" for i, j in zip(*upper, strict=True))
    entries = edges.numbers(slice(column, column + len(names)), names)
    matrix = np.zeros((len(entries), k, k))
    matrix[:, upper[0], upper[1]] = matrix[:, upper[1], upper[0]] = entries
    tangent = np.array(layout.tangent)
    return _definite(edges, matrix)[:, tangent[:, None], tangent]


def _definite(edges: TextTable, matrix: FloatArray) -> FloatArray:
    """Project matrices (M, k, k) that are nearly positive definite."""
    values, vectors = np.linalg.eigh(matrix)
    smallest, largest, k = values[:, 0], values[:, -1], matrix.shape[1]
    bad = (smallest < -_SLIGHT * largest) | (largest <= 0)
    if bad.any():
        row = int(np.argmax(bad))
        raise edges.fault(
            row, f"I11 ... I{k}{k}: expected a positive definite matrix, smallest eigenvalue {smallest[row]:.3g}"
        )
    near = np.flatnonzero(smallest <= 0)
    if len(near):
        example = edges.fault(int(near[0]), f"smallest eigenvalue {smallest[near[0]]:.3g}")
        log.warning("%s; so of %d information matrices, which are made positive definite", example, len(near))
        raised = np.maximum(values[near], _LEAST * largest[near, None])
        matrix[near] = (vectors[near] * raised[:, None]) @ vectors[near].swapaxes(1, 2)
    return matrix


def _columns(T: FloatArray) -> FloatArray:
    """Poses as the columns of the file."""
    if T.shape[1] == 3:
        return np.column_stack([T[:, 0, 2], T[:, 1, 2], np.arctan2(T[:, 1, 0], T[:, 0, 0])])
    return np.column_stack([T[:, :3, 3], rotation_quaternion(T[:, :3, :3])[:, [1, 2, 3, 0]]])


def _numbers(row: FloatArray) -> str:
    return " ".join(f"{x:.17g}" for x in row)
