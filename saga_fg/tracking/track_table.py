"""The table of tracks, with the belief of their class and the evidence of each sensor.

The table of tracks: one row a track, one column an attribute, all that is known of tracks besides the joint state.

The joint state (`saga_fg.tracking.joint_state`) is kept by id, since tracks are correlated in it.

Class of an object: a discrete belief of its track over the classes that detectors mistake for each other.

    L_j(c)    = A_s(z_j | c)                              likelihood of class c by detection j of the class z_j
    cost_ij  += -2 log sum_c b_i(c) L_j(c)                in association, within the group
    b_i(c)   <- b_i(c) L_j(c) / sum                       in the update, when j is matched to i

A_s(z | c) is the chance that sensor s reports an object of class c as a z. False detections are counted by class, so
that this is the ratio of likelihoods of `saga_fg.tracking.association` again. A track's class is the likeliest, the
present one if several are; its score counts by the belief in that class. Beliefs are kept away from 0 and 1: a detector
that errs in one frame errs in the next as well. Between groups, and outside of all, nothing is matched, and a track
keeps its first class.

Source: Bar-Shalom, Kirubarajan, Gokberk, Tracking with Classification-Aided Multiframe Data Association, IEEE
Transactions on Aerospace and Electronic Systems 41(3), 2005.

The latest evidence of each sensor on every track, and their fusion into one score.

    logit P = logit prior + sum over sensors of   logit p - logit prior      detected, p the calibrated probability
                                                  log(1 - P_D)               an opportunity, and has never detected it
                                                  0                          out of view, or no recent evidence

P is the probability that the track has an object, if sensors err independently of one another. With a single sensor
it is that sensor's p. Sensors report at different times, so that the latest evidence of each counts for a while. A
sensor that has detected the object before and misses it now adds nothing: intermittent objects are a matter of
existence.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from saga_fg.model.sensor import Sensor
from saga_fg.numerics.arrays import BoolArray, Columns, FloatArray, IntArray, StrArray, distinct
from saga_fg.tracking.track_filters import BoxFilter, Stationarity, TurnRate
from saga_fg.types.boxes import Boxes

PRIOR_LOGIT = math.log(0.3 / 0.7)  # of a detection whose score says nothing
MANY_SENSORS = 32  # from here on, sensors without a part in any track are forgotten: names come from outside
LARGEST_LOGIT = 7.0  # a sum of many sensors is no certainty, since they do not err quite independently


@dataclass(eq=False)
class SensorEvidence(Columns):
    """Columns over n tracks and S sensors.

    logit          (n, S) latest evidence of each sensor, as log-odds
    detected       (n, S) whether that was a detection
    time           (n, S) of it, s, -inf if there was none
    hits           (n, S) frames in which the sensor detected the track
    opportunities  (n, S) frames in which the sensor could have detected it
    in_view        (n, S) whether it was in the field of view in the sensor's latest frame
    sensors        names (S,), of the whole table
    """

    logit: FloatArray
    detected: BoolArray
    time: FloatArray
    hits: IntArray
    opportunities: IntArray
    in_view: BoolArray
    sensors: tuple[str, ...]

    @classmethod
    def empty(cls, tracks: int = 0, sensors: Sequence[str] = ()) -> Self:
        """Tracks of which no sensor has reported anything."""
        shape = (tracks, len(sensors))
        counts = np.zeros(shape, dtype=np.int64)
        unseen = np.full(shape, -np.inf)
        no = np.zeros(shape, dtype=bool)
        return cls(np.zeros(shape), no, unseen, counts, counts.copy(), no.copy(), tuple(sensors))

    def initiated(self, sensor: str, probability: FloatArray, now: float) -> Self:
        """Return the evidence of new tracks, each from a detection by the sensor with this probability (k,)."""
        at = self._column(sensor)
        new = self.empty(len(probability), self.sensors)
        new.logit[:, at], new.time[:, at] = _logit(probability) - PRIOR_LOGIT, now
        new.detected[:, at], new.hits[:, at], new.opportunities[:, at], new.in_view[:, at] = True, 1, 1, True
        return new

    def update(
        self, sensor: str, now: float, seen: IntArray, probability: FloatArray, missed: BoolArray, chance: FloatArray
    ) -> None:
        """Take in a frame: `seen` tracks (k,), their probabilities (k,); `missed` ones (n,), by the chance (n,) to
        detect them."""
        at = self._column(sensor)
        self.opportunities[missed, at] += 1
        self.opportunities[seen, at] += 1
        missed = missed & (self.hits[:, at] == 0)
        self.logit[missed, at] = np.log(1 - np.minimum(chance[missed], 0.99))
        self.logit[seen, at] = _logit(probability) - PRIOR_LOGIT
        self.detected[missed, at], self.detected[seen, at] = False, True
        self.time[missed, at] = self.time[seen, at] = now
        self.hits[seen, at] += 1

    def join(self, rows: IntArray, others: IntArray) -> None:
        """Add what is known of tracks `others` (k,) to tracks `rows` (k,), which missed all detections of theirs."""
        newer = self.time[others] > self.time[rows]
        for column in (self.logit, self.detected, self.time):
            column[rows] = np.where(newer, column[others], column[rows])
        self.hits[rows] += self.hits[others]
        self.opportunities[rows] = np.maximum(self.opportunities[rows], self.hits[rows])

    def look(self, sensor: str, visible: BoolArray) -> BoolArray:
        """Note which tracks (n,) a frame of the sensor has in view; return those in view of some sensor's latest frame.

        A sensor that falls silent keeps its field of view, so that an outage of one sensor ends no track.
        """
        at = self._column(sensor)
        self.in_view[:, at] = visible
        return np.asarray(self.in_view.any(axis=1))

    def probability(self, now: float, memory: float) -> FloatArray:
        """P (n,) by the evidence of the last `memory` s, NaN for tracks that no sensor has detected since."""
        recent = now - self.time <= memory
        logit = PRIOR_LOGIT + np.where(recent, self.logit, 0.0).sum(axis=1)
        p = 1 / (1 + np.exp(-np.clip(logit, -LARGEST_LOGIT, LARGEST_LOGIT)))
        return np.where((recent & self.detected).any(axis=1), p, np.nan)

    def detected_by_others(self, sensor: str, now: float, memory: float) -> BoolArray:
        """(n,) which tracks another sensor has detected in the last `memory` s."""
        at = self._column(sensor)
        if len(self.sensors) == 1:
            return np.zeros(len(self), dtype=bool)
        seen = self.detected & (now - self.time <= memory)
        seen[:, at] = False
        return np.asarray(seen.any(axis=1))

    def best_hits(self) -> tuple[FloatArray, FloatArray]:
        """Hits (n,) and opportunities (n,) of the sensor with the best hit ratio of each track."""
        if len(self.sensors) == 1:
            return self.hits[:, 0].astype(np.float64), self.opportunities[:, 0].astype(np.float64)
        best = ((self.hits + 0.0) / (self.opportunities + 1.0)).argmax(axis=1)[:, None]
        hits, total = (np.take_along_axis(count, best, axis=1)[:, 0] for count in (self.hits, self.opportunities))
        return hits.astype(np.float64), total.astype(np.float64)

    def confirmed(self, detections: FloatArray) -> BoolArray:
        """(n,) which tracks two sensors have detected, or one at least this often (n,)."""
        if len(self.sensors) == 1:
            return np.asarray(self.hits[:, 0] >= detections)
        return np.asarray(((self.hits > 0).sum(axis=1) > 1) | (self.hits.sum(axis=1) >= detections))

    def _column(self, sensor: str) -> int:
        """The number of a sensor's column; a sensor not met before gets a new one."""
        if sensor not in self.sensors:
            kept = np.arange(len(self.sensors))
            if len(kept) >= MANY_SENSORS:  # forget those that have detected none of the present tracks
                kept = np.flatnonzero(self.hits.any(axis=0))
            new = self.empty(len(self.logit), [sensor])
            for name in ("logit", "detected", "time", "hits", "opportunities", "in_view"):
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
    covariance_scale  (n,) factor on the reported standard deviation of the position, see `saga_fg.tracking.reporting`
    position_bias     (n,) standard deviation of the position error that all its detections share, m
    initiated         (n,) time of its first detection
    last_detected     (n,) time of its latest detection
    last_in_view      (n,) time when it was last inside a sensor's field of view
    confirmed         (n,) whether misses no longer delete it
    has_moved         (n,) whether it was ever clearly in motion
    opportunities     (n,) frames in which its best sensor could have detected it
    hits              (n,) frames in which that sensor detected it
    required_hits     (n,) detections after which it is no longer tentative, if they are of one sensor
    unresolved        (n,) further frames to tell it from the track that it overlaps, see `saga_fg.tracking.initiation`
    class_belief      (n, C) probabilities of the classes that detectors mistake for each other
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
    last_in_view: FloatArray
    confirmed: BoolArray
    has_moved: BoolArray
    opportunities: FloatArray
    hits: FloatArray
    required_hits: FloatArray
    unresolved: FloatArray
    class_belief: FloatArray
    box: BoxFilter
    stationarity: Stationarity
    turn: TurnRate
    sensors: SensorEvidence

    @classmethod
    def empty(cls, classes: int = 0) -> Self:
        """A table without tracks; `classes`: C."""
        number, truth = np.empty(0), np.empty(0, dtype=bool)
        return cls(
            np.empty(0, dtype=np.int64),
            np.empty(0, dtype="<U1"),
            *(number,) * 9,
            *(truth,) * 2,
            *(number,) * 4,
            np.empty((0, classes)),
            BoxFilter.empty(),
            Stationarity.empty(),
            TurnRate.empty(),
            SensorEvidence.empty(),
        )

    def snapshot(self) -> Self:
        """A copy that shares no array with this table that can be written."""
        return self.copied()

    def rows(self, ids: IntArray) -> IntArray:
        """Rows (k,) of tracks that are in the table."""
        return np.searchsorted(self.id, ids)  # ids count up

    @property
    def tentative(self) -> BoolArray:
        """(n,) tracks that may be no object of their own: of too few detections, or unresolved."""
        return np.asarray((self.unresolved > 0) | ~self.sensors.confirmed(self.required_hits))

    def coasting(self, now: float) -> FloatArray:
        """(n,) time since the latest detection, s, rounded to the microsecond."""
        return np.maximum(_rounded(now - self.last_detected), 0.0)

    def out_of_view(self, now: float) -> FloatArray:
        """(n,) time since it was last in a sensor's field of view, s, rounded to the microsecond."""
        return _rounded(now - self.last_in_view)

    def boxes(self, position: FloatArray, velocity: FloatArray) -> Boxes:
        """The boxes of all tracks at positions (n, 2), world, with velocities (n, 2), which are not checked."""
        centre = np.concatenate([position, self.box.z[:, None]], axis=1)
        return Boxes.unchecked(self.label, centre, self.box.size, self.box.yaw, velocity)


