"""Objects over the moments of a recording: their lifespans, and their smoothed states as one table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from saga_fg.numerics.arrays import FloatArray, IntArray, StrArray
from saga_fg.numerics.columns import Columns


@dataclass(frozen=True, eq=False)
class Lifespans(Columns):
    """n objects: id (n,) unique and ascending, label (n,) classes, first and last (n,) moments, both included."""

    id: IntArray
    label: StrArray
    first: IntArray
    last: IntArray

    def rows_of(self, ids: IntArray) -> IntArray:
        """The rows of some objects that are all there."""
        return np.searchsorted(self.id, ids)

    def reaching(self, times: FloatArray, back: float, ahead: float) -> Self:
        """Extend to up to `back` s earlier and `ahead` s later; times (K,) s, of all moments."""
        first = np.searchsorted(times, times[self.first] - back)
        last = np.searchsorted(times, times[self.last] + ahead, side="right") - 1
        return replace(self, first=np.minimum(first, self.first), last=np.maximum(last, self.last))


def lifespans_of(object_of: IntArray, label: StrArray, moment: IntArray) -> Lifespans:
    """The lifespans of all objects from their first to their last detection.

    object_of (N,) the object of each detection, negative for none; label (N,), moment (N,) of the detections
    """
    rows = np.flatnonzero(object_of >= 0)
    ids, index = np.unique(object_of[rows], return_inverse=True)
    first = np.full(len(ids), np.iinfo(np.int64).max)
    last = np.full(len(ids), -1)
    np.minimum.at(first, index, moment[rows])
    np.maximum.at(last, index, moment[rows])
    example = np.zeros(len(ids), dtype=np.int64)
    example[index] = rows
    return Lifespans(ids, label[example] if len(ids) else np.empty(0, dtype="<U1"), first, last)


@dataclass(frozen=True, eq=False)
class StateTable(Columns):
    """Smoothed states, R rows in order of moments and within a moment of ids.

    moment, id (R,); mean (R, 4) local position (m) and velocity (m/s); covariance (R, 4, 4)
    """

    moment: IntArray
    id: IntArray
    mean: FloatArray
    covariance: FloatArray

    @classmethod
    def of_moments(cls, parts: Sequence[tuple[int, IntArray, FloatArray, FloatArray]]) -> Self:
        """Build from (moment, ids, means, covariances) of each moment in order."""
        if not parts:
            return cls(*(np.empty(0, dtype=np.int64),) * 2, np.empty((0, 4)), np.empty((0, 4, 4)))
        moment = np.repeat([k for k, *_ in parts], [len(ids) for _, ids, *_ in parts])
        ids, mean, P = (np.concatenate([part[i] for part in parts]) for i in (1, 2, 3))
        order = np.lexsort((ids, moment))
        return cls(moment[order], ids[order], mean[order], P[order])

    def merged(self, other: Self) -> Self:
        """With the states of other objects."""
        both = self.append(other)
        return both.select(np.lexsort((both.id, both.moment)))

    def within(self, lifespans: Lifespans) -> Self:
        """The states of some objects from their first to their last moment."""
        row = np.minimum(lifespans.rows_of(self.id), max(len(lifespans) - 1, 0))
        if len(lifespans) == 0:
            return self.select(np.empty(0, dtype=np.int64))
        there = (
            (lifespans.id[row] == self.id)
            & (lifespans.first[row] <= self.moment)
            & (self.moment <= lifespans.last[row])
        )
        return self.select(there)

    @cached_property
    def previous(self) -> IntArray:
        """(R,) the row of the same object at the moment before, -1 for its first."""
        order = np.lexsort((self.moment, self.id))
        before = np.full(len(self), -1, dtype=np.int64)
        same = self.id[order[1:]] == self.id[order[:-1]]
        before[order[1:][same]] = order[:-1][same]
        return before

    def elapsed(self, times: FloatArray) -> FloatArray:
        """(R,) s from the object's state before to each state, 0 for its first; times (K,) s, of all moments."""
        return np.where(self.previous >= 0, times[self.moment] - times[self.moment[self.previous]], 0.0)

    @cached_property
    def _bounds(self) -> IntArray:
        return np.searchsorted(self.moment, np.arange((int(self.moment[-1]) if len(self) else 0) + 2))

    def at(self, moment: int) -> slice:
        """The rows of a moment."""
        if moment + 1 >= len(self._bounds):
            return slice(len(self), len(self))
        return slice(int(self._bounds[moment]), int(self._bounds[moment + 1]))

    def rows_of(self, moment: IntArray, ids: IntArray) -> IntArray:
        """(m,) the rows of these objects at these moments, -1 where there is none."""
        if len(self) == 0:
            return np.full(len(ids), -1, dtype=np.int64)
        wanted = moment * self._span + ids
        at = np.minimum(np.searchsorted(self._keys, wanted), len(self) - 1)
        return np.where((self._keys[at] == wanted) & (ids >= 0) & (ids < self._span), at, -1)

    @cached_property
    def _span(self) -> int:
        return int(self.id.max()) + 1

    @cached_property
    def _keys(self) -> IntArray:
        """(R,) one ascending number for each moment and object."""
        return self.moment * self._span + self.id
