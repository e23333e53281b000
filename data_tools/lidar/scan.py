"""One sweep of a LiDAR, and sequences of sweeps."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol, Self

import numpy as np

from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray, checked


@dataclass(frozen=True, eq=False)
class Scan:
    """N points of one sweep, in the sensor's frame (x ahead, y left, z up).

    points     (N, 3) m
    intensity  (N,) strength of the echo in the sensor's own unit, NaN where unknown
    time       (N,) s relative to the timestamp of the scan; None where unknown

    Raises `InputError` for arrays of other shapes and positions that are not finite.
    """

    points: FloatArray
    intensity: FloatArray
    time: FloatArray | None = None

    def __post_init__(self) -> None:
        points = checked("points", self.points, (None, 3))
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "intensity", checked("intensity", self.intensity, (len(points),), "finite-or-nan"))
        if self.time is not None:
            object.__setattr__(self, "time", checked("time", self.time, (len(points),)))

    @classmethod
    def of(cls, points: FloatArray) -> Self:
        """A scan without intensities and times."""
        return cls(points, np.full(len(points), np.nan))

    def __len__(self) -> int:
        return len(self.points)

    def select(self, rows: BoolArray | IntArray) -> Self:
        """The points of a mask or of row indices."""
        time = None if self.time is None else self.time[rows]
        return replace(self, points=self.points[rows], intensity=self.intensity[rows], time=time)

    def within(self, nearest: float, farthest: float) -> Self:
        """The points at distances from `nearest` to `farthest` m, without echoes of the vehicle itself."""
        square = np.einsum("ni,ni->n", self.points, self.points)
        return self.select((square >= nearest**2) & (square <= farthest**2))


class ScanSequence(Protocol):
    """K recorded scans in order of time, each read on access; `data_tools.datasets.kitti.KittiScans` is one.

    timestamps   (K,) s
    world_T_ego  (K, 4, 4) reference poses of the vehicle
    ego_T_lidar  (4, 4) pose of the sensor on the vehicle
    """

    @property
    def timestamps(self) -> FloatArray: ...
    @property
    def world_T_ego(self) -> FloatArray: ...
    @property
    def ego_T_lidar(self) -> FloatArray: ...
    def __len__(self) -> int: ...
    def __getitem__(self, row: int) -> Scan: ...
