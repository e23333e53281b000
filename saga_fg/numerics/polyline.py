"""Places along polylines: distance s along one, offset e to its left, direction."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np

from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray


class Feet(NamedTuple):
    """Nearest points (m, 2) of a polyline to m places, s (m,) and e (m,), m, and its direction (m, 2) at s."""

    point: FloatArray
    s: FloatArray
    e: FloatArray
    direction: FloatArray

    def select(self, rows: IntArray | BoolArray) -> Feet:
        """The feet of some rows."""
        return Feet(*(column[rows] for column in self))


class Polylines(NamedTuple):
    """L polylines as S pieces, one line after the other.

    start (S, 2), m, and unit direction t (S, 2) of each piece; low, high (S,): bounds of the way along it, m, infinite
    at both ends of a line; before (S,): length of the line before it, m; middle (S,): s of its middle; angle (S,), rad,
    without jumps; first (L,), pieces (L,): its pieces; length (L,), m; base (L,) of keys s + base that sort all pieces
    """

    start: FloatArray
    t: FloatArray
    low: FloatArray
    high: FloatArray
    before: FloatArray
    middle: FloatArray
    angle: FloatArray
    first: IntArray
    pieces: IntArray
    length: FloatArray
    base: FloatArray

    @classmethod
    def of(cls, lines: Sequence[FloatArray]) -> Self:
        """Polylines (k, 2) of one piece at least, of points apart."""
        pieces = np.array([len(line) - 1 for line in lines], dtype=np.int64)
        first, total, length = np.cumsum(pieces) - pieces, int(pieces.sum()), np.empty(len(lines))
        columns = tuple(np.empty((total, *width)) for width in ((2,), (2,), (), (), (), (), ()))
        for count in np.unique(pieces).tolist():
            alike = np.flatnonzero(pieces == count)
            at = first[alike][:, None] + np.arange(count)
            *parts, length[alike] = _pieces(np.array([lines[k] for k in alike.tolist()]))
            for column, part in zip(columns, parts, strict=True):
                column[at] = part
        start, t, low, high, before, middle, angle = columns
        base = np.cumsum(length + 1) - length
        return cls(start, t, low, high, before, middle, angle, first, pieces, length, base)

    def __len__(self) -> int:
        return len(self.length)

    def feet(self, line: IntArray, places: FloatArray) -> Feet:
        """The feet of places (m, 2) on polylines `line` (m,); first and last pieces run on straight."""
        count = self.pieces[line]
        begin = np.cumsum(count) - count
        row = np.repeat(np.arange(len(line)), count)
        piece = np.arange(len(row)) + (self.first[line] - begin)[row]
        t, place = self.t[piece], places[row]
        offset = place - self.start[piece]
        along = np.clip(offset[:, 0] * t[:, 0] + offset[:, 1] * t[:, 1], self.low[piece], self.high[piece])
        apart = offset - along[:, None] * t
        distance = apart[:, 0] ** 2 + apart[:, 1] ** 2
        least = np.minimum.reduceat(distance, begin) if len(line) else distance
        hit = np.flatnonzero(distance == least[row])
        k = hit[np.unique(row[hit], return_index=True)[1]]  # the first of equals
        t, apart = t[k], apart[k]
        s = self.before[piece[k]] + along[k]
        return Feet(places - apart, s, t[:, 0] * apart[:, 1] - t[:, 1] * apart[:, 0], self.direction_at(line, s))

    def direction_at(self, line: IntArray, s: FloatArray) -> FloatArray:
        """Unit directions (m, 2) at distances s (m,) along `line` (m,), turning evenly from piece to piece."""
        key = np.clip(s, 0.0, self.length[line]) + self.base[line]
        first, last = self.first[line], self.first[line] + self.pieces[line] - 1
        passed = np.searchsorted(np.repeat(self.base, self.pieces) + self.middle, key, side="right")
        a, b = np.clip(passed - 1, first, last), np.clip(passed, first, last)
        apart = self.middle[b] - self.middle[a]
        share = np.where(apart > 0, (s - self.middle[a]) / np.where(apart > 0, apart, 1.0), 0.0)
        angle = self.angle[a] + share * (self.angle[b] - self.angle[a])
        return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def feet(polyline: FloatArray, places: FloatArray) -> Feet:
    """The feet on a polyline (k, 2) of places (m, 2); its first and last pieces run on straight."""
    return Polylines.of([polyline]).feet(np.zeros(len(places), dtype=np.int64), places)


def on_it(polyline: FloatArray, s: FloatArray) -> BoolArray:
    """Mask (m,) of distances along a polyline (k, 2) between its first and its last point."""
    return np.asarray((s >= 0) & (s <= np.hypot(*np.diff(polyline, axis=0).T).sum()))


def direction_at(polyline: FloatArray, s: FloatArray) -> FloatArray:
    """Unit directions (m, 2) at distances s (m,) along a polyline (k, 2), turning evenly from piece to piece."""
    return Polylines.of([polyline]).direction_at(np.zeros(len(s), dtype=np.int64), s)


def _pieces(lines: FloatArray) -> tuple[FloatArray, ...]:
    """The pieces of polylines (L, k, 2): their columns in `Polylines`, (L, k - 1, ...), and the lengths (L,)."""
    step = np.diff(lines, axis=1)
    length = np.hypot(step[..., 0], step[..., 1])
    end = np.cumsum(length, axis=1)
    low, high = np.zeros_like(length), length.copy()
    low[:, 0], high[:, -1] = -np.inf, np.inf
    angle = np.unwrap(np.arctan2(step[..., 1], step[..., 0]), axis=1)
    return lines[:, :-1], step / length[..., None], low, high, end - length, end - length / 2, angle, length.sum(axis=1)
