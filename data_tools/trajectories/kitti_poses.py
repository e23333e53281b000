"""Trajectories in KITTI's format: a line a pose, its upper three rows row by row; times in a file of their own.

    poses.txt   r11 r12 r13 tx r21 r22 r23 ty r31 r32 r33 tz
    times.txt   seconds

Source: the development kit of the KITTI odometry benchmark, https://www.cvlibs.net/datasets/kitti/eval_odometry.php.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from data_tools.files.atomic_files import write_text
from data_tools.files.error_messages import error_context
from data_tools.files.text_tables import read_table
from data_tools.trajectories.trajectory import Trajectory
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray

_COLUMNS = ("r11", "r12", "r13", "tx", "r21", "r22", "r23", "ty", "r31", "r32", "r33", "tz")


def read_kitti_poses(path: str | Path, times: str | Path | None = None, period: float = 0.1) -> Trajectory:
    """Read poses and their times; without a file of times, the poses are `period` s apart and start at 0.

    Raises `InputError` naming file and line for what is not as above.
    """
    table = read_table(Path(path), (12,), "r11 r12 r13 tx r21 ... tz")
    if not len(table):
        raise InputError(f"{path}: expected a pose per line, the file is empty")
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3] = table.numbers(slice(0, 12), _COLUMNS).reshape(-1, 3, 4)
    timestamps = (
        np.arange(len(table), dtype=np.float64) * period if times is None else _read_times(Path(times), len(table))
    )
    with error_context(str(path)):
        return Trajectory(timestamps, poses)


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
