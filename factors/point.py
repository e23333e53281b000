"""A point landmark seen from a pose: in the plane or in space.

    r = R^T (l - t) - z,        world_T_pose = (R, t), landmark l, both in world coordinates, z in the pose's frame

With the pose moved by its tangent to (R Exp(w), t + R v):

    dr/dw = [R^T (l - t)]x   (in the plane: (y, -x) of that vector),    dr/dv = -1,    dr/dl = R^T

GTSAM has no such factor in Python; its `BearingRangeFactor*` measure the same in polar coordinates, see
`bearing_range_factor`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from factors.robust import RobustLoss
from factors.rotations import cross_matrix
from factors.stacked import ResidualFactors
from factors.validation import FloatArray, checked, checked_covariances
from factors.variables import PlanarPose, SpatialPose


def point_factors(
    rows: ArrayLike, z: ArrayLike, covariances: ArrayLike, robust: RobustLoss | None = None
) -> ResidualFactors:
    """Return n factors of points seen from poses.

    rows: (n, 2) keys of the pose and of the point (a vector of d); z: (n, d), m, in the pose's frame, d = 2 for
    `gtsam.Pose2`, 3 for `gtsam.Pose3`; covariances: (n, d, d), or one for all, m^2. Raises `FactorError`.
    """
    values = np.asarray(z)
    d = 2 if values.ndim == 2 and values.shape[1] == 2 else 3
    measured = checked("z", z, (None, d)).copy()
    function = Point(measured)
    return ResidualFactors(
        rows=np.asarray(rows),
        dims=(PlanarPose() if d == 2 else SpatialPose(), d),
        residual=function.residual,
        covariances=checked_covariances("covariances", covariances, len(measured), d),
        jacobians=function.jacobians,
        robust=robust,
        name="points seen from poses",
    )


@dataclass(frozen=True, eq=False)
class Point:
    """The residual and its derivatives, for n points (n, d) seen at `z` (n, d)."""

    z: FloatArray

    def residual(self, pose: FloatArray, point: FloatArray) -> FloatArray:
        return self._seen(pose, point) - self.z

    def jacobians(self, pose: FloatArray, point: FloatArray) -> Sequence[FloatArray]:
        n, d = self.z.shape
        seen = self._seen(pose, point)
        shift = np.broadcast_to(-np.eye(d), (n, d, d))
        if d == 2:
            turn = np.stack([seen[:, 1], -seen[:, 0]], axis=1)[:, :, None]
            J_pose = np.concatenate([shift, turn], axis=2)
        else:
            J_pose = np.concatenate([cross_matrix(seen), shift], axis=2)
        return [J_pose, pose[:, :d, :d].swapaxes(1, 2)]

    def _seen(self, pose: FloatArray, point: FloatArray) -> FloatArray:
        d = self.z.shape[1]
        offset = point - pose[:, :d, d]
        return np.asarray((pose[:, :d, :d].swapaxes(1, 2) @ offset[:, :, None])[:, :, 0])
