"""Rigid transforms and angles. Names carry frames: `world_T_ego` maps points from ego to world coordinates.

    p_world = world_T_ego[:3, :3] @ p_ego + world_T_ego[:3, 3]

All vehicle and world frames have z up; yaw is measured about z, from x towards y, in rad.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from saga_fg.errors import InputError
from saga_fg.numerics.arrays import BoolArray, FloatArray, checked


def wrap_angle(angle: ArrayLike) -> FloatArray:
    """Angles (any shape, rad) wrapped into [-pi, pi)."""
    wrapped = (np.asarray(angle, dtype=np.float64) + np.pi) % (2 * np.pi) - np.pi
    return np.asarray(np.where(wrapped >= np.pi, -np.pi, wrapped))  # an angle just below -pi is rounded to pi


def checked_transform(name: str, value: ArrayLike) -> FloatArray:
    """`value` as a read-only 4 x 4 rigid transform; raises `InputError` unless its rotation is orthonormal (1e-4)."""
    matrix = checked(name, value, (4, 4))
    if not is_rotation(matrix[:3, :3], 1e-4) or not np.allclose(matrix[3], [0, 0, 0, 1]):
        raise InputError(f"{name}: expected a rigid 4 x 4 transform (orthonormal rotation, last row 0 0 0 1)")
    return matrix


def is_rotation(R: FloatArray, tolerance: float) -> BoolArray:
    """Test matrices (..., 3, 3): orthonormal to within `tolerance` and no reflection."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        orthonormal = (np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3)) <= tolerance).all(axis=(-2, -1))
        return np.asarray(orthonormal & (np.linalg.det(R) > 0))


def inverse_transform(target_T_source: FloatArray) -> FloatArray:
    """source_T_target of a rigid (..., 4, 4) transform."""
    Rt = np.swapaxes(target_T_source[..., :3, :3], -1, -2)
    result = np.zeros_like(target_T_source)
    result[..., :3, :3] = Rt
    result[..., :3, 3] = -(Rt @ target_T_source[..., :3, 3:])[..., 0]
    result[..., 3, 3] = 1.0
    return result


def transform_points(target_T_source: FloatArray, points: FloatArray) -> FloatArray:
    """Points (N, 3) in source coordinates to target coordinates."""
    return points @ target_T_source[:3, :3].T + target_T_source[:3, 3]


def adjoint(a_T_b: FloatArray) -> FloatArray:
    """Adjoints (..., 6, 6) of rigid transforms: tangents (rotation, translation) in the frame of b to those in a's."""
    R, t = a_T_b[..., :3, :3], a_T_b[..., :3, 3]
    result = np.zeros((*a_T_b.shape[:-2], 6, 6))
    result[..., :3, :3] = result[..., 3:, 3:] = R
    result[..., 3:, :3] = np.cross(t[..., None, :], np.swapaxes(R, -1, -2)).swapaxes(-1, -2)
    return result


def carried_covariance(a_T_b: FloatArray, covariance: FloatArray) -> FloatArray:
    """Covariances (..., 6, 6) of tangents (rotation, translation) in the frame of b, brought into that of a."""
    Ad = adjoint(a_T_b)
    return np.asarray(Ad @ covariance @ np.swapaxes(Ad, -1, -2))


def yaw_of(rotation: FloatArray) -> FloatArray:
    """Yaw (rad) of rotation matrices (..., 3, 3): direction of the rotated x axis in the horizontal plane."""
    return np.asarray(np.arctan2(rotation[..., 1, 0], rotation[..., 0, 0]))


def yaw_transform(x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> FloatArray:
    """4 x 4 transform with translation (x, y, z) in m and a rotation by `yaw` rad about z."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, z], [0, 0, 0, 1]], dtype=np.float64)


def quaternion_yaw(quaternion: FloatArray) -> FloatArray:
    """Yaw (N,) of unit quaternions (N, 4) in (w, x, y, z) order."""
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    return np.asarray(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def yaw_quaternion(yaw: ArrayLike) -> FloatArray:
    """Unit quaternions (N, 4), (w, x, y, z), of rotations by `yaw` (N,) about z."""
    half = np.asarray(yaw, dtype=np.float64) / 2
    zero = np.zeros_like(half)
    return np.stack([np.cos(half), zero, zero, np.sin(half)], axis=-1)


def quaternion_rotation(quaternion: FloatArray) -> FloatArray:
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4) in (w, x, y, z) order."""
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def rotation_quaternion(rotation: FloatArray) -> FloatArray:
    """Unit quaternions (N, 4), (w, x, y, z) with w >= 0, of rotation matrices (N, 3, 3)."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(rotation).as_quat(canonical=True, scalar_first=True))


def quaternion_norms(quaternions: FloatArray) -> FloatArray:
    """Norms (N,) of quaternions (N, 4); infinite where they are beyond all numbers."""
    with np.errstate(over="ignore"):
        return np.asarray(np.linalg.norm(quaternions, axis=1))


def checked_quaternions(name: str, value: ArrayLike) -> FloatArray:
    """`value` as unit quaternions (N, 4), (w, x, y, z); raises `InputError` where the norm is off 1 by over 1e-3."""
    quaternions = checked(name, value, (None, 4))
    norm = quaternion_norms(quaternions)
    bad = np.abs(norm - 1) > 1e-3
    if bad.any():
        row = int(np.argmax(bad))
        raise InputError(f"{name}[{row}]: expected a unit quaternion (w, x, y, z), got norm {norm[row]:.6g}")
    return np.asarray(quaternions / norm[:, None])
