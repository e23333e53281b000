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

from saga_fg.kernels.boxes import Shapes, faced_boxes, turned_headings, updated_boxes
from saga_fg.kernels.compilation import compiled_by
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.numerics.columns import Columns
from saga_fg.numerics.geometry import wrap_angle

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
        later = _updated(*now, rows, size, weight, z, z_noise, yaw, yaw_noise, MOST_WEIGHT, MOST_VOTES)
        for column, values in zip(now, later, strict=True):
            column[rows] = values

    def face_motion(self, velocity: FloatArray) -> None:
        """Reverse headings that point against a clear motion; velocity (n, 2), zero where it is not clear."""
        self.yaw, self.votes = _faced(self.yaw, self.votes, velocity, MOVING, MOST_VOTES)

    def turn_with(self, before: FloatArray, after: FloatArray, coasting: BoolArray) -> None:
        """Turn the headings of moving, `coasting` (n,) tracks as their velocities (n, 2) turn in a prediction.

        Headings of detected tracks are left to their measurements, which are better than the course of neighbours.
        """
        self.yaw = _turned(self.yaw, before, after, coasting, MOVING)


@compiled_by(updated_boxes)
def _updated(
    size: FloatArray,
    size_weight: FloatArray,
    z: FloatArray,
    z_variance: FloatArray,
    yaw: FloatArray,
    yaw_variance: FloatArray,
    votes: FloatArray,
    rows: IntArray,
    seen_size: FloatArray,
    weight: FloatArray,
    seen_z: FloatArray,
    z_noise: FloatArray,
    seen_yaw: FloatArray,
    yaw_noise: FloatArray,
    most_weight: float,
    most_votes: float,
) -> Shapes:
    size, size_weight, z, z_variance = size[rows], size_weight[rows], z[rows], z_variance[rows]
    total = size_weight + weight
    known = np.asarray(np.isfinite(seen_size).all(axis=1))
    old = np.where(np.isfinite(size), size, seen_size)
    share = np.divide(weight, total, out=np.zeros_like(total), where=total > 0)  # 0: no size known so far
    size = np.where(known[:, None], old + share[:, None] * (seen_size - old), size)
    size_weight = np.where(known, np.minimum(total, most_weight), size_weight)
    gain = z_variance / (z_variance + z_noise**2)
    z, z_variance = z + gain * (seen_z - z), z_variance * (1 - gain)
    before, variance, votes = yaw[rows], yaw_variance[rows], votes[rows]
    measured, first = np.isfinite(seen_yaw), ~np.isfinite(before)
    heading, variance = np.where(first, seen_yaw, before), np.where(first & measured, yaw_noise**2, variance)
    difference = wrap_angle(seen_yaw - heading)
    against = np.abs(difference) > np.pi / 2
    difference = np.where(against, wrap_angle(difference + np.pi), difference)
    gain = np.where(first, 0.0, variance / (variance + yaw_noise**2))
    heading = np.where(measured, wrap_angle(heading + gain * difference), before)
    variance = np.where(measured, variance * (1 - gain), variance)
    votes = np.where(measured, np.minimum(votes + np.where(against, -weight, weight), most_votes), votes)
    heading = np.where(votes < 0, wrap_angle(heading + np.pi), heading)
    return size, size_weight, z, z_variance, heading, variance, np.abs(votes)


@compiled_by(faced_boxes)
def _faced(
    yaw: FloatArray, votes: FloatArray, velocity: FloatArray, moving: float, most_votes: float
) -> tuple[FloatArray, FloatArray]:
    along = np.cos(yaw) * velocity[:, 0] + np.sin(yaw) * velocity[:, 1]
    turned = np.where(along < -moving, wrap_angle(yaw + np.pi), yaw)
    return turned, np.where(np.abs(along) > moving, most_votes, np.abs(votes))


@compiled_by(turned_headings)
def _turned(yaw: FloatArray, before: FloatArray, after: FloatArray, coasting: BoolArray, moving: float) -> FloatArray:
    cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    clear = coasting & (np.hypot(*before.T) > moving)
    return wrap_angle(yaw + np.where(clear, np.arctan2(cross, (before * after).sum(axis=1)), 0.0))
