"""Planes in a scan: walls, and the ground under the vehicle.

A plane is n . x + d = 0 in the sensor's frame, n of length 1 pointing to the side of the sensor (d > 0). Fitted to
points, or to means of surfels, c their centre and a <= b <= e the eigenvalues of S = sum (p - c)(p - c)^T, n is the
eigenvector of a and d = - n . c. With a noise of sigma across the plane, and k points,

    var(tilt) = sigma^2 / b        (the worse of the two directions),        var(d) = sigma^2 / k + |c|^2 var(tilt)

where the last term is the effect of the tilt on the distance at the sensor. Walls are found by consensus: the upright
flat surfel with the most others in its plane forms a wall with the connected ones among them; this is repeated with
the remaining surfels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from data_tools.lidar.surfels import surfels_of
from data_tools.lidar.voxels import voxel_downsample
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray

_MIN_COSINE = 0.97  # least cosine between normals of one wall
_MAX_THICKNESS = 0.15  # largest distance of a surfel from the plane of its wall, m
_MIN_SURFELS = 8  # fewest surfels of a wall
SURFEL_SIZE = 1.0  # voxel size of the surfels, m
MAX_RANGE = 50.0  # largest distance from the sensor, m
MAX_TILT = 0.15  # largest z component of the normal of a wall
MAX_GAP = 3.0  # largest gap within a wall, m
MIN_LENGTH = 3.0  # least length of a wall, m
WALL_NOISE = 0.03  # standard deviation of surfels across their wall, m
GROUND_NOISE = 0.02  # standard deviation of surfels of the ground, m


@dataclass(frozen=True, eq=False)
class Plane:
    """A plane and its visible part, in the sensor's frame.

    coefficients  (4,) n and d, d > 0
    covariance    (3, 3) of two tilts of n (rad^2) and of d (m^2); no correlations, the tilts alike
    centre        (3,) of the visible part, m
    extent        (2, 3) its ends: for a wall the lowest point of one end and the highest of the other; for the ground
                  two corners
    """

    coefficients: FloatArray
    covariance: FloatArray
    centre: FloatArray
    extent: FloatArray


def fit_plane(points: FloatArray, noise: float) -> Plane:
    """The plane of points (N, 3), m, N >= 3, each with `noise` m across it."""
    centre = points.mean(axis=0)
    off = points - centre
    values, vectors = np.linalg.eigh(off.T @ off)
    normal, d = vectors[:, 0], float(-vectors[:, 0] @ centre)
    if d < 0:
        normal, d = -normal, -d
    tilt = noise**2 / max(float(values[1]), 1e-9)
    covariance = np.diag([tilt, tilt, noise**2 / len(points) + float(centre @ centre) * tilt])
    along = off @ vectors[:, 2]
    ends = np.stack([points[along.argmin()], points[along.argmax()]])
    ends[0, 2], ends[1, 2] = points[:, 2].min(), points[:, 2].max()
    return Plane(np.append(normal, d), covariance, centre, ends)


def near_walls(positions: FloatArray, walls: Sequence[Plane], distance: float) -> BoolArray:
    """Mask of the positions (N, 3), m, within a horizontal `distance`, m, of the visible part of a wall."""
    near = np.zeros(len(positions), dtype=np.bool_)
    for wall in walls:
        along = np.array([-wall.coefficients[1], wall.coefficients[0]])
        ends = np.sort(wall.extent[:, :2] @ along)
        u = positions[:, :2] @ along
        across = np.abs(positions @ wall.coefficients[:3] + wall.coefficients[3])
        near |= (across <= distance) & (u >= ends[0] - distance) & (u <= ends[1] + distance)
    return near


def fit_ground(ground: FloatArray, reach: float = 15.0) -> Plane | None:
    """The plane of the ground points (N, 3) within `reach` m; None for too few points."""
    near = ground[np.hypot(ground[:, 0], ground[:, 1]) <= reach]
    near = near[voxel_downsample(near, SURFEL_SIZE)]
    for _ in range(3):
        if len(near) < 3 * _MIN_SURFELS:
            return None
        plane = fit_plane(near, GROUND_NOISE)
        off = np.abs(near @ plane.coefficients[:3] + plane.coefficients[3])
        near = near[off <= max(2.5 * float(np.median(off)), 0.01)]
    return plane


def extract_walls(points: FloatArray) -> list[Plane]:
    """The walls among points (N, 3), m, of a scan without its ground, the largest first."""
    points = points[np.hypot(points[:, 0], points[:, 1]) <= MAX_RANGE]
    surfels = surfels_of(points, SURFEL_SIZE)
    surfels = surfels.select(surfels.flat & (np.abs(surfels.normal[:, 2]) <= MAX_TILT))
    mean, normal = surfels.mean, surfels.normal
    coplanar = np.abs(normal @ normal.T) >= _MIN_COSINE
    across = np.abs(normal @ mean.T - np.einsum("ni,ni->n", normal, mean)[:, None])
    coplanar &= (across <= _MAX_THICKNESS) & (_MAX_THICKNESS >= across.T)
    walls: list[Plane] = []
    left = np.ones(len(mean), dtype=np.bool_)
    while left.any():
        support = coplanar[:, left].sum(axis=1) * left
        best = int(support.argmax())
        if support[best] < _MIN_SURFELS:
            break
        rows = _connected(mean, np.flatnonzero(coplanar[best] & left), best, MAX_GAP)
        left[rows] = left[best] = False
        if len(rows) < _MIN_SURFELS:
            continue
        wall = fit_plane(mean[rows], WALL_NOISE)
        if np.hypot(*(wall.extent[1] - wall.extent[0])[:2]) >= MIN_LENGTH and abs(wall.coefficients[2]) <= MAX_TILT:
            walls.append(wall)
    return walls


def _connected(mean: FloatArray, rows: IntArray, seed: int, gap: float) -> IntArray:
    """The rows connected with `seed` by gaps of at most `gap` m."""
    pairs = cKDTree(mean[rows]).query_pairs(gap, output_type="ndarray")
    links = csr_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(rows), len(rows)))
    _, part = connected_components(links, directed=False)
    return np.asarray(rows[part == part[np.flatnonzero(rows == seed)[0]]])
