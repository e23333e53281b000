"""Size, height and heading of tracks, which the graph does not couple, filtered track by track.

size      running mean weighted by detection probability
height    scalar Kalman filter, random walk
heading   scalar Kalman filter on the circle, random walk; a detector's heading may be off by half a turn, so that a
          measurement is first turned to the side of the estimate. The detections vote on which side is the front,
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
MOST_VOTES = 5.0  # limit on the past votes, so that later ones can outvote them


@dataclass(eq=False)
class BoxFilter(Columns):
    """Columns over n tracks: size (n, 3), size_weight, z, z_variance, yaw, yaw_variance, votes (n,); NaN is unknown.

    votes: probability-weighted votes for the front at yaw less those against it; >= 0
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
    def initiated(
        cls,
        size: FloatArray,
        weight: FloatArray,
        z: FloatArray,
        z_noise: FloatArray,
        yaw: FloatArray,
        yaw_noise: FloatArray,
    ) -> BoxFilter:
        """Return the filters of new tracks from their first detections; noises are standard deviations."""
        known = np.isfinite(size).all(axis=1)
        votes = np.where(np.isfinite(yaw), weight, 0.0)
        return cls(size.copy(), np.where(known, weight, 0.0), z.copy(), z_noise**2, yaw.copy(), yaw_noise**2, votes)

    def predict(self, dt: float, yaw_drift: FloatArray) -> None:
        """Predict by `dt` s; yaw_drift (n,), rad after one second."""
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
        share = np.divide(weight, total, out=np.zeros_like(total), where=total > 0)  # 0: no size known so far
        mixed = old + share[:, None] * (size - old)
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
        """Reverse headings that point against a clear motion; velocity (n, 2), zero where it is not clear."""
        along = np.cos(self.yaw) * velocity[:, 0] + np.sin(self.yaw) * velocity[:, 1]
        self._turn(along < -MOVING)
        self.votes = np.where(np.abs(along) > MOVING, MOST_VOTES, self.votes)

    def turn_with(self, before: FloatArray, after: FloatArray, coasting: BoolArray) -> None:
        """Turn the headings of moving, `coasting` (n,) tracks as their velocities (n, 2) turn in a prediction.

        Headings of detected tracks are left to their measurements, which are better than the course of neighbours.
        """
        cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
        moving = coasting & (np.hypot(*before.T) > MOVING)
        turn = np.where(moving, np.arctan2(cross, (before * after).sum(axis=1)), 0.0)
        self.yaw = wrap_angle(self.yaw + turn)

    def _turn(self, rows: BoolArray) -> None:
        self.yaw = np.where(rows, wrap_angle(self.yaw + np.pi), self.yaw)
        self.votes = np.abs(self.votes)
