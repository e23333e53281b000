"""An object seen from the vehicle: couples the pose of the vehicle with the object's place in the world.

z (3,) is the object's centre in the vehicle's frame, world_T_ego = (R, t) the pose in space, p = (x, y) the horizontal
position among the components of the object's state. With E = diag(1, 1, 0) the projection along the vertical,

    r = first two rows of  R^T E (R z + t - (p, 0)),       r ~ N(0, covariance)

is how far off the object stands, in the axes of the vehicle, in which the sensor's noise is known. Heights do not
matter: they are filtered object by object. The Jacobians, for a pose moved to (R Exp(w), t + R v), are

    dr/dw = [R^T d]x - R^T E R [z]x,    dr/dv = R^T E R,    dr/dp = -R^T E,        d = E (R z + t - (p, 0))

From a pose in the plane, with z (2,), it is a point seen from it (`factors.point`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from factors.measurement import checked_components
from factors.point import Point
from factors.robust import RobustLoss
from factors.rotations import cross_matrix
from factors.stacked import ResidualFactors
from factors.validation import FloatArray, checked, checked_covariances
from factors.variables import PlanarPose, SpatialPose

_LEVEL = np.diag([1.0, 1.0, 0.0])


def relative_detection_factors(
    rows: ArrayLike,
    z: ArrayLike,
    covariances: ArrayLike,
    state_dim: int,
    position: tuple[int, int] = (0, 1),
    robust: RobustLoss | None = None,
) -> ResidualFactors:
    """Return n factors of objects seen from the vehicle.

    rows: (n, 2) keys of the pose (`gtsam.Pose3`) and of the object (vector of `state_dim`); z: (n, 3), m, in the
    vehicle's frame, or (n, 2) from a `gtsam.Pose2`; covariances: (n, 2, 2), or one for all, m^2, in the vehicle's axes
    ahead and left; position: where the world position sits in the object's state. Raises `FactorError`.
    """
    planar = np.ndim(z) == 2 and np.shape(z)[1] == 2
    measured = checked("z", z, (None, 2 if planar else 3)).copy()
    checked_components("position", position, state_dim, least=2)
    kind = _PlanarDetection if planar else _RelativeDetection
    function = kind(measured, state_dim, tuple(position))
    return ResidualFactors(
        rows=np.asarray(rows),
        dims=(PlanarPose() if planar else SpatialPose(), state_dim),
        residual=function.residual,
        covariances=checked_covariances("covariances", covariances, len(measured), 2),
        jacobians=function.jacobians,
        robust=robust,
        name="objects seen from the vehicle",
    )


@dataclass(frozen=True, eq=False)
class _RelativeDetection:
    z: FloatArray
    state_dim: int
    position: tuple[int, ...]

    def residual(self, pose: FloatArray, state: FloatArray) -> FloatArray:
        return self._offset(pose, state)[:, :2]

    def jacobians(self, pose: FloatArray, state: FloatArray) -> Sequence[FloatArray]:
        R = pose[:, :3, :3]
        level = R.swapaxes(1, 2) @ _LEVEL @ R
        J_pose = np.concatenate([cross_matrix(self._offset(pose, state)) - level @ cross_matrix(self.z), level], axis=2)
        J_state = np.zeros((len(pose), 2, self.state_dim))
        J_state[:, :, list(self.position)] = -R[:, :2, :2].swapaxes(1, 2)
        return [J_pose[:, :2], J_state]

    def _offset(self, pose: FloatArray, state: FloatArray) -> FloatArray:
        """R^T d (n, 3)."""
        R = pose[:, :3, :3]
        d = (R @ self.z[:, :, None])[:, :, 0] + pose[:, :3, 3]
        d[:, :2] -= state[:, list(self.position)]
        d[:, 2] = 0.0
        return np.asarray((R.swapaxes(1, 2) @ d[:, :, None])[:, :, 0])


@dataclass(frozen=True, eq=False)
class _PlanarDetection:
    z: FloatArray
    state_dim: int
    position: tuple[int, ...]

    def residual(self, pose: FloatArray, state: FloatArray) -> FloatArray:
        return Point(self.z).residual(pose, state[:, list(self.position)])

    def jacobians(self, pose: FloatArray, state: FloatArray) -> Sequence[FloatArray]:
        J_pose, J_place = Point(self.z).jacobians(pose, state[:, list(self.position)])
        J_state = np.zeros((len(pose), 2, self.state_dim))
        J_state[:, :, list(self.position)] = J_place
        return [J_pose, J_state]
