"""An oriented plane seen from a pose: a wall, a facade, the ground.

The plane n . x + d = 0 of the world (n of length 1, pointing to the side it is seen from) is, in the frame of a pose
world_T_pose = (R, t),

    n' = R^T n,        d' = n . t + d,        z = (n', d') + noise in the tangent (two angles of the normal, distance)

Wraps GTSAM's `OrientedPlane3Factor` (Trevor, Rogers and Christensen, "Planar surface SLAM with 3D and 2D sensors", ICRA
2012), which takes whatever four numbers it is given for a plane.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from factors.between import gaussian_noise
from factors.errors import FactorError
from factors.validation import FloatArray, checked, checked_keys
from factors.variables import Manifold

_UNIT = 1e-6  # what the length of a normal may be off 1


@dataclass(frozen=True)
class OrientedPlane(Manifold):
    """A `gtsam.OrientedPlane3`; delta = (two turns of the normal, rad; distance, m); as numbers (4,): n, d."""

    dim: ClassVar[int] = 3

    def read(self, values: gtsam.Values, key: int) -> gtsam.OrientedPlane3:
        return values.atOrientedPlane3(key)

    def size(self, state: gtsam.OrientedPlane3) -> FloatArray:
        return np.array([1.0, 1.0, abs(state.distance())])

    def array(self, state: gtsam.OrientedPlane3) -> FloatArray:
        return state.planeCoefficients()


def plane(name: str, coefficients: ArrayLike) -> gtsam.OrientedPlane3:
    """The plane of coefficients (4,) = (n, d); raises `FactorError` unless n has length 1."""
    values = checked(name, coefficients, (4,))
    length = float(np.linalg.norm(values[:3]))
    if abs(length - 1) > _UNIT:
        raise FactorError(f"{name}: expected a normal of length 1, got {length:.6g}")
    return gtsam.OrientedPlane3(np.concatenate([values[:3] / length, values[3:]]))


def plane_factor(pose_key: int, plane_key: int, z: ArrayLike, covariance: ArrayLike) -> gtsam.NonlinearFactor:
    """Return GTSAM's factor of a plane seen from a `gtsam.Pose3`.

    z: (4,) = (n', d'), in the pose's frame; covariance: (3, 3) of two turns of the normal (rad) and the distance (m).
    GTSAM's has no robust version. Raises `FactorError`.
    """
    pose_name, plane_name = checked_keys("keys", [pose_key, plane_key])
    seen = plane("z", z).planeCoefficients()
    return gtsam.OrientedPlane3Factor(seen, gaussian_noise("covariance", covariance, 3), pose_name, plane_name)
