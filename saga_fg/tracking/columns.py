"""What the tracker keeps of its tracks besides their joint state and their boxes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray, StrArray
from saga_fg.numerics.columns import Columns


@dataclass(eq=False)
class TrackColumns(Columns):
    """n tracks, in order of birth. Times in s.

    id            (n,)
    label         (n,) class
    existence     (n,) probability that the track is a real object
    score         (n,) probability of its latest detection
    told, shared  (n,) what the sensor of its latest detection tells of positions: a factor, and an error in m
    last_seen     (n,) time of its latest detection
    last_in_view  (n,) when it was last inside a sensor's field of view
    confirmed     (n,) misses no longer end it
    has_moved     (n,) was ever seen moving
    looks, hits   (n,) how often a sensor looked where it was, and how often it was detected
    accepted      (n,) born from a sensor that is trusted alone, or confirmed since
    ready         (n,) its velocity was once known well enough to be reported
    """

    id: IntArray
    label: StrArray
    existence: FloatArray
    score: FloatArray
    told: FloatArray
    shared: FloatArray
    last_seen: FloatArray
    last_in_view: FloatArray
    confirmed: BoolArray
    has_moved: BoolArray
    looks: FloatArray
    hits: FloatArray
    accepted: BoolArray
    ready: BoolArray

    @classmethod
    def empty(cls) -> Self:
        none = np.empty(0)
        label = np.empty(0, dtype="<U1")
        return cls.born(np.empty(0, dtype=np.int64), label, none, (none, none), 0.0, 0.0, none.astype(bool), True)

    @classmethod
    def born(
        cls,
        ids: IntArray,
        label: StrArray,
        probability: FloatArray,
        told: tuple[FloatArray, FloatArray],
        seen: float,
        now: float,
        confirmed: BoolArray,
        accepted: bool,
    ) -> Self:
        """New tracks `ids` (k,) `now`, from detections of some `probability` (k,) made at `seen`."""
        k = len(ids)
        return cls(
            ids,
            label,
            probability.copy(),
            probability.copy(),
            *told,
            np.full(k, seen),
            np.full(k, now),
            confirmed,
            np.zeros(k, dtype=bool),
            np.ones(k),
            np.ones(k),
            np.full(k, accepted),
            np.zeros(k, dtype=bool),
        )

    def coasting(self, now: float) -> FloatArray:
        """(n,) how long the tracks have not been detected, s; to the microsecond, as all times are."""
        return np.maximum(np.round(now - self.last_seen, 6), 0.0)
