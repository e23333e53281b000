"""Maps of planar scans: occupancy, registration with points on lines, search for a pose by branch and bound.

Registration of planar scans with a map of points on lines.

    minimise over T   sum_i w_i ( n_i . (T p_i - m_i) )^2 / sigma^2  +  || T - T_0 ||^2_Omega

p_i are points of the scan, m_i the nearest points of the map, n_i the normal of the line through the neighbours of m_i;
w_i are Cauchy weights. T_0 with information Omega is what odometry says; along a bare corridor it alone decides.
T = (x, y, heading) is stepped in the map's axes about the scan's origin by Gauss and Newton.

Source: Censi, An ICP variant using a point-to-line metric, ICRA 2008.

Occupancy grid of planar scans: how often each cell stopped a ray, and how often one went through.

    p = (hits + 1) / (hits + misses + 2),     entropy = sum over cells that a ray met  of  - p log2 p - (1-p) log2 (1-p)

Walls that are drawn twice, or blurred, have cells that are hit and passed, and more cells: their entropy is larger.
Source: Thrun, Burgard, Fox, Probabilistic Robotics (2005), chapter 9.

Search for the pose of a scan in a map, inside a window: branch and bound over a grid of scores.

    score(T) = mean_i  exp( - d(T p_i)^2 / 2 sigma^2 ),        d: distance from the nearest point of the map

A level l holds the largest score of each square of 2^l cells, which bounds all shifts within it; squares whose bound is
below the best score found are left out. Sources: Olson, Real-time correlative scan matching, ICRA 2009; Hess, Kohler,
Rapp, Andor, Real-time loop closure in 2D LIDAR SLAM, ICRA 2016.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from saga_fg.numerics import BoolArray, FloatArray, IntArray

SIGMA = 0.04  # m, of a point about its line: noise of the laser, and what is not a line
SMEAR = 4.0  # how often the points of a wall say the same: information of a registration is divided by this
_WEAK = 0.3  # ratio of information along and across below which few points tell the way along
_NEIGHBOURS, _REACH = 8, 0.4  # of a point that determine its line, and m from it
_COARSE = 0.12  # m: lines are those of means in such cells, so that the noise of dense scans is averaged
_FEWEST = 4  # of them
_NEAR = 0.15  # m, largest distance of a pair at the end
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

    def fit(self, scan: FloatArray, pose: FloatArray, prior: FloatArray, reach: float) -> Fit:
        """Register points (n, 2) of a scan from a pose (3,), of which odometry knows `prior` (3, 3).

        reach: largest distance of a pair at the start, m; it shrinks to `_NEAR`
        """
        start, x = pose, pose.copy()
        H = np.zeros((3, 3))
        for iteration in range(_ITERATIONS):
            farthest = max(_NEAR, reach * 0.7**iteration)
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
            if farthest == _NEAR and np.abs(step).max() < _STEP:
                break
        distance, _ = self.tree.query(_turned(scan, x[2]) + x[:2], distance_upper_bound=_NEAR)
        return Fit(x, H, float(np.isfinite(distance).mean()) if len(scan) else 0.0)


def _lines(points: FloatArray, map_points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Normal (n, 2) of the line through the nearest points of a map, and the ratio (n,) of variances across and along.

    The ratio is infinite where fewer than four points are near.
    """
    k = max(1, min(_NEIGHBOURS, len(map_points)))
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


_MAX_CELLS = 50_000_000


@dataclass(frozen=True, eq=False)
class OccupancyGrid:
    """hits, misses (W, H); origin (2,) of the first cell and width of a cell, m."""

    hits: FloatArray
    misses: FloatArray
    origin: FloatArray
    cell: float

    @classmethod
    def of(cls, scans: Sequence[FloatArray], world_T_laser: FloatArray, cell: float = 0.1) -> OccupancyGrid:
        """A grid of scans, points (n, 2) each in the laser's frame, from poses (N, 3, 3); cells grow where too many."""
        ends = [scan @ T[:2, :2].T + T[:2, 2] for scan, T in zip(scans, world_T_laser, strict=True)]
        every = np.concatenate([*ends, world_T_laser[:, :2, 2]])
        low, high = every.min(axis=0), every.max(axis=0)
        cell = max(cell, float(np.sqrt(np.prod(high - low + 2 * cell) / _MAX_CELLS)))
        origin = low - cell
        size = np.ceil((high - origin) / cell).astype(int) + 1
        hits, misses = np.zeros(int(size.prod())), np.zeros(int(size.prod()))
        for end, T in zip(ends, world_T_laser, strict=True):
            if not len(end):
                continue
            at = ((end - origin) / cell).astype(int)
            np.add.at(hits, at[:, 0] * size[1] + at[:, 1], 1.0)
            ray = end - T[:2, 2]
            length = np.linalg.norm(ray, axis=1)
            steps = np.arange(0.0, max(float(length.max()) - cell, cell), cell)
            inside = steps[None, :] < length[:, None] - cell
            places = T[:2, 2] + (ray / np.maximum(length, 1e-9)[:, None])[:, None, :] * steps[None, :, None]
            at = ((places[inside] - origin) / cell).astype(int)
            passed = np.unique(at[:, 0] * size[1] + at[:, 1])  # a scan passes a cell once
            misses[passed] += 1.0
        return cls(hits.reshape(size), misses.reshape(size), origin, cell)

    @property
    def seen(self) -> FloatArray:
        """Number of rays that met each cell (W, H)."""
        return self.hits + self.misses

    @property
    def probability(self) -> FloatArray:
        """Probability (W, H) that a cell is occupied, 1/2 where no ray came."""
        return (self.hits + 1) / (self.seen + 2)

    @property
    def entropy(self) -> float:
        """Entropy of the cells that a ray met, bits."""
        p = self.probability[self.seen > 0]
        return float(-(p * np.log2(p) + (1 - p) * np.log2(1 - p)).sum())


