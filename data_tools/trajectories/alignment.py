"""The rigid motion that brings one trajectory nearest to another.

    min over R, t of  sum_k || b_k - R a_k - t ||^2

With the means a, b removed and C = sum_k b_k a_k^T = U D V^T:  R = U diag(1, 1, det(U) det(V)) V^T,  t = b - R a.
Source: Umeyama, Least-squares estimation of transformation parameters between two point patterns, PAMI 1991 (without
scale). Where all points lie on a line, the turn about that line is not determined by them; the one returned is then
the smallest that brings the line onto its image.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from data_tools.trajectories.trajectory import Trajectory
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, checked
from saga_fg.numerics.geometry import inverse_transform

Alignment = Literal["rigid", "start", "none"]

_ON_A_LINE = 1e-12  # second singular value over the first one


def rigid_alignment(source: ArrayLike, target: ArrayLike) -> FloatArray:
    """target_T_source (4, 4) that brings points (n, 3) nearest to their namesakes (n, 3), n >= 1."""
    a = checked("source", source, (None, 3))
    b = checked("target", target, a.shape)
    if not len(a):
        raise InputError("source: expected at least one point")
    center_a, center_b = a.mean(axis=0), b.mean(axis=0)
    U, D, Vt = np.linalg.svd((b - center_b).T @ (a - center_a))
    if D[1] <= _ON_A_LINE * max(D[0], np.finfo(float).tiny):
        R = _shortest_turn(Vt[0], U[:, 0]) if D[0] > 0 else np.eye(3)
    else:
        R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))]) @ Vt
    target_T_source = np.eye(4)
    target_T_source[:3, :3] = R
    target_T_source[:3, 3] = center_b - R @ center_a
    return target_T_source


def aligned(estimate: Trajectory, truth: Trajectory, alignment: Alignment = "rigid") -> Trajectory:
    """`estimate` in the coordinates of `truth`; both of the same length, pose for pose.

    rigid: moved as a whole to lie nearest, which leaves the error of the shape; start: moved so that the first poses
    agree, which leaves the drift; none: as it is. Raises `InputError` for other names and different lengths.
    """
    if len(estimate) != len(truth):
        raise InputError(f"estimate: expected {len(truth)} poses, one for each of the truth, got {len(estimate)}")
    match alignment:
        case "rigid":
            return estimate.transformed(rigid_alignment(estimate.positions, truth.positions))
        case "start":
            return estimate.transformed(truth.world_T_ego[0] @ inverse_transform(estimate.world_T_ego[0]))
        case "none":
            return estimate
    raise InputError(f"alignment: expected one of {', '.join(get_args(Alignment))}, got {alignment!r}")


def _shortest_turn(a: FloatArray, b: FloatArray) -> FloatArray:
    """The rotation (3, 3) by the smallest angle that takes the unit vector a to b."""
    axis, cosine = np.cross(a, b), float(a @ b)
    if cosine < -1 + 1e-12:  # opposite: half a turn about anything across
        across = np.cross(a, np.eye(3)[np.argmin(np.abs(a))])
        across /= np.linalg.norm(across)
        return np.asarray(2 * np.outer(across, across) - np.eye(3))
    K = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.asarray(np.eye(3) + K + K @ K / (1 + cosine))
