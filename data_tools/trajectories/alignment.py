"""Alignment of trajectories by the rigid motion with the least squared distances.

    min over R, t of  sum_k || b_k - R a_k - t ||^2

With the means a, b removed and C = sum_k b_k a_k^T = U D V^T:  R = U diag(1, 1, det(U) det(V)) V^T,  t = b - R a.
Source: Umeyama, Least-squares estimation of transformation parameters between two point patterns, PAMI 1991 (without
scale). If all points lie on a line, R is the smallest rotation that brings the line onto its image.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from data_tools.trajectories.trajectory import Trajectory
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, checked
from saga_fg.numerics.geometry import inverse_transform

Alignment = Literal["rigid", "start", "none"]

_ON_A_LINE = 1e-12  # second singular value over the first one


def rigid_alignment(source: ArrayLike, target: ArrayLike) -> FloatArray:
    """target_T_source (4, 4) with the least squared distances between corresponding points (n, 3), n >= 1."""
    a = checked("source", source, (None, 3))
    b = checked("target", target, a.shape)
    if not len(a):
        raise InputError("source: expected at least one point")
    center_a, center_b = a.mean(axis=0), b.mean(axis=0)
    U, D, Vt = np.linalg.svd((b - center_b).T @ (a - center_a))
    on_a_line = D[1] <= _ON_A_LINE * max(D[0], np.finfo(float).tiny)
    pairs = (U[:, :1].T, Vt[:1]) if on_a_line else (b - center_b, a - center_a)
    target_T_source = np.eye(4)
    if D[0] > 0:
        target_T_source[:3, :3] = Rotation.align_vectors(*pairs)[0].as_matrix()
    target_T_source[:3, 3] = center_b - target_T_source[:3, :3] @ center_a
    return target_T_source


def aligned(estimate: Trajectory, truth: Trajectory, alignment: Alignment = "rigid") -> Trajectory:
    """`estimate` in the coordinates of `truth`; both of the same length, pose for pose.

    rigid: least squared distances; start: equal first poses, which shows the drift; none: unchanged. Raises
    `InputError` for other names and different lengths.
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
