"""Intervals of ratios of medians and means of errors that two methods make at the same moments.

Errors that are near in time share their causes. Blocks of them (a stretch of a recording) are drawn with replacement,
the same draw for both methods; the statistic is that of all errors drawn, each as often as its block.

Source: Kuensch, The jackknife and the bootstrap for general stationary observations, Annals of Statistics 17(3), 1989;
here with blocks that don't overlap.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from data_tools.metrics.bootstrap import Interval
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, IntArray, checked, checked_rows

Average = Literal["median", "mean"]


def relative_change_of_errors(
    a: ArrayLike,
    b: ArrayLike,
    block: ArrayLike,
    average: Average,
    *,
    confidence: float = 0.95,
    draws: int = 2000,
    seed: int = 0,
) -> Interval:
    """average(a) / average(b) - 1 of paired errors a, b (n,) in blocks (n,), numbers >= 0.

    Raises `InputError` for no errors, for arrays of different lengths, and for errors that are not finite.
    """
    first = checked("a", a, (None,))
    second = checked("b", b, first.shape)
    rows = checked_rows("block", block, len(first))
    if len(first) == 0:
        raise InputError("a: expected at least one error")
    _, of_row = np.unique(rows, return_inverse=True)
    blocks = int(of_row.max()) + 1
    share = np.full(blocks, 1 / blocks)
    weight = np.random.default_rng(seed).multinomial(blocks, share, size=draws)[:, of_row].astype(np.float64)
    ones = np.ones((1, len(first)))
    (estimate,) = _ratio(_weighted(first, ones, average), _weighted(second, ones, average)) - 1
    changes = _ratio(_weighted(first, weight, average), _weighted(second, weight, average)) - 1
    tail = (1 - confidence) / 2
    low, high = np.quantile(changes, [tail, 1 - tail])
    return Interval(float(estimate), float(low), float(high), confidence)


def _ratio(a: FloatArray, b: FloatArray) -> FloatArray:
    """a / b (n,), of numbers >= 0; 1 where neither errs."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where((a == 0) & (b == 0), 1.0, a / b)


def _weighted(errors: FloatArray, weight: FloatArray, average: Average) -> FloatArray:
    """The average (draws,) of errors (n,) that count as `weight` (draws, n) says; of two middle errors the lower."""
    if average == "mean":
        return np.asarray(weight @ errors / weight.sum(axis=1))
    order: IntArray = np.argsort(errors)
    total = np.cumsum(weight[:, order], axis=1)
    middle = (total >= total[:, -1:] / 2).argmax(axis=1)
    return np.asarray(errors[order][middle])
