"""Trajectories: formats, alignment and errors; velocities of annotated objects.

Alignment of trajectories by the rigid motion with the least squared distances.

    min over R, t of  sum_k || b_k - R a_k - t ||^2

With the means a, b removed and C = sum_k b_k a_k^T = U D V^T:  R = U diag(1, 1, det(U) det(V)) V^T,  t = b - R a.
Source: Umeyama, Least-squares estimation of transformation parameters between two point patterns, PAMI 1991 (without
scale). If all points lie on a line, R is the smallest rotation that brings the line onto its image.

Absolute and relative errors of a trajectory (ATE and RPE).

With P_k the true and Q_k the estimated world_T_ego, Q already aligned with P:

    absolute, of each pose        e_k = || p_k - q_k ||
    relative, over d m of path    E_i = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j),      j(i) = the first pose with s_j - s_i >= d

s being the true path's length. The relative error of a start i has a translation || trans E_i || in m and a rotation
|| log rot E_i || in rad; i runs through all poses with d more metres of path ahead. It does not depend on the
alignment. Sources: Sturm et al., A benchmark for the evaluation of RGB-D SLAM systems, IROS 2012 (ATE, RPE); Geiger et
al., Are we ready for autonomous driving?, CVPR 2012 (relative errors by length of path).

Trajectories in KITTI's format: a line a pose, its upper three rows row by row; times in a file of their own.

    poses.txt   r11 r12 r13 tx r21 r22 r23 ty r31 r32 r33 tz
    times.txt   seconds

Source: the development kit of the KITTI odometry benchmark, https://www.cvlibs.net/datasets/kitti/eval_odometry.php.

Trajectories in the format of the TUM RGB-D benchmark: a line a pose, with its time and a unit quaternion.

    # timestamp tx ty tz qx qy qz qw

Seconds and metres; lines that start with # are comments. Source: Sturm et al., A benchmark for the evaluation of RGB-D
SLAM systems, IROS 2012; https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats.

Velocities of annotated objects by central differences of their positions.

    v_k = (p_{k+r} - p_{k-r}) / (t_{k+r} - t_{k-r})

over the annotations k of one object in order of time; at the ends of its annotations the difference is one-sided. With
r = 1 and 1.5 s as the longest gap this is `NuScenes.box_velocity` of the nuScenes development kit.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Self, get_args

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from data_tools.files import read_table, write_text
from saga_fg.errors import InputError, error_context
from saga_fg.numerics import (
    BoolArray,
    FloatArray,
    IntArray,
    StrArray,
    checked,
    inverse_transform,
    is_rotation,
    quaternion_norms,
    quaternion_rotation,
    refuse,
    rigid_transforms,
)

__all__ = [
    "Alignment",
    "Trajectory",
    "TrajectoryErrors",
    "absolute_errors",
    "aligned",
    "matched",
    "read_kitti_poses",
    "read_tum_poses",
    "relative_errors",
    "rigid_alignment",
    "rotation_angle",
    "trajectory_errors",
    "write_kitti_poses",
    "write_tum_poses",
]

_ORTHONORMAL = 1e-4  # largest allowed entry of R R^T - 1, as in `checked_transform`


@dataclass(frozen=True, eq=False)
class Trajectory:
    """n poses of the vehicle, n >= 1.

    timestamps   (n,) s, strictly increasing
    world_T_ego  (n, 4, 4) rigid transforms, lengths in m

    Raises `InputError` naming the record: a time that does not increase, a matrix that is not rigid.
    """

    timestamps: FloatArray
    world_T_ego: FloatArray

    def __post_init__(self) -> None:
        timestamps = checked("timestamps", self.timestamps, (None,))
        poses = checked("world_T_ego", self.world_T_ego, (len(timestamps), 4, 4))
        if not len(timestamps):
            raise InputError("timestamps: expected at least one pose")
        late = "timestamps[{}]: expected increasing times, got {:.6f} s after {:.6f} s"
        refuse(
            np.diff(timestamps, prepend=-np.inf) <= 0,
            lambda k: InputError(late.format(k, timestamps[k], timestamps[k - 1])),
        )
        askew = ~is_rotation(poses[:, :3, :3], _ORTHONORMAL)
        askew |= (np.abs(poses[:, 3] - [0, 0, 0, 1]) > 1e-9).any(axis=1)
        expected = "expected a rigid transform (orthonormal rotation, last row 0 0 0 1)"
        refuse(askew, lambda k: InputError(f"world_T_ego[{k}]: {expected}"))
        object.__setattr__(self, "timestamps", timestamps)
        object.__setattr__(self, "world_T_ego", poses)

    def __len__(self) -> int:
        return len(self.timestamps)

    @property
    def positions(self) -> FloatArray:
        """(n, 3) positions of the vehicle in the world, m."""
        return self.world_T_ego[:, :3, 3]

    @property
    def path_length(self) -> FloatArray:
        """(n,) length of the path from the first pose on, m."""
        steps = np.linalg.norm(np.diff(self.positions, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])

    def select(self, rows: BoolArray | IntArray | slice) -> Self:
        """The poses of a mask, of increasing row indices or of a slice."""
        return type(self)(self.timestamps[rows], self.world_T_ego[rows])

    def transformed(self, target_T_world: ArrayLike) -> Self:
        """The trajectory in other world coordinates; target_T_world (4, 4)."""
        return type(self)(self.timestamps, checked("target_T_world", target_T_world, (4, 4)) @ self.world_T_ego)


def matched(estimate: Trajectory, truth: Trajectory, tolerance: float = 0.01) -> tuple[Trajectory, Trajectory]:
    """The poses of both at common times: each pose of `estimate` with the nearest of `truth`, within `tolerance` s.

    A pose of the truth is used once, for the estimate nearest to it in time. Raises `InputError` if there is no pair.
    """
    after = np.clip(np.searchsorted(truth.timestamps, estimate.timestamps), 1, max(len(truth) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(truth) - 1)
    to_before = np.abs(estimate.timestamps - truth.timestamps[before])
    to_after = np.abs(estimate.timestamps - truth.timestamps[after])
    nearest = np.where(to_before <= to_after, before, after)
    gap = np.minimum(to_before, to_after)
    order = np.lexsort((gap, nearest))
    first = np.ones(len(order), dtype=bool)
    first[1:] = nearest[order][1:] != nearest[order][:-1]
    rows = np.sort(order[first])
    rows = rows[gap[rows] <= tolerance]
    if not len(rows):
        raise InputError(
            f"estimate: expected poses within {tolerance:g} s of the truth's, which run from "
            f"{truth.timestamps[0]:.3f} to {truth.timestamps[-1]:.3f} s; the estimate's run from "
            f"{estimate.timestamps[0]:.3f} to {estimate.timestamps[-1]:.3f} s"
        )
    return estimate.select(rows), truth.select(nearest[rows])


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


_KITTI_COLUMNS = ("r11", "r12", "r13", "tx", "r21", "r22", "r23", "ty", "r31", "r32", "r33", "tz")


def read_kitti_poses(path: str | Path, times: str | Path | None = None, period: float = 0.1) -> Trajectory:
    """Read poses and their times; without a file of times, the poses are `period` s apart and start at 0.

    Raises `InputError` naming file and line for what is not as above.
    """
    table = read_table(Path(path), (12,), "r11 r12 r13 tx r21 ... tz")
    if not len(table):
        raise InputError(f"{path}: expected a pose per line, the file is empty")
    rows = table.numbers(slice(0, 12), _KITTI_COLUMNS).reshape(-1, 3, 4)
    timestamps = (
        np.arange(len(table), dtype=np.float64) * period if times is None else _read_times(Path(times), len(table))
    )
    with error_context(str(path)):
        return Trajectory(timestamps, rigid_transforms(rows[:, :, :3], rows[:, :, 3]))


def write_kitti_poses(path: str | Path, trajectory: Trajectory, times: str | Path | None = None) -> None:
    """Write the poses and, if a file is named for them, the times; each file atomically."""
    rows = trajectory.world_T_ego[:, :3].reshape(-1, 12)
    write_text(path, "".join(" ".join(f"{value:.9e}" for value in row) + "\n" for row in rows.tolist()))
    if times is not None:
        write_text(times, "".join(f"{time!r}\n" for time in trajectory.timestamps.tolist()))


def _read_times(path: Path, poses: int) -> FloatArray:
    table = read_table(path, (1,), "seconds")
    if len(table) != poses:
        raise InputError(f"{path}: expected {poses} times, one per pose, got {len(table)}")
    return table.numbers(slice(0, 1), ("time",))[:, 0]


_TUM_COLUMNS = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")
_UNIT = 1e-3  # how far a quaternion's norm may be off 1, for files of few digits


def read_tum_poses(path: str | Path) -> Trajectory:
    """Read a trajectory; quaternions are normalised. Raises `InputError` naming file and line for what is broken."""
    table = read_table(Path(path), (8,), "timestamp tx ty tz qx qy qz qw", comment="#")
    if not len(table):
        raise InputError(f"{path}: expected a pose per line, there is none")
    numbers = table.numbers(slice(0, 8), _TUM_COLUMNS)
    norm = quaternion_norms(numbers[:, 4:])
    expected = "qx qy qz qw: expected a unit quaternion"
    refuse(np.abs(norm - 1) > _UNIT, lambda row: table.fault(row, f"{expected}, got norm {norm[row]:.6g}"))
    rotation = quaternion_rotation(numbers[:, [7, 4, 5, 6]] / norm[:, None])
    with error_context(str(path)):
        return Trajectory(numbers[:, 0], rigid_transforms(rotation, numbers[:, 1:4]))


def write_tum_poses(path: str | Path, trajectory: Trajectory) -> None:
    """Write a trajectory atomically; of the two quaternions of a rotation the one with qw >= 0."""
    quaternions = Rotation.from_matrix(trajectory.world_T_ego[:, :3, :3]).as_quat(canonical=True)
    rows = np.column_stack([trajectory.positions, quaternions]).tolist()
    lines = ["# timestamp tx ty tz qx qy qz qw\n"]
    for time, row in zip(trajectory.timestamps.tolist(), rows, strict=True):
        lines.append(f"{time!r} " + " ".join(f"{value:.9f}" for value in row) + "\n")
    write_text(path, "".join(lines))


def central_differences(
    instance: StrArray, time: FloatArray, position: FloatArray, longest_gap: float, reach: int = 1
) -> FloatArray:
    """Velocities (N, 2), m/s, of annotations with instance names (N,), times (N,) in s, positions (N, 2) in m.

    The annotations come in any order. `reach` is r above. Unknown (NaN) for an object annotated once, and where more
    than `longest_gap` s per annotation lie between the two annotations.
    """
    n = len(instance)
    velocity = np.full((n, 2), np.nan)
    if n < 2:
        return velocity
    order = np.lexsort((time, instance))
    same = instance[order][1:] == instance[order][:-1]
    rank = np.arange(n)
    previous: IntArray = rank - np.append(False, same)
    following: IntArray = rank + np.append(same, False)
    before, after = rank, rank
    for _ in range(reach):
        before, after = previous[before], following[after]
    t, p = time[order], position[order]
    elapsed = t[after] - t[before]
    known = (elapsed > 0) & (elapsed <= longest_gap * (after - before))
    with np.errstate(over="ignore"):  # infinite positions are refused elsewhere
        velocity[order[known]] = (p[after] - p[before])[known] / elapsed[known, None]
    return velocity
