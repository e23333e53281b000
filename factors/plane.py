"""Planes: seen from a pose, and objects that stand on one.

An oriented plane seen from a pose: a wall, a facade, the ground.

The plane n . x + d = 0 of the world (n of length 1, pointing to the side it is seen from) is, in the frame of a pose
world_T_pose = (R, t),

    n' = R^T n,        d' = n . t + d,        z = (n', d') + noise in the tangent (two angles of the normal, distance)

Wraps GTSAM's `OrientedPlane3Factor` (Trevor, Rogers and Christensen, "Planar surface SLAM with 3D and 2D sensors", ICRA
2012), which takes whatever four numbers it is given for a plane.

An object on a plane: on the ground, which is a landmark.

    r = n . p + d - height

p is the place of the object's centre in its state, height (m) how far the centre is above the plane, (n, d) the plane
n . x + d = 0 with its normal upwards. Moved by its tangent the normal is Exp(B xi) n to first order n + B xi, with B
the basis GTSAM steps in; so dr/dp = n, dr/dxi = p^T B, dr/dd = 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from factors.between import gaussian_noise
from factors.manifolds import Manifold, Vector
from factors.measurement import checked_components
from factors.nonlinear import ResidualFactor
from factors.robust import RobustLoss
from factors.validation import FactorError, FloatArray, checked, checked_keys

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


def on_plane_factor(
    key: int,
    plane_key: int,
    height: float,
    variance: float,
    state_dim: int,
    position: tuple[int, int, int] = (0, 1, 2),
    robust: RobustLoss | None = None,
) -> ResidualFactor:
    """Return the factor of an object on a plane.

    key: the object (a vector of `state_dim`); plane_key: a `gtsam.OrientedPlane3`; height: m; variance: m^2; position:
    where the place of its centre, m, sits in the state. Raises `FactorError`.
    """
    checked_components("position", position, state_dim, least=3)
    function = _OnPlane(float(checked("height", height, ())), state_dim, tuple(position))
    return ResidualFactor(
        keys=(key, plane_key),
        variables=(Vector(state_dim), OrientedPlane()),
        residual=function.residual,
        covariance=np.reshape(checked("variance", variance, ()), (1, 1)),
        jacobians=function.jacobians,
        robust=robust,
        name="object on a plane",
    )


@dataclass(frozen=True)
class _OnPlane:
    height: float
    state_dim: int
    position: tuple[int, ...]

    def residual(self, state: FloatArray, plane: gtsam.OrientedPlane3) -> FloatArray:
        p = state[list(self.position)]
        return np.array([plane.normal().point3() @ p + plane.distance() - self.height])

    def jacobians(self, state: FloatArray, plane: gtsam.OrientedPlane3) -> Sequence[FloatArray]:
        J_state = np.zeros((1, self.state_dim))
        J_state[0, list(self.position)] = plane.normal().point3()
        turns = state[list(self.position)] @ plane.normal().basis()
        return [J_state, np.concatenate([turns, [1.0]])[None]]
