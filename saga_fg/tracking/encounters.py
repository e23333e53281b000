"""Encounters: pairs of tracks that may have exchanged their objects, and are told apart by what follows.

Where one track of a pair has a detection that may be the other's (`saga_fg.tracking.association`), both answers go on:
that each track keeps its object, and that they exchange them from this frame on. Under either, two Kalman filters of
constant velocity follow the two objects by the same detections, from the tracks' predictions in this frame,

    log odds = sum over frames and both objects of   log N(z; H x', S') - log N(z; H x, S)

with ' where the detections are exchanged; the noise of the acceleration is what the motion of the class adds to its
velocity in a second. From `LIKELY` on, in a frame that detects both, the tracks exchange all that is known of them but
their ids. An encounter ends below `UNLIKELY`, after `MEMORY`, and with one of its tracks.

Source: Reid, An Algorithm for Tracking Multiple Targets, IEEE Transactions on Automatic Control 24(6), 1979; of its
hypotheses those of one pair alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from saga_fg.kernels.identities import exchanged_tracks
from saga_fg.numerics.arrays import BoolArray, Columns, FloatArray, IntArray

LIKELY, UNLIKELY = 2.0, -5.0  # log odds; 1.5 to 2.5 exchange alike
MEMORY = 2.0  # s; 1 to 3 exchange alike


@dataclass(frozen=True, eq=False)
class Encounters(Columns):
    """E encounters.

    ids       (E, 2) the two tracks
    x, P      (E, 4, 4), (E, 4, 4, 4) position and velocity, local, of the first and second, then of both exchanged
    since     (E,) time of the frame, s
    log_odds  (E,) that they exchanged their objects then
    """

    ids: IntArray
    x: FloatArray
    P: FloatArray
    since: FloatArray
    log_odds: FloatArray

    @classmethod
    def empty(cls) -> Self:
        """No encounters."""
        flat = np.empty(0)
        return cls(np.empty((0, 2), dtype=np.int64), np.empty((0, 4, 4)), np.empty((0, 4, 4, 4)), flat, flat)

    def live(self, tracks: IntArray, time: float) -> Self:
        """Those that are open at a time, s, of the tracks (n,) that are left."""
        if len(self) == 0:
            return self
        there = np.isin(self.ids, tracks).all(axis=1)
        return self.select(there & (time - self.since <= MEMORY) & (self.log_odds > UNLIKELY))

    def without(self, pairs: Sequence[tuple[int, int]]) -> Self:
        """Those of no track of some pairs."""
        return self.select(np.asarray(~np.isin(self.ids, pairs).any(axis=1))) if pairs else self

    def begun(self, ids: IntArray, x: FloatArray, P: FloatArray, time: float) -> Self:
        """With new ones, of tracks `ids` (e, 2) predicted to x (e, 2, 4), P (e, 2, 4, 4)."""
        both = np.concatenate([x, x], axis=1), np.concatenate([P, P], axis=1)
        return self.append(type(self)(ids, *both, np.full(len(ids), time), np.zeros(len(ids))))

    def followed(self, noise: FloatArray, dt: FloatArray, z: FloatArray, R: FloatArray, seen: BoolArray) -> Self:
        """After a frame: noise (E,) m^2/s^3; dt (E,) s before; z (E, 2, 2), R (E, 2, 2, 2) where `seen` (E, 2)."""
        evidence, x, P = exchanged_tracks(self.x, self.P, noise, dt, z, R, seen)
        return replace(self, x=x, P=P, log_odds=self.log_odds + evidence)

    def exchanges(self, seen: IntArray) -> list[tuple[int, int]]:
        """The pairs of tracks, each in one at most, of which it is likely and both are `seen` (k,) now."""
        likely = (self.log_odds >= LIKELY) & np.isin(self.ids, seen).all(axis=1)
        rows, done = likely.nonzero()[0], set[int]()
        found = []
        for a, b in self.ids[rows[np.argsort(-self.log_odds[rows], kind="stable")]].tolist():
            if not done & {a, b}:
                found.append((a, b))
                done |= {a, b}
        return found
