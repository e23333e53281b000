"""Poles in a scan: masts, posts and trunks.

Points above the ground are clustered from above (`clusters_from_above`) on small cells. A cluster is a pole if it is
thin, tall, filled from its foot to its top, and isolated: few points in the ring around it at its own height.
Its position is the mean of its points, moved away from the sensor, because the visible points of a circle of radius r
lie on average pi/4 r in front of its centre. The width w across the line of sight gives r = w / 2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from data_tools.lidar.planes import Plane, near_walls
from data_tools.lidar.voxels import clusters_from_above
from saga_fg.numerics.arrays import FloatArray, IntArray

_MIN_FILLED = 0.5  # least share of half-metre steps of the height that contain points
_CLEAR_RADIUS = 0.6  # radius around the axis without other objects, m
_DEPTH_NOISE = 0.1  # standard deviation along the line of sight, from the unknown radius, m
CELL = 0.2  # cell of the clustering grid, m
MAX_RANGE = 40.0  # largest distance from the sensor, m
MIN_HEIGHT = 0.3  # lowest height above the ground of clustered points, m
MIN_LENGTH = 1.2  # least height from the lowest to the highest point, m
MAX_WIDTH = 0.6  # largest horizontal extent, m
MIN_POINTS = 8  # fewest points
CLEAR_SHARE = 0.1  # _CLEAR_RADIUS as a share of the range, against columns of walls at grazing angles
NOISE = 0.05  # standard deviation of the axis, m
BEARING_NOISE = 0.006  # standard deviation across the line of sight, rad


@dataclass(frozen=True, eq=False)
class Pole:
    """An upright pole, in the sensor's frame.

    foot        (3,) lowest visible point of the axis, m
    top         height of the highest visible point, m
    radius      m
    covariance  (2, 2) of the axis' position, x and y, m^2
    """

    foot: FloatArray
    top: float
    radius: float
    covariance: FloatArray


def extract_poles(points: FloatArray, height: FloatArray, walls: Sequence[Plane] = ()) -> list[Pole]:
    """The poles among points (N, 3), m, at `height` (N,) above the ground, m, except near `walls`."""
    points = points[(height >= MIN_HEIGHT) & (np.hypot(points[:, 0], points[:, 1]) <= MAX_RANGE)]
    everything = points
    points = points[~near_walls(points, walls, CELL)]
    slender = [points[rows] for rows in _slender(points, clusters_from_above(points, CELL))]
    if not slender:
        return []
    tree = cKDTree(everything[:, :2], balanced_tree=False, compact_nodes=False)
    poles = []
    for candidate in slender:
        pole = _pole(candidate)
        around = everything[
            tree.query_ball_point(pole.foot[:2], max(_CLEAR_RADIUS, CLEAR_SHARE * float(np.hypot(*pole.foot[:2]))))
        ]
        level = (around[:, 2] >= pole.foot[2]) & (around[:, 2] <= pole.top)
        if level.sum() <= 1.2 * len(candidate):
            poles.append(pole)
    return poles


def _slender(points: FloatArray, clusters: Sequence[IntArray]) -> list[IntArray]:
    """The clusters that are thin, tall and filled."""
    if not clusters:
        return []
    count = np.array([len(rows) for rows in clusters])
    grouped, start = points[np.concatenate(clusters)], np.cumsum(count) - count
    low, high = np.minimum.reduceat(grouped, start), np.maximum.reduceat(grouped, start)
    size = high - low
    thin = (count >= MIN_POINTS) & (size[:, :2].max(axis=1) <= MAX_WIDTH) & (size[:, 2] >= MIN_LENGTH)
    return [clusters[k] for k in np.flatnonzero(thin).tolist() if _filled(points[clusters[k], 2])]


def _filled(height: FloatArray) -> bool:
    steps = np.floor((height - height.min()) / 0.5)
    return bool(len(np.unique(steps)) >= _MIN_FILLED * np.ceil(np.ptp(height) / 0.5))


def _pole(points: FloatArray) -> Pole:
    mean = points[:, :2].mean(axis=0)
    sight = mean / max(float(np.hypot(*mean)), 1e-9)
    aside = np.array([-sight[1], sight[0]])
    across = points[:, :2] @ aside
    radius = float(np.ptp(across)) / 2
    axis = mean + np.pi / 4 * radius * sight
    covariance = np.cov(points[:, :2].T) / len(points) + NOISE**2 * np.eye(2)
    covariance += (BEARING_NOISE * float(np.hypot(*mean))) ** 2 * np.outer(aside, aside)
    covariance += _DEPTH_NOISE**2 * np.outer(sight, sight)
    return Pole(np.append(axis, points[:, 2].min()), float(points[:, 2].max()), radius, covariance)
