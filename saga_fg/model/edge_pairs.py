"""Pairs of nodes that edge rules choose from: those near each other, or ahead in a lane, and the strongest of them."""

from __future__ import annotations

import numpy as np

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


def strongest(target: IntArray, rate: FloatArray, n: int, degree: int) -> IntArray:
    """Rows (k,) of at most `degree` edges into each of n nodes, the strongest of E edges: target (E,), rate (E,)."""
    order = np.lexsort((-rate, target))
    rank = np.arange(len(order)) - np.searchsorted(target[order], np.arange(n))[target[order]]
    return order[rank < degree]
