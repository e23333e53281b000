"""Paired bootstrap over scenes: confidence intervals of differences between two trackers run on the same scenes.

Scenes are sampled with replacement, the same sample for both trackers; the sums of each sample are added up and the
statistic is computed from the totals (a pooled RMSE, a pooled MOTA), not averaged over scenes. The interval is the
percentile interval of the compared statistics. The independent units are scenes,
not boxes: errors within a scene are correlated.

Source: Efron and Tibshirani, An Introduction to the Bootstrap, 1993, chapters 8 and 13.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from data_tools.metrics import ErrorSample
from saga_fg.errors import InputError
from saga_fg.numerics import FloatArray, checked

Statistic = Callable[[FloatArray], FloatArray]
Comparison = Callable[[FloatArray, FloatArray], FloatArray]


@dataclass(frozen=True)
class Interval:
    """An estimate with its `confidence` interval [low, high]."""

    estimate: float
    low: float
    high: float
    confidence: float

    def __str__(self) -> str:
        return f"{self.estimate:.4g} [{self.low:.4g}, {self.high:.4g}]"


def ratio_of_sums(sums: FloatArray) -> FloatArray:
    """First sum over second sum (..., 2) -> (...): a pooled mean."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(sums[..., 0] / sums[..., 1])


def root_mean_square(sums: FloatArray) -> FloatArray:
    """Pooled RMSE of (sum of squares, count) (..., 2) -> (...)."""
    return np.sqrt(ratio_of_sums(sums))


def relative_change(a: FloatArray, b: FloatArray) -> FloatArray:
    """a / b - 1: -0.25 if a is 25 % lower than b."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(a / b - 1.0)


def difference(a: FloatArray, b: FloatArray) -> FloatArray:
    """a - b."""
    return np.asarray(a - b)


def square_sums(errors: ErrorSample) -> tuple[float, float]:
    """(sum of squares, number of values), the sums for a bootstrap of the RMSE."""
    return float(np.sum(errors.values**2)), float(len(errors))


def paired_bootstrap(
    a: ArrayLike,
    b: ArrayLike,
    statistic: Statistic = root_mean_square,
    compare: Comparison = relative_change,
    *,
    confidence: float = 0.95,
    draws: int = 10_000,
    seed: int = 0,
) -> Interval:
    """Interval of `compare(statistic(sums of a), statistic(sums of b))` over the same S scenes.

    a, b       (S, m) sums of each scene, for instance `square_sums`
    statistic  maps totals (..., m) to values (...); must work on stacks of totals

    Samples in which the statistic is undefined (all their scenes are empty) are left out; NaN if there are no others.
    Raises `InputError` for arrays of different shapes, no scene, or a confidence outside (0, 1).
    """
    first = checked("a", a, (None, None))
    second = checked("b", b, first.shape)
    if len(first) == 0:
        raise InputError("a: expected the sums of at least one scene")
    if not 0.0 < confidence < 1.0:
        raise InputError(f"confidence: expected a probability between 0 and 1, got {confidence}")
    estimate = float(compare(statistic(first.sum(axis=0)), statistic(second.sum(axis=0))))
    scenes = len(first)
    weights = (
        np.random.default_rng(seed).multinomial(scenes, np.full(scenes, 1 / scenes), size=draws).astype(np.float64)
    )
    values = compare(statistic(weights @ first), statistic(weights @ second))
    values = values[np.isfinite(values)]
    tail = (1 - confidence) / 2
    low, high = np.quantile(values, [tail, 1 - tail]) if len(values) else (np.nan, np.nan)
    return Interval(estimate, float(low), float(high), confidence)
