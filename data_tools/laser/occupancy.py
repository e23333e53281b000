"""Occupancy grid of planar scans: how often each cell stopped a ray, and how often one went through.

    p = (hits + 1) / (hits + misses + 2),     entropy = sum over cells that a ray met  of  - p log2 p - (1-p) log2 (1-p)

Walls that are drawn twice, or blurred, have cells that are hit and passed, and more cells: their entropy is larger.
Source: Thrun, Burgard, Fox, Probabilistic Robotics (2005), chapter 9.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from saga_fg.numerics.arrays import FloatArray

_MOST_CELLS = 50_000_000


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
        cell = max(cell, float(np.sqrt(np.prod(high - low + 2 * cell) / _MOST_CELLS)))
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
