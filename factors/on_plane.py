"""An object on a plane: on the ground, which is a landmark.

    r = n . p + d - height

p is the place of the object's centre in its state, height (m) how far the centre is above the plane, (n, d) the plane
n . x + d = 0 with its normal upwards. Moved by its tangent the normal is Exp(B xi) n to first order n + B xi, with B
the basis GTSAM steps in; so dr/dp = n, dr/dxi = p^T B, dr/dd = 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from factors.measurement import checked_components
from factors.nonlinear import ResidualFactor
from factors.plane import OrientedPlane
from factors.robust import RobustLoss
from factors.validation import FloatArray, checked
from factors.variables import Vector


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
