"""Straight lines on the ground, seen from the vehicle: curbs, borders of lanes.

The state is a line in the plane, (theta, rho), in the Hesse normal form

    n . x = rho,      n = (cos theta, sin theta)

Of a piece of it two points z_1, z_2 (3,) are observed, its ends, in the frame of the pose (R, t); where along the line
they lie says nothing. The residuals are how far off the line they are in the world, from above,

    r_i = n . (R z_i + t) - rho

(E the first two axes), which needs no wrapping and is as good far from the origin as near it. (theta, rho),
(theta + 2 pi, rho) and (theta + pi, -rho) are one line; `HesseLine` goes from one line to another by the smallest
turn. With the pose moved to (R Exp(w), t + R v),

    dr_i/dw = -n^T E R [z_i]x    dr_i/dv = n^T E R    dr_i/dtheta = n' . (R z_i + t)    dr_i/drho = -1
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from factors.robust import RobustLoss
from factors.rotations import cross_matrix
from factors.stacked import ResidualFactors, residual_factors
from factors.validation import FloatArray, checked
from factors.variables import SpatialPose, Vector


@dataclass(frozen=True)
class HesseLine:
    """A line in the plane as a vector (theta, rho), rad and m; delta = (turn within a quarter, m)."""

    @property
    def dim(self) -> int:
        return 2

    def read(self, values: gtsam.Values, key: int) -> FloatArray:
        return Vector(2).read(values, key)

    def retract(self, state: FloatArray, delta: FloatArray) -> FloatArray:
        return state + delta

    def local(self, state: FloatArray, other: FloatArray) -> FloatArray:
        turn = (other[0] - state[0] + np.pi) % (2 * np.pi) - np.pi
        if abs(turn) <= np.pi / 2:
            return np.array([turn, other[1] - state[1]])
        return np.array([turn - np.copysign(np.pi, turn), -other[1] - state[1]])

    def size(self, state: FloatArray) -> FloatArray:
        return np.array([1.0, abs(state[1])])

    def array(self, state: FloatArray) -> FloatArray:
        return state


def line_factors(
    rows: ArrayLike, ends: ArrayLike, covariances: ArrayLike, robust: RobustLoss | None = None
) -> ResidualFactors:
    """Return n factors of straight lines seen from the vehicle.

    rows: (n, 2) keys of the pose (`gtsam.Pose3`) and of the line (a vector of 2: rad, m); ends: (n, 2, 3), m, in the
    frame of the pose; covariances: (n, 2, 2), or one for all, m^2, of the two ends across the line. Raises
    `FactorError`.
    """
    measured = checked("ends", ends, (None, 2, 3)).copy()
    function = _Edge(measured)
    return residual_factors(function, rows, (SpatialPose(), 2), covariances, 2, "straight lines", robust)


@dataclass(frozen=True, eq=False)
class _Edge:
    ends: FloatArray

    def residual(self, pose: FloatArray, line: FloatArray) -> FloatArray:
        n = np.stack([np.cos(line[:, 0]), np.sin(line[:, 0])], axis=1)
        return np.asarray((self._world(pose) @ n[:, :, None])[:, :, 0] - line[:, 1:])

    def jacobians(self, pose: FloatArray, line: FloatArray) -> Sequence[FloatArray]:
        c, s = np.cos(line[:, 0]), np.sin(line[:, 0])
        nR = c[:, None] * pose[:, 0, :3] + s[:, None] * pose[:, 1, :3]
        J_pose = np.empty((len(pose), 2, 6))
        for end in (0, 1):
            J_pose[:, end, :3] = -(nR[:, None, :] @ cross_matrix(self.ends[:, end]))[:, 0]
            J_pose[:, end, 3:] = nR
        turned = np.stack([-s, c], axis=1)
        by_theta = self._world(pose) @ turned[:, :, None]
        return [J_pose, np.concatenate([by_theta, np.full_like(by_theta, -1.0)], axis=2)]

    def _world(self, pose: FloatArray) -> FloatArray:
        """The ends (n, 2, 2) from above."""
        return np.asarray(self.ends @ pose[:, :2, :3].swapaxes(1, 2) + pose[:, None, :2, 3])
