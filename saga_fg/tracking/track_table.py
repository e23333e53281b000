"""The table of tracks, with the evidence of each sensor.

The table of tracks: one row a track, one column an attribute, all that is known of tracks besides the joint state.

The joint state (`saga_fg.tracking.joint_state`) is kept by id, since tracks are correlated in it.

The latest evidence of each sensor on every track, and their fusion into one score.

    logit P = logit prior + sum over sensors of   logit p - logit prior      detected, p the calibrated probability
                                                  log(1 - P_D)               an opportunity, and has never detected it
                                                  0                          out of view, or no recent evidence

P is the probability that the track has an object, if sensors err independently of one another. With a single sensor
it is that sensor's p. Sensors report at different times, so that the latest evidence of each counts for a while. A
sensor that has detected the object before and misses it now adds nothing: intermittent objects are a matter of
existence.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from saga_fg.numerics import BoolArray, Columns, FloatArray, IntArray, StrArray
from saga_fg.tracking.track_filters import BoxFilter, Stationarity, TurnRate
from saga_fg.types import Boxes

PRIOR_LOGIT = math.log(0.3 / 0.7)  # of a detection whose score says nothing
MANY_SENSORS = 32  # from here on, sensors without a part in any track are forgotten: names come from outside
MEMORY = 3.0  # s, over which an object that was hidden or in view goes on to be; usual 1 to 3
LARGEST_LOGIT = 7.0  # a sum of many sensors is no certainty, since they do not err quite independently


@dataclass(eq=False)
class SensorEvidence(Columns):
    """Columns over n tracks and S sensors.

    logit          (n, S) latest evidence of each sensor, as log-odds
    detected       (n, S) whether that was a detection
    time           (n, S) of it, s, -inf if there was none
    hits           (n, S) frames in which the sensor detected the track
    opportunities  (n, S) frames in which the sensor could have detected it
    visibility     (n, S) probability that the sensor's latest frame had it in view, see `saga_fg.tracking.update`
    looked         (n, S) time of that frame, s
    sensors        names (S,), of the whole table
    """

    logit: FloatArray
    detected: BoolArray
    time: FloatArray
    hits: IntArray
    opportunities: IntArray
    visibility: FloatArray
    looked: FloatArray
    sensors: tuple[str, ...]

    @classmethod
    def empty(cls, tracks: int = 0, sensors: Sequence[str] = ()) -> Self:
        """Tracks of which no sensor has reported anything."""
        shape = (tracks, len(sensors))
        counts = np.zeros(shape, dtype=np.int64)
        unseen = np.full(shape, -np.inf)
        no = np.zeros(shape, dtype=bool)
        return cls(np.zeros(shape), no, unseen, counts, counts.copy(), np.zeros(shape), unseen.copy(), tuple(sensors))

    def initiated(self, sensor: str, probability: FloatArray, now: float) -> Self:
        """Return the evidence of new tracks, each from a detection by the sensor with this probability (k,)."""
        at = self._column(sensor)
        new = self.empty(len(probability), self.sensors)
        new.logit[:, at], new.time[:, at], new.looked[:, at] = _logit(probability) - PRIOR_LOGIT, now, now
        new.detected[:, at], new.hits[:, at], new.opportunities[:, at], new.visibility[:, at] = True, 1, 1, 1.0
        return new

    def update(
        self, sensor: str, now: float, seen: IntArray, probability: FloatArray, missed: BoolArray, chance: FloatArray
    ) -> None:
        """Take in a frame: `seen` tracks (k,), their probabilities (k,); `missed` ones (n,), by the chance (n,) to
        detect them where they are in view."""
        at = self._column(sensor)
        v = self.visibility[:, at].copy()
        self.opportunities[missed & (v >= 0.5), at] += 1
        self.opportunities[seen, at] += 1
        self.visibility[missed, at] = (v * (1 - chance) / np.maximum(1 - v * chance, 1e-9))[missed]
        self.visibility[seen, at] = 1.0
        missed = missed & (v > 0) & (self.hits[:, at] == 0)
        self.logit[missed, at] = np.log(1 - np.minimum(v * chance, 0.99)[missed])
        self.logit[seen, at] = _logit(probability) - PRIOR_LOGIT
        self.detected[missed, at], self.detected[seen, at] = False, True
        self.time[missed, at] = self.time[seen, at] = now
        self.hits[seen, at] += 1

    def join(self, rows: IntArray, others: IntArray) -> None:
        """Add what is known of tracks `others` (k,) to tracks `rows` (k,), which missed all detections of theirs."""
        newer = self.time[others] > self.time[rows]
        for column in (self.logit, self.detected, self.time, self.visibility, self.looked):
            column[rows] = np.where(newer, column[others], column[rows])
        self.hits[rows] += self.hits[others]
        self.opportunities[rows] = np.maximum(self.opportunities[rows], self.hits[rows])

    def look(self, sensor: str, view: FloatArray, now: float) -> None:
        """Note the tracks that a frame of the sensor has in view, by how probable (n,) that is of what covers them."""
        at = self._column(sensor)
        before, kept = self.visibility[:, at], np.exp(np.minimum(self.looked[:, at] - now, 0.0) / MEMORY)
        self.visibility[:, at] = np.where((before > 0) & (view > 0), view + (before - view) * kept, view)
        self.looked[:, at] = now

    def seen_by(self, sensor: str) -> FloatArray:
        """(n,) probability that the sensor has a track in view."""
        return self.visibility[:, self._column(sensor)].copy()

    def seen_by_any(self) -> FloatArray:
        """(n,) probability that the sensor which sees a track best has it in view, by the latest frame of each.

        A sensor that falls silent keeps its field of view, so that an outage of one sensor ends no track.
        """
        return np.asarray(self.visibility.max(axis=1, initial=0.0))

    def probability(self, now: float, memory: float) -> FloatArray:
        """P (n,) by the evidence of the last `memory` s, NaN for tracks that no sensor has detected since."""
        recent = now - self.time <= memory
        logit = PRIOR_LOGIT + np.where(recent, self.logit, 0.0).sum(axis=1)
        p = 1 / (1 + np.exp(-np.clip(logit, -LARGEST_LOGIT, LARGEST_LOGIT)))
        return np.where((recent & self.detected).any(axis=1), p, np.nan)

    def overlooked_by(self, sensor: str, missed: BoolArray) -> BoolArray:
        """(n,) which of the `missed` tracks (n,) the sensor has in view, and has never detected."""
        at = self._column(sensor)
        return np.asarray(missed & (self.visibility[:, at] > 0) & (self.hits[:, at] == 0))

    def detected_by_others(self, sensor: str, now: float, memory: float) -> BoolArray:
        """(n,) which tracks another sensor has detected in the last `memory` s."""
        at = self._column(sensor)
        seen = self.detected & (now - self.time <= memory)
        seen[:, at] = False
        return np.asarray(seen.any(axis=1))

    def best_hits(self) -> tuple[FloatArray, FloatArray]:
        """Hits (n,) and opportunities (n,) of the sensor with the best hit ratio of each track."""
        if len(self) == 0:
            return np.empty(0), np.empty(0)
        best = ((self.hits + 0.0) / (self.opportunities + 1.0)).argmax(axis=1)[:, None]
        hits, total = (np.take_along_axis(count, best, axis=1)[:, 0] for count in (self.hits, self.opportunities))
        return hits.astype(np.float64), total.astype(np.float64)

    def confirmed(self, detections: FloatArray) -> BoolArray:
        """(n,) which tracks two sensors have detected, or one at least this often (n,)."""
        return np.asarray(((self.hits > 0).sum(axis=1) > 1) | (self.hits.sum(axis=1) >= detections))

    def _column(self, sensor: str) -> int:
        """The number of a sensor's column; a sensor not met before gets a new one."""
        if sensor not in self.sensors:
            kept = np.arange(len(self.sensors))
            if len(kept) >= MANY_SENSORS:  # forget those that have detected none of the present tracks
                kept = np.flatnonzero(self.hits.any(axis=0))
            new = self.empty(len(self.logit), [sensor])
            for name in ("logit", "detected", "time", "hits", "opportunities", "visibility", "looked"):
                setattr(self, name, np.concatenate([getattr(self, name)[:, kept], getattr(new, name)], axis=1))
            self.sensors = (*(self.sensors[k] for k in kept.tolist()), sensor)
        return self.sensors.index(sensor)


