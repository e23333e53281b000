"""Submaps from keyframes: points are collected while a submap runs, and thinned to one cloud when it is closed."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from data_tools.lidar import Submap, upright, voxel_downsample
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import inverse_transform, transform_points


class SubmapBuilder:
    """Collects the points of the running submap's keyframes; spacing: of the points that are kept, m."""

    def __init__(self, spacing: float) -> None:
        self._spacing = spacing
        self._clouds: list[npt.NDArray[np.float32]] = []
        self._number, self._first, self._way = 0, 0, 0.0
        self._driven = 0.0
        self._anchor_T_submap: FloatArray = np.eye(4)

    def add(self, points: FloatArray, world_T_sensor: FloatArray, driven: float) -> None:
        """Add the next keyframe: points (N, 3), thinned to the spacing already; driven: way since the last, m."""
        self._driven += driven
        if not self._clouds:
            self._anchor_T_submap, self._way = upright(world_T_sensor), self._driven
        self._clouds.append(points.astype(np.float32))

    def close(self, world_T_sensor: FloatArray) -> Submap:
        """Return the submap, given the poses (n, 4, 4) of its keyframes, and begin the next."""
        frame = inverse_transform(world_T_sensor[0] @ self._anchor_T_submap)
        clouds = zip(world_T_sensor, self._clouds, strict=True)
        every = np.concatenate([transform_points(frame @ T, cloud.astype(np.float64)) for T, cloud in clouds])
        points = every[voxel_downsample(every, self._spacing)].astype(np.float32)
        last, count = self._first + len(self._clouds), self._number
        submap = Submap(
            count, (self._first, last), self._first, self._anchor_T_submap, points, (self._way, self._driven)
        )
        self._clouds, self._first, self._number = [], last, count + 1
        return submap

    def __len__(self) -> int:
        return len(self._clouds)


def world_T_submap(submap: Submap, world_T_anchor: FloatArray) -> FloatArray:
    """The frame (4, 4) of a submap, given the pose of its anchor."""
    return np.asarray(world_T_anchor @ submap.anchor_T_submap)
