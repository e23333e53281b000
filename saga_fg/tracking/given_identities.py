"""Identities that a sensor gives to the objects it follows, as evidence for the association.

Radars, cameras and other trackers report objects with numbers of their own, which mostly stay. Where the track that had
a detection's number last is a candidate for it, every other track's pair with the detection costs

    2 log( q / (1 - q) )

more, with q the share of numbers that stay on their object. So numbers decide between tracks that the motion allows,
and the motion decides where a number has jumped to another object. They do not make a match likelier than none:
a tracker gives its number to the nearest box, be it a false one. Numbers of different sensors are independent.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from saga_fg.numerics import FloatArray, IntArray

STAYING = 0.9  # q; labels from the tracks of nuScenes are alike from 0.75 to 0.9
_NOBODY = np.empty(0, dtype=np.int64)


@dataclass(frozen=True, eq=False)
class GivenIdentities:
    """By sensor: its numbers (n,), ascending, and the ids (n,) of the tracks that had them last; when that was, s."""

    known: Mapping[str, tuple[IntArray, IntArray]] = field(default_factory=dict)
    newest: Mapping[str, float] = field(default_factory=dict)

    def tracks(self, sensor: str, identity: IntArray) -> IntArray:
        """(m,) the ids of the tracks that last had these numbers (m,), -1 for none."""
        numbers, tracks = self.known.get(sensor, (_NOBODY, _NOBODY))
        if not len(numbers):
            return np.full(len(identity), -1, dtype=np.int64)
        at = np.minimum(np.searchsorted(numbers, identity), len(numbers) - 1)
        return np.where((numbers[at] == identity) & (identity >= 0), tracks[at], -1)

    def updated(
        self, sensor: str, identity: IntArray, track: IntArray, alive: IntArray, time: float
    ) -> GivenIdentities:
        """After tracks (m,) took detections of these numbers (m,), -1 for none; those of dead tracks are forgotten.

        alive: the ids of the live tracks; a frame of a `time`, s, before the sensor's newest one changes nothing
        """
        given = identity >= 0
        if not given.any() or time < self.newest.get(sensor, time):
            return self
        numbers, tracks = self.known.get(sensor, (_NOBODY, _NOBODY))
        others = np.isin(tracks, alive) & ~np.isin(numbers, identity[given])
        numbers, tracks = np.append(numbers[others], identity[given]), np.append(tracks[others], track[given])
        order = np.argsort(numbers)
        known = {**self.known, sensor: (numbers[order], tracks[order])}
        return GivenIdentities(known, {**self.newest, sensor: time})

    def exchanged(self, a: int, b: int) -> GivenIdentities:
        """After two tracks, by id, have exchanged their objects."""
        known = {name: (own, exchanged(tracks, a, b)) for name, (own, tracks) in self.known.items()}
        return replace(self, known=known)


def exchanged(ids: IntArray, a: int, b: int) -> IntArray:
    """(n,) with b in place of a, and a in place of b."""
    return np.where(ids == a, b, np.where(ids == b, a, ids))


def identity_cost(track: IntArray, detection: IntArray, ids: IntArray, last: IntArray) -> FloatArray:
    """(K,) cost of pairs, rows (K,) of tracks and detections.

    ids (n,) of the tracks; last (m,) the track that last had the number of each detection, -1 for none
    """
    same = last[detection] == ids[track]
    named = np.zeros(len(last), dtype=np.bool_)
    named[detection[same]] = True  # the track of that number is a candidate
    return np.where(named[detection] & ~same, 2 * np.log(STAYING / (1 - STAYING)), 0.0)
