"""Shortest paths along the measurements of a pose graph, with whose length errors of relative poses grow."""

from __future__ import annotations

import numpy as np

from saga_fg.numerics.arrays import FloatArray, IntArray

_SHORTEST = 1e-6  # m: a sparse matrix takes 0 for no measurement


def shortest_paths(first: IntArray, second: IntArray, length: FloatArray, poses: int, row: int) -> FloatArray:
    """Lengths (poses,) of shortest paths from a pose along measurements (M,) of these lengths; infinite without one."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import dijkstra

    low, high = np.minimum(first, second), np.maximum(first, second)
    order = np.lexsort((length, high, low))  # the shortest of several between the same two
    _, once = np.unique(low[order] * poses + high[order], return_index=True)
    kept = order[once]
    joined = csr_array((np.maximum(length[kept], _SHORTEST), (low[kept], high[kept])), shape=(poses, poses))
    return np.asarray(dijkstra(joined, directed=False, indices=row))