CELL = 0.1  # m
_SIGMA = 0.1  # m
_LEVELS = 4  # the coarsest of squares of 8 cells
_RIVAL = 0.9  # share of the best score from which another place is a rival
_APART = 0.8  # m, and
_TURNED = 0.35  # rad, between two places that are not the same


class Found(NamedTuple):
    """pose (3,), score, and the score of the best rival that lies apart."""

    pose: FloatArray
    score: float
    rival: float


@dataclass(frozen=True, eq=False)
class ScoreGrid:
    """levels: (W, H) each; origin (2,): of the first cell, m."""

    levels: tuple[FloatArray, ...]
    origin: FloatArray

    @classmethod
    def of(cls, points: FloatArray) -> ScoreGrid:
        """The scores about the points (n, 2) of a map."""
        margin = 4 * _SIGMA
        origin = points.min(axis=0) - margin
        size = np.ceil((points.max(axis=0) + margin - origin) / CELL).astype(int) + 1
        hit = np.ones(size, dtype=bool)
        at = ((points - origin) / CELL).astype(int)
        hit[at[:, 0], at[:, 1]] = False
        level = np.exp(-0.5 * (distance_transform_edt(hit) * CELL / _SIGMA) ** 2).astype(np.float32)
        levels = [level]
        for k in range(_LEVELS - 1):  # each is padded, so that squares may begin before the first cell
            ahead, behind = (0, 2**k), (2**k, 0)
            level = np.maximum(np.pad(level, (behind, (0, 0))), np.pad(level, (ahead, (0, 0))))
            level = np.maximum(np.pad(level, ((0, 0), behind)), np.pad(level, ((0, 0), ahead)))
            levels.append(level)
        return cls(tuple(levels), origin)

    def search(self, scan: FloatArray, pose: FloatArray, reach: float, turn: float, least: float) -> Found | None:
        """The best pose within `reach` (m, in each axis) and `turn` (rad) of `pose`; None if none scores `least`."""
        far = max(1.0, float(np.quantile(np.linalg.norm(scan, axis=1), 0.9)))
        step = 1.5 * CELL / far
        angles = pose[2] + step * np.arange(-np.ceil(turn / step), np.ceil(turn / step) + 1)
        c, s = np.cos(angles)[:, None], np.sin(angles)[:, None]
        x = c * scan[:, 0] - s * scan[:, 1] + pose[0] - self.origin[0]
        y = s * scan[:, 0] + c * scan[:, 1] + pose[1] - self.origin[1]
        cells = np.floor(np.stack([x, y], axis=2) / CELL).astype(np.int64)
        top = _LEVELS - 1
        n = int(np.ceil(reach / CELL))
        steps = np.arange(-n, n + 1, 2**top)
        angle, dx, dy = (a.ravel() for a in np.meshgrid(np.arange(len(angles)), steps, steps, indexing="ij"))
        bound = self._scores(top, cells, angle, dx, dy)
        best = least
        for level in range(top, 0, -1):
            lead = int(np.argmax(bound))
            best = max(best, self._reached(level, n, cells, angle[lead], dx[lead], dy[lead]))
            keep = bound >= max(least, _RIVAL * best)
            if not keep.any():
                return None
            half = 2 ** (level - 1)
            angle, dx, dy = (np.repeat(a[keep], 4) for a in (angle, dx, dy))
            dx, dy = dx + half * np.tile([0, 0, 1, 1], len(dx) // 4), dy + half * np.tile([0, 1, 0, 1], len(dy) // 4)
            inside = (dx <= n) & (dy <= n)  # the last squares of the coarsest level reach beyond the window
            angle, dx, dy = angle[inside], dx[inside], dy[inside]
            bound = self._scores(level - 1, cells, angle, dx, dy)
        lead = int(np.argmax(bound))
        if bound[lead] < least:
            return None
        apart = np.hypot(dx - dx[lead], dy - dy[lead]) * CELL > _APART
        apart |= np.abs(angles[angle] - angles[angle[lead]]) > _TURNED
        rival = float(bound[apart].max(initial=0.0))
        found = np.array([pose[0] + dx[lead] * CELL, pose[1] + dy[lead] * CELL, angles[angle[lead]]])
        return Found(found, float(bound[lead]), rival)

    def _reached(self, level: int, n: int, cells: IntArray, angle: int, dx: int, dy: int) -> float:
        """The best score in a square of a level, within shifts of n cells."""
        xs, ys = np.meshgrid(*(np.arange(at, min(at + 2**level - 1, n) + 1) for at in (dx, dy)))
        return float(self._scores(0, cells, np.full(xs.size, angle), xs.ravel(), ys.ravel()).max())

    def _scores(self, level: int, cells: IntArray, angle: IntArray, dx: IntArray, dy: IntArray) -> FloatArray:
        """Mean scores (k,) of a level for shifts in cells."""
        grid, pad = self.levels[level], 2**level - 1
        found = np.empty(len(angle))
        block = max(1, 2_000_000 // cells.shape[1])
        for at in range(0, len(angle), block):
            part = slice(at, at + block)
            i = cells[angle[part], :, 0] + (dx[part, None] + pad)
            j = cells[angle[part], :, 1] + (dy[part, None] + pad)
            inside = (i >= 0) & (j >= 0) & (i < grid.shape[0]) & (j < grid.shape[1])
            flat = np.where(inside, i * grid.shape[1] + j, 0)
            found[part] = (grid.ravel()[flat] * inside).mean(axis=1)
        return found
