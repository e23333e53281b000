"""Ground segmentation on a polar grid, ring by ring from the vehicle outwards.

In each sector the ground height of a ring is the lowest decile of its points' heights, if it differs from that of the
next inner ring by no more than the steepest road would rise; otherwise (a car, a wall, a reflection from below) the
inner height is kept. A point is ground if it lies within a clearance of the height interpolated between rings. After
Himmelsbach, Hundelshausen, Wuensche, Fast segmentation of 3D point clouds for ground vehicles, IV 2010, with heights
instead of lines.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data_tools.lidar.voxels import cell_order_statistics
from saga_fg.numerics.arrays import BoolArray, FloatArray

_SECTORS = 60  # number of sectors of the polar grid
_RING_WIDTH = 1.5  # width of a ring, m
_MAX_SLOPE = 0.15  # steepest rise, m per m
MAX_RANGE = 80.0  # outer radius of the last ring, m
MAX_STEP = 0.1  # change of height between rings allowed beyond the slope, m
CLEARANCE = 0.2  # largest distance of a ground point from the ground height, m


@dataclass(frozen=True, eq=False)
class Ground:
    """Segmentation of N points: is_ground (N,), and height (N,) of each point above the ground, m."""

    is_ground: BoolArray
    height: FloatArray


def segment_ground(points: FloatArray) -> Ground:
    """Find the ground in points (N, 3), m, of a sensor that stands upright (z up) above it."""
    if not len(points):
        return Ground(np.empty(0, dtype=np.bool_), np.empty(0))
    distance = np.hypot(points[:, 0], points[:, 1])
    sector = ((np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) + 0.5) * _SECTORS).astype(np.int64) % _SECTORS
    rings = int(np.ceil(MAX_RANGE / _RING_WIDTH))
    ring = np.minimum((distance / _RING_WIDTH).astype(np.int64), rings - 1)
    low = cell_order_statistics(points[:, 2], sector * rings + ring, _SECTORS * rings, 10).reshape(_SECTORS, rings)
    ground = _ground_heights(low)
    place = np.clip(distance / _RING_WIDTH - 0.5, 0, rings - 1)
    inner = np.minimum(place.astype(np.int64), rings - 2)
    share = place - inner
    height = points[:, 2] - ((1 - share) * ground[sector, inner] + share * ground[sector, inner + 1])
    return Ground(np.abs(height) <= CLEARANCE, height)


def _ground_heights(low: FloatArray) -> FloatArray:
    """Heights (sectors, rings) of the ground, from the innermost ring on."""
    near = low[:, : max(int(10.0 / _RING_WIDTH), 1)]
    start = float(np.nanmedian(near)) if np.isfinite(near).any() else float(np.nanmin(low))
    height, since = np.full(len(low), start), np.ones(len(low))
    ground = np.empty_like(low)
    for k in range(low.shape[1]):
        fits = np.abs(low[:, k] - height) <= MAX_STEP + _MAX_SLOPE * _RING_WIDTH * since  # False in empty cells
        height = np.where(fits, low[:, k], height)
        since = np.where(fits, 1.0, since + 1.0)
        ground[:, k] = height
    return ground
