"""Association: which detection belongs to which track.

    d^2 = (z - H m)^T S^-1 (z - H m),   S = H P H^T + R

A pair is possible where d^2 is inside the chi-square gate and the centres are closer than a cap; the assignment is the
one of least total cost, where an unmatched track or detection costs as much as a pair at the gate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Self

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.stats import chi2

from saga_fg.arrays import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Matching:
    """track (k,) and detection (k,): rows that belong together; distance (k,): their d^2."""

    track: IntArray
    detection: IntArray
    distance: FloatArray

    @classmethod
    def empty(cls) -> Self:
        return cls(np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64), np.empty(0))

    @classmethod
    def concatenate(cls, parts: Sequence[Matching]) -> Self:
        """All pairs of `parts`, in order; at least one part."""
        return cls(*(np.concatenate([getattr(p, name) for p in parts]) for name in cls.__dataclass_fields__))


@dataclass(frozen=True, eq=False)
class Assignment:
    """id (k,) of tracks and the row (k,) of the detection, among all of a frame, that each took in or was born from."""

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
    return float(chi2.ppf(probability, dim))


def assign(cost: FloatArray, possible: BoolArray, unmatched: float | FloatArray) -> tuple[IntArray, IntArray]:
    """Rows and columns of the assignment of least cost (n, m) among possible pairs.

    Leaving a pair out costs `unmatched` (a number, one per track (n, 1), or one per pair); only pairs cheaper than that
    are matched.
    """
    if not possible.any():
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    gain = np.where(possible, np.minimum(cost - unmatched, 0.0), 0.0)
    rows, columns = linear_sum_assignment(gain)
    matched = gain[rows, columns] < 0
    return rows[matched].astype(np.int64), columns[matched].astype(np.int64)


def assign_greedily(cost: FloatArray, possible: BoolArray, unmatched: float | FloatArray) -> tuple[IntArray, IntArray]:
    """As `assign`, but the cheapest pair first, which takes its track and its detection from all others."""
    gain = np.where(possible, np.minimum(cost - unmatched, 0.0), 0.0)
    rows, columns = np.nonzero(gain < 0)
    order = np.argsort(gain[rows, columns], kind="stable")
    taken_row, taken_column = np.zeros(len(gain), dtype=bool), np.zeros(gain.shape[1], dtype=bool)
    chosen = []
    for k in order.tolist():
        if not (taken_row[rows[k]] or taken_column[columns[k]]):
            taken_row[rows[k]] = taken_column[columns[k]] = True
            chosen.append(k)
    kept = np.sort(np.array(chosen, dtype=np.int64))
    return rows[kept], columns[kept]
