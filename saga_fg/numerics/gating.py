"""Gates: pairs of places near each other, and quantiles of the chi-square distribution.

Pairs of places that are near each other, from a k-d tree where there are many.

Up to `MAX_COMPARED` distances are compared by a kernel, which is faster. Beyond, rows whose reach differs by less than
a factor of two are searched together, so that a few far-reaching ones do not widen the search of all others.

Quantiles of the chi-square distribution: gates, and ellipses that hold a given share.

`scipy.stats` has them, too, and takes half a second to import, which every start of the command would pay.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import gammaincinv

from saga_fg.kernels.pairs import compared_pairs
from saga_fg.numerics.arrays import FloatArray, IntArray

MAX_COMPARED = 500_000  # distances that the kernel compares
_MIN_REACH = 1e-9  # m, so that a reach of 0 has a logarithm


def near_pairs(
    a: FloatArray, b: FloatArray, reach: FloatArray, further: FloatArray | float = 0.0
) -> tuple[IntArray, IntArray]:
    """Rows (K,) of `a` and of `b` with |a_i - b_j| <= reach_i + further_j, in order of i, then of j.

    a (n, 2), b (m, 2), reach (n,) and further (m,) in m; where one of these is NaN there is no pair
    """
    reach, further = np.asarray(reach, dtype=np.float64), np.asarray(further, dtype=np.float64)
    return _near_pairs(a, b, reach, further if further.ndim else np.full(len(b), further))


def _near_pairs(a: FloatArray, b: FloatArray, reach: FloatArray, further: FloatArray) -> tuple[IntArray, IntArray]:
    if len(a) * len(b) <= MAX_COMPARED:
        return compared_pairs(a, b, reach, further)
    i, j = (~np.isnan(reach)).nonzero()[0], (~np.isnan(further)).nonzero()[0]
    if len(i) == 0 or len(j) == 0:
        return i[:0], j[:0]
    widest = reach[i] + further[j].max()
    bounded = np.isfinite(widest)
    all_i, all_j = compared_pairs(a[i[~bounded]], b[j], reach[i[~bounded]], further[j])
    found, tree = [i[~bounded][all_i] * len(b) + j[all_j]], cKDTree(b[j])
    i, widest = i[bounded], widest[bounded]
    octave = np.ceil(np.log2(np.maximum(widest, _MIN_REACH)))
    for level in np.unique(octave).tolist():
        alike = (octave == level).nonzero()[0]
        radius = float(widest[alike].max()) * (1 + 1e-9)
        near = cKDTree(a[i[alike]]).sparse_distance_matrix(tree, radius, output_type="ndarray")
        row, column = i[alike[near["i"]]], j[near["j"]]
        within = _square(a[row], b[column]) <= (reach[row] + further[column]) ** 2
        found.append(row[within] * len(b) + column[within])
    row, column = np.divmod(np.sort(np.concatenate(found)), len(b))
    return row, column


def _square(a: FloatArray, b: FloatArray) -> FloatArray:
    """Squared distances (...) of places (..., 2)."""
    x, y = a[..., 0] - b[..., 0], a[..., 1] - b[..., 1]
    return np.asarray(x * x + y * y)


def chi_square_quantile(probability: float, degrees: float) -> float:
    """The value that a chi-square variable of so many degrees of freedom stays below with this probability."""
    return float(2 * gammaincinv(degrees / 2, probability))
