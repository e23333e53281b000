r"""The latest evidence of each sensor on every track, and their fusion into one score.

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

from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.numerics.columns import Columns

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
