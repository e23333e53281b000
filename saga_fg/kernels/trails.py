"""Paths along the trails of earlier traffic, see `saga_fg.tracking.trails`."""

from __future__ import annotations

import math

import numpy as np

from saga_fg.kernels.array_types import BoolArray, FloatArray, IntArray
from saga_fg.kernels.compilation import kernel

Paths = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]


@kernel("i1 f2 f1 f1 b1 i1 f2 f1 f1 i i f f f f f f")
def trail_paths(
    of: IntArray,
    points: FloatArray,
    headings: FloatArray,
    speeds: FloatArray,
    timed: BoolArray,
    ids: IntArray,
    position: FloatArray,
    heading: FloatArray,
    curvature: FloatArray,
    steps: int,
    most: int,
    reach: float,
    length: float,
    bend: float,
    turning: float,
    prior: float,
    agreement: float,
) -> Paths:
    """Places (k, steps + 1, 2), courses, typical speeds and weights (k, steps + 1), certainty and disagreement (k,).

    Of n points of trails: their tracks `of` (n,), places (n, 2), headings, speeds and whether these are known (n,); of
    k tracks: ids (k,), position (k, 2), heading, curvature (k,); most: points compared; length of a step; the rest are
    the module's scales
    """
    n, k, cell = len(of), len(ids), 2 * reach
    buckets = 16
    while buckets < 2 * n:
        buckets *= 2
    ix, iy = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
    latest, before = np.full(buckets, -1, dtype=np.int64), np.empty(n, dtype=np.int64)
    for p in range(n):  # points by cell, in lists
        ix[p], iy[p] = math.floor(points[p, 0] / cell), math.floor(points[p, 1] / cell)
        bucket = (ix[p] * 73856093 + iy[p] * 19349663) % buckets
        before[p], latest[bucket] = latest[bucket], p
    place, course = np.empty((k, steps + 1, 2)), np.empty((k, steps + 1))
    speed, weight = np.zeros((k, steps + 1)), np.zeros((k, steps + 1))
    certainty, disagreement = np.zeros(k), np.zeros(k)
    near, apart = np.empty(most, dtype=np.int64), np.empty(most)
    share, turns = np.empty(most), np.empty(most)
    for t in range(k):
        x, y, h = position[t, 0], position[t, 1], heading[t]
        for step in range(steps + 1):
            own, at_x, at_y = 0.0, x, y
            if step > 0:
                own = curvature[t] * length * math.exp(-(step - 0.5) * length / bend)
                at_x, at_y = x + length * math.cos(h + own / 2), y + length * math.sin(h + own / 2)
            found = 0
            cx, cy = math.floor(at_x / cell), math.floor(at_y / cell)
            for jx in range(cx - 1, cx + 2):
                for jy in range(cy - 1, cy + 2):
                    p = latest[(jx * 73856093 + jy * 19349663) % buckets]
                    while p >= 0:
                        if ix[p] == jx and iy[p] == jy:
                            d = math.sqrt((points[p, 0] - at_x) ** 2 + (points[p, 1] - at_y) ** 2)
                            if d < cell and (found < most or d < apart[found - 1]):
                                q = min(found, most - 1)
                                while q > 0 and apart[q - 1] > d:
                                    apart[q], near[q] = apart[q - 1], near[q - 1]
                                    q -= 1
                                apart[q], near[q] = d, p
                                found = min(found + 1, most)
                        p = before[p]
            total, mean, typical, known = 0.0, 0.0, 0.0, 0.0
            for q in range(found):
                p = near[q]
                share[q] = 0.0
                counts = of[p] != ids[t]
                for r in range(q):  # of each trail the nearest point
                    counts = counts and of[near[r]] != of[p]
                turns[q] = (headings[p] - h - own + math.pi) % (2 * math.pi) - math.pi
                if counts:
                    share[q] = math.exp(-((apart[q] / reach) ** 2 + (turns[q] / turning) ** 2) / 2)
                    total += share[q]
                    if timed[p]:
                        known += share[q]
                        typical += share[q] * speeds[p]
            scale = max(total, 1e-9)
            for q in range(found):
                mean += share[q] / scale * turns[q]
            variance = 0.0
            for q in range(found):
                variance += share[q] / scale * (turns[q] - mean) ** 2
            sure = total / (total + prior) / (1 + variance / agreement**2)
            after = h + own + sure * mean
            if step == 0:
                certainty[t], disagreement[t] = sure, variance
            else:
                x, y = x + length * math.cos((h + after) / 2), y + length * math.sin((h + after) / 2)
            h = after
            place[t, step, 0], place[t, step, 1], course[t, step] = x, y, h
            speed[t, step], weight[t, step] = typical / max(known, 1e-9), known
    return place, course, speed, weight, certainty, disagreement
