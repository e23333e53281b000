"""Optimal one-to-one assignment at many score thresholds at once.

At each threshold ("level") some of the candidate pairs are present. Within each group of candidates (a frame and class)
the assignment has as many pairs as possible, and among those assignments the least sum of costs. Most pairs have no
competing pair and are chosen at once; the Hungarian method solves the rest, equal problems of several levels once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from saga_fg.numerics.arrays import BoolArray, Columns, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Candidates(Columns):
    """P candidate pairs: `row` and `column` (P,), `cost` (P,) >= 0, `group` (P,).

    Pairs of different groups share neither row nor column.
    """

    row: IntArray
    column: IntArray
    cost: FloatArray
    group: IntArray


def optimal_pairs(candidates: Candidates, present: BoolArray) -> BoolArray:
    """(P, T): the candidates chosen at each of T levels, out of those `present` (P, T) there."""
    chosen = np.zeros_like(present)
    if not present.any():
        return chosen
    levels = present.shape[1]
    pair, level = np.nonzero(present)
    alone = _unique(candidates.row[pair], level, levels) & _unique(candidates.column[pair], level, levels)
    chosen[pair[alone], level[alone]] = True
    pair, level = pair[~alone], level[~alone]
    if len(pair) == 0:
        return chosen
    key = candidates.group[pair] * levels + level
    order = np.argsort(key, kind="stable")
    solved: dict[bytes, IntArray] = {}
    for members in np.split(order, np.flatnonzero(np.diff(key[order])) + 1):
        contested = pair[members]
        name = contested.tobytes()
        if name not in solved:
            solved[name] = contested[
                _hungarian(candidates.row[contested], candidates.column[contested], candidates.cost[contested])
            ]
        chosen[solved[name], level[members[0]]] = True
    return chosen


def best_pairs(candidates: Candidates) -> BoolArray:
    """(P,): the candidates that the assignment of all of them chooses."""
    return optimal_pairs(candidates, np.ones((len(candidates), 1), dtype=np.bool_))[:, 0]


def _unique(row: IntArray, level: IntArray, levels: int) -> BoolArray:
    """(Q,) True for entries whose row occurs once at their level."""
    key = (row - row.min()) * levels + level
    return np.asarray(np.bincount(key)[key] == 1)


def _hungarian(row: IntArray, column: IntArray, cost: FloatArray) -> BoolArray:
    """Mask of the pairs (row, column) that the assignment chooses."""
    rows, r = np.unique(row, return_inverse=True)
    columns, c = np.unique(column, return_inverse=True)
    outside = 2.0 * min(len(rows), len(columns)) * (cost.max() + 1.0) + 1.0  # more than all pairs together
    matrix = np.full((len(rows), len(columns)), outside)
    matrix[r, c] = cost
    selected = np.zeros(matrix.shape, dtype=np.bool_)
    selected[linear_sum_assignment(matrix)] = True
    return np.asarray(selected[r, c])
