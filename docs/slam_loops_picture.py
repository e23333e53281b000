"""The picture of the loops in docs/guides/slam.md: the path by odometry, with loops, and where loops were closed."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.loops import drive_course
from data_tools.figures import paths_from_above, png
from data_tools.files.file_access import write_bytes

SEED, DRIFT = 1, 30.0  # m


def write_loops_picture(folder: Path) -> None:
    """A simulated drive of 2 km."""
    course, result = drive_course(SEED, DRIFT)
    paths = {
        "by odometry": result.odometry.positions,
        "true": course.world_T_ego[:, :3, 3],
        "with loops": result.trajectory.positions,
    }
    ends = result.keyframes[np.array([loop.second for loop in result.loops], dtype=np.int64)]
    points = {"a loop was closed": result.trajectory.positions[ends]}
    write_bytes(folder / "slam_loops.png", png(paths_from_above(paths, points)))
