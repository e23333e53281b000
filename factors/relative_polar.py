"""Range and bearing of an object, seen from a vehicle in the plane.

z = (rho, beta), m and rad, from the pose world_T_ego = (R, t) to the position p among the components of the object's
state. With s = R^T (p - t) = (s_x, s_y) and rho = |s|,

    r = (rho - z_rho, atan2(s_y, s_x) - z_beta)

    drho/ds = s^T / rho,    dbeta/ds = (-s_y, s_x) / rho^2,    ds/dp = R^T,    ds/dt = -1,    ds/dheading = (s_y, -s_x)

for a pose moved in its own frame. Undefined where the object is at the vehicle itself. GTSAM's `BearingRangeFactor2D`
is the same on a point instead of a state.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from factors.errors import FactorError
from factors.measurement import checked_components
from factors.robust import RobustLoss
from factors.stacked import ResidualFactors
from factors.validation import FloatArray, checked, checked_covariances
from factors.variables import PlanarPose


def relative_range_bearing_factors(
    rows: ArrayLike,
    z: ArrayLike,
    covariances: ArrayLike,
    state_dim: int,
    position: tuple[int, int] = (0, 1),
    robust: RobustLoss | None = None,
) -> ResidualFactors:
    """Return n factors of objects seen from the vehicle.

    rows: (n, 2) keys of the pose (`gtsam.Pose2`) and of the object (vector of `state_dim`); z: (n, 2) range, m, and
    bearing, rad from the vehicle's heading, counterclockwise; covariances: (n, 2, 2), or one for all; position: where
    the position sits in the object's state. Raises `FactorError`.
    """
    measured = checked("z", z, (None, 2))
    checked_components("position", position, state_dim, least=2)
    if not (measured[:, 0] > 0).all():
        raise FactorError(f"z: expected ranges > 0, got {measured[:, 0].min()}")
    function = _RangeBearing(measured.copy(), state_dim, tuple(position))
    return ResidualFactors(
        rows=np.asarray(rows),
        dims=(PlanarPose(), state_dim),
        residual=function.residual,
        covariances=checked_covariances("covariances", covariances, len(measured), 2),
        jacobians=function.jacobians,
        robust=robust,
        angles=(1,),
        name="range and bearing from the vehicle",
    )


@dataclass(frozen=True, eq=False)
class _RangeBearing:
    z: FloatArray
    state_dim: int
    position: tuple[int, ...]

    def residual(self, pose: FloatArray, state: FloatArray) -> FloatArray:
        s = self._seen(pose, state)
        return np.stack([np.hypot(s[:, 0], s[:, 1]), np.arctan2(s[:, 1], s[:, 0])], axis=1) - self.z

    def jacobians(self, pose: FloatArray, state: FloatArray) -> Sequence[FloatArray]:
        s = self._seen(pose, state)
        rho = np.hypot(s[:, 0], s[:, 1])
        turned = np.stack([s[:, 1], -s[:, 0]], axis=1)
        by_s = np.stack([s / rho[:, None], -turned / rho[:, None] ** 2], axis=1)
        J_pose = np.concatenate([-by_s, by_s @ turned[:, :, None]], axis=2)
        J_state = np.zeros((len(s), 2, self.state_dim))
        J_state[:, :, list(self.position)] = by_s @ pose[:, :2, :2].swapaxes(1, 2)
        return [J_pose, J_state]

    def _seen(self, pose: FloatArray, state: FloatArray) -> FloatArray:
        """s (n, 2)."""
        offset = state[:, list(self.position)] - pose[:, :2, 2]
        s = np.asarray((pose[:, :2, :2].swapaxes(1, 2) @ offset[:, :, None])[:, :, 0])
        if not (np.abs(s).max(axis=1, initial=0.0) > 0).all():
            raise FactorError("an object is at the vehicle itself, where range and bearing have no derivative")
        return s
