"""Poses and what is measured between two of them: odometry, scan registration, loop closures.

    r = log( measured^-1 first^-1 second ),    measured = first_T_second + noise in the tangent of the second pose

Wraps GTSAM's `PriorFactorPose*` and `BetweenFactorPose*`, which crash or answer nonsense where a matrix is no pose or a
covariance has another shape. Tangents are ordered as in `PlanarPose` and `SpatialPose`: (x, y, heading) in the plane,
(rotation vector, translation) in space. False loop closures are what robust losses are for.
"""

from __future__ import annotations

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from factors.errors import FactorError
from factors.robust import RobustLoss
from factors.validation import checked, checked_keys, whitener

Pose = gtsam.Pose2 | gtsam.Pose3
_ORTHONORMAL = 1e-6


def pose(name: str, matrix: ArrayLike) -> Pose:
    """The transform (3, 3) as a `gtsam.Pose2`, or (4, 4) as a `gtsam.Pose3`; `FactorError` where it is not rigid."""
    T = checked(name, matrix, (None, None))
    if T.shape not in ((3, 3), (4, 4)):
        raise FactorError(f"{name}: expected a 3 x 3 or 4 x 4 transform, got shape {T.shape}")
    d = len(T) - 1
    R = T[:d, :d]
    if np.abs(R @ R.T - np.eye(d)).max() > _ORTHONORMAL or np.linalg.det(R) < 0 or (T[d] != np.eye(d + 1)[d]).any():
        raise FactorError(f"{name}: expected a rigid transform (orthonormal rotation, last row 0 ... 0 1)")
    return gtsam.Pose2(T[0, 2], T[1, 2], np.arctan2(R[1, 0], R[0, 0])) if d == 2 else gtsam.Pose3(T)


def pose_prior_factor(
    key: int, world_T_pose: ArrayLike, covariance: ArrayLike, robust: RobustLoss | None = None
) -> gtsam.NonlinearFactor:
    """Return GTSAM's prior on a pose; world_T_pose: (3, 3) or (4, 4); covariance: (3, 3) or (6, 6) of its tangent."""
    (name,) = checked_keys("key", [key])
    mean = pose("world_T_pose", world_T_pose)
    noise = noise_model("covariance", covariance, mean.dim(), robust)
    if isinstance(mean, gtsam.Pose2):
        return gtsam.PriorFactorPose2(name, mean, noise)
    return gtsam.PriorFactorPose3(name, mean, noise)


def between_factor(
    first: int, second: int, first_T_second: ArrayLike, covariance: ArrayLike, robust: RobustLoss | None = None
) -> gtsam.NonlinearFactor:
    """Return GTSAM's factor of a pose measured in the frame of another.

    first_T_second: (3, 3) between `gtsam.Pose2` variables or (4, 4) between `gtsam.Pose3`; covariance: (3, 3) or (6, 6)
    of the tangent. Raises `FactorError`.
    """
    one, other = checked_keys("keys", [first, second])
    measured = pose("first_T_second", first_T_second)
    noise = noise_model("covariance", covariance, measured.dim(), robust)
    if isinstance(measured, gtsam.Pose2):
        return gtsam.BetweenFactorPose2(one, other, measured, noise)
    return gtsam.BetweenFactorPose3(one, other, measured, noise)


def gaussian_noise(name: str, covariance: ArrayLike, dim: int) -> gtsam.noiseModel.Gaussian:
    """GTSAM's noise model of a covariance (dim, dim); raises `FactorError` unless it is positive definite."""
    whitener(name, covariance, dim)
    return gtsam.noiseModel.Gaussian.Covariance(np.asarray(covariance, dtype=np.float64))


def noise_model(
    name: str, covariance: ArrayLike, dim: int, robust: RobustLoss | None = None
) -> gtsam.noiseModel.Gaussian | gtsam.noiseModel.Robust:
    """GTSAM's noise model of a covariance, under a robust loss if one is given."""
    gaussian = gaussian_noise(name, covariance, dim)
    return gaussian if robust is None else robust.model(gaussian)
