"""Places on predicted paths, see `saga_fg.model.paths`."""

from __future__ import annotations

import math

import numpy as np

from saga_fg.kernels.array_types import BoolArray, FloatArray, IntArray
from saga_fg.kernels.compilation import kernel, kernel_part


@kernel_part
def unwrapped(points: FloatArray, p: int, angle: FloatArray) -> None:
    """Directions of the pieces of path `p`, rad, into `angle` (m,), without jumps."""
    before = 0.0
    for s in range(len(angle)):
        raw = math.atan2(points[p, s + 1, 1] - points[p, s, 1], points[p, s + 1, 0] - points[p, s, 0])
        angle[s] = raw if s == 0 else angle[s - 1] + (raw - before + math.pi) % (2 * math.pi) - math.pi
        before = raw


@kernel("f3 f f f")
def path_cones(
    points: FloatArray, most: float, sharp: float, rounding: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Direction (k,) at the start of paths through points (k, m + 1, 2), how far they turn, and a margin (k,), m."""
    k, m = len(points), points.shape[1] - 1
    begin, turn, margin, angle = np.empty(k), np.empty(k), np.empty(k), np.empty(m)
    for p in range(k):
        unwrapped(points, p, angle)
        farthest, corner = 0.0, 0.0
        for s in range(1, m):
            farthest = max(farthest, abs(angle[s] - angle[0]))
            corner = max(corner, abs(angle[s] - angle[s - 1]))
        begin[p], turn[p], margin[p] = angle[0], farthest, rounding * most / math.cos(min(corner, sharp))
    return begin, turn, margin


@kernel("f2 f1 i1 f3 i1 i1")
def places_along(
    position: FloatArray, heading: FloatArray, path: IntArray, points: FloatArray, target: IntArray, source: IntArray
) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """Where nodes `source` (E,) are on the paths of nodes `target` (E,): ahead and aside, m, direction there, rad, and
    whether the path is a predicted one (E,).

    Of n nodes: position (n, 2), heading (n,), path (n,), -1: straight on; of k paths: points (k, m + 1, 2)
    """
    E, m, known = len(target), points.shape[1] - 1, -1
    ahead, aside, direction = np.empty(E), np.empty(E), np.empty(E)
    predicted, angle, middle = np.zeros(E, dtype=np.bool_), np.empty(m), np.empty(m)
    for e in range(E):
        i, j = target[e], source[e]
        p = path[i]
        if p < 0:
            c, s = math.cos(heading[i]), math.sin(heading[i])
            dx, dy = position[j, 0] - position[i, 0], position[j, 1] - position[i, 1]
            ahead[e], aside[e], direction[e] = dx * c + dy * s, dy * c - dx * s, heading[i]
            continue
        if p != known:
            known = p
            unwrapped(points, p, angle)
        least, way, x, y, before, at, off = math.inf, 0.0, position[j, 0], position[j, 1], 0.0, 0.0, 0.0
        for s in range(m):
            tx, ty = points[p, s + 1, 0] - points[p, s, 0], points[p, s + 1, 1] - points[p, s, 1]
            length = math.sqrt(tx * tx + ty * ty)
            tx, ty = tx / length, ty / length
            dx, dy = x - points[p, s, 0], y - points[p, s, 1]
            along = dx * tx + dy * ty
            if s > 0:
                along = max(along, 0.0)
            if s < m - 1:
                along = min(along, length)
            dx, dy = dx - along * tx, dy - along * ty
            if dx * dx + dy * dy < least:
                least, at, off = dx * dx + dy * dy, before + along, tx * dy - ty * dx
            middle[s] = before + length / 2
            before += length
        way, a = min(max(at, 0.0), before), -1
        while a + 1 < m and middle[a + 1] <= way:
            a += 1
        b = min(a + 1, m - 1)
        a = max(a, 0)
        course = angle[a]
        if middle[b] > middle[a]:
            course += (at - middle[a]) / (middle[b] - middle[a]) * (angle[b] - angle[a])
        ahead[e], aside[e], direction[e] = at, off, math.atan2(math.sin(course), math.cos(course))
        predicted[e] = True
    return ahead, aside, direction, predicted
