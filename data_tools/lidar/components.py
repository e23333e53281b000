"""Points that hang together, seen from above: connected cells of a square grid.

Cells that hold points are joined with the eight around them; the parts are the connected components. Objects on the
ground are apart when seen from above, which makes two dimensions enough, and quick.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from saga_fg.numerics.arrays import FloatArray, IntArray

_NEIGHBOURS = ((1, 0), (0, 1), (1, 1), (1, -1))  # half of the eight: links go both ways


def connected_from_above(points: FloatArray, cell: float) -> IntArray:
    """Part (N,) from 0 on of each of the points (N, 3), m, joined over cells of `cell` m."""
    if not len(points):
        return np.empty(0, dtype=np.int64)
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
    return np.asarray(part[row], dtype=np.int64)
