"""Trajectories of a vehicle: KITTI's and TUM's files, alignment, absolute and relative errors."""

from data_tools.trajectories.alignment import Alignment, aligned, rigid_alignment
from data_tools.trajectories.degraded import degraded_odometry
from data_tools.trajectories.errors import (
    TrajectoryErrors,
    absolute_errors,
    relative_errors,
    rotation_angle,
    trajectory_errors,
)
from data_tools.trajectories.kitti_poses import read_kitti_poses, write_kitti_poses
from data_tools.trajectories.trajectory import Trajectory, matched
from data_tools.trajectories.tum_poses import read_tum_poses, write_tum_poses

__all__ = [
    "Alignment",
    "Trajectory",
    "TrajectoryErrors",
    "absolute_errors",
    "aligned",
    "degraded_odometry",
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
