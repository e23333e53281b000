"""Optimal one-to-one pairs at many score thresholds at once.

At each threshold ("level") some of the candidate pairs are there; wanted is, within each group of them (a frame and
class), the assignment with as many pairs as possible, and among those the least sum of costs. Most pairs have no
rival, so they are chosen at once; only the rest goes through the Hungarian method, and what recurs at several levels
is solved once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Candidates:
    """P pairs that may be chosen: `row` and `column` (P,), of cost `cost` (P,) >= 0, in `group` (P,).

    Pairs of different groups share neither row nor column.
    """

    row: IntArray
    column: IntArray
    cost: FloatArray
    group: IntArray

    def __len__(self) -> int:
        return len(self.row)


def optimal_pairs(candidates: Candidates, present: BoolArray) -> BoolArray:
    """(P, T): which of the candidates `present` (P, T) at each of T levels the assignment chooses."""
    chosen = np.zeros_like(present)
    if not present.any():
        return chosen
    levels = present.shape[1]
    pair, level = np.nonzero(present)
    alone = _unrivalled(candidates.row[pair], level, levels) & _unrivalled(candidates.column[pair], level, levels)
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


def _unrivalled(row: IntArray, level: IntArray, levels: int) -> BoolArray:
    """(Q,) whether no other entry has the same row at the same level."""
    key = (row - row.min()) * levels + level
    return np.asarray(np.bincount(key)[key] == 1)


def _hungarian(row: IntArray, column: IntArray, cost: FloatArray) -> BoolArray:
    """Which of the pairs (row, column) the assignment chooses."""
    rows, r = np.unique(row, return_inverse=True)
    columns, c = np.unique(column, return_inverse=True)
    outside = 2.0 * min(len(rows), len(columns)) * (cost.max() + 1.0) + 1.0  # dearer than all pairs together
    matrix = np.full((len(rows), len(columns)), outside)
    matrix[r, c] = cost
    selected = np.zeros(matrix.shape, dtype=np.bool_)
    selected[linear_sum_assignment(matrix)] = True
    return np.asarray(selected[r, c])
