"""Points, objects and planes seen from the vehicle: factors between its pose and them.

With world_T_pose = (R, t) and the place p, a point landmark or components of an object's state,

    r = h(s) - z,        s = R^T (p - t)          h: the place itself, or a measurement model on s

and for a pose moved by its tangent to (R Exp(w), t + R v)

    ds/dw = [s]x   (in the plane: (s_y, -s_x)),    ds/dv = -1,    ds/dp = R^T

An object has a place in the plane alone. Seen from a pose in space at z (3,), the residual is how far off it stands, in
the axes of the vehicle, in which the sensor's noise is known. With E = diag(1, 1, 0) the projection along the vertical,

    r = first two rows of  R^T d,                  d = E (R z + t - (p, 0))
    dr/dw = [R^T d]x - R^T E R [z]x,    dr/dv = R^T E R,    dr/dp = -R^T E

Heights do not matter: they are filtered object by object.

A plane n . x + d = 0 of the world (n of length 1, pointing to the side it is seen from: a wall, a facade, the ground)
is, in the frame of a pose world_T_pose = (R, t),

    n' = R^T n,        d' = n . t + d,        z = (n', d') + noise in the tangent (two angles of the normal, distance)

by GTSAM's `OrientedPlane3Factor` (Trevor, Rogers and Christensen, "Planar surface SLAM with 3D and 2D sensors", ICRA
2012), which takes whatever four numbers it is given for a plane.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from factors.manifolds import PlanarPose, SpatialPose, cross_matrix
from factors.measurement import RANGE, MeasurementModel, Polar, checked_components
from factors.nonlinear import ResidualFactors, residual_factors
from factors.robust import RobustLoss
from factors.validation import FactorError, FloatArray, checked, checked_keys, whitener

_LEVEL = np.diag([1.0, 1.0, 0.0])


def relative_factors(
    rows: ArrayLike,
    z: ArrayLike,
    covariances: ArrayLike,
    state_dim: int,
    position: Sequence[int] = (0, 1),
    robust: RobustLoss | None = None,
    model: MeasurementModel | None = None,
) -> ResidualFactors:
    """Return n factors of places seen from poses.

    rows: (n, 2) keys of the pose and of the object or point (vector of `state_dim`); position: the components of the
    state that are its place, m; z: what is seen in the pose's frame:

    * without a model the place, m: (n, 2) from a `gtsam.Pose2`; (n, 3) from a `gtsam.Pose3`, where a position of two
      components is an object's, whose height does not matter
    * h of the place (n, m), with a model on places in the plane or in space, and the pose of that dimension

    covariances: (n, k, k), or one for all, k = 2 for objects, in the vehicle's axes ahead and left.
    Raises `FactorError`, also when linearised where h is undefined.
    """
    measured = checked("z", z, (len(np.asarray(rows)), None if model is None else model.dim)).copy()
    d = measured.shape[1] if model is None else model.state_dim
    if d not in (2, 3):
        raise FactorError(f"expected a place in the plane or in space, got {d} components")
    if isinstance(model, Polar) and RANGE in model.measured:
        ranges = measured[:, model.measured.index(RANGE)]
        if not (ranges > 0).all():
            raise FactorError(f"z: expected ranges > 0, got {ranges.min()}")
    checked_components("position", position, state_dim, least=2)
    pose, name = PlanarPose() if d == 2 else SpatialPose(), "places seen from the vehicle"
    if model is None and len(position) < d:
        levelled = _Levelled(measured, state_dim, tuple(position))
        return residual_factors(levelled, rows, (pose, state_dim), covariances, 2, name, robust)
    checked_components("position", position, state_dim, least=d)
    function = _Relative(model, measured, state_dim, tuple(position))
    m, angles = (d, ()) if model is None else (model.dim, model.angles)
    return residual_factors(function, rows, (pose, state_dim), covariances, m, name, robust, angles)


@dataclass(frozen=True, eq=False)
class _Relative:
    """h(s) - z, for n places."""

    model: MeasurementModel | None
    z: FloatArray
    state_dim: int
    position: tuple[int, ...]

    def residual(self, pose: FloatArray, state: FloatArray) -> FloatArray:
        s = self._relative(pose, state)
        return (s if self.model is None else self.model.predict(s)) - self.z

    def jacobians(self, pose: FloatArray, state: FloatArray) -> Sequence[FloatArray]:
        s = self._relative(pose, state)
        n, d = s.shape
        shift = np.broadcast_to(-np.eye(d), (n, d, d))
        H = -shift if self.model is None else self.model.jacobian(s)
        if d == 2:
            by_pose = np.concatenate([shift, np.stack([s[:, 1], -s[:, 0]], axis=1)[:, :, None]], axis=2)
        else:
            by_pose = np.concatenate([cross_matrix(s), shift], axis=2)
        J_state = np.zeros((n, H.shape[1], self.state_dim))
        J_state[:, :, list(self.position)] = H @ pose[:, :d, :d].swapaxes(1, 2)
        return [H @ by_pose, J_state]

    def _relative(self, pose: FloatArray, state: FloatArray) -> FloatArray:
        """s (n, d)."""
        d = len(self.position)
        offset = state[:, list(self.position)] - pose[:, :d, d]
        return np.asarray((pose[:, :d, :d].swapaxes(1, 2) @ offset[:, :, None])[:, :, 0])


@dataclass(frozen=True, eq=False)
class _Levelled:
    """First two rows of R^T d, for n objects seen from poses in space."""

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


_UNIT = 1e-6  # what the length of a normal may be off 1


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
    whitener("covariance", covariance, 3)
    noise = gtsam.noiseModel.Gaussian.Covariance(np.asarray(covariance, dtype=np.float64))
    return gtsam.OrientedPlane3Factor(seen, noise, pose_name, plane_name)
