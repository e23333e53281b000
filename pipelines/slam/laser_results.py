"""Results of SLAM with a planar laser.

trajectory.tum, matched.tum, odometry.tum   the path at every scan: the result, by scan matching alone, by the wheels
poses.g2o       keyframes and all measurements between them that were kept
map.png         occupancy, with the path; figures.json: counts, entropy of the map, time
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from data_tools.figures import write_figures
from data_tools.files.atomic_files import atomic_directory, write_bytes
from data_tools.laser import LaserLog, OccupancyGrid
from data_tools.plots import occupancy_picture, png
from data_tools.pose_graphs import write_g2o
from data_tools.trajectories import write_tum_poses
from pipelines.slam.laser_slam import LaserPath
from pipelines.slam.results import planar_trajectory
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.planar_poses import transforms


def write_laser_slam(
    output: Path, log: LaserLog, path: LaserPath, largest_range: float, seconds: float
) -> dict[str, float]:
    """Write the results, and return the figures. Poses are sorted by time; of two at one time the first is kept."""
    grid = _grid(log, path, path.poses, largest_range)
    lasted = float(log.time.max() - log.time.min())
    figures: dict[str, float] = {
        "scans": len(log),
        "keyframes": len(path.keyframes),
        "loops": path.loops,
        "false_loops": path.rejected,
        "jumps_of_the_wheels": path.jumps,
        "scale_of_the_wheels": path.wheel_scale,
        "entropy": grid.entropy,
        "entropy_scan_matching": _grid(log, path, path.matched, largest_range).entropy,
        "seconds": seconds,
        "times_real_time": lasted / seconds if seconds > 0 else np.inf,
    }
    _, first = np.unique(log.time, return_index=True)
    wheels = transforms(log.odometry)
    wheels = np.linalg.inv(wheels[0]) @ wheels
    with atomic_directory(output) as folder:
        for name, poses in (("trajectory", path.poses), ("matched", path.matched), ("odometry", wheels)):
            write_tum_poses(folder / f"{name}.tum", planar_trajectory(log.time[first], poses[first]))
        write_g2o(folder / "poses.g2o", path.graph)
        write_bytes(
            folder / "map.png", png(occupancy_picture(grid.probability, grid.origin, grid.cell, path.poses[:, :2, 2]))
        )
        write_figures(folder / "figures.json", figures)
    return figures


def _grid(log: LaserLog, path: LaserPath, poses: FloatArray, largest_range: float) -> OccupancyGrid:
    laser = transforms(log.robot_T_laser[None])[0]
    scans = [log.points(row, largest_range) for row in path.keyframes.tolist()]
    return OccupancyGrid.of(scans, poses[path.keyframes] @ laser)
