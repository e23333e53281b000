"""Surfels of the scans before: for each voxel, the Gaussian of the points that fell into it.

    n, m = mean, S = sum (p - m)(p - m)^T;   two sets of points of one voxel together, d = m_b - m_a:

    n = n_a + n_b,   m = m_a + n_b/n d,   S = S_a + S_b + n_a n_b / n d d^T            (Chan et al., 1979)

The eigenvector of S with the smallest eigenvalue is the normal of a surfel whose points lie flat: smallest eigenvalue
below a share of the second, and the second above that of a line. The voxels are sorted by key, and those too far from
the vehicle are dropped. Sources: Chan, Golub, LeVeque, Updating
formulae and a pairwise algorithm for computing sample variances, 1979; Biber and Strasser, The normal distributions
transform, IROS 2003.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from data_tools.lidar.voxels import voxel_groups, voxel_keys
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.numerics.columns import Columns

LEAST_POINTS = 6  # of a flat surfel
FLAT = 1 / 9  # largest share of the smallest eigenvalue in the second: a third of the standard deviation
WIDTH = 0.05  # least standard deviation along the surface, of a voxel's size: a line is not a surface
MEMORY = 200.0  # points after which older points lose weight


@dataclass(frozen=True, eq=False)
class Surfels(Columns):
    """M Gaussians, sorted by voxel.

    voxel    (M,) keys
    count    (M,) points, older ones with less weight
    mean     (M, 3) m
    scatter  (M, 3, 3) sum of the squares about the mean, m^2
    normal   (M, 3) unit normals, 0 where `flat` is False; flat (M,)
    """

    voxel: IntArray
    count: FloatArray
    mean: FloatArray
    scatter: FloatArray
    normal: FloatArray
    flat: BoolArray

    @classmethod
    def empty(cls) -> Surfels:
        none = np.empty(0)
        voxel = np.empty(0, dtype=np.int64)
        return cls(voxel, none, np.empty((0, 3)), np.empty((0, 3, 3)), np.empty((0, 3)), np.empty(0, dtype=np.bool_))


def surfels_of(points: FloatArray, size: float) -> Surfels:
    """The surfels of points (N, 3), m, in voxels of `size` m."""
    moments = _moments(points, size)
    return _with_normals(moments, np.ones(len(moments), dtype=np.bool_), size)


class SurfelMap:
    """Surfels around the vehicle, in the map's frame, and the search for the nearest flat one.

    size   of a voxel, m
    reach  largest distance of surfels from the last scan's position, m
    """

    def __init__(self, size: float, reach: float) -> None:
        self.size, self.reach = size, reach
        self.surfels = Surfels.empty()
        self._flat = self.surfels
        self._tree = cKDTree(np.empty((0, 3)))

    def add(self, points: FloatArray, position: FloatArray) -> None:
        """Add points (N, 3) observed from `position` (3,), both in the map's frame."""
        old, new = self.surfels, _moments(points, self.size)
        row = np.searchsorted(old.voxel, new.voxel)
        known = np.zeros(len(new), dtype=np.bool_)
        inside = row < len(old)
        known[inside] = old.voxel[row[inside]] == new.voxel[inside]
        merged = _merged(old.select(row[known]), new.select(known))
        both = old.append(new.select(~known))
        for name in ("count", "mean", "scatter"):
            getattr(both, name)[row[known]] = getattr(merged, name)
        changed = np.zeros(len(both), dtype=np.bool_)
        changed[row[known]] = changed[len(old) :] = True
        order = np.argsort(both.voxel, kind="stable")
        order = order[np.linalg.norm(both.mean[order] - position, axis=1) <= self.reach]
        self.surfels = _with_normals(both.select(order), changed[order], self.size)
        self._flat = self.surfels.select(self.surfels.flat)
        self._tree = cKDTree(self._flat.mean, balanced_tree=False, compact_nodes=False)

    @property
    def flat(self) -> Surfels:
        """The flat surfels."""
        return self._flat

    def nearest(self, points: FloatArray, farthest: float) -> tuple[IntArray, Surfels]:
        """Rows (K,) of the points that have a flat surfel with its mean within `farthest` m, and the surfel of each."""
        distance, row = self._tree.query(points, distance_upper_bound=farthest)
        found = np.flatnonzero(np.isfinite(distance))
        return found, self._flat.select(row[found])


def _moments(points: FloatArray, size: float) -> Surfels:
    order, start = voxel_groups(points, size)
    m = len(start)
    if not m:
        return Surfels.empty()
    grouped = points[order]
    voxel, count = voxel_keys(grouped[start], size), np.diff(start, append=len(points))
    mean = np.add.reduceat(grouped, start) / count[:, None]
    off = grouped - np.repeat(mean, count, axis=0)
    scatter = np.empty((m, 3, 3))
    for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
        scatter[:, i, j] = scatter[:, j, i] = np.add.reduceat(off[:, i] * off[:, j], start)
    return Surfels(voxel, count.astype(np.float64), mean, scatter, np.zeros((m, 3)), np.zeros(m, dtype=np.bool_))


def _merged(a: Surfels, b: Surfels) -> Surfels:
    count = a.count + b.count
    d = b.mean - a.mean
    mean = a.mean + d * (b.count / count)[:, None]
    scatter = a.scatter + b.scatter + (a.count * b.count / count)[:, None, None] * d[:, :, None] * d[:, None, :]
    kept = np.minimum(1.0, MEMORY / count)
    return Surfels(a.voxel, count * kept, mean, scatter * kept[:, None, None], a.normal, a.flat)


def _with_normals(surfels: Surfels, changed: BoolArray, size: float) -> Surfels:
    normal, flat = surfels.normal.copy(), surfels.flat.copy()
    rows = np.flatnonzero(changed & (surfels.count >= LEAST_POINTS))
    values, vectors = np.linalg.eigh(surfels.scatter[rows] / surfels.count[rows, None, None])
    flat[rows] = (values[:, 0] < FLAT * values[:, 1]) & (values[:, 1] > (WIDTH * size) ** 2)
    normal[rows] = np.where(flat[rows, None], vectors[:, :, 0], 0.0)
    return Surfels(surfels.voxel, surfels.count, surfels.mean, surfels.scatter, normal, flat)
