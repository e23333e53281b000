"""Paths along the trails of earlier traffic, see `saga_fg.tracking.trails`."""

from __future__ import annotations

import math

import numpy as np

from saga_fg.kernels.array_types import BoolArray, FloatArray, IntArray
from saga_fg.kernels.compilation import kernel

Paths = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]


@kernel("f2 f")
def points_by_cell(points: FloatArray, size: float) -> tuple[IntArray, IntArray]:
    """Points (n, 2) in lists, by the hash of their cells of `size` m.

    (n, 3) for each point its cell and the one before it in its list, -1 for none; the last point of each list
    """
    n, buckets = len(points), 16
    while buckets < 2 * n:
        buckets *= 2
    cells, latest = np.empty((n, 3), dtype=np.int64), np.full(buckets, -1, dtype=np.int64)
    for p in range(n):
        ix, iy = math.floor(points[p, 0] / size), math.floor(points[p, 1] / size)
        bucket = (ix * 73856093 + iy * 19349663) % buckets
        cells[p, 0], cells[p, 1], cells[p, 2] = ix, iy, latest[bucket]
        latest[bucket] = p
    return cells, latest


@kernel("i1 f2 f1 f1 b1 i2 i1 i1 f2 f1 f1 b1 i2 i1 i1 f2 f1 f1 i i f f f f f f")
def trail_paths(
    lane_of: IntArray,
    lane_points: FloatArray,
    lane_headings: FloatArray,
    lane_speeds: FloatArray,
    lane_timed: BoolArray,
    lane_cells: IntArray,
    lane_latest: IntArray,
    trail_of: IntArray,
    trail_points: FloatArray,
    trail_headings: FloatArray,
    trail_speeds: FloatArray,
    trail_timed: BoolArray,
    trail_cells: IntArray,
    trail_latest: IntArray,
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

    Of n points of lanes, and of those of trails: their tracks `of` (n,), places (n, 2), headings, speeds and whether
    these are known (n,), and the result of `points_by_cell` at 2 * reach; of k tracks: ids (k,), position (k, 2),
    heading, curvature (k,); most: points compared; length of a step; the rest are the module's scales
    """
    of, points, headings = (lane_of, trail_of), (lane_points, trail_points), (lane_headings, trail_headings)
    speeds, timed = (lane_speeds, trail_speeds), (lane_timed, trail_timed)
    cells, latest = (lane_cells, trail_cells), (lane_latest, trail_latest)
    k, cell = len(ids), 2 * reach
    place, course = np.empty((k, steps + 1, 2)), np.empty((k, steps + 1))
    speed, weight = np.zeros((k, steps + 1)), np.zeros((k, steps + 1))
    certainty, disagreement = np.zeros(k), np.zeros(k)
    near, side, apart = np.empty(most, dtype=np.int64), np.empty(most, dtype=np.int64), np.empty(most)
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
                    for s in range(2):
                        p = latest[s][(jx * 73856093 + jy * 19349663) % len(latest[s])]
                        while p >= 0:
                            if cells[s][p, 0] == jx and cells[s][p, 1] == jy:
                                d = math.sqrt((points[s][p, 0] - at_x) ** 2 + (points[s][p, 1] - at_y) ** 2)
                                if d < cell and (found < most or d < apart[found - 1]):
                                    q = min(found, most - 1)
                                    while q > 0 and apart[q - 1] > d:
                                        apart[q], near[q], side[q] = apart[q - 1], near[q - 1], side[q - 1]
                                        q -= 1
                                    apart[q], near[q], side[q] = d, p, s
                                    found = min(found + 1, most)
                            p = cells[s][p, 2]
            total, mean, typical, known = 0.0, 0.0, 0.0, 0.0
            for q in range(found):
                p, s = near[q], side[q]
                share[q] = 0.0
                counts = of[s][p] != ids[t]
                for r in range(q):  # of each trail the nearest point
                    counts = counts and of[side[r]][near[r]] != of[s][p]
                turns[q] = (headings[s][p] - h - own + math.pi) % (2 * math.pi) - math.pi
                if counts:
                    share[q] = math.exp(-((apart[q] / reach) ** 2 + (turns[q] / turning) ** 2) / 2)
                    total += share[q]
                    if timed[s][p]:
                        known += share[q]
                        typical += share[q] * speeds[s][p]
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
