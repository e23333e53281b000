"""Ranges of a device whose scale and offset are unknown, from a pose in the plane to a beacon.

    r = (1 + s) || l - t || + o - z,        world_T_pose = (R, t), beacon l, calibration (s, o)

Radios measure the time of flight with clocks and delays of their own: one scale and one offset for all ranges, which
are states of the same graph and known as well as odometry's scale lets them be. With u the unit vector towards the
beacon, and the pose moved to t + R v:

    dr/dv = -(1 + s) u^T R      dr/dl = (1 + s) u^T      dr/ds = || l - t ||      dr/do = 1

With (s, o) = 0 this is `range_factor`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from factors.errors import FactorError
from factors.robust import RobustLoss
from factors.stacked import ResidualFactors
from factors.validation import FloatArray, checked, checked_covariances
from factors.variables import PlanarPose


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
    return ResidualFactors(
        rows=np.asarray(rows),
        dims=(PlanarPose(), 2, 2),
        residual=function.residual,
        covariances=checked_covariances("variance", noise, len(measured), 1),
        jacobians=function.jacobians,
        robust=robust,
        name="ranges",
    )


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
