"""Ranges and bearings to landmarks, from poses: beacons, radar reflectors, points of a scanner.

    range              z = || l - t || + v
    bearing, range     z = (direction of R^T (l - t), || l - t ||) + v
    calibrated range   z = (1 + s) || l - t || + o + v         world_T_pose = (R, t), landmark l, calibration (s, o)

The first two wrap GTSAM's `RangeFactor*` and `BearingRangeFactor*`. A range alone does not determine its landmark:
several, from places that are not on one line, do. Robust losses are for outliers (echoes). The Jacobians of directions
in space are exact at the measured direction and lack the curvature of the sphere away from it.

Radios measure the time of flight with clocks and delays of their own: one scale and one offset for all ranges, which
are states of the same graph and known as well as odometry's scale lets them be. With u the unit vector towards the
beacon, and the pose in the plane moved to t + R v:

    dr/dv = -(1 + s) u^T R      dr/dl = (1 + s) u^T      dr/ds = || l - t ||      dr/do = 1
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from factors.between import noise_model
from factors.errors import FactorError
from factors.robust import RobustLoss
from factors.stacked import ResidualFactors, residual_factors
from factors.validation import FloatArray, checked, checked_keys
from factors.variables import PlanarPose


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


def calibrated_range_factors(
    rows: ArrayLike, z: ArrayLike, variance: float, robust: RobustLoss | None = None
) -> ResidualFactors:
    """Return n factors of ranges.

    rows: (n, 3) keys of the pose (`gtsam.Pose2`), the beacon (vector of 2) and the calibration (vector of 2: scale,
    offset in m); z: (n,) m; variance: m^2. Raises `FactorError`, when linearised also where a pose is at its beacon.
    """
    measured = checked("z", z, (None,)).copy()
    function = _Range(measured)
    noise = np.reshape(checked("variance", variance, ()), (1, 1))
    return residual_factors(function, rows, (PlanarPose(), 2, 2), noise, 1, "ranges", robust)


@dataclass(frozen=True, eq=False)
class _Range:
    z: FloatArray

    def residual(self, pose: FloatArray, beacon: FloatArray, calibration: FloatArray) -> FloatArray:
        distance = np.linalg.norm(beacon - pose[:, :2, 2], axis=1)
        residual: FloatArray = (1 + calibration[:, 0]) * distance + calibration[:, 1] - self.z
        return residual[:, None]

    def jacobians(self, pose: FloatArray, beacon: FloatArray, calibration: FloatArray) -> Sequence[FloatArray]:
        towards = beacon - pose[:, :2, 2]
        distance = np.linalg.norm(towards, axis=1)
        if (distance == 0).any():
            raise FactorError("range: the pose is at its beacon, where the direction is undefined")
        scaled = ((1 + calibration[:, :1]) * towards / distance[:, None])[:, None, :]
        J_pose = np.concatenate([-scaled @ pose[:, :2, :2], np.zeros((len(self.z), 1, 1))], axis=2)
        return [J_pose, scaled, np.stack([distance, np.ones_like(distance)], axis=1)[:, None, :]]


def _distance(distance: float) -> float:
    measured = float(checked("distance", distance, ()))
    if measured <= 0:
        raise FactorError(f"distance: expected a number > 0, got {measured}")
    return measured
