"""Straight pieces of the road's edge, from its points (`curbs`): lines with the covariance of their ends.

Each pair of points, far enough apart, is a candidate line; the one with the most points beside it, in an unbroken row,
is fitted by least squares, its points are taken out, and the next is looked for (RANSAC of Fischler and Bolles, 1981,
over all pairs instead of drawn ones: there are few points). With n points of deviation sigma across the line, at u_i
along it, the two ends at u and u' have the covariance

    cov(e(u), e(u')) = sigma^2 ( 1/n + (u - m)(u' - m) / sum (u_i - m)^2 ) + bias^2 [u = u']

where the bias, of each end, is what neighbouring points have in common: a step shows where the first point above it
lies, and rings cross a curb at the same angle.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from saga_fg.numerics.arrays import BoolArray, FloatArray
from saga_fg.settings import Positive, Range, Settings, setting


@dataclass(frozen=True)
class EdgeSettings(Settings):
    """What counts as a straight edge; lengths in m."""

    width: Positive = setting(0.2, "points this far from the line belong to it, m")
    gap: Positive = setting(4.0, "longest stretch without a point, m")
    length: Positive = setting(6.0, "least length, m")
    points: Annotated[int, Range(3)] = setting(8, "least points")
    noise: Positive = setting(0.1, "least deviation of a point across the line, m")
    bias: Positive = setting(0.1, "deviation of either end that its points have in common, m")


@dataclass(frozen=True, eq=False)
class Edge:
    """A straight piece: ends (2, 3), m, in the points' frame, and the covariance (2, 2) of these across it, m^2."""

    ends: FloatArray
    covariance: FloatArray


def straight_edges(points: FloatArray, most: int, settings: EdgeSettings | None = None) -> list[Edge]:
    """The straight pieces, at most so many, the one with the most points first; points (M, 3) of edges, m."""
    s = settings or EdgeSettings()
    found: list[Edge] = []
    while len(found) < most and len(points) >= s.points:
        chosen = _best_line(points[:, :2], s)
        if chosen is None:
            break
        found.append(_fitted(points[chosen], s))
        points = points[~chosen]
    return found


def _best_line(xy: FloatArray, s: EdgeSettings) -> BoolArray | None:
    """The points (M,) of the line through two of them that has the most in an unbroken row; None if none has enough."""
    i, j = np.triu_indices(len(xy), 1)
    apart = xy[j] - xy[i]
    length = np.linalg.norm(apart, axis=1)
    far = length >= s.length / 2
    i, apart, length = i[far], apart[far], length[far]
    normal = np.stack([-apart[:, 1], apart[:, 0]], axis=1) / length[:, None]
    off = np.abs(normal @ xy.T - (normal * xy[i]).sum(axis=1)[:, None])
    count = (off <= s.width).sum(axis=1)
    for line in np.argsort(-count, kind="stable")[:20]:
        if count[line] < s.points:
            return None
        rows = np.flatnonzero(off[line] <= s.width)
        u = xy[rows] @ (apart[line] / length[line])
        order = np.argsort(u)
        pieces = np.split(order, np.flatnonzero(np.diff(u[order]) > s.gap) + 1)
        piece = max(pieces, key=len)
        if len(piece) >= s.points and u[piece[-1]] - u[piece[0]] >= s.length:
            chosen = np.zeros(len(xy), dtype=np.bool_)
            chosen[rows[piece]] = True
            return chosen
    return None


def _fitted(points: FloatArray, s: EdgeSettings) -> Edge:
    centre = points.mean(axis=0)
    xy = points[:, :2] - centre[:2]
    along = np.linalg.svd(xy, full_matrices=False)[2][0]
    u, e = xy @ along, xy @ np.array([-along[1], along[0]])
    variance = max(float(e @ e) / (len(points) - 2), s.noise**2)
    ends = np.array([u.min(), u.max()])
    covariance = variance * (1 / len(points) + np.outer(ends, ends) / float(u @ u)) + s.bias**2 * np.eye(2)
    return Edge(np.column_stack([centre[:2] + ends[:, None] * along, np.full(2, centre[2])]), covariance)
