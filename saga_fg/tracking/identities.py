"""Identities: numbers that sensors give to the objects they follow, and pairs of tracks that may have exchanged theirs.

Radars, cameras and other trackers report objects with numbers of their own, which mostly stay. Where the track that had
a detection's number last is a candidate for it, every other track's pair with the detection costs

    2 log( q / (1 - q) )

more, with q the share of numbers that stay on their object. So numbers decide between tracks that the motion allows,
and the motion decides where a number has jumped to another object. They do not make a match likelier than none:
a tracker gives its number to the nearest box, be it a false one. Numbers of different sensors are independent.

Encounters are pairs of tracks that may have exchanged their objects, and are told apart by what follows. Where one
track of a pair has a detection that may be the other's (`saga_fg.tracking.association`), both answers go on: that each
track keeps its object, and that they exchange them from this frame on. Under either, two Kalman filters of constant
velocity follow the two objects by the same detections, from the tracks' predictions in this frame,

    log odds = sum over frames and both objects of   log N(z; H x', S') - log N(z; H x, S)

with ' where the detections are exchanged; the noise of the acceleration is what the motion of the class adds to its
velocity in a second. From `LIKELY` on, in a frame that detects both, the tracks exchange states, rows of the table,
and passages since then, but no ids, one pair a frame. An encounter ends below `UNLIKELY`, after `MEMORY`, and with one
of its tracks.

Source: Reid, An Algorithm for Tracking Multiple Targets, IEEE Transactions on Automatic Control 24(6), 1979; of its
hypotheses those of one pair alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from saga_fg.numerics import BoolArray, Columns, FloatArray, IntArray, mahalanobis_of_pairs

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
        """Select the encounters between present `tracks` (n,) that are still undecided at a time, s."""
        if len(self) == 0:
            return self
        there = np.isin(self.ids, tracks).all(axis=1)
        return self.select(there & (time - self.since <= MEMORY) & (self.log_odds > UNLIKELY))

    def without(self, a: int, b: int) -> Self:
        """Select the encounters without tracks a and b."""
        return self.select(np.asarray(~np.isin(self.ids, [a, b]).any(axis=1)))

    def begun(self, ids: IntArray, x: FloatArray, P: FloatArray, time: float) -> Self:
        """With new ones, of tracks `ids` (e, 2) predicted to x (e, 2, 4), P (e, 2, 4, 4)."""
        since = np.full(len(ids), time)
        return self.append(type(self)(ids, np.tile(x, (1, 2, 1)), np.tile(P, (1, 2, 1, 1)), since, 0 * since))

    def followed(self, noise: FloatArray, dt: FloatArray, z: FloatArray, R: FloatArray, seen: BoolArray) -> Self:
        """After a frame: noise (E,) m^2/s^3; dt (E,) s before; z (E, 2, 2), R (E, 2, 2, 2) where `seen` (E, 2)."""
        F, Q = np.eye(4) + dt[:, None, None] * np.eye(4, k=2), np.zeros((len(self), 4, 4))
        for i, j, power in ((0, 0, 3), (0, 2, 2), (2, 0, 2), (2, 2, 1)):
            Q[:, [i, i + 1], [j, j + 1]] = (noise * dt**power / power)[:, None]
        F, Q, crossed = F[:, None], Q[:, None], [0, 1, 1, 0]  # the detection of each filter
        x, P = (F @ self.x[..., None])[..., 0], F @ self.P @ np.swapaxes(F, 2, 3) + Q
        innovation, S = (
            z[:, crossed] - x[..., :2],
            P[..., :2, :2] + np.where(seen[..., None, None], R, np.eye(2))[:, crossed],
        )
        told = seen[:, crossed]
        log_density = np.where(told, -0.5 * np.sum(mahalanobis_of_pairs(innovation, S), axis=0), 0.0)
        K = np.where(told[..., None, None], P[..., :2] @ np.linalg.inv(S), 0.0)
        x, P = x + (K @ innovation[..., None])[..., 0], P - K @ P[..., :2, :]
        return replace(self, x=x, P=P, log_odds=self.log_odds + log_density @ [-1.0, -1.0, 1.0, 1.0])

    def exchanges(self, seen: IntArray) -> list[tuple[int, int, float]]:
        """The likeliest pair of tracks, if it is likely, of those of which both are `seen` (k,) now; since when, s."""
        if self.log_odds.max(initial=-np.inf) < LIKELY:
            return []
        odds = np.where(np.isin(self.ids, seen).all(axis=1), self.log_odds, -np.inf)
        best = np.flatnonzero(odds == odds.max(initial=LIKELY))[:1]
        return [(*self.ids[k].tolist(), float(self.since[k])) for k in best]
