"""Absolute measurements of a pose: its place from a satellite receiver, its tilt from an accelerometer.

    position   r = t + R a - z                                       z in the local frame, a the antenna's place, m
    attitude   r = angle between R u_pose and u_world, two turns     GTSAM's `AttitudeFactorPose3`

With the pose moved by its tangent to (R Exp(w), t + R v): dr/dv = R, dr/dw = -R [a]x (in the plane: R (-a_y, a_x)).

An accelerometer at rest measures "up" in the frame of the pose, u_pose, where the world says u_world = (0, 0, 1); a
compass does the same with north. Neither measures the turn about its own direction.
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
from factors.rotations import cross_matrix
from factors.stacked import ResidualFactors, residual_factors
from factors.validation import FloatArray, checked, checked_keys
from factors.variables import PlanarPose, SpatialPose

_UP = (0.0, 0.0, 1.0)


def position_factor(
    pose_key: int,
    position: ArrayLike,
    covariance: ArrayLike,
    antenna: ArrayLike = (0.0, 0.0, 0.0),
    robust: RobustLoss | None = None,
) -> ResidualFactors:
    """Return the factor of a measured place, of a `gtsam.Pose2` where it is (2,), of a `gtsam.Pose3` where it is (3,).

    position: m, local frame; covariance: (2, 2) or (3, 3), m^2; antenna: (3,), where on the vehicle it is measured, m.
    Raises `FactorError`.
    """
    (key,) = checked_keys("pose_key", [pose_key])
    z = checked("position", position, (None,))
    if len(z) not in (2, 3):
        raise FactorError(f"position: expected 2 or 3 coordinates, got {len(z)}")
    function = _Place(z, checked("antenna", antenna, (3,))[: len(z)])
    pose = PlanarPose() if len(z) == 2 else SpatialPose()
    return residual_factors(function, [[key]], (pose,), covariance, len(z), "measured place", robust)


def attitude_factor(
    pose_key: int,
    seen: ArrayLike,
    variance: float,
    world: ArrayLike = _UP,
    robust: RobustLoss | None = None,
) -> gtsam.NonlinearFactor:
    """Return GTSAM's factor of a known direction seen from a `gtsam.Pose3`.

    seen: (3,) in the frame of the pose, world: (3,) the same in the world; of any length > 0. variance: rad^2, of
    either turn. Raises `FactorError`.
    """
    (key,) = checked_keys("pose_key", [pose_key])
    noise = noise_model("variance", float(checked("variance", variance, ())) * np.eye(2), 2, robust)
    return gtsam.AttitudeFactorPose3(key, _direction("world", world), noise, _direction("seen", seen))


def _direction(name: str, value: ArrayLike) -> gtsam.Unit3:
    direction = checked(name, value, (3,))
    if not np.linalg.norm(direction) > 0:
        raise FactorError(f"{name}: expected a direction, got a vector of length 0")
    return gtsam.Unit3(direction)


@dataclass(frozen=True, eq=False)
class _Place:
    z: FloatArray
    antenna: FloatArray

    def residual(self, pose: FloatArray) -> FloatArray:
        d = len(self.z)
        return pose[:, :d, d] + pose[:, :d, :d] @ self.antenna - self.z

    def jacobians(self, pose: FloatArray) -> Sequence[FloatArray]:
        d = len(self.z)
        R = pose[:, :d, :d]
        if d == 3:
            return [np.concatenate([-R @ cross_matrix(self.antenna), R], axis=2)]
        turned = R @ np.array([[-self.antenna[1]], [self.antenna[0]]])
        return [np.concatenate([R, turned], axis=2)]
