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
    if not size > 0:
        raise InputError(f"size: expected a voxel size > 0 m, got {size!r}")
    index = np.floor(points / size)
    if len(index) and np.abs(index).max() >= _HALF:
        raise InputError(f"points: expected coordinates within {_HALF * size:g} m for voxels of {size:g} m")
    cell = index.astype(np.int64) + _HALF
    return np.asarray((cell[:, 0] << 2 * _BITS) | (cell[:, 1] << _BITS) | cell[:, 2])


def voxel_downsample(points: FloatArray, size: float) -> IntArray:
    """Rows (M,) of `points` (N, 3), ascending: the first point in each voxel of `size` m.

    Means of several points would not lie on the surface near corners.
    """
    _, first = np.unique(voxel_keys(points, size), return_index=True)
    return np.sort(first)


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
    order = np.lexsort((values, cell))
    count = np.bincount(cell, minlength=cells)
    start = np.cumsum(count) - count
    filled = count > 0
    result = np.full(cells, np.nan)
    result[filled] = values[order[(start + count // divisor)[filled]]]
    return result
