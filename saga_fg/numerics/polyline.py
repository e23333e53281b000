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
    """The feet of places (m, 2) on a polyline (k, 2), or each on its own (m, k, 2).

    The first and last pieces run on straight. The direction turns evenly from the middle of a piece to the next one's.
    """
    start, step = polyline[..., :-1, :], np.diff(polyline, axis=-2)
    length = np.hypot(step[..., 0], step[..., 1])
    t = step / length[..., None]
    offset = places[:, None] - start
    along = offset[..., 0] * t[..., 0] + offset[..., 1] * t[..., 1]
    low, high = np.zeros_like(length), length.copy()
    low[..., 0], high[..., -1] = -np.inf, np.inf
    along = np.clip(along, low, high)
    nearest = start + along[..., None] * t
    k = np.argmin(((places[:, None] - nearest) ** 2).sum(axis=-1), axis=1)
    rows, last = np.arange(len(places)), length.shape[-1] - 1
    length, t = np.broadcast_to(length, along.shape), np.broadcast_to(t, offset.shape)
    point, along, own = nearest[rows, k], along[rows, k], t[rows, k]
    apart = places - point
    e = own[:, 0] * apart[:, 1] - own[:, 1] * apart[:, 0]
    s = np.cumsum(length, axis=1)[rows, k] - length[rows, k] + along
    beyond = along - length[rows, k] / 2
    other = np.clip(k + np.where(beyond < 0, -1, 1), 0, last)
    next_to = t[rows, other]
    turn = np.arctan2(own[:, 0] * next_to[:, 1] - own[:, 1] * next_to[:, 0], (own * next_to).sum(axis=1))
    turn *= 2 * np.abs(beyond) / (length[rows, k] + length[rows, other])
    c, sine = np.cos(turn), np.sin(turn)
    direction = np.stack([c * own[:, 0] - sine * own[:, 1], sine * own[:, 0] + c * own[:, 1]], axis=-1)
    return Feet(point, s, e, direction)


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
