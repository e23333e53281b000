"""What is seen from the vehicle's pose: points, objects, beacons; by components, ranges or bearings.

Points and objects seen from the vehicle: factors between its pose and their places in the world.

With world_T_pose = (R, t) and the place p, a point landmark or components of an object's state,

    r = h(s) - z,        s = R^T (p - t)          h: a measurement model on s (`factors.measurement`)

and for a pose moved by its tangent to (R Exp(w), t + R v)

    ds/dw = [s]x   (in the plane: (s_y, -s_x)),    ds/dv = -1,    ds/dp = R^T

An object has a place in the plane alone. Seen from a pose in space at z (3,), the residual is how far off it stands, in
the axes of the vehicle, in which the sensor's noise is known. With E = diag(1, 1, 0) the projection along the vertical,

    r = first two rows of  R^T d,                  d = E (R z + t - (p, 0))
    dr/dw = [R^T d]x - R^T E R [z]x,    dr/dv = R^T E R,    dr/dp = -R^T E

Heights do not matter: they are filtered object by object. GTSAM's `BearingRangeFactor2D` is the planar factor of range
and bearing on a point.

Ranges and bearings to landmarks, from poses: beacons, radar reflectors, points of a scanner.

    range              z = || l - t || + v
    bearing, range     z = (direction of R^T (l - t), || l - t ||) + v
    calibrated range   z = (1 + s) || l - t || + o + v         world_T_pose = (R, t), landmark l, calibration (s, o)

The first two wrap GTSAM's `RangeFactor*` and `BearingRangeFactor*`. A range alone does not determine its landmark:
several, from places that are not on one line, do. Robust losses are for outliers (echoes). The Jacobians of directions
in space are exact at the measured direction and lack the curvature of the sphere away from it.

Radios measure the time of flight with clocks and delays of their own: one scale and one offset for all ranges, which
are states of the same graph and known as well as odometry's scale lets them be. With u the unit vector towards the
beacon, and the pose in the plane moved to t + R v:

    dr/dv = -(1 + s) u^T R      dr/dl = (1 + s) u^T      dr/ds = || l - t ||      dr/do = 1
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from factors.between import noise_model
from factors.manifolds import PlanarPose, SpatialPose, cross_matrix
from factors.measurement import MeasurementModel, RangeBearing, checked_components
from factors.measurement import position as position_model
from factors.nonlinear import ResidualFactors, residual_factors
from factors.robust import RobustLoss
from factors.validation import FactorError, FloatArray, checked, checked_keys

_LEVEL = np.diag([1.0, 1.0, 0.0])


def relative_factors(
    rows: ArrayLike,
    model: MeasurementModel,
    z: ArrayLike,
    covariances: ArrayLike,
    state_dim: int,
    position: Sequence[int] = (0, 1),
    robust: RobustLoss | None = None,
    name: str = "",
) -> ResidualFactors:
    """Return n factors of a measurement model of the place in the pose's frame.

    rows: (n, 2) keys of the pose and of the object or landmark (vector of `state_dim`); model: on states (d,), d = 2
    for `gtsam.Pose2`, 3 for `gtsam.Pose3`; z: (n, m); covariances: (n, m, m), or one for all; position: the d
    components of the state that are its place, m. Raises `FactorError`, also when linearised where h is undefined.
    """
    d = model.state_dim
    if d not in (2, 3):
        raise FactorError(f"model: expected one of a place in the plane or in space, got a state of {d} components")
    checked_components("position", position, state_dim, least=d)
    measured = checked("z", z, (None, model.dim)).copy()
    function = _Relative(model, measured, state_dim, tuple(position))
    dims = (PlanarPose() if d == 2 else SpatialPose(), state_dim)
    name = name or f"{model.name} from the vehicle"
    return residual_factors(function, rows, dims, covariances, model.dim, name, robust, model.angles)


def point_factors(
    rows: ArrayLike, z: ArrayLike, covariances: ArrayLike, robust: RobustLoss | None = None
) -> ResidualFactors:
    """Return n factors of points seen from poses.

    rows: (n, 2) keys of the pose and of the point (a vector of d); z: (n, d), m, in the pose's frame, d = 2 for
    `gtsam.Pose2`, 3 for `gtsam.Pose3`; covariances: (n, d, d), or one for all, m^2. Raises `FactorError`.
    """
    d = _dimension(z)
    place = tuple(range(d))
    return relative_factors(rows, position_model(d, place), z, covariances, d, place, robust, "points seen from poses")


def relative_range_bearing_factors(
    rows: ArrayLike,
    z: ArrayLike,
    covariances: ArrayLike,
    state_dim: int,
    position: tuple[int, int] = (0, 1),
    robust: RobustLoss | None = None,
) -> ResidualFactors:
    """Return n factors of range and bearing of objects from a `gtsam.Pose2`.

    z: (n, 2) range, m, and bearing, rad from the vehicle's heading, counterclockwise; the rest as in
    `relative_factors`.
    """
    if not (checked("z", z, (None, 2))[:, 0] > 0).all():
        raise FactorError(f"z: expected ranges > 0, got {np.asarray(z)[:, 0].min()}")
    return relative_factors(rows, RangeBearing(2), z, covariances, state_dim, position, robust)


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
    name = "objects seen from the vehicle"
    if _dimension(z) == 2:
        return relative_factors(rows, position_model(2), z, covariances, state_dim, position, robust, name)
    measured = checked("z", z, (None, 3)).copy()
    checked_components("position", position, state_dim, least=2)
    function = _Levelled(measured, state_dim, tuple(position))
    return residual_factors(function, rows, (SpatialPose(), state_dim), covariances, 2, name, robust)


def _dimension(z: ArrayLike) -> int:
    return 2 if np.ndim(z) == 2 and np.shape(z)[1] == 2 else 3


@dataclass(frozen=True, eq=False)
class _Relative:
    """h(s) - z, for n places."""

    model: MeasurementModel
    z: FloatArray
    state_dim: int
    position: tuple[int, ...]

    def residual(self, pose: FloatArray, state: FloatArray) -> FloatArray:
        return self.model.predict(self._relative(pose, state)) - self.z

    def jacobians(self, pose: FloatArray, state: FloatArray) -> Sequence[FloatArray]:
        s = self._relative(pose, state)
        n, d = s.shape
        H, shift = self.model.jacobian(s), np.broadcast_to(-np.eye(d), (n, d, d))
        if d == 2:
            by_pose = np.concatenate([shift, np.stack([s[:, 1], -s[:, 0]], axis=1)[:, :, None]], axis=2)
        else:
            by_pose = np.concatenate([cross_matrix(s), shift], axis=2)
        J_state = np.zeros((n, self.model.dim, self.state_dim))
        J_state[:, :, list(self.position)] = H @ pose[:, :d, :d].swapaxes(1, 2)
        return [H @ by_pose, J_state]

    def _relative(self, pose: FloatArray, state: FloatArray) -> FloatArray:
        """s (n, d)."""
        d = self.model.state_dim
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


def range_factor(
    pose_key: int, point_key: int, distance: float, variance: float, planar: bool, robust: RobustLoss | None = None
) -> gtsam.NonlinearFactor:
    """Return GTSAM's factor of a range from a pose to a point.

    distance: > 0, m; variance: m^2; planar: whether they are a `gtsam.Pose2` and a vector of 2, or a `gtsam.Pose3` and
    a vector of 3. Raises `FactorError`.
    """
    keys = checked_keys("keys", [pose_key, point_key])
    measured = _distance(distance)
    noise = noise_model("variance", np.reshape(checked("variance", variance, ()), (1, 1)), 1, robust)
    kind = gtsam.RangeFactor2D if planar else gtsam.RangeFactor3D
    return kind(keys[0], keys[1], measured, noise)


def bearing_range_factor(
    pose_key: int,
    point_key: int,
    bearing: float | ArrayLike,
    distance: float,
    covariance: ArrayLike,
    robust: RobustLoss | None = None,
) -> gtsam.NonlinearFactor:
    """Return GTSAM's factor of bearing and range from a pose to a point.

    bearing: rad, from a `gtsam.Pose2`, with covariance (2, 2) of bearing and range; or a direction (3,) of length 1, in
    the frame of a `gtsam.Pose3`, with covariance (3, 3) of its two turns and the range. Raises `FactorError`.
    """
    pose_name, point_name = checked_keys("keys", [pose_key, point_key])
    measured = _distance(distance)
    if np.ndim(bearing) == 0:
        angle = gtsam.Rot2(float(checked("bearing", bearing, ())))
        noise = noise_model("covariance", covariance, 2, robust)
        return gtsam.BearingRangeFactor2D(pose_name, point_name, angle, measured, noise)
    direction = checked("bearing", bearing, (3,))
    if abs(np.linalg.norm(direction) - 1) > 1e-6:
        raise FactorError(f"bearing: expected a direction of length 1, got {np.linalg.norm(direction):.6g}")
    noise = noise_model("covariance", covariance, 3, robust)
    return gtsam.BearingRangeFactor3D(pose_name, point_name, gtsam.Unit3(direction), measured, noise)


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
    return residual_factors(function, rows, (PlanarPose(), 2, 2), noise, 1, "ranges", robust)


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


def _distance(distance: float) -> float:
    measured = float(checked("distance", distance, ()))
    if measured <= 0:
        raise FactorError(f"distance: expected a number > 0, got {measured}")
    return measured
