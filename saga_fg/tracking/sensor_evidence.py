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

import numpy as np

from saga_fg.arrays import BoolArray, FloatArray, IntArray

PRIOR_LOGIT = math.log(0.3 / 0.7)  # of a detection about which its score says nothing
LARGEST_LOGIT = 7.0  # a sum of many sensors is no certainty, since they do not err quite independently


class SensorEvidence:
    """Of n tracks and S sensors: the latest word of each, as log-odds (n, S), whether a detection (n, S) and when
    (n, S), and how often so far the sensor detected it (n, S) and looked where it was (n, S)."""

    def __init__(self) -> None:
        self._column: dict[str, int] = {}
        self._logit = np.zeros((0, 0))
        self._detected = np.zeros((0, 0), dtype=bool)
        self._time = np.zeros((0, 0))
        self._count = np.zeros((0, 0), dtype=np.int64)
        self._looks = np.zeros((0, 0), dtype=np.int64)

    def select(self, rows: IntArray | BoolArray) -> None:
        """Keep these tracks."""
        self._logit, self._detected = self._logit[rows], self._detected[rows]
        self._time, self._count, self._looks = self._time[rows], self._count[rows], self._looks[rows]

    def born(self, sensor: str, probability: FloatArray, now: float) -> None:
        """New tracks, each from a detection of the sensor with this probability (k,)."""
        k, at, total = len(probability), self._of(sensor), len(self._column)
        logit, time, count = np.zeros((k, total)), np.full((k, total), -np.inf), np.zeros((k, total), dtype=np.int64)
        logit[:, at], time[:, at], count[:, at] = _logit(probability) - PRIOR_LOGIT, now, 1
        self._logit = np.concatenate([self._logit, logit])
        self._detected = np.concatenate([self._detected, count > 0])
        self._time = np.concatenate([self._time, time])
        self._count = np.concatenate([self._count, count])
        self._looks = np.concatenate([self._looks, count])

    def hear(
        self, sensor: str, now: float, seen: IntArray, probability: FloatArray, missed: BoolArray, chance: FloatArray
    ) -> None:
        """A frame: `seen` tracks (k,), their probabilities (k,); `missed` ones (n,), by the chance (n,) to see them."""
        at = self._of(sensor)
        self._looks[missed, at] += 1
        self._looks[seen, at] += 1
        missed = missed & (self._count[:, at] == 0)
        self._logit[missed, at] = np.log(1 - np.minimum(chance[missed], 0.99))
        self._logit[seen, at] = _logit(probability) - PRIOR_LOGIT
        self._detected[missed, at], self._detected[seen, at] = False, True
        self._time[missed, at] = self._time[seen, at] = now
        self._count[seen, at] += 1

    def probability(self, now: float, memory: float) -> FloatArray:
        """P (n,) by what was said in the last `memory` s, NaN for tracks that none has detected since."""
        fresh = now - self._time <= memory
        logit = PRIOR_LOGIT + np.where(fresh, self._logit, 0.0).sum(axis=1)
        p = 1 / (1 + np.exp(-np.clip(logit, -LARGEST_LOGIT, LARGEST_LOGIT)))
        return np.where((fresh & self._detected).any(axis=1), p, np.nan)

    def seen_by_others(self, sensor: str, now: float, memory: float) -> BoolArray:
        """Which tracks (n,) another sensor has detected in the last `memory` s."""
        at = self._of(sensor)
        seen = self._detected & (now - self._time <= memory)
        seen[:, at] = False
        return np.asarray(seen.any(axis=1))

    def steadiest(self) -> tuple[FloatArray, FloatArray]:
        """Detections (n,) and looks (n,) of the sensor that detects each track most steadily.

        What one sensor overlooks while another sees it is no less steady for that.
        """
        best = ((self._count + 0.0) / (self._looks + 1.0)).argmax(axis=1)[:, None]
        hits, looks = (np.take_along_axis(counted, best, axis=1)[:, 0] for counted in (self._count, self._looks))
        return hits.astype(np.float64), looks.astype(np.float64)

    def confirmed(self, detections: int) -> BoolArray:
        """Which tracks (n,) two sensors have seen, or one this often."""
        return np.asarray(((self._count > 0).sum(axis=1) > 1) | (self._count.sum(axis=1) >= detections))

    def _of(self, sensor: str) -> int:
        """The sensor's column, a new one at its first word."""
        if sensor not in self._column:
            self._column[sensor] = len(self._column)
            n = len(self._logit)
            self._logit = np.concatenate([self._logit, np.zeros((n, 1))], axis=1)
            self._detected = np.concatenate([self._detected, np.zeros((n, 1), dtype=bool)], axis=1)
            self._time = np.concatenate([self._time, np.full((n, 1), -np.inf)], axis=1)
            self._count = np.concatenate([self._count, np.zeros((n, 1), dtype=np.int64)], axis=1)
            self._looks = np.concatenate([self._looks, np.zeros((n, 1), dtype=np.int64)], axis=1)
        return self._column[sensor]


def _logit(p: FloatArray) -> FloatArray:
    return np.asarray(np.log(p / (1 - p)))
