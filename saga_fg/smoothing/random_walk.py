r"""Scalar random walks, one an object, smoothed together: heights and headings.

    s(k+1) = s(k) + q,  q ~ N(0, drift^2 dt)        z = s + v,  v ~ N(0, sigma^2)

Kalman filter forwards and Rauch-Tung-Striebel smoother backwards. With a `period` p only s modulo p is measured (the
axis of a box is its heading up to half a turn, p = pi): the innovation is taken to [-p/2, p/2), and s runs on
continuously over all turns.

Source: Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 8.6.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.smoothing.states import StateTable


class ScalarReadings(NamedTuple):
    """Readings of some states: rows (m,) of the table, each at most once; value (m,); variance (m,)."""

    rows: IntArray
    value: FloatArray
    variance: FloatArray


def scalar_readings(rows: IntArray, value: FloatArray, variance: FloatArray) -> list[ScalarReadings]:
    """Readings (m,) of rows that may repeat, as groups in which each row occurs once at most."""
    order = np.argsort(rows, kind="stable")
    rank = np.empty(len(rows), dtype=np.int64)
    rank[order] = np.arange(len(rows)) - np.searchsorted(rows[order], rows[order])
    groups = (np.flatnonzero(rank == k) for k in range(int(rank.max(initial=-1)) + 1))
    return [ScalarReadings(rows[group], value[group], variance[group]) for group in groups]


def smooth_walks(
    states: StateTable, growth: FloatArray, readings: Sequence[ScalarReadings], period: float | None = None
) -> tuple[FloatArray, FloatArray]:
    """Means and variances (R,), NaN for objects without any reading.

    growth (R,): of the variance from the object's row before to each row
    """
    mean, variance = np.full(len(states), np.nan), np.full(len(states), np.nan)
    before = states.previous
    moments = range(int(states.moment[0]), int(states.moment[-1]) + 1) if len(states) else range(0)
    by_moment = [_split(states, reading) for reading in readings]
    for k in moments:
        rows = np.arange(*states.at(k).indices(len(states)))
        old = rows[before[rows] >= 0]
        mean[old] = mean[before[old]]
        variance[old] = variance[before[old]] + growth[old]
        for split in by_moment:
            if k in split:
                _update(mean, variance, split[k], period)
    filtered = variance.copy()
    for k in reversed(moments):
        rows = np.arange(*states.at(k).indices(len(states)))
        new = rows[before[rows] >= 0]
        old = before[new]
        unknown = np.isnan(mean[old])
        share = np.where(unknown, 1.0, filtered[old] / (filtered[old] + growth[new]))
        spread = np.where(unknown, growth[new], filtered[old] * (1 - share))
        mean[old] = np.where(unknown, mean[new], mean[old] + share * (mean[new] - mean[old]))
        variance[old] = spread + share**2 * variance[new]
    return mean, variance


def _split(states: StateTable, reading: ScalarReadings) -> dict[int, ScalarReadings]:
    """The readings of each moment."""
    order = np.argsort(reading.rows)
    rows, value, variance = reading.rows[order], reading.value[order], reading.variance[order]
    moments, starts = np.unique(states.moment[rows], return_index=True)
    ends = np.append(starts[1:], len(rows))[: len(starts)].tolist()
    return {
        int(k): ScalarReadings(rows[a:b], value[a:b], variance[a:b])
        for k, a, b in zip(moments, starts.tolist(), ends, strict=True)
    }


def _update(mean: FloatArray, variance: FloatArray, reading: ScalarReadings, period: float | None) -> None:
    rows, value, noise = reading
    first = np.isnan(mean[rows])
    innovation = np.where(first, 0.0, value - mean[rows])
    if period is not None:
        innovation = (innovation + period / 2) % period - period / 2
    gain = np.where(first, 0.0, variance[rows] / (variance[rows] + noise))
    mean[rows] = np.where(first, value, mean[rows] + gain * innovation)
    variance[rows] = np.where(first, noise, variance[rows] * (1 - gain))
