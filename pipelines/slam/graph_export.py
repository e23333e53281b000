"""The keyframes of LiDAR SLAM as a pose graph for other tools (g2o), and its landmarks as a table.

The pose graph holds odometry and loops, and the poses as they were estimated; landmarks and sensors of the vehicle,
which g2o has no records for, are left out: its own optimum is that of odometry and loops alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import pairwise
from pathlib import Path

import numpy as np

from data_tools.files.atomic_files import write_text
from pipelines.slam.lidar_slam_types import LidarSlamResult
from saga_fg.numerics.arrays import FloatArray
from saga_fg.slam.pose_graph import PoseGraph
from saga_fg.types.landmark import Landmark


def pose_graph_of(result: LidarSlamResult) -> PoseGraph:
    """Keyframes 0 .. M - 1 with the odometry between them and the loops; M > 1."""
    odometry = result.drive.motions(result.drive.keyframes)
    pairs = [*pairwise(range(len(result.keyframes))), *((loop.first, loop.second) for loop in result.loops)]
    measured = [*(T for T, _ in odometry), *(loop.first_T_second for loop in result.loops)]
    covariances = np.array([*(P for _, P in odometry), *(loop.covariance for loop in result.loops)])
    information = np.linalg.inv(covariances)
    first, second = np.array(pairs, dtype=np.int64).T
    return PoseGraph(
        np.arange(len(result.keyframes), dtype=np.int64),
        result.world_T_lidar,
        first,
        second,
        np.array(measured),
        (information + information.swapaxes(1, 2)) / 2,
    )


def write_landmark_table(path: Path, landmarks: Iterable[Landmark], pieces: Mapping[int, FloatArray]) -> None:
    """Write number, kind, observations, standard deviations of the state, and the geometry as WKT, in x and y, m.

    pieces: (n, 2, 2) ends of what was seen of walls and lines, by the number of the landmark; others are points
    """
    rows = ["number,kind,observations,deviations,geometry"]
    for mark in landmarks:
        deviations = " ".join(f"{x:.4g}" for x in np.sqrt(np.diag(mark.covariance)))
        if mark.number in pieces:
            lines = ", ".join(f"({', '.join(f'{x:.3f} {y:.3f}' for x, y in ends)})" for ends in pieces[mark.number])
            shape = f"MULTILINESTRING ({lines})" if lines else "MULTILINESTRING EMPTY"
        else:
            place = mark.kind.coordinates(mark.state)
            shape = f"POINT ({place['x']:.3f} {place['y']:.3f})" if "x" in place else "POINT EMPTY"
        rows.append(f'{mark.number},{mark.kind.name},{mark.observations},{deviations},"{shape}"')
    write_text(path, "\n".join(rows) + "\n")