def _logit(p: FloatArray) -> FloatArray:
    return np.asarray(np.log(p / (1 - p)))


@dataclass(eq=False)
class TrackTable(Columns):
    """n tracks, in order of initiation. Times in s on the tracker's clock.

    id                (n,)
    label             (n,) class
    existence         (n,) probability that the track is a real object
    last_existence    (n,) its existence at its latest detection
    score             (n,) probability of its latest detection
    best_score        (n,) the highest of its detections
    covariance_scale  (n,) factor on the reported standard deviation of the position, see `saga_fg.tracking.track_life`
    position_bias     (n,) standard deviation of the position error that all its detections share, m
    initiated         (n,) time of its first detection
    last_detected     (n,) time of its latest detection
    confirmed         (n,) whether misses no longer delete it
    has_moved         (n,) whether it was ever clearly in motion
    required_hits     (n,) detections after which it is no longer tentative, if they are of one sensor
    overlooked        (n,) time at which a sensor whose tracks count at once last had it in view and had never detected
                      it; NaN for those that such a sensor has initiated
    unresolved        (n,) further frames to tell it from the track that it overlaps, see `saga_fg.tracking.track_life`
    class_belief      (n, C) log-probabilities by its detections, see `saga_fg.tracking.class_belief`
    box               size, height and heading
    stationarity      probability and place of standing still
    turn              turn rate
    sensors           latest evidence of each sensor
    """

    id: IntArray
    label: StrArray
    existence: FloatArray
    last_existence: FloatArray
    score: FloatArray
    best_score: FloatArray
    covariance_scale: FloatArray
    position_bias: FloatArray
    initiated: FloatArray
    last_detected: FloatArray
    confirmed: BoolArray
    has_moved: BoolArray
    required_hits: FloatArray
    overlooked: FloatArray
    unresolved: FloatArray
    class_belief: FloatArray
    box: BoxFilter
    stationarity: Stationarity
    turn: TurnRate
    sensors: SensorEvidence

    @classmethod
    def empty(cls, classes: int = 0) -> Self:
        """A table without tracks, with beliefs over this many confused classes."""
        none, no = np.empty(0), np.empty(0, dtype=bool)
        return cls(
            id=np.empty(0, dtype=np.int64),
            label=np.empty(0, dtype="<U1"),
            existence=none,
            last_existence=none,
            score=none,
            best_score=none,
            covariance_scale=none,
            position_bias=none,
            initiated=none,
            last_detected=none,
            confirmed=no,
            has_moved=no,
            required_hits=none,
            overlooked=none,
            unresolved=none,
            class_belief=np.empty((0, classes)),
            box=BoxFilter.empty(),
            stationarity=Stationarity.empty(),
            turn=TurnRate.empty(),
            sensors=SensorEvidence.empty(),
        )

    def rows(self, ids: IntArray) -> IntArray:
        """Rows (k,) of tracks that are in the table."""
        return np.searchsorted(self.id, ids)  # ids count up

    def tentative(self, now: float) -> BoolArray:
        """(n,) tracks that may be no object of their own: unresolved, of too few detections, or of one sensor where
        a better one has lately seen nothing."""
        overlooked = now - self.overlooked <= MEMORY
        required = np.where(overlooked, np.inf, self.required_hits)
        return np.asarray((self.unresolved > 0) | ~self.sensors.confirmed(required))

    @property
    def seen_existence(self) -> FloatArray:
        """(n,) probability that the track is a real object that some sensor has in view."""
        return np.asarray(self.existence * self.sensors.seen_by_any())

    def coasting(self, now: float) -> FloatArray:
        """(n,) time since the latest detection, s, rounded to the microsecond."""
        return np.maximum(_rounded(now - self.last_detected), 0.0)

    def boxes(self, position: FloatArray, velocity: FloatArray) -> Boxes:
        """The boxes of all tracks at positions (n, 2), world, with velocities (n, 2), which are not checked."""
        centre = np.concatenate([position, self.box.z[:, None]], axis=1)
        return Boxes.unchecked(self.label, centre, self.box.size, self.box.yaw, velocity)


def _rounded(seconds: FloatArray) -> FloatArray:
    """Times (n,), s, to the microsecond: as by `round`, in half the time."""
    return np.asarray(np.rint(seconds * 1e6) / 1e6)
