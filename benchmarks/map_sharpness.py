"""Sharpness of the map of scans along a trajectory, a measure without a true trajectory.

A scan is compared with a map of the scans around it: each of its points q has k nearest neighbours in the map, with
mean c and normal n (direction of the least spread); its residual is | n . (q - c) |. Wrong poses make surfaces thick,
which increases residuals. The scan itself is not part of the map. Compare Razlaw et al.,
Evaluation of registration methods for sparse 3D laser scans, ECMR 2015 (mean plane variance).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from data_tools.lidar import voxel_downsample
from saga_fg.numerics import FloatArray, transform_points

NEIGHBOURS = 8
SPACING = 0.2  # m, of the map's points
THINNED = 0.5  # m, of the scan's
NEAREST_WITHIN = 0.5  # m; points without a neighbour this near are new and left out
FARTHEST = 50.0  # m from the sensor: beyond, rings are too far apart for planes


def scan_to_map_residual(
    clouds: Sequence[FloatArray], world_T_lidar: FloatArray, around: int = 10, every: int = 5
) -> float:
    """Mean residual, m, of every fifth scan in the map of the ten before it and the ten after it; NaN for one scan.

    clouds         K scans without skew, points (N, 3) in the sensor's frame; asked for when they are needed
    world_T_lidar  (K, 4, 4)
    """
    residuals, thin = [np.empty(0)], dict[int, FloatArray]()
    for k in range(0, len(clouds), every):
        near = range(max(0, k - around), min(len(clouds), k + around + 1))
        thin = {j: thin[j] if j in thin else _thinned(clouds[j]) for j in near}
        others = [j for j in near if j != k]
        if others:
            map_points = np.concatenate([transform_points(world_T_lidar[j], thin[j]) for j in others])
            residuals.append(_residuals(thin[k], map_points, world_T_lidar[k]))
    found = np.concatenate(residuals)
    return float(found.mean()) if len(found) else float("nan")


def _thinned(cloud: FloatArray) -> FloatArray:
    return cloud[voxel_downsample(cloud, SPACING)]


def _residuals(scan: FloatArray, map_points: FloatArray, world_T_lidar: FloatArray) -> FloatArray:
    scan = scan[np.linalg.norm(scan, axis=1) <= FARTHEST]
    points = transform_points(world_T_lidar, scan[voxel_downsample(scan, THINNED)])
    map_points = map_points[voxel_downsample(map_points, SPACING)]
    if len(map_points) < NEIGHBOURS:
        return np.empty(0)
    distance, row = cKDTree(map_points).query(points, k=NEIGHBOURS)
    near = distance[:, 0] <= NEAREST_WITHIN
    around = map_points[row[near]]
    mean = around.mean(axis=1)
    off = around - mean[:, None]
    normal = np.linalg.eigh(off.swapaxes(1, 2) @ off)[1][:, :, 0]
    return np.asarray(np.abs(np.einsum("ni,ni->n", points[near] - mean, normal)))
