"""Priors of variables, and absolute measurements of poses: places from satellites, tilt by gravity.

Absolute measurements of a pose: its place from a satellite receiver, its tilt from an accelerometer.

    position   r = t + R a - z                                       z in the local frame, a the antenna's place, m
    attitude   r = angle between R u_pose and u_world, two turns     GTSAM's `AttitudeFactorPose3`

With the pose moved by its tangent to (R Exp(w), t + R v): dr/dv = R, dr/dw = -R [a]x (in the plane: R (-a_y, a_x)).

An accelerometer at rest measures "up" in the frame of the pose, u_pose, where the world says u_world = (0, 0, 1); a
compass does the same with north. Neither measures the turn about its own direction.

Priors of a variable, or of several together.

    phi(x) = || x - m ||_P^2

One variable's prior is the initial state of a track. A joint prior over many keys, P being their full joint
covariance, is what a filter knows of the past: all of it in one factor.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from factors.between import noise_model
from factors.gaussian import GaussianFactors, gaussian_factor, native_factor, stacked_gaussian_factors
from factors.manifolds import PlanarPose, SpatialPose, cross_matrix
from factors.nonlinear import ResidualFactors, residual_factors
from factors.robust import RobustLoss
from factors.validation import FactorError, FloatArray, checked, checked_key_array, checked_keys, whitener

_UP = (0.0, 0.0, 1.0)


def position_factor(
    pose_key: int,
    position: ArrayLike,
    covariance: ArrayLike,
    antenna: ArrayLike = (0.0, 0.0, 0.0),
    robust: RobustLoss | None = None,
) -> ResidualFactors:
    """Return the factor of a measured place, of a `gtsam.Pose2` where it is (2,), of a `gtsam.Pose3` where it is (3,).

    position: m, local frame; covariance: (2, 2) or (3, 3), m^2; antenna: (3,), where on the vehicle it is measured, m.
    Raises `FactorError`.
    """
    (key,) = checked_keys("pose_key", [pose_key])
    z = checked("position", position, (None,))
    if len(z) not in (2, 3):
        raise FactorError(f"position: expected 2 or 3 coordinates, got {len(z)}")
    function = _Place(z, checked("antenna", antenna, (3,))[: len(z)])
    pose = PlanarPose() if len(z) == 2 else SpatialPose()
    return residual_factors(function, [[key]], (pose,), covariance, len(z), "measured place", robust)


def attitude_factor(
    pose_key: int,
    seen: ArrayLike,
    variance: float,
    world: ArrayLike = _UP,
    robust: RobustLoss | None = None,
) -> gtsam.NonlinearFactor:
    """Return GTSAM's factor of a known direction seen from a `gtsam.Pose3`.

    seen: (3,) in the frame of the pose, world: (3,) the same in the world; of any length > 0. variance: rad^2, of
    either turn. Raises `FactorError`.
    """
    (key,) = checked_keys("pose_key", [pose_key])
    noise = noise_model("variance", float(checked("variance", variance, ())) * np.eye(2), 2, robust)
    return gtsam.AttitudeFactorPose3(key, _direction("world", world), noise, _direction("seen", seen))


def _direction(name: str, value: ArrayLike) -> gtsam.Unit3:
    direction = checked(name, value, (3,))
    if not np.linalg.norm(direction) > 0:
        raise FactorError(f"{name}: expected a direction, got a vector of length 0")
    return gtsam.Unit3(direction)


@dataclass(frozen=True, eq=False)
class _Place:
    z: FloatArray
    antenna: FloatArray

    def residual(self, pose: FloatArray) -> FloatArray:
        d = len(self.z)
        return pose[:, :d, d] + pose[:, :d, :d] @ self.antenna - self.z

    def jacobians(self, pose: FloatArray) -> Sequence[FloatArray]:
        d = len(self.z)
        R = pose[:, :d, :d]
        if d == 3:
            return [np.concatenate([-R @ cross_matrix(self.antenna), R], axis=2)]
        turned = R @ np.array([[-self.antenna[1]], [self.antenna[0]]])
        return [np.concatenate([R, turned], axis=2)]


def prior_factor(key: int, mean: ArrayLike, covariance: ArrayLike) -> gtsam.JacobianFactor:
    """Return the factor || x(key) - mean ||_covariance; mean: (d,), covariance: (d, d), positive definite."""
    center = checked("mean", mean, (None,))
    return gaussian_factor([key], [np.eye(len(center))], center, covariance)


def prior_factors(keys: ArrayLike, means: ArrayLike, covariances: ArrayLike) -> list[gtsam.JacobianFactor]:
    """Return one prior a key; keys: (n,); means: (n, d); covariances: (n, d, d), or one (d, d) for all."""
    return stacked_prior_factors(keys, means, covariances).native()


def stacked_prior_factors(keys: ArrayLike, means: ArrayLike, covariances: ArrayLike) -> GaussianFactors:
    """Return the factors of `prior_factors` as arrays."""
    centers = checked("means", means, (None, None))
    names = checked_key_array("keys", keys)
    checked_keys("keys", names.tolist())
    identity = np.broadcast_to(np.eye(centers.shape[1]), (*centers.shape, centers.shape[1]))
    return stacked_gaussian_factors(names[:, None], [identity], centers, covariances)


def joint_prior_factor(keys: Iterable[int], means: Sequence[ArrayLike], covariance: ArrayLike) -> gtsam.JacobianFactor:
    """Return one factor on all `keys` from their joint covariance.

    means: one vector (d_k,) a key; covariance: (D, D) with D = sum_k d_k, in the order of the keys, positive definite.
    Raises `FactorError` on anything else.
    """
    distinct = checked_keys("keys", keys)
    vectors = [checked("means", mean, (None,)) for mean in means]
    dims = [len(vector) for vector in vectors]
    if not distinct or len(vectors) != len(distinct) or 0 in dims:
        raise FactorError(f"means: expected one vector per key, got {len(vectors)} for {len(distinct)} keys")
    W = whitener("covariance", covariance, sum(dims))
    augmented = np.empty((len(W), len(W) + 1), order="F")
    augmented[:, :-1] = W
    augmented[:, -1] = W @ np.concatenate(vectors)
    return native_factor(distinct, dims, augmented)
