"""Places along a polyline: distance s along it, offset e to its left, direction."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray


class Feet(NamedTuple):
    """Nearest points (m, 2) of a polyline to m places, s (m,) and e (m,), m, and its direction (m, 2) at s."""

    point: FloatArray
    s: FloatArray
    e: FloatArray
    direction: FloatArray

    def select(self, rows: IntArray) -> Feet:
        """The feet of some rows."""
        return Feet(*(column[rows] for column in self))


def feet(polyline: FloatArray, places: FloatArray) -> Feet:
    """The feet on a polyline (k, 2) of places (m, 2); its first and last pieces run on straight."""
    start, step = polyline[:-1], np.diff(polyline, axis=0)
    length = np.hypot(*step.T)
    t = step / length[:, None]
    offset = places[:, None] - start
    along = np.einsum("mki,ki->mk", offset, t)
    low, high = np.zeros(len(step)), length.copy()
    low[0], high[-1] = -np.inf, np.inf
    along = np.clip(along, low, high)
    nearest = start + along[..., None] * t
    k = np.argmin(((places[:, None] - nearest) ** 2).sum(axis=-1), axis=1)
    rows = np.arange(len(places))
    point = nearest[rows, k]
    apart = places - point
    e = t[k, 0] * apart[:, 1] - t[k, 1] * apart[:, 0]
    s = np.concatenate([[0.0], np.cumsum(length)])[k] + along[rows, k]
    return Feet(point, s, e, direction_at(polyline, s))


def on_it(polyline: FloatArray, s: FloatArray) -> BoolArray:
    """Mask (m,) of distances along a polyline (k, 2) between its first and its last point."""
    return np.asarray((s >= 0) & (s <= np.hypot(*np.diff(polyline, axis=0).T).sum()))


def direction_at(polyline: FloatArray, s: FloatArray) -> FloatArray:
    """Unit directions (m, 2) at distances s (m,) along a polyline (k, 2), turning evenly from piece to piece."""
    step = np.diff(polyline, axis=0)
    length = np.hypot(*step.T)
    middle = np.cumsum(length) - length / 2
    angle = np.interp(s, middle, np.unwrap(np.arctan2(step[:, 1], step[:, 0])))
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)
