"""Who is ahead and who is behind, in any lane. A vehicle that changes lanes is in both of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from saga_fg.numerics.arrays import FloatArray, IntArray

SPAN = 1.0e6  # m, more than any road is long


@dataclass(frozen=True, eq=False)
class LaneOrder:
    """All vehicles sorted by lane and distance: keys lane * SPAN + s (E,) and the vehicles they belong to (E,)."""

    key: FloatArray
    vehicle: IntArray

    @classmethod
    def of(cls, s: FloatArray, lanes: IntArray) -> LaneOrder:
        """From s (N,), m, and the lanes each vehicle is in (N, 2), -1 for none."""
        rows, columns = np.nonzero(lanes >= 0)
        key = lanes[rows, columns] * SPAN + s[rows]
        order = np.argsort(key, kind="stable")
        return cls(key[order], rows[order])

    def ahead(self, lane: IntArray, s: FloatArray) -> IntArray:
        """The first vehicle (N,) beyond s (N,) in lane (N,), or -1; lanes may be -1."""
        return self._at(np.searchsorted(self.key, lane * SPAN + s, side="right"), lane)

    def behind(self, lane: IntArray, s: FloatArray) -> IntArray:
        """The last vehicle (N,) before s (N,) in lane (N,), or -1."""
        return self._at(np.searchsorted(self.key, lane * SPAN + s, side="left") - 1, lane)

    def _at(self, place: IntArray, lane: IntArray) -> IntArray:
        if len(self.key) == 0:
            return np.full(len(place), -1)
        inside = np.clip(place, 0, len(self.key) - 1)
        same = (inside == place) & (lane >= 0) & (np.floor_divide(self.key[inside], SPAN) == lane)
        return np.where(same, self.vehicle[inside], -1)
