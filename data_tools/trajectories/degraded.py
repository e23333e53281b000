"""Odometry made worse: what a poor device would have reported of a known path."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from saga_fg.arrays import FloatArray
from saga_fg.ego import Odometry, OdometryNoise


def degraded_odometry(odometry: Odometry, noise: OdometryNoise, rng: np.random.Generator) -> Odometry:
    """`odometry` with errors drawn from the model of `noise`: independent ones, a scale and a bias that wander.

    What the estimator is told is the model alone, never what was drawn.
    """
    n, dt = len(odometry.a_T_b), odometry.dt
    if n == 0:
        return odometry
    deviations = np.sqrt(np.diagonal(noise.covariances(odometry.distance, dt), axis1=1, axis2=2))
    drawn = deviations * rng.standard_normal((n, 8))
    slow = rng.standard_normal(2) * [noise.scale, noise.bias] + np.cumsum(drawn[:, 6:], axis=0)
    bias = np.zeros((n, 3))
    bias[:, 2] = slow[:, 1] * dt
    a_T_b = odometry.a_T_b.copy()
    a_T_b[:, :3, :3] = _rotations(bias) @ a_T_b[:, :3, :3] @ _rotations(drawn[:, :3])
    a_T_b[:, :3, 3] = a_T_b[:, :3, 3] * (1 + slow[:, :1]) + drawn[:, 3:6]
    return Odometry(odometry.timestamps, a_T_b)


def _rotations(vector: FloatArray) -> FloatArray:
    return np.asarray(Rotation.from_rotvec(vector).as_matrix())
