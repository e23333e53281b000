"""The part of a track that the graph does not couple: size, height and heading, filtered object by object.

size      running mean weighted by detection probability
height    scalar Kalman filter, random walk
heading   scalar Kalman filter on the circle, random walk; a detector's heading may be off by half a turn, so that a
          measurement is first turned to the side of the estimate. On which side is the front, the detections vote,
          each with its probability, and a clear motion decides
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.numerics.columns import Columns
from saga_fg.numerics.geometry import wrap_angle

HEIGHT_DRIFT = 0.1  # standard deviation after one second, m
MOVING = 2.0  # speed from which the motion tells front from rear, m/s
MOST_VOTES = 5.0  # that the past has, so that it can be outvoted


@dataclass(eq=False)
class BoxFilter(Columns):
    """Columns over n tracks: size (n, 3), size_weight, z, z_variance, yaw, yaw_variance, votes (n,); NaN is unknown.

    votes: for the front being where yaw points, less those against it; >= 0
    """

    size: FloatArray
    size_weight: FloatArray
    z: FloatArray
    z_variance: FloatArray
    yaw: FloatArray
    yaw_variance: FloatArray
    votes: FloatArray

    @classmethod
    def empty(cls) -> BoxFilter:
        none = np.empty(0)
        return cls(np.empty((0, 3)), none, none, none, none, none, none)

    @classmethod
    def born(
        cls,
        size: FloatArray,
        weight: FloatArray,
        z: FloatArray,
        z_noise: FloatArray,
        yaw: FloatArray,
        yaw_noise: FloatArray,
    ) -> BoxFilter:
        """Filters of new tracks from their first detections; noises are standard deviations."""
        known = np.isfinite(size).all(axis=1)
        votes = np.where(np.isfinite(yaw), weight, 0.0)
        return cls(size.copy(), np.where(known, weight, 0.0), z.copy(), z_noise**2, yaw.copy(), yaw_noise**2, votes)

    def predict(self, dt: float, yaw_drift: FloatArray) -> None:
        self.z_variance = self.z_variance + HEIGHT_DRIFT**2 * dt
        self.yaw_variance = self.yaw_variance + yaw_drift**2 * dt

    def update(
        self,
        rows: IntArray,
        size: FloatArray,
        weight: FloatArray,
        z: FloatArray,
        z_noise: FloatArray,
        yaw: FloatArray,
        yaw_noise: FloatArray,
    ) -> None:
        """Take in one detection each for the tracks `rows` (k,)."""
        total = self.size_weight[rows] + weight
        known = np.asarray(np.isfinite(size).all(axis=1))
        old = np.where(np.isfinite(self.size[rows]), self.size[rows], size)
        mixed = old + (weight / total)[:, None] * (size - old)
        self.size[rows] = np.where(known[:, None], mixed, self.size[rows])
        self.size_weight[rows] = np.where(known, np.minimum(total, 20.0), self.size_weight[rows])
        gain = self.z_variance[rows] / (self.z_variance[rows] + z_noise**2)
        self.z[rows] += gain * (z - self.z[rows])
        self.z_variance[rows] *= 1 - gain
        self._update_yaw(rows, yaw, yaw_noise**2, weight)

    def _update_yaw(self, rows: IntArray, yaw: FloatArray, variance: FloatArray, weight: FloatArray) -> None:
        measured = np.isfinite(yaw)
        rows, yaw, variance, weight = rows[measured], yaw[measured], variance[measured], weight[measured]
        first = ~np.isfinite(self.yaw[rows])
        self.yaw[rows[first]], self.yaw_variance[rows[first]] = yaw[first], variance[first]
        difference = wrap_angle(yaw - self.yaw[rows])
        against = np.abs(difference) > np.pi / 2
        difference = np.where(against, wrap_angle(difference + np.pi), difference)
        gain = np.where(first, 0.0, self.yaw_variance[rows] / (self.yaw_variance[rows] + variance))
        self.yaw[rows] = wrap_angle(self.yaw[rows] + gain * difference)
        self.yaw_variance[rows] *= 1 - gain
        self.votes[rows] = np.minimum(self.votes[rows] + np.where(against, -weight, weight), MOST_VOTES)
        self._turn(self.votes < 0)

    def face_motion(self, velocity: FloatArray) -> None:
        """Turn headings round that point against a clear motion; velocity (n, 2), zero where it is not clear."""
        along = np.cos(self.yaw) * velocity[:, 0] + np.sin(self.yaw) * velocity[:, 1]
        self._turn(along < -MOVING)
        self.votes = np.where(np.abs(along) > MOVING, MOST_VOTES, self.votes)

    def turn_with(self, before: FloatArray, after: FloatArray, hidden: BoolArray) -> None:
        """Turn the headings of what is clearly in motion as its velocity (n, 2) turns in a prediction.

        Only of what is `hidden` (n,): headings that are measured tell more than the course of the neighbours does.
        """
        cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
        moving = hidden & (np.hypot(*before.T) > MOVING)
        turn = np.where(moving, np.arctan2(cross, (before * after).sum(axis=1)), 0.0)
        self.yaw = wrap_angle(self.yaw + turn)

    def _turn(self, rows: BoolArray) -> None:
        self.yaw = np.where(rows, wrap_angle(self.yaw + np.pi), self.yaw)
        self.votes = np.abs(self.votes)
