r"""One size per object, from all its detections.

A rigid object has one size; a detector sees it well from near and guesses it from far. Length, width and height are
each the weighted median of what was measured, with weight probability / (1 + (distance / FAR)^2): half the weight may
be wrong without harm.
"""

from __future__ import annotations

import numpy as np

from saga_fg.numerics.arrays import FloatArray, IntArray

FAR = 20.0  # distance at which a detection's size counts half, m


def constant_sizes(
    owner: IntArray, count: int, size: FloatArray, probability: FloatArray, distance: FloatArray
) -> FloatArray:
    """(count, 3) length, width, height of each object, NaN where none was measured.

    owner (m,): row of the object of each detection; size (m, 3), NaN for unmeasured; probability (m,); distance (m,)
    from the sensor, m, NaN for unknown
    """
    weight = size_weights(probability, distance)
    known = np.isfinite(size).all(axis=1)
    columns = [weighted_medians(owner[known], count, column[known], weight[known]) for column in size.T]
    return np.stack(columns, axis=-1)


def size_weights(probability: FloatArray, distance: FloatArray) -> FloatArray:
    """(m,) the weight of detections' sizes; distance (m,) from the sensor, m, NaN for unknown."""
    return np.asarray(probability / (1 + (np.nan_to_num(distance) / FAR) ** 2))


def weighted_medians(owner: IntArray, count: int, value: FloatArray, weight: FloatArray) -> FloatArray:
    """(count,) the weighted median of the values (m,) of each owner, NaN for one that has none.

    Between the two values around half the weight it is interpolated, so that of equal weights it is the usual median.
    """
    order = np.lexsort((value, owner))
    owner, value, weight = owner[order], value[order], weight[order]
    total = np.bincount(owner, weight, minlength=count)
    before = np.concatenate([[0.0], np.cumsum(total)])[:-1]
    share = (np.cumsum(weight) - weight / 2 - before[owner]) / total[owner]  # of the owner's weight up to a value
    result = np.full(count, np.nan)
    first = np.searchsorted(owner, np.arange(count))
    last = np.searchsorted(owner, np.arange(count), side="right") - 1
    there = np.flatnonzero(last >= first)
    key = owner + np.clip(share, 0.0, 1.0) * 0.999
    upper = np.clip(np.searchsorted(key, there + 0.5 * 0.999), first[there], last[there])
    lower = np.maximum(upper - 1, first[there])
    gap = share[upper] - share[lower]
    part = np.where(gap > 0, (0.5 - share[lower]) / np.where(gap > 0, gap, 1.0), 1.0)
    result[there] = value[lower] + np.clip(part, 0.0, 1.0) * (value[upper] - value[lower])
    return result
