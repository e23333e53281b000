"""Relative poses: between two poses, and odometry with the slow errors of its device as states.

Poses and what is measured between two of them: odometry, scan registration, loop closures.

    r = log( measured^-1 first^-1 second ),    measured = first_T_second + noise in the tangent of the second pose

Wraps GTSAM's `PriorFactorPose*` and `BetweenFactorPose*`, which crash or answer nonsense where a matrix is no pose or a
covariance has another shape. Tangents are ordered as in `PlanarPose` and `SpatialPose`: (x, y, heading) in the plane,
(rotation vector, translation) in space. False loop closures are what robust losses are for.

Odometry between consecutive poses in space, with the slow errors of the device as states of their own.

A device that counts wheels or matches scans reports the increment (R_m, d) over dt seconds. Its length is wrong by a
scale s, its heading turns with a bias b, and its course is off by an angle c: the device is not mounted quite straight
beside the sensors whose axes the poses have, or the vehicle slips. All three wander slowly:

    R_m = Exp(b dt e_z) R_a^T R_b Exp(noise)
    d   = (1 + s) Exp(c e_z) R_a^T (t_b - t_a) + noise          (s, b, c)' = (s, b, c) + noise

Residuals, in the frame of the first pose (9 rows):

    r_rotation    = Log( R_m^T Exp(b dt e_z) R_a^T R_b )
    r_translation = (1 + s) Exp(c e_z) R_a^T (t_b - t_a) - d
    r_error       = (s, b, c)' - (s, b, c)

The scale stands at the true motion, not at the measured one: there it would scale the noise of d as well, and be drawn
to where that is small.

With the errors held at 0 by a prior this is the plain factor between two poses. The bias model is that of a gyroscope
mounted upright (Groves, Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems, 2nd ed. 2013,
section 4.4.1), the scale that of a wheel odometer (section 6.3).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from factors.manifolds import SpatialPose, cross_matrix, inverse_right_jacobian, rotation_exp, rotation_log
from factors.nonlinear import ResidualFactors, residual_factors
from factors.robust import RobustLoss
from factors.validation import FactorError, FloatArray, checked, checked_keys, whitener

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


def noise_model(
    name: str, covariance: ArrayLike, dim: int, robust: RobustLoss | None = None
) -> gtsam.noiseModel.Gaussian | gtsam.noiseModel.Robust:
    """GTSAM's noise model of a covariance (dim, dim), under a robust loss if one is given.

    Raises `FactorError` unless it is positive definite.
    """
    whitener(name, covariance, dim)
    gaussian = gtsam.noiseModel.Gaussian.Covariance(np.asarray(covariance, dtype=np.float64))
    return gaussian if robust is None else robust.model(gaussian)


ERROR_DIM = 3  # scale, yaw-rate bias in rad/s, course in rad
_UP = np.array([0.0, 0.0, 1.0])


def odometry_factors(
    rows: ArrayLike, a_T_b: ArrayLike, dt: ArrayLike, covariances: ArrayLike, robust: RobustLoss | None = None
) -> ResidualFactors:
    """Return n factors of odometry with slow errors.

    rows: (n, 4) keys of the pose before, the pose after (`gtsam.Pose3`), the errors before and after (vectors of 3:
    scale, yaw-rate bias in rad/s, course in rad); a_T_b: (n, 4, 4) measured increments; dt: (n,) s; covariances:
    (n, 9, 9), or one for all, of rotation (rad), translation (m) and the errors' change. Raises `FactorError`.
    """
    measured = checked("a_T_b", a_T_b, (None, 4, 4))
    seconds = checked("dt", dt, (len(measured),))
    if (seconds < 0).any():
        raise FactorError(f"dt[{int(np.argmax(seconds < 0))}]: expected seconds >= 0, got {seconds.min()}")
    function = _Odometry(measured[:, :3, :3].copy(), measured[:, :3, 3].copy(), seconds.copy())
    dims = (SpatialPose(), SpatialPose(), ERROR_DIM, ERROR_DIM)
    return residual_factors(function, rows, dims, covariances, 6 + ERROR_DIM, "odometry", robust)


@dataclass(frozen=True, eq=False)
class _Odometry:
    """R (n, 3, 3) and d (n, 3) of the increments, dt (n,)."""

    R: FloatArray
    d: FloatArray
    dt: FloatArray

    def residual(self, a: FloatArray, b: FloatArray, before: FloatArray, after: FloatArray) -> FloatArray:
        translation = self._reported(a, b, before) - self.d
        return np.concatenate([rotation_log(self._turned(a, b, before)), translation, after - before], axis=1)

    def jacobians(self, a: FloatArray, b: FloatArray, before: FloatArray, after: FloatArray) -> Sequence[FloatArray]:
        n = len(self.d)
        Ra, Rb = a[:, :3, :3], b[:, :3, :3]
        E = self._turned(a, b, before)
        inverse, moved = inverse_right_jacobian(rotation_log(E)), self._moved(a, b)
        course = (1 + before[:, 0, None, None]) * _about_up(before[:, 2])
        J_a, J_b, J_before, J_after = (np.zeros((n, 6 + ERROR_DIM, d)) for d in (6, 6, ERROR_DIM, ERROR_DIM))
        J_a[:, :3, :3] = -inverse @ Rb.swapaxes(1, 2) @ Ra
        J_b[:, :3, :3] = inverse
        axis = E.swapaxes(1, 2) @ self.R.swapaxes(1, 2) @ _UP
        J_before[:, :3, 1] = self.dt[:, None] * (inverse @ axis[:, :, None])[:, :, 0]
        J_a[:, 3:6, :3] = course @ cross_matrix(moved)
        J_a[:, 3:6, 3:] = -course
        J_b[:, 3:6, 3:] = course @ Ra.swapaxes(1, 2) @ Rb
        reported = self._reported(a, b, before)
        J_before[:, 3:6, 0] = reported / (1 + before[:, :1])
        J_before[:, 3:6, 2] = np.cross(_UP, reported)
        J_before[:, 6:] = -np.eye(ERROR_DIM)
        J_after[:, 6:] = np.eye(ERROR_DIM)
        return [J_a, J_b, J_before, J_after]

    def _turned(self, a: FloatArray, b: FloatArray, before: FloatArray) -> FloatArray:
        turned = _about_up(before[:, 1] * self.dt)
        return np.asarray(self.R.swapaxes(1, 2) @ turned @ a[:, :3, :3].swapaxes(1, 2) @ b[:, :3, :3])

    def _reported(self, a: FloatArray, b: FloatArray, before: FloatArray) -> FloatArray:
        """(n, 3) the translation as a device with these errors reports it."""
        turned = _about_up(before[:, 2]) @ self._moved(a, b)[:, :, None]
        return np.asarray((1 + before[:, :1]) * turned[:, :, 0])

    def _moved(self, a: FloatArray, b: FloatArray) -> FloatArray:
        return np.asarray((a[:, :3, :3].swapaxes(1, 2) @ (b[:, :3, 3] - a[:, :3, 3])[:, :, None])[:, :, 0])


def _about_up(angle: FloatArray) -> FloatArray:
    """Rotations (n, 3, 3) about the vertical."""
    return rotation_exp(angle[:, None] * _UP)
