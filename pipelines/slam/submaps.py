"""Submaps from keyframes: points are collected while a submap runs, and thinned to one cloud when it is closed.

Odometry that does not come from the scans bends what they show: 5 % of drift blur a submap of 30 m by more than a
metre, and no place is recognised in it. So its scans are registered with each other. That straightens the cloud alone;
the graph has the odometry as it is.
"""

from __future__ import annotations

import contextlib

import numpy as np
import numpy.typing as npt

from data_tools.lidar import (
    RegistrationError,
    RegistrationSettings,
    Submap,
    SurfelMap,
    register,
    upright,
    voxel_downsample,
)
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import inverse_transform, transform_points

_SURFEL, _SCAN = 1.0, 1.5  # m: voxels, and spacing of the points registered
_REGISTRATION = RegistrationSettings()


class SubmapBuilder:
    """Collects the points of the running submap's keyframes.

    spacing: of the points that are kept, m; straighten: by registration of the scans with each other
    """

    def __init__(self, spacing: float, straighten: bool = False) -> None:
        self._spacing, self._straighten = spacing, straighten
        self._clouds: list[npt.NDArray[np.float32]] = []
        self._number, self._first, self._way = 0, 0, 0.0
        self._driven = 0.0
        self._anchor_T_submap: FloatArray = np.eye(4)
        self._surfels = SurfelMap(_SURFEL, reach=np.inf)
        self._inner: list[FloatArray] = []  # of the sensor since the first keyframe, straightened
        self._last: FloatArray = np.eye(4)

    def add(self, points: FloatArray, world_T_sensor: FloatArray, driven: float) -> None:
        """Add the next keyframe: points (N, 3), thinned to the spacing already; driven: way since the last, m."""
        self._driven += driven
        if not self._clouds:
            self._anchor_T_submap, self._way = upright(world_T_sensor), self._driven
        if self._straighten:
            self._register(points, inverse_transform(self._last) @ world_T_sensor)
        self._clouds.append(points.astype(np.float32))
        self._last = world_T_sensor

    def _register(self, points: FloatArray, moved: FloatArray) -> None:
        """Place a scan by those of the submap before it; moved: (4, 4) since the last by odometry."""
        placed = self._inner[-1] @ moved if self._inner else np.eye(4)
        if self._inner and len(points):
            thin = points[voxel_downsample(points, _SCAN)]
            with contextlib.suppress(RegistrationError):  # then it lies as odometry has it
                found = register(thin, self._surfels, placed, 2 * _SURFEL, 0.1, _REGISTRATION, "hold")
                placed = found.map_T_scan if found.converged else placed
        self._surfels.add(transform_points(placed, points), placed[:3, 3])
        self._inner.append(placed)

    def close(self, world_T_sensor: FloatArray) -> Submap:
        """Return the submap, given the poses (n, 4, 4) of its keyframes, and begin the next."""
        inner = np.array(self._inner) if self._straighten else inverse_transform(world_T_sensor[0]) @ world_T_sensor
        frame = inverse_transform(self._anchor_T_submap)
        clouds = zip(inner, self._clouds, strict=True)
        every = np.concatenate([transform_points(frame @ T, cloud.astype(np.float64)) for T, cloud in clouds])
        points = every[voxel_downsample(every, self._spacing)].astype(np.float32)
        last, count = self._first + len(self._clouds), self._number
        submap = Submap(
            count, (self._first, last), self._first, self._anchor_T_submap, points, (self._way, self._driven)
        )
        self._clouds, self._first, self._number = [], last, count + 1
        self._surfels, self._inner = SurfelMap(_SURFEL, reach=np.inf), []
        return submap

    def __len__(self) -> int:
        return len(self._clouds)


def world_T_submap(submap: Submap, world_T_anchor: FloatArray) -> FloatArray:
    """The frame (4, 4) of a submap, given the pose of its anchor."""
    return np.asarray(world_T_anchor @ submap.anchor_T_submap)
