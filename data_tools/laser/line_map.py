r"""Registration of planar scans with a map of points on lines.

    minimise over T   sum_i w_i ( n_i . (T p_i - m_i) )^2 / sigma^2  +  || T - T_0 ||^2_Omega

p_i are points of the scan, m_i the nearest points of the map, n_i the normal of the line through the neighbours of m_i;
w_i are Cauchy weights. T_0 with information Omega is what odometry says; along a bare corridor it alone decides.
T = (x, y, heading) is stepped in the map's axes about the scan's origin by Gauss and Newton.

Source: Censi, An ICP variant using a point-to-line metric, ICRA 2008.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray

SIGMA = 0.04  # m, of a point about its line: noise of the laser, and what is not a line
SMEAR = 4.0  # how often the points of a wall say the same: information of a registration is divided by this
_WEAK = 0.3  # ratio of information along and across below which few points tell the way along
_NEIGHBOURS, _REACH = 8, 0.4  # of a point that determine its line, and m from it
_COARSE = 0.12  # m: lines are those of means in such cells, so that the noise of dense scans is averaged
_FEWEST = 4  # of them
_FLAT = 0.15  # largest ratio of the standard deviations across and along a line
_ITERATIONS, _STEP = 20, 1e-4


class Fit(NamedTuple):
    """pose (3,); information (3, 3) of the points alone, in the map's axes; share: of the points that lie
    within `near` of a point of the map, there.
    """

    pose: FloatArray
    information: FloatArray
    share: float


@dataclass(frozen=True, eq=False)
class LineMap:
    """points (n, 2), their normals (n, 2), and which lie on a line (n,)."""

    tree: cKDTree
    points: FloatArray
    normals: FloatArray
    flat: BoolArray

    @classmethod
    def of(cls, points: FloatArray, cell: float = 0.04) -> LineMap:
        """A map of points (n, 2), their mean in each cell, m."""
        points = cell_means(points, cell)
        tree = cKDTree(points)
        normals, ratio = _lines(points, points)
        wider, wider_ratio = _lines(points, cell_means(points, _COARSE))
        better = wider_ratio < ratio
        normals[better] = wider[better]
        return cls(tree, points, normals, np.minimum(ratio, wider_ratio) <= _FLAT**2)

    def fit(self, scan: FloatArray, pose: FloatArray, prior: FloatArray, reach: float, near: float = 0.15) -> Fit:
        """Register points (n, 2) of a scan from a pose (3,), of which odometry knows `prior` (3, 3).

        reach: largest distance of a pair at the start, m; it shrinks to `near`
        """
        start, x = pose, pose.copy()
        H = np.zeros((3, 3))
        for iteration in range(_ITERATIONS):
            farthest = max(near, reach * 0.7**iteration)
            arm = _turned(scan, x[2])
            at = arm + x[:2]
            distance, rows = self.tree.query(at, distance_upper_bound=farthest)
            paired = np.isfinite(distance)
            rows, arms = rows[paired], arm[paired]
            flat = self.flat[rows]
            rows, arms = rows[flat], arms[flat]
            if len(rows) < 5:
                break
            n = self.normals[rows]
            r = ((at[paired][flat] - self.points[rows]) * n).sum(axis=1)
            w = 1 / (1 + (r / (2 * SIGMA)) ** 2) / SIGMA**2
            J = np.column_stack([n, n[:, 1] * arms[:, 0] - n[:, 0] * arms[:, 1]])
            H = J.T @ (w[:, None] * J)
            known = prior + _along_weak(H, prior)
            gradient = J.T @ (w * r) + known @ difference(x, start)
            step = -np.linalg.solve(H + known, gradient)
            x = x + step
            if farthest == near and np.abs(step).max() < _STEP:
                break
        distance, _ = self.tree.query(_turned(scan, x[2]) + x[:2], distance_upper_bound=near)
        return Fit(x, H, float(np.isfinite(distance).mean()) if len(scan) else 0.0)


def _lines(points: FloatArray, map_points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Normal (n, 2) of the line through the nearest points of a map, and the ratio (n,) of variances across and along.

    The ratio is infinite where fewer than four points are near.
    """
    k = min(_NEIGHBOURS, len(map_points))
    distance, rows = cKDTree(map_points).query(points, k=k, distance_upper_bound=_REACH)
    known = np.isfinite(distance).reshape(len(points), k)
    near = map_points[np.where(known, rows.reshape(len(points), k), 0)]
    weight = known / np.maximum(known.sum(axis=1, keepdims=True), 1)
    centre = (weight[:, :, None] * near).sum(axis=1)
    off = near - centre[:, None]
    xx, yy, xy = ((weight * a).sum(axis=1) for a in (off[..., 0] ** 2, off[..., 1] ** 2, off[..., 0] * off[..., 1]))
    half, root = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    angle = 0.5 * np.arctan2(2 * xy, xx - yy) + np.pi / 2
    normals = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    counts = (known.sum(axis=1) >= _FEWEST) & (half + root > 0)
    return normals, np.where(counts, (half - root) / np.maximum(half + root, 1e-12), np.inf)


def _along_weak(H: FloatArray, prior: FloatArray) -> FloatArray:
    """Information (3, 3) to add to a prior in the direction that few points tell, whose errors are not independent."""
    values, vectors = np.linalg.eigh(H[:2, :2])
    added = np.zeros((3, 3))
    if values[0] < _WEAK * values[1]:
        u = vectors[:, 0]
        added[:2, :2] = (SMEAR - 1) * (u @ prior[:2, :2] @ u) * np.outer(u, u)
    return added


def _turned(points: FloatArray, angle: float) -> FloatArray:
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(points @ np.array([[c, s], [-s, c]]))


def difference(x: FloatArray, other: FloatArray) -> FloatArray:
    """x - other (3,), the angle within a half turn."""
    d = x - other
    d[2] = np.arctan2(np.sin(d[2]), np.cos(d[2]))
    return d


def thinned(points: FloatArray, cell: float) -> FloatArray:
    """One of the points (n, 2) in each cell, m."""
    _, first = np.unique(_cells(points, cell), return_index=True)
    return np.asarray(points[np.sort(first)])


def cell_means(points: FloatArray, cell: float) -> FloatArray:
    """Mean of the points (n, 2) in each cell, m: the noise of several readings is averaged."""
    _, part = np.unique(_cells(points, cell), return_inverse=True)
    sums = [np.bincount(part, weights=column) for column in points.T]
    return np.asarray(np.stack(sums, axis=1) / np.bincount(part)[:, None])


def _cells(points: FloatArray, cell: float) -> IntArray:
    keys = np.floor(points / cell).astype(np.int64)
    return np.asarray(keys[:, 0] * 4_000_037 + keys[:, 1])
