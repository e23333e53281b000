"""Curbs: points on the edge of the road, and straight lines through them with the covariance of their ends.

Points. Near the ground, each narrow sector is a profile of heights over the distance: the median height in steps of a
quarter metre. A curb is a rise within two steps that is more than the roughness of tarmac, less than a wall, and stays;
the first one from the vehicle outwards is the edge of the road. After Zhao and Yuan, Curb detection and tracking using
3D-LIDAR scanner, ICIP 2012 (height steps along the rays).

Lines. Each pair of points that is far enough apart is a candidate; the line with the most points beside it, without a
long gap, is fitted by least squares and its points are removed, then the next is searched (RANSAC of Fischler and
Bolles, 1981, over all pairs, because there are few points). With n points of deviation sigma across the line, at u_i
along it, the two ends at u and u' have the covariance

    cov(e(u), e(u')) = sigma^2 ( 1/n + (u - m)(u' - m) / sum (u_i - m)^2 ) + bias^2 [u = u']

where the bias is an error that neighbouring points share: rings cross a curb at equal angles.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from data_tools.lidar.voxels import cell_order_statistics
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.settings import Positive, Range, Settings, setting

_SECTORS = 180  # number of sectors around the sensor


@dataclass(frozen=True)
class CurbSettings(Settings):
    """Detection of points on curbs."""

    spacing: Positive = setting(0.25, "spacing of the height profile, m")
    min_range: Positive = setting(2.5, "nearest distance from the sensor, m")
    max_range: Positive = setting(20.0, "largest distance from the sensor, limited by the spacing of the rings, m")
    min_step: Positive = setting(0.05, "least step, m")
    max_step: Positive = setting(0.3, "largest step, m")


def extract_curbs(points: FloatArray, height: FloatArray, settings: CurbSettings | None = None) -> FloatArray:
    """Points (M, 3), m, on the edge of the road, at most one in each sector.

    points  (N, 3) m, sensor's frame; height (N,) of each above the ground, m
    """
    s = settings or CurbSettings()
    distance = np.hypot(points[:, 0], points[:, 1])
    low = (np.abs(height) <= s.max_step) & (distance >= s.min_range) & (distance < s.max_range)
    points, distance = points[low], distance[low]
    if not len(points):
        return np.empty((0, 3))
    steps = int(np.ceil((s.max_range - s.min_range) / s.spacing))
    turn = np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) + 0.5
    sector = (turn * _SECTORS).astype(np.int64) % _SECTORS
    bin_ = sector * steps + ((distance - s.min_range) / s.spacing).astype(np.int64)
    profile = cell_order_statistics(points[:, 2], bin_, _SECTORS * steps, 2).reshape(_SECTORS, steps)
    row, step = _first_steps(profile, s)
    angle = ((row + 0.5) / _SECTORS - 0.5) * 2 * np.pi
    out = s.min_range + (step + 0.5) * s.spacing
    return np.column_stack([out * np.cos(angle), out * np.sin(angle), profile[row, step]])


def _first_steps(profile: FloatArray, s: CurbSettings) -> tuple[IntArray, IntArray]:
    """Sectors of the profile (sectors, steps) that rise and stay higher, and the index at which each first does."""
    seen = np.isfinite(profile)
    at = np.argsort(~seen, axis=1, kind="stable")  # filled steps of a sector in front, outwards
    z, count = np.take_along_axis(profile, at, axis=1), seen.sum(axis=1)
    k = np.arange(z.shape[1] - 3)
    before = np.maximum(k[:, None] - np.arange(4), 0)  # the last four up to k
    weight = (k[:, None] >= np.arange(4)).astype(np.float64)
    mean = np.einsum("rki,ki->rk", z[:, before], weight) / weight.sum(axis=1)
    rise = np.minimum(z[:, 1:-2], z[:, 2:-1]) - mean
    with np.errstate(invalid="ignore"):  # NaN beyond the filled ones
        found = (at[:, 1:-2] - at[:, :-3] <= 2) & (s.min_step <= rise) & (rise <= s.max_step)
        found &= np.abs(z[:, :-3] - z[:, np.maximum(k - 2, 0)]) < s.min_step / 2
    found &= k < count[:, None] - 3
    row = np.flatnonzero(found.any(axis=1))
    return row, at[row, found[row].argmax(axis=1) + 1]


@dataclass(frozen=True)
class LineSettings(Settings):
    """Straight lines through points."""

    max_offset: Positive = setting(0.2, "largest distance of a point from its line, m")
    max_gap: Positive = setting(4.0, "longest gap between points of a line, m")
    min_length: Positive = setting(6.0, "least length, m")
    min_points: Annotated[int, Range(3)] = setting(8, "fewest points")
    noise: Positive = setting(0.1, "least standard deviation of a point across the line, m")
    bias: Positive = setting(0.1, "standard deviation of the error that neighbouring points share, m")


@dataclass(frozen=True, eq=False)
class Line:
    """A straight line segment: ends (2, 3), m, and the covariance (2, 2) of the ends across it, m^2."""

    ends: FloatArray
    covariance: FloatArray


def straight_lines(points: FloatArray, most: int, settings: LineSettings | None = None) -> list[Line]:
    """At most `most` lines through points (M, 3), m, the one with the most points first."""
    s = settings or LineSettings()
    found: list[Line] = []
    while len(found) < most and len(points) >= s.min_points:
        chosen = _best_line(points[:, :2], s)
        if chosen is None:
            break
        found.append(_fit_line(points[chosen], s))
        points = points[~chosen]
    return found


def _best_line(xy: FloatArray, s: LineSettings) -> BoolArray | None:
    """Mask (M,) of the points on the candidate line with the most points; None if none has enough."""
    i, j = np.triu_indices(len(xy), 1)
    apart = xy[j] - xy[i]
    length = np.linalg.norm(apart, axis=1)
    far = length >= s.min_length / 2
    i, apart, length = i[far], apart[far], length[far]
    normal = np.stack([-apart[:, 1], apart[:, 0]], axis=1) / length[:, None]
    off = np.abs(normal @ xy.T - (normal * xy[i]).sum(axis=1)[:, None])
    count = (off <= s.max_offset).sum(axis=1)
    for line in np.argsort(-count, kind="stable")[:20]:
        if count[line] < s.min_points:
            return None
        rows = np.flatnonzero(off[line] <= s.max_offset)
        u = xy[rows] @ (apart[line] / length[line])
        order = np.argsort(u)
        pieces = np.split(order, np.flatnonzero(np.diff(u[order]) > s.max_gap) + 1)
        piece = max(pieces, key=len)
        if len(piece) >= s.min_points and u[piece[-1]] - u[piece[0]] >= s.min_length:
            chosen = np.zeros(len(xy), dtype=np.bool_)
            chosen[rows[piece]] = True
            return chosen
    return None


def _fit_line(points: FloatArray, s: LineSettings) -> Line:
    centre = points.mean(axis=0)
    xy = points[:, :2] - centre[:2]
    along = np.linalg.svd(xy, full_matrices=False)[2][0]
    u, e = xy @ along, xy @ np.array([-along[1], along[0]])
    variance = max(float(e @ e) / (len(points) - 2), s.noise**2)
    ends = np.array([u.min(), u.max()])
    covariance = variance * (1 / len(points) + np.outer(ends, ends) / float(u @ u)) + s.bias**2 * np.eye(2)
    return Line(np.column_stack([centre[:2] + ends[:, None] * along, np.full(2, centre[2])]), covariance)
