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

from saga_fg.kernels.boxes import faced_boxes, turned_headings, updated_boxes
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.numerics.columns import Columns

HEIGHT_DRIFT = 0.1  # standard deviation after one second, m
MOVING = 2.0  # speed from which the motion tells front from rear, m/s
MOST_WEIGHT = 20.0  # limit on the weight of past sizes
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
        now = self.size, self.size_weight, self.z, self.z_variance, self.yaw, self.yaw_variance, self.votes
        later = updated_boxes(*now, rows, size, weight, z, z_noise, yaw, yaw_noise, MOST_WEIGHT, MOST_VOTES)
        for column, values in zip(now, later, strict=True):
            column[rows] = values

    def face_motion(self, velocity: FloatArray) -> None:
        """Reverse headings that point against a clear motion; velocity (n, 2), zero where it is not clear."""
        self.yaw, self.votes = faced_boxes(self.yaw, self.votes, velocity, MOVING, MOST_VOTES)

    def turn_with(self, before: FloatArray, after: FloatArray, coasting: BoolArray) -> None:
        """Turn the headings of moving, `coasting` (n,) tracks as their velocities (n, 2) turn in a prediction.

        Headings of detected tracks are left to their measurements, which are better than the course of neighbours.
        """
        self.yaw = turned_headings(self.yaw, before, after, coasting, MOVING)
