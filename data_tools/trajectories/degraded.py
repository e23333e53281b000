"""Degraded odometry: the increments that a poor device measures on a known path."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from saga_fg.numerics.arrays import FloatArray
from saga_fg.slam.joint import OdometryIncrements, OdometryNoise


def degraded_odometry(
    odometry: OdometryIncrements, noise: OdometryNoise, rng: np.random.Generator
) -> OdometryIncrements:
    """Odometry with errors sampled from `noise`: independent ones, and random walks of scale, bias and course."""
    n, dt = len(odometry.a_T_b), odometry.dt
    if n == 0:
        return odometry
    deviations = np.sqrt(np.diagonal(noise.covariances(odometry.distance, dt), axis1=1, axis2=2))
    sampled = deviations * rng.standard_normal(deviations.shape)
    slow = rng.standard_normal(3) * [noise.scale, noise.bias, noise.course] + np.cumsum(sampled[:, 6:], axis=0)
    bias = np.zeros((n, 3))
    bias[:, 2] = slow[:, 1] * dt
    a_T_b = odometry.a_T_b.copy()
    a_T_b[:, :3, :3] = _rotations(bias) @ a_T_b[:, :3, :3] @ _rotations(sampled[:, :3])
    course = np.zeros((n, 3))
    course[:, 2] = slow[:, 2]
    turned = (_rotations(course) @ a_T_b[:, :3, 3, None])[:, :, 0]
    a_T_b[:, :3, 3] = turned * (1 + slow[:, :1]) + sampled[:, 3:6]
    return OdometryIncrements(odometry.timestamps, a_T_b)


def _rotations(vector: FloatArray) -> FloatArray:
    return np.asarray(Rotation.from_rotvec(vector).as_matrix())
