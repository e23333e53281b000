"""Trajectories in the format of the TUM RGB-D benchmark: a line a pose, with its time and a unit quaternion.

    # timestamp tx ty tz qx qy qz qw

Seconds and metres; lines that start with # are comments. Source: Sturm et al., A benchmark for the evaluation of RGB-D
SLAM systems, IROS 2012; https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from data_tools.files.atomic_files import write_text
from data_tools.files.error_messages import error_context
from data_tools.files.text_tables import read_table
from data_tools.trajectories.trajectory import Trajectory
from saga_fg.errors import InputError
from saga_fg.numerics.geometry import quaternion_norms, quaternion_rotation

_COLUMNS = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")
_UNIT = 1e-3  # how far a quaternion's norm may be off 1, for files of few digits


def read_tum_poses(path: str | Path) -> Trajectory:
    """Read a trajectory; quaternions are normalised. Raises `InputError` naming file and line for what is broken."""
    table = read_table(Path(path), (8,), "timestamp tx ty tz qx qy qz qw", comment="#")
    if not len(table):
        raise InputError(f"{path}: expected a pose per line, there is none")
    numbers = table.numbers(slice(0, 8), _COLUMNS)
    norm = quaternion_norms(numbers[:, 4:])
    if (np.abs(norm - 1) > _UNIT).any():
        row = int(np.argmax(np.abs(norm - 1) > _UNIT))
        raise table.fault(row, f"qx qy qz qw: expected a unit quaternion, got norm {norm[row]:.6g}")
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3, :3] = quaternion_rotation(numbers[:, [7, 4, 5, 6]] / norm[:, None])
    poses[:, :3, 3] = numbers[:, 1:4]
    with error_context(str(path)):
        return Trajectory(numbers[:, 0], poses)


def write_tum_poses(path: str | Path, trajectory: Trajectory) -> None:
    """Write a trajectory atomically; of the two quaternions of a rotation the one with qw >= 0."""
    quaternions = Rotation.from_matrix(trajectory.world_T_ego[:, :3, :3]).as_quat(canonical=True)
    rows = np.column_stack([trajectory.positions, quaternions]).tolist()
    lines = ["# timestamp tx ty tz qx qy qz qw\n"]
    for time, row in zip(trajectory.timestamps.tolist(), rows, strict=True):
        lines.append(f"{time!r} " + " ".join(f"{value:.9f}" for value in row) + "\n")
    write_text(path, "".join(lines))