def _rounded(seconds: FloatArray) -> FloatArray:
    """Times (n,), s, to the microsecond: as by `round`, in half the time."""
    return np.asarray(np.rint(seconds * 1e6) / 1e6)


LEAST_BELIEF = 1e-3  # in each class of the group


class ClassGroups:
    """C classes in groups of those that are mistaken for each other; beliefs and likelihoods are (..., C), 0 outside
    of the group."""

    def __init__(self, groups: Sequence[Sequence[str]]) -> None:
        self._groups = tuple(tuple(group) for group in groups)
        self.classes = tuple(label for group in self._groups for label in group)
        self._number = [number for number, group in enumerate(self._groups) for _ in group]
        self._column = {label: k for k, label in enumerate(self.classes)}
        self._of_label: dict[str, int] = {}  # numbers as `numbers` gives them

    def __len__(self) -> int:
        return len(self.classes)

    def same_group(self, labels: StrArray, others: StrArray) -> BoolArray:
        """(n, m) which classes (n,) equal others (m,) or share a group with them."""
        return np.asarray(self.numbers(labels)[:, None] == self.numbers(others))

    def numbers(self, label: StrArray) -> IntArray:
        """(n,) equal for classes that equal each other or share a group, also between calls."""
        classes, of_row = distinct(label)
        return np.array([self._of_label.get(c) or self._numbered(c) for c in classes], dtype=np.int64)[of_row]

    def _numbered(self, label: str) -> int:
        column = self._column.get(label)
        first = label if column is None else self._groups[self._number[column]][0]
        return self._of_label.setdefault(label, self._of_label.setdefault(first, len(self._of_label) + 1))

    def pairs_of_group(self, labels: StrArray, others: StrArray, i: IntArray, j: IntArray) -> BoolArray:
        """(K,) whether the classes of labels[i] and others[j], i and j (K,), are one or share a group."""
        return np.asarray(self.numbers(labels)[i] == self.numbers(others)[j])

    def likelihood(self, label: StrArray, sensor: Sensor) -> FloatArray:
        """L (m, C) of detections of the classes `label` (m,) by a sensor."""
        if not self.classes:
            return np.empty((len(label), 0))
        row, of_group = self._rows(label)
        return np.asarray(self._confusion(sensor)[row] * of_group[:, None])

    def updated(self, belief: FloatArray, likelihood: FloatArray) -> FloatArray:
        """Beliefs (k, C) after a detection of likelihood (k, C) each; by that alone where there is no belief yet."""
        if not self.classes:
            return belief
        of_group = likelihood > 0
        before = np.where(belief.sum(axis=1, keepdims=True) > 0, belief, of_group)
        after = before * likelihood
        after = after / np.maximum(after.sum(axis=1, keepdims=True), 1e-300)
        after = np.where(of_group, np.maximum(after, LEAST_BELIEF), 0.0)
        return np.asarray(after / np.maximum(after.sum(axis=1, keepdims=True), 1e-300))

    def labels(self, belief: FloatArray, label: StrArray) -> StrArray:
        """The likeliest classes (n,) by beliefs (n, C), of tracks that had the classes `label` (n,)."""
        row, of_group = self._rows(label)
        had = np.where(of_group, belief[np.arange(len(label)), row], np.inf)
        best = belief.argmax(axis=1)
        likelier = belief.max(axis=1, initial=0.0) > had + 1e-9
        if not likelier.any():
            return label
        return np.where(likelier, np.array(self.classes)[best], label)

    def certainty(self, belief: FloatArray) -> FloatArray:
        """(n,) largest belief of (n, C); 1 outside of all groups."""
        most = belief.max(axis=1, initial=0.0)
        return np.where(most > 0, most, 1.0)

    def _rows(self, label: StrArray) -> tuple[IntArray, BoolArray]:
        """Columns (n,) of labels (n,), 0 for those outside of all groups, and which are inside of one (n,)."""
        occurring, index = distinct(label)
        column = np.array([self._column.get(c, -1) for c in occurring], dtype=np.int64)[index]
        return np.maximum(column, 0), column >= 0

    def _confusion(self, sensor: Sensor) -> FloatArray:
        """A (C, C): by reported class, the chance of it for each true class of its group, 0 for others."""
        A = np.zeros((len(self), len(self)))
        for group in self._groups:
            rows = [self._column[label] for label in group]
            A[np.ix_(rows, rows)] = sensor.confusion_among(group).T
        return A


@dataclass(frozen=True, eq=False)
class ClassEvidence:
    """Evidence of a frame: belief (n, C) of the tracks, likelihood (m, C) of the detections."""

    groups: ClassGroups
    belief: FloatArray
    likelihood: FloatArray
