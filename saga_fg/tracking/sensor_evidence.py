r"""What each sensor lately said of every track, put together: how sure a box is when several sensors look.

    logit P = logit prior + sum over sensors of   logit p - logit prior      detected, p the calibrated probability
                                                  log(1 - P_D)               looked, and has never seen it
                                                  0                          out of view, or long without a word

P is the probability that the track has an object, if sensors err independently of one another. With a single sensor
it is that sensor's p. Sensors speak at times of their own, so that the latest word of each counts for a while. A sensor
that has seen the object before and misses it now says nothing new: what comes and goes is a matter of existence.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import numpy as np

from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray

PRIOR_LOGIT = math.log(0.3 / 0.7)  # of a detection about which its score says nothing
MANY_SENSORS = 32  # from here on, sensors without a part in any track are forgotten: names come from outside
LARGEST_LOGIT = 7.0  # a sum of many sensors is no certainty, since they do not err quite independently


@dataclass(eq=False)
class SensorEvidence:
    """Of n tracks and S sensors, all (n, S) but the names.

    sensors   names (S,)
    logit     latest word of each sensor, as log-odds
    detected  whether that was a detection
    time      of it, s, -inf if there was none
    count     how often the sensor detected the track
    looks     how often it looked where the track was
    """

    sensors: tuple[str, ...]
    logit: FloatArray
    detected: BoolArray
    time: FloatArray
    count: IntArray
    looks: IntArray

    @classmethod
    def empty(cls) -> Self:
        none = np.zeros((0, 0))
        whole = np.zeros((0, 0), dtype=np.int64)
        return cls((), none, none.astype(bool), none, whole, whole)

    def select(self, rows: IntArray | BoolArray) -> None:
        """Keep these tracks."""
        self.logit, self.detected, self.time = self.logit[rows], self.detected[rows], self.time[rows]
        self.count, self.looks = self.count[rows], self.looks[rows]

    def born(self, sensor: str, probability: FloatArray, now: float) -> None:
        """New tracks, each from a detection of the sensor with this probability (k,)."""
        k, at, total = len(probability), self._of(sensor), len(self.sensors)
        logit, time, count = np.zeros((k, total)), np.full((k, total), -np.inf), np.zeros((k, total), dtype=np.int64)
        logit[:, at], time[:, at], count[:, at] = _logit(probability) - PRIOR_LOGIT, now, 1
        self.logit = np.concatenate([self.logit, logit])
        self.detected = np.concatenate([self.detected, count > 0])
        self.time = np.concatenate([self.time, time])
        self.count = np.concatenate([self.count, count])
        self.looks = np.concatenate([self.looks, count])

    def hear(
        self, sensor: str, now: float, seen: IntArray, probability: FloatArray, missed: BoolArray, chance: FloatArray
    ) -> None:
        """A frame: `seen` tracks (k,), their probabilities (k,); `missed` ones (n,), by the chance (n,) to see them."""
        at = self._of(sensor)
        self.looks[missed, at] += 1
        self.looks[seen, at] += 1
        missed = missed & (self.count[:, at] == 0)
        self.logit[missed, at] = np.log(1 - np.minimum(chance[missed], 0.99))
        self.logit[seen, at] = _logit(probability) - PRIOR_LOGIT
        self.detected[missed, at], self.detected[seen, at] = False, True
        self.time[missed, at] = self.time[seen, at] = now
        self.count[seen, at] += 1

    def probability(self, now: float, memory: float) -> FloatArray:
        """P (n,) by what was said in the last `memory` s, NaN for tracks that none has detected since."""
        fresh = now - self.time <= memory
        logit = PRIOR_LOGIT + np.where(fresh, self.logit, 0.0).sum(axis=1)
        p = 1 / (1 + np.exp(-np.clip(logit, -LARGEST_LOGIT, LARGEST_LOGIT)))
        return np.where((fresh & self.detected).any(axis=1), p, np.nan)

    def seen_by_others(self, sensor: str, now: float, memory: float) -> BoolArray:
        """Which tracks (n,) another sensor has detected in the last `memory` s."""
        at = self._of(sensor)
        seen = self.detected & (now - self.time <= memory)
        seen[:, at] = False
        return np.asarray(seen.any(axis=1))

    def steadiest(self) -> tuple[FloatArray, FloatArray]:
        """Detections (n,) and looks (n,) of the sensor that detects each track most steadily.

        What one sensor overlooks while another sees it is no less steady for that.
        """
        best = ((self.count + 0.0) / (self.looks + 1.0)).argmax(axis=1)[:, None]
        hits, looks = (np.take_along_axis(counted, best, axis=1)[:, 0] for counted in (self.count, self.looks))
        return hits.astype(np.float64), looks.astype(np.float64)

    def confirmed(self, detections: int) -> BoolArray:
        """Which tracks (n,) two sensors have seen, or one this often."""
        return np.asarray(((self.count > 0).sum(axis=1) > 1) | (self.count.sum(axis=1) >= detections))

    def _of(self, sensor: str) -> int:
        """The sensor's column, a new one at its first word."""
        if sensor not in self.sensors:
            if len(self.sensors) >= MANY_SENSORS:  # those that have detected none of the tracks there are
                self._keep_sensors(np.flatnonzero(self.count.any(axis=0)))
            n = len(self.logit)
            self.sensors = (*self.sensors, sensor)
            self.logit = np.concatenate([self.logit, np.zeros((n, 1))], axis=1)
            self.detected = np.concatenate([self.detected, np.zeros((n, 1), dtype=bool)], axis=1)
            self.time = np.concatenate([self.time, np.full((n, 1), -np.inf)], axis=1)
            self.count = np.concatenate([self.count, np.zeros((n, 1), dtype=np.int64)], axis=1)
            self.looks = np.concatenate([self.looks, np.zeros((n, 1), dtype=np.int64)], axis=1)
        return self.sensors.index(sensor)

    def _keep_sensors(self, columns: IntArray) -> None:
        self.sensors = tuple(self.sensors[k] for k in columns.tolist())
        self.logit, self.time = self.logit[:, columns], self.time[:, columns]
        self.detected = self.detected[:, columns]
        self.count, self.looks = self.count[:, columns], self.looks[:, columns]


def _logit(p: FloatArray) -> FloatArray:
    return np.asarray(np.log(p / (1 - p)))
