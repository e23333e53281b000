"""Absolute and relative errors of a trajectory (ATE and RPE).

With P_k the true and Q_k the estimated world_T_ego, Q already aligned with P:

    absolute, of each pose        e_k = || p_k - q_k ||
    relative, over d m of path    E_i = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j),      j(i) = the first pose with s_j - s_i >= d

s being the true path's length. The relative error of a start i has a translation || trans E_i || in m and a rotation
|| log rot E_i || in rad; i runs through all poses with d more metres of path ahead. It does not depend on the
alignment. Sources: Sturm et al., A benchmark for the evaluation of RGB-D SLAM systems, IROS 2012 (ATE, RPE); Geiger et
al., Are we ready for autonomous driving?, CVPR 2012 (relative errors by length of path).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from data_tools.trajectories.alignment import Alignment, aligned
from data_tools.trajectories.trajectory import Trajectory, matched
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import inverse_transform


@dataclass(frozen=True)
class TrajectoryErrors:
    """Errors of one trajectory.

    poses                  number of compared poses
    path_length            of the truth, m
    ate                    root mean square of the absolute errors, m
    end_error              absolute error of the last pose, m
    relative_distance      d, m
    pieces                 number of compared sections of d m; 0 for a shorter path
    relative_translation   mean over the sections, m per d m; NaN without sections
    relative_rotation      mean over the sections, rad per d m; NaN without sections
    """

    poses: int
    path_length: float
    ate: float
    end_error: float
    relative_distance: float
    pieces: int
    relative_translation: float
    relative_rotation: float


def absolute_errors(estimate: Trajectory, truth: Trajectory, alignment: Alignment = "rigid") -> FloatArray:
    """Distances (n,) in m between the poses' positions after alignment. Raises `InputError` for different lengths."""
    return np.asarray(np.linalg.norm(aligned(estimate, truth, alignment).positions - truth.positions, axis=1))


def relative_errors(estimate: Trajectory, truth: Trajectory, distance: float = 10.0) -> tuple[FloatArray, FloatArray]:
    """Translation (s,) in m and rotation (s,) in rad of the relative error over each section of `distance` m.

    Raises `InputError` for trajectories of different lengths and a distance that is not positive.
    """
    if len(estimate) != len(truth):
        raise InputError(f"estimate: expected {len(truth)} poses, one for each of the truth, got {len(estimate)}")
    if not 0 < distance < np.inf:
        raise InputError(f"distance: expected a positive number of metres, got {distance!r}")
    length = truth.path_length
    end = np.searchsorted(length, length + distance * (1 - 1e-12))
    start = np.flatnonzero(end < len(truth))
    end = end[start]
    P, Q = truth.world_T_ego, estimate.world_T_ego
    E = inverse_transform(inverse_transform(Q[start]) @ Q[end]) @ (inverse_transform(P[start]) @ P[end])
    return np.linalg.norm(E[:, :3, 3], axis=1), rotation_angle(E[:, :3, :3])


def rotation_angle(rotation: FloatArray) -> FloatArray:
    """Angles (...) in [0, pi], rad, of rotation matrices (..., 3, 3)."""
    return np.asarray(Rotation.from_matrix(rotation.reshape(-1, 3, 3)).magnitude()).reshape(rotation.shape[:-2])


def trajectory_errors(
    estimate: Trajectory,
    truth: Trajectory,
    alignment: Alignment = "rigid",
    distance: float = 10.0,
    tolerance: float = 0.01,
) -> TrajectoryErrors:
    """All errors; poses are matched by time, within `tolerance` s, and aligned as in `aligned`."""
    estimate, truth = matched(estimate, truth, tolerance)
    absolute = absolute_errors(estimate, truth, alignment)
    translation, rotation = relative_errors(estimate, truth, distance)
    return TrajectoryErrors(
        poses=len(truth),
        path_length=float(truth.path_length[-1]),
        ate=float(np.sqrt(np.mean(absolute**2))),
        end_error=float(absolute[-1]),
        relative_distance=distance,
        pieces=len(translation),
        relative_translation=float(translation.mean()) if len(translation) else float("nan"),
        relative_rotation=float(rotation.mean()) if len(rotation) else float("nan"),
    )
