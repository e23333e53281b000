r"""Search for the pose of a scan in a map, inside a window: branch and bound over a grid of scores.

    score(T) = mean_i  exp( - d(T p_i)^2 / 2 sigma^2 ),        d: distance from the nearest point of the map

A level l holds the largest score of each square of 2^l cells, which bounds all shifts within it; squares whose bound is
below the best score found are left out. Sources: Olson, Real-time correlative scan matching, ICRA 2009; Hess, Kohler,
Rapp, Andor, Real-time loop closure in 2D LIDAR SLAM, ICRA 2016.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.ndimage import distance_transform_edt

from saga_fg.numerics.arrays import FloatArray, IntArray

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
            lead = int(np.argmax(bound))  # a way straight down tells a score that is really reached
            best = max(best, self._descended(level, n, cells, angle[lead], dx[lead], dy[lead]))
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

    def _descended(self, level: int, n: int, cells: IntArray, angle: int, dx: int, dy: int) -> float:
        """A score that is reached inside the square, within shifts of n cells."""
        score = 0.0
        for down in range(level - 1, -1, -1):
            xs, ys = dx + 2**down * np.array([0, 0, 1, 1]), dy + 2**down * np.array([0, 1, 0, 1])
            inside = (xs <= n) & (ys <= n)
            xs, ys = xs[inside], ys[inside]
            scores = self._scores(down, cells, np.full(len(xs), angle), xs, ys)
            lead = int(np.argmax(scores))
            dx, dy, score = xs[lead], ys[lead], float(scores[lead])
        return score

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
