"""Edges of the road: the first step in height on the way out from the vehicle.

Near the ground, each narrow sector is a profile of heights over the distance: the median height in steps of a quarter
metre. Where the profile rises, within two steps, by more than rough tarmac does and by less than a wall, and stays up,
is a curb; the first on the way out is the edge of the road. After Zhao and Yuan, Curb detection and tracking using
3D-LIDAR scanner, ICIP 2012 (height steps along the rays).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from saga_fg.numerics.arrays import FloatArray
from saga_fg.settings import Positive, PositiveInt, Settings, setting


@dataclass(frozen=True)
class CurbSettings(Settings):
    """What counts as a curb; lengths in m."""

    sectors: PositiveInt = setting(180, "the horizon is cut into")
    spacing: Positive = setting(0.25, "of the profile, m")
    nearest: Positive = setting(2.5, "from the sensor, m")
    farthest: Positive = setting(20.0, "beyond, rings are too far apart, m")
    low: Positive = setting(0.05, "least step, m")
    high: Positive = setting(0.3, "largest step, m")


def extract_curbs(points: FloatArray, height: FloatArray, settings: CurbSettings | None = None) -> FloatArray:
    """Points (M, 3), m, on the edge of the road, at most one in each sector.

    points  (N, 3) m, sensor's frame; height (N,) of each above the ground, m
    """
    s = settings or CurbSettings()
    distance = np.hypot(points[:, 0], points[:, 1])
    low = (np.abs(height) <= s.high) & (distance >= s.nearest) & (distance < s.farthest)
    points, distance = points[low], distance[low]
    if not len(points):
        return np.empty((0, 3))
    steps = int(np.ceil((s.farthest - s.nearest) / s.spacing))
    turn = np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) + 0.5
    sector = (turn * s.sectors).astype(np.int64) % s.sectors
    bin_ = sector * steps + ((distance - s.nearest) / s.spacing).astype(np.int64)
    profile = _medians(points[:, 2], bin_, s.sectors * steps).reshape(s.sectors, steps)
    found = []
    for row in np.flatnonzero(np.isfinite(profile).sum(axis=1) >= 4):
        edge = _first_step(profile[row], s)
        if edge is not None:
            angle = ((row + 0.5) / s.sectors - 0.5) * 2 * np.pi
            out = s.nearest + (edge + 0.5) * s.spacing
            found.append((out * np.cos(angle), out * np.sin(angle), profile[row, edge]))
    return np.array(found).reshape(-1, 3)


def _first_step(profile: FloatArray, s: CurbSettings) -> int | None:
    """Where the profile (steps,) of one sector first rises and stays up."""
    at = np.flatnonzero(np.isfinite(profile))
    z = profile[at]
    for k in range(len(at) - 3):
        near = at[k + 1] - at[k] <= 2
        rise = z[k + 1 : k + 3].min() - z[: k + 1][-4:].mean()
        if near and s.low <= rise <= s.high and abs(z[k] - z[max(k - 2, 0)]) < s.low / 2:
            return int(at[k + 1])
    return None


def _medians(values: FloatArray, cell: np.ndarray[tuple[int], np.dtype[np.int64]], cells: int) -> FloatArray:
    order = np.lexsort((values, cell))
    count = np.bincount(cell, minlength=cells)
    start = np.cumsum(count) - count
    medians = np.full(cells, np.nan)
    medians[count > 0] = values[order[(start + count // 2)[count > 0]]]
    return medians
