"""Pairs of vehicles of which one may be ahead of the other in its lane, see `saga_fg.model.edge_rules`."""

from __future__ import annotations

import math

import numpy as np

from saga_fg.kernels.array_types import BoolArray, FloatArray, IntArray
from saga_fg.kernels.compilation import kernel


@kernel("f2 f1 b1 b1 f f f i1 f2 f1 f1 f1 f")
def pairs_ahead(
    position: FloatArray,
    heading: FloatArray,
    follows: BoolArray,
    able: BoolArray,
    farthest: float,
    aside: float,
    widening: float,
    path: IntArray,
    begin: FloatArray,
    direction: FloatArray,
    turn: FloatArray,
    margin: FloatArray,
    sharp: float,
) -> tuple[IntArray, IntArray]:
    """Rows (E,) of targets that follow and of able sources ahead of them, up to `farthest` m away.

    Of n nodes: position (n, 2), heading, follows, able (n,), path (n,), -1 for none; of k paths: begin (k, 2) and
    direction (k,) there, turn, margin (k,) as in `saga_fg.model.paths.Paths.cones`. Without a path a source is ahead
    by x and at most aside + widening x beside; on one that turns by more than `sharp` all may be.
    """
    n, k = len(position), 0
    low, high = math.inf, -math.inf
    for j in range(n):
        if able[j]:
            low, high = min(low, position[j, 0]), max(high, position[j, 0])
    strips = int(min(max((high - low) / max(farthest, 1e-9), 0.0), n)) + 1  # along x, at least as wide as `farthest`
    width = max((high - low) / strips * (1 + 1e-9), farthest)
    first, following = np.full(strips + 1, -1, dtype=np.int64), np.empty(n, dtype=np.int64)
    for j in range(n - 1, -1, -1):
        if able[j]:
            strip = int((position[j, 0] - low) / width)
            following[j], first[strip] = first[strip], j
    room = 16 * n + 64
    found = np.empty((2, room), dtype=np.int64)
    for i in range(n):
        if not follows[i] or not high >= low:
            continue
        if k + n > room:
            room = 2 * room + n
            longer = np.empty((2, room), dtype=np.int64)
            for e in range(k):
                longer[0, e], longer[1, e] = found[0, e], found[1, e]
            found = longer
        p = path[i]
        angle = heading[i] if p < 0 else direction[p]
        c, s = math.cos(angle), math.sin(angle)
        x, y = position[i, 0], position[i, 1]
        cos_turn, sin_turn = (math.cos(turn[p]), math.sin(turn[p])) if p >= 0 else (1.0, 0.0)
        own, of_i = math.floor((x - low) / width), k
        for strip in range(max(own - 1, 0), min(own + 1, strips) + 1):
            j = first[strip]
            while j >= 0:
                dx, dy = position[j, 0] - x, position[j, 1] - y
                there = i != j and dx * dx + dy * dy <= farthest * farthest
                if there and p < 0:
                    ahead = dx * c + dy * s
                    there = ahead > 0 and abs(dy * c - dx * s) <= aside + widening * ahead
                elif there:
                    dx, dy = position[j, 0] - begin[p, 0], position[j, 1] - begin[p, 1]
                    ahead = dx * c + dy * s
                    beside = abs(dy * c - dx * s) * cos_turn - ahead * sin_turn <= margin[p]
                    there = turn[p] > sharp or (ahead >= -margin[p] and beside)
                if there:
                    at = k
                    while at > of_i and found[1, at - 1] > j:
                        found[1, at] = found[1, at - 1]
                        at -= 1
                    found[0, k], found[1, at] = i, j
                    k += 1
                j = following[j]
    return found[0, :k].copy(), found[1, :k].copy()
