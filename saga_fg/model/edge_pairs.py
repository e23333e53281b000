"""Pairs of nodes that edge rules choose from: those near each other, or ahead in a lane, and the strongest of them."""

from __future__ import annotations

import numpy as np

from saga_fg.kernels import lanes
from saga_fg.kernels.compilation import compiled_by
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.numerics.near_pairs import near_pairs

LEAST = 1e-9  # probability that a certain object does not exist


def pairs_within(
    position: FloatArray, targets: BoolArray, sources: BoolArray, radius: float
) -> tuple[IntArray, IntArray]:
    """All pairs (E,) of different rows of two masks (n,) within `radius` m: target rows, source rows."""
    to, of = targets.nonzero()[0], sources.nonzero()[0]
    if len(to) == 0 or len(of) < 2:
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    i, j = near_pairs(position[to], position[of], np.full(len(to), radius))
    target, source = to[i], of[j]
    different = target != source
    return target[different], source[different]


@compiled_by(lanes.pairs_ahead)
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
    target, source = pairs_within(position, follows, able, farthest)
    c, s, (x, y), of = np.cos(heading), np.sin(heading), position.T, path[target]
    dx, dy, c, s = x[source] - x[target], y[source] - y[target], c[target], s[target]
    ahead = dx * c + dy * s
    inside = (ahead > 0) & (np.abs(dy * c - dx * s) <= aside + widening * ahead)
    bent = (of >= 0).nonzero()[0]
    of, (dx, dy) = of[bent], (position[source[bent]] - begin[of[bent]]).T
    c, s = np.cos(direction[of]), np.sin(direction[of])
    ahead, beside = dx * c + dy * s, np.abs(dy * c - dx * s)
    near = (ahead >= -margin[of]) & (beside * np.cos(turn[of]) - ahead * np.sin(turn[of]) <= margin[of])
    inside[bent] = near | (turn[of] > sharp)
    front = inside.nonzero()[0]
    return target[front], source[front]


def strongest(target: IntArray, rate: FloatArray, n: int, degree: int) -> IntArray:
    """Rows (k,) of at most `degree` edges into each of n nodes, the strongest of E edges: target (E,), rate (E,)."""
    order = np.lexsort((-rate, target))
    rank = np.arange(len(order)) - np.searchsorted(target[order], np.arange(n))[target[order]]
    return order[rank < degree]


def none_before(target: IntArray, remoteness: FloatArray, exists: FloatArray) -> FloatArray:
    """Probabilities (E,) that no source of the same target with a lower remoteness exists, given those of sources."""
    order = np.lexsort((remoteness, target))
    first = np.diff(target[order], prepend=-1).nonzero()[0]
    missing = np.log1p(-np.minimum(exists[order], 1 - LEAST))
    before = np.cumsum(missing) - missing
    nearer = np.exp(before - np.repeat(before[first], np.diff(first, append=len(order))))
    result = np.empty(len(order))
    result[order] = np.where(nearer > 2 * LEAST, nearer, 0.0)
    return result
