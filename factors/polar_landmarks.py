"""Ranges and bearings to landmarks, from poses: beacons, radar reflectors, points of a scanner.

    range            z = || l - t || + v
    bearing, range   z = (direction of R^T (l - t), || l - t ||) + v

Wraps GTSAM's `RangeFactor*` and `BearingRangeFactor*`. A range alone does not say where its landmark stands: several,
from places that are not on one line, do, and outliers (echoes) are what robust losses are for. The Jacobians of
directions in space are exact at the measured direction and lack the curvature of the sphere away from it.
"""

from __future__ import annotations

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from factors.between import noise_model
from factors.errors import FactorError
from factors.robust import RobustLoss
from factors.validation import checked, checked_keys


def range_factor(
    pose_key: int, point_key: int, distance: float, variance: float, planar: bool, robust: RobustLoss | None = None
) -> gtsam.NonlinearFactor:
    """Return GTSAM's factor of a range from a pose to a point.

    distance: > 0, m; variance: m^2; planar: whether they are a `gtsam.Pose2` and a vector of 2, or a `gtsam.Pose3` and
    a vector of 3. Raises `FactorError`.
    """
    keys = checked_keys("keys", [pose_key, point_key])
    measured = _distance(distance)
    noise = noise_model("variance", np.reshape(checked("variance", variance, ()), (1, 1)), 1, robust)
    kind = gtsam.RangeFactor2D if planar else gtsam.RangeFactor3D
    return kind(keys[0], keys[1], measured, noise)


def bearing_range_factor(
    pose_key: int,
    point_key: int,
    bearing: float | ArrayLike,
    distance: float,
    covariance: ArrayLike,
    robust: RobustLoss | None = None,
) -> gtsam.NonlinearFactor:
    """Return GTSAM's factor of bearing and range from a pose to a point.

    bearing: rad, from a `gtsam.Pose2`, with covariance (2, 2) of bearing and range; or a direction (3,) of length 1, in
    the frame of a `gtsam.Pose3`, with covariance (3, 3) of its two turns and the range. Raises `FactorError`.
    """
    pose_name, point_name = checked_keys("keys", [pose_key, point_key])
    measured = _distance(distance)
    if np.ndim(bearing) == 0:
        angle = gtsam.Rot2(float(checked("bearing", bearing, ())))
        noise = noise_model("covariance", covariance, 2, robust)
        return gtsam.BearingRangeFactor2D(pose_name, point_name, angle, measured, noise)
    direction = checked("bearing", bearing, (3,))
    if abs(np.linalg.norm(direction) - 1) > 1e-6:
        raise FactorError(f"bearing: expected a direction of length 1, got {np.linalg.norm(direction):.6g}")
    noise = noise_model("covariance", covariance, 3, robust)
    return gtsam.BearingRangeFactor3D(pose_name, point_name, gtsam.Unit3(direction), measured, noise)


def _distance(distance: float) -> float:
    measured = float(checked("distance", distance, ()))
    if measured <= 0:
        raise FactorError(f"distance: expected a number > 0, got {measured}")
    return measured
