"""Points on grids: voxel downsampling, and clusters of points connected from above.

The voxel of a point p is floor(p / size), three integers packed into one of 3 x 21 bits. With voxels of 0.1 m the grid
extends 100 km in every direction.

Clusters are the connected components of the occupied cells of a square grid, each cell with its eight neighbours. Two
dimensions are enough, because objects on the ground are separate from above.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, IntArray

_BITS = 21
_HALF = 1 << (_BITS - 1)
_NEIGHBOURS = ((1, 0), (0, 1), (1, 1), (1, -1))  # half of the eight: the links are undirected


def voxel_keys(points: FloatArray, size: float) -> IntArray:
    """The voxels (N,) of points (N, 3), m; `size` in m. Raises `InputError` for points off the grid."""
    cell = _cells(points, size) + _HALF
    return np.asarray((cell[0] << 2 * _BITS) | (cell[1] << _BITS) | cell[2])


def voxel_groups(points: FloatArray, size: float) -> tuple[IntArray, IntArray]:
    """Rows (N,) of points (N, 3) voxel by voxel, ascending in each, and where (M,) each of the M voxels begins."""
    if not len(points):
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    cell = _cells(points, size)
    low = cell.min(axis=1)
    bits = [int(span).bit_length() for span in cell.max(axis=1) - low]
    row_bits = len(points).bit_length()
    key = ((cell[0] - low[0]) << bits[1] | (cell[1] - low[1])) << bits[2] | (cell[2] - low[2])
    if sum(bits) + row_bits < 63:  # voxel and row as one number: sorting numbers is far quicker than sorting rows
        packed = np.sort(key << row_bits | np.arange(len(points)))
        order, key = packed & ((1 << row_bits) - 1), packed >> row_bits
    else:
        key = voxel_keys(points, size)
        order = np.argsort(key, kind="stable")
        key = key[order]
    return order, np.flatnonzero(np.concatenate([[True], key[1:] != key[:-1]]))


def voxel_downsample(points: FloatArray, size: float) -> IntArray:
    """Rows (M,) of `points` (N, 3), ascending: the first point in each voxel of `size` m.

    Means of several points would not lie on the surface near corners.
    """
    order, start = voxel_groups(points, size)
    return np.sort(order[start])


def _cells(points: FloatArray, size: float) -> IntArray:
    """Voxels (3, N) of points (N, 3)."""
    if not size > 0:
        raise InputError(f"size: expected a voxel size > 0 m, got {size!r}")
    index = np.floor(np.ascontiguousarray(points.T) / size)
    if index.size and max(-index.min(), index.max()) >= _HALF:
        raise InputError(f"points: expected coordinates within {_HALF * size:g} m for voxels of {size:g} m")
    return index.astype(np.int64)


def clusters_from_above(points: FloatArray, cell: float) -> list[IntArray]:
    """Rows of points (N, 3), m, of each cluster on a grid of `cell` m."""
    if not len(points):
        return []
    index = np.floor(points[:, :2] / cell).astype(np.int64)
    index -= index.min(axis=0) - 1
    width = int(index[:, 1].max()) + 2
    keys, row = np.unique(index[:, 0] * width + index[:, 1], return_inverse=True)
    first, second = [], []
    for dx, dy in _NEIGHBOURS:
        beside = np.searchsorted(keys, keys + dx * width + dy)
        beside = np.minimum(beside, len(keys) - 1)
        linked = np.flatnonzero(keys[beside] == keys + dx * width + dy)
        first.append(linked)
        second.append(beside[linked])
    i, j = np.concatenate(first), np.concatenate(second)
    _, part = connected_components(csr_array((np.ones(len(i)), (i, j)), shape=(len(keys), len(keys))), directed=False)
    order = np.argsort(part[row], kind="stable")
    return np.split(order, np.flatnonzero(np.diff(part[row][order])) + 1)


def cell_order_statistics(values: FloatArray, cell: IntArray, cells: int, divisor: int) -> FloatArray:
    """Value (cells,) of rank count // divisor in each cell, NaN in empty ones; values (N,) and their cells (N,)."""
    count = np.bincount(cell, minlength=cells)
    start = np.cumsum(count) - count
    filled = count > 0
    result = np.full(cells, np.nan)
    if len(values):
        by_value = np.empty(len(values), dtype=np.int64)
        ranked = np.argsort(values)
        by_value[ranked] = np.arange(len(values))
        bits = len(values).bit_length()
        ordered = np.sort(cell.astype(np.int64) << bits | by_value) & ((1 << bits) - 1)  # ranks, cell by cell
        result[filled] = values[ranked[ordered[(start + count // divisor)[filled]]]]
    return result
