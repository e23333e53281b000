"""Share of the structure above the ground that two registered submaps have in common: the proof of a place.

Ground lies on ground everywhere, so it proves nothing; and what only one of the two has seen says nothing either.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from data_tools.lidar.places import heights_above_ground
from data_tools.lidar.voxels import voxel_downsample
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import inverse_transform, transform_points

_STANDS = 0.5  # m above the ground
_SPACING, _CELL = 0.8, 1.0  # m: of the points compared, and of the cells that were seen
_SEEN, _NEAR = 2.0, 0.6  # m from above to a cell that was seen, and to a point that is the same
_FEWEST = 20  # points that tell an overlap


@dataclass(frozen=True, eq=False)
class Structure:
    """Points above the ground, thinned (M, 3), with trees of more of them, and of the cells seen from above."""

    points: FloatArray
    tree: cKDTree
    seen: cKDTree

    @classmethod
    def of(cls, points: FloatArray) -> Structure:
        """The structure of points (N, 3), m, z up; N > 0."""
        standing = points[heights_above_ground(points)[0] > _STANDS]
        cells = np.unique(np.floor(points[:, :2] / _CELL), axis=0) * _CELL + _CELL / 2
        standing = standing[voxel_downsample(standing, _SPACING / 2)]
        return cls(standing[voxel_downsample(standing, _SPACING)], cKDTree(standing), cKDTree(cells))

    def shared(self, other: Structure, self_T_other: FloatArray) -> float:
        """Share of the points of each that lie on the other, where that one has seen: the smaller one; 0: too few."""
        return min(share or 0.0 for share in self._shares(other, self_T_other))

    def agreement(self, other: Structure, self_T_other: FloatArray) -> float | None:
        """Mean of the two shares: for a scan, which sees too little of the other to have most of it; None: too few."""
        told = [share for share in self._shares(other, self_T_other) if share is not None]
        return float(np.mean(told)) if told else None

    def _shares(self, other: Structure, T: FloatArray) -> tuple[float | None, float | None]:
        return self._share(other.points, T), other._share(self.points, inverse_transform(T))

    def _share(self, points: FloatArray, T: FloatArray) -> float | None:
        """Share of the points that lie on this structure where it has seen; None: too few there."""
        moved = transform_points(T, points)
        distance, _ = self.seen.query(moved[:, :2], distance_upper_bound=_SEEN)
        moved = moved[np.isfinite(distance)]
        if len(moved) < _FEWEST:
            return None
        if not len(self.points):
            return 0.0
        distance, _ = self.tree.query(moved, distance_upper_bound=_NEAR)
        return float(np.isfinite(distance).mean())
