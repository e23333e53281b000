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

import numpy as np

from data_tools.lidar.voxels import cell_order_statistics
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray

_SECTORS = 180  # number of sectors around the sensor
SPACING = 0.25  # spacing of the height profile, m
MIN_RANGE = 2.5  # nearest distance from the sensor, m
MAX_RANGE = 20.0  # largest distance from the sensor, limited by the spacing of the rings, m
MIN_STEP = 0.05  # least step, m
MAX_STEP = 0.3  # largest step, m
MAX_OFFSET = 0.2  # largest distance of a point from its line, m
MAX_GAP = 4.0  # longest gap between points of a line, m
MIN_LENGTH = 6.0  # least length, m
MIN_POINTS = 8  # fewest points
NOISE = 0.1  # least standard deviation of a point across the line, m
BIAS = 0.1  # standard deviation of the error that neighbouring points share, m


def extract_curbs(points: FloatArray, height: FloatArray) -> FloatArray:
    """Points (M, 3), m, on the edge of the road, at most one in each sector.

    points  (N, 3) m, sensor's frame; height (N,) of each above the ground, m
    """
    distance = np.hypot(points[:, 0], points[:, 1])
    low = (np.abs(height) <= MAX_STEP) & (distance >= MIN_RANGE) & (distance < MAX_RANGE)
    points, distance = points[low], distance[low]
    if not len(points):
        return np.empty((0, 3))
    steps = int(np.ceil((MAX_RANGE - MIN_RANGE) / SPACING))
    turn = np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) + 0.5
    sector = (turn * _SECTORS).astype(np.int64) % _SECTORS
    bin_ = sector * steps + ((distance - MIN_RANGE) / SPACING).astype(np.int64)
    profile = cell_order_statistics(points[:, 2], bin_, _SECTORS * steps, 2).reshape(_SECTORS, steps)
    row, step = _first_steps(profile)
    angle = ((row + 0.5) / _SECTORS - 0.5) * 2 * np.pi
    out = MIN_RANGE + (step + 0.5) * SPACING
    return np.column_stack([out * np.cos(angle), out * np.sin(angle), profile[row, step]])


def _first_steps(profile: FloatArray) -> tuple[IntArray, IntArray]:
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
        found = (at[:, 1:-2] - at[:, :-3] <= 2) & (rise >= MIN_STEP) & (rise <= MAX_STEP)
        found &= np.abs(z[:, :-3] - z[:, np.maximum(k - 2, 0)]) < MIN_STEP / 2
    found &= k < count[:, None] - 3
    row = np.flatnonzero(found.any(axis=1))
    return row, at[row, found[row].argmax(axis=1) + 1]


@dataclass(frozen=True, eq=False)
class Line:
    """A straight line segment: ends (2, 3), m, and the covariance (2, 2) of the ends across it, m^2."""

    ends: FloatArray
    covariance: FloatArray


def straight_lines(points: FloatArray, most: int) -> list[Line]:
    """At most `most` lines through points (M, 3), m, the one with the most points first."""
    found: list[Line] = []
    while len(found) < most and len(points) >= MIN_POINTS:
        chosen = _best_line(points[:, :2])
        if chosen is None:
            break
        found.append(_fit_line(points[chosen]))
        points = points[~chosen]
    return found


def _best_line(xy: FloatArray) -> BoolArray | None:
    """Mask (M,) of the points on the candidate line with the most points; None if none has enough."""
    i, j = np.triu_indices(len(xy), 1)
    apart = xy[j] - xy[i]
    length = np.linalg.norm(apart, axis=1)
    far = length >= MIN_LENGTH / 2
    i, apart, length = i[far], apart[far], length[far]
    normal = np.stack([-apart[:, 1], apart[:, 0]], axis=1) / length[:, None]
    off = np.abs(normal @ xy.T - (normal * xy[i]).sum(axis=1)[:, None])
    count = (off <= MAX_OFFSET).sum(axis=1)
    for line in np.argsort(-count, kind="stable")[:20]:
        if count[line] < MIN_POINTS:
            return None
        rows = np.flatnonzero(off[line] <= MAX_OFFSET)
        u = xy[rows] @ (apart[line] / length[line])
        order = np.argsort(u)
        pieces = np.split(order, np.flatnonzero(np.diff(u[order]) > MAX_GAP) + 1)
        piece = max(pieces, key=len)
        if len(piece) >= MIN_POINTS and u[piece[-1]] - u[piece[0]] >= MIN_LENGTH:
            chosen = np.zeros(len(xy), dtype=np.bool_)
            chosen[rows[piece]] = True
            return chosen
    return None


def _fit_line(points: FloatArray) -> Line:
    centre = points.mean(axis=0)
    xy = points[:, :2] - centre[:2]
    along = np.linalg.svd(xy, full_matrices=False)[2][0]
    u, e = xy @ along, xy @ np.array([-along[1], along[0]])
    variance = max(float(e @ e) / (len(points) - 2), NOISE**2)
    ends = np.array([u.min(), u.max()])
    covariance = variance * (1 / len(points) + np.outer(ends, ends) / float(u @ u)) + BIAS**2 * np.eye(2)
    return Line(np.column_stack([centre[:2] + ends[:, None] * along, np.full(2, centre[2])]), covariance)
