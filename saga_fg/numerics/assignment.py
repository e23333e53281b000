"""Association: which detection belongs to which track.

    d^2 = (z - H m)^T S^-1 (z - H m),   S = H P H^T + R

A pair is possible where d^2 is inside the chi-square gate and the centres are closer than a cap; the assignment is the
one of least total cost, where an unmatched track or detection costs as much as a pair at the gate.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Self

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.numerics.chi_square import chi_square_quantile
from saga_fg.numerics.columns import Columns

_DENSE = 10_000  # pairs of rivals up to which one matrix of all is the fastest


@dataclass(frozen=True, eq=False)
class Matching(Columns):
    """track (k,) and detection (k,): rows that belong together; distance (k,): their d^2."""

    track: IntArray
    detection: IntArray
    distance: FloatArray

    @classmethod
    def empty(cls) -> Self:
        return cls(np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64), np.empty(0))


@dataclass(frozen=True, eq=False)
class Assignment:
    """id (k,) of tracks, and the row (k,) in the frame of the detection that updated or initiated each."""

    id: IntArray
    detection: IntArray

    @staticmethod
    def empty() -> Assignment:
        return Assignment(np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64))


def mahalanobis(
    position: FloatArray, covariance: FloatArray, measured: FloatArray, noise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Squared distances and log det S, both (n, m), of n predicted positions and m measured ones in the plane.

    position (n, 2), covariance (n, 2, 2), measured (m, 2), noise (m, 2, 2)
    """
    return mahalanobis_of_pairs(measured[None] - position[:, None], covariance[:, None] + noise[None])


def mahalanobis_of_pairs(innovation: FloatArray, S: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Squared distances and log det S, both (...), of innovations (..., 2) with covariances S (..., 2, 2)."""
    dx, dy = innovation[..., 0], innovation[..., 1]
    a, b, c = S[..., 0, 0], S[..., 0, 1], S[..., 1, 1]
    det = a * c - b * b
    return (c * dx * dx - 2 * b * dx * dy + a * dy * dy) / det, np.log(det)


@lru_cache
def gate(probability: float, dim: int = 2) -> float:
    """The chi-square gate that lets `probability` of the true pairs through."""
    return chi_square_quantile(probability, dim)


def assign(cost: FloatArray, possible: BoolArray, unmatched: float | FloatArray) -> tuple[IntArray, IntArray]:
    """Rows and columns of the assignment of least cost (n, m) among possible pairs.

    Leaving a pair out costs `unmatched` (a number, one per track (n, 1), or one per pair); only pairs cheaper than that
    are matched.
    """
    rows, columns = possible.nonzero()
    chosen = least_total(rows, columns, (cost - unmatched)[rows, columns])
    return rows[chosen], columns[chosen]


def least_total(row: IntArray, column: IntArray, gain: FloatArray) -> IntArray:
    """Choose from K candidates, pairs (row, column), the assignment of least total gain; ascending.

    gain (K,): what a candidate costs less than leaving both alone. Candidates without a rival need no assignment.
    """
    paying = (gain < 0).nonzero()[0]
    row, column, gain = row[paying], column[paying], gain[paying]
    alone = (np.bincount(row)[row] == 1) & (np.bincount(column)[column] == 1)
    rival = (~alone).nonzero()[0]
    if len(rival) == 0:
        return paying
    rows, r = np.unique(row[rival], return_inverse=True)
    columns, c = np.unique(column[rival], return_inverse=True)
    if len(rows) * len(columns) <= _DENSE:
        parts = [np.arange(len(rival))]
    else:  # one assignment for each set of rivals, in which nobody shares a row or a column with others
        n, m = len(rows), len(columns)
        _, part = connected_components(coo_array((np.ones(len(r)), (r, n + c)), (n + m, n + m)), directed=False)
        order = np.argsort(part[r], kind="stable")
        parts = np.split(order, np.flatnonzero(np.diff(part[r][order])) + 1)
    for part in parts:
        alone[_assigned(r[part], c[part], gain[rival[part]], rival[part])] = True
    return np.asarray(paying[alone])


def _assigned(row: IntArray, column: IntArray, gain: FloatArray, number: IntArray) -> IntArray:
    """The numbers of the pairs of the assignment of least total gain."""
    rows, r = np.unique(row, return_inverse=True)
    columns, c = np.unique(column, return_inverse=True)
    dense, numbers = np.zeros((len(rows), len(columns))), np.full((len(rows), len(columns)), -1)
    dense[r, c], numbers[r, c] = gain, number
    chosen = numbers[linear_sum_assignment(dense)]
    return np.asarray(chosen[chosen >= 0])


def cheapest_first(row: IntArray, column: IntArray, gain: FloatArray) -> IntArray:
    """Assign greedily: like `least_total`, but the cheapest candidate of the rows and columns left comes first."""
    paying = (gain < 0).nonzero()[0]
    taken_rows: set[int] = set()
    taken_columns: set[int] = set()
    chosen = []
    for k in paying[gain[paying].argsort(kind="stable")].tolist():
        if row[k] not in taken_rows and column[k] not in taken_columns:
            taken_rows.add(int(row[k]))
            taken_columns.add(int(column[k]))
            chosen.append(k)
    return np.sort(np.array(chosen, dtype=np.int64))
