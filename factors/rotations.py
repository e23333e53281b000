"""The exponential map of rotations and its derivative, for many at once.

    Log(R) = theta u,     Log(R Exp(d)) = Log(R) + Jr^-1(Log R) d + O(d^2)
    Jr^-1(w) = 1 + [w]x / 2 + (1 / theta^2 - (1 + cos theta) / (2 theta sin theta)) [w]x^2

Source: Sola, Deray and Atchuthan, A micro Lie theory for state estimation in robotics, 2018, equations 132 and 144.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from factors.validation import FloatArray

_SMALL = 1e-4  # rad, below which a series does


def cross_matrix(vector: FloatArray) -> FloatArray:
    """[v]x (..., 3, 3) of vectors (..., 3): [v]x w = v x w."""
    x, y, z = np.moveaxis(vector, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*vector.shape[:-1], 3, 3)


def rotation_log(rotation: FloatArray) -> FloatArray:
    """Rotation vectors (N, 3), rad, of rotation matrices (N, 3, 3)."""
    if len(rotation) == 0:
        return np.empty((0, 3))
    return np.asarray(Rotation.from_matrix(rotation).as_rotvec())


def rotation_exp(vector: FloatArray) -> FloatArray:
    """Rotation matrices (N, 3, 3) of rotation vectors (N, 3), rad."""
    if len(vector) == 0:
        return np.empty((0, 3, 3))
    return np.asarray(Rotation.from_rotvec(vector).as_matrix())


def inverse_right_jacobian(vector: FloatArray) -> FloatArray:
    """Jr^-1 (N, 3, 3) at rotation vectors (N, 3) shorter than 2 pi."""
    theta = np.linalg.norm(vector, axis=-1)
    safe = np.where(theta < _SMALL, 1.0, theta)
    factor = 1 / safe**2 - (1 + np.cos(safe)) / (2 * safe * np.sin(safe))
    factor = np.where(theta < _SMALL, 1 / 12 + theta**2 / 720, factor)
    W = cross_matrix(vector)
    return np.asarray(np.eye(3) + W / 2 + factor[..., None, None] * (W @ W))
