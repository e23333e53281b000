"""The graph of LiDAR SLAM as files for other tools: keyframes, odometry, loops, poles, walls, curbs.

graph.g2o          poses, the first one's prior, odometry and loops, poles
observations.csv   keyframe, landmark, kind, value, covariance: all observations of landmarks of the map, the value as
                   the kind has it (a wall nx ny nz d, a pole x y z), the covariance as its upper triangle

The pose graph holds the first pose as a prior, odometry and loops as they were in the solution, the poses as estimated,
and poles as points whose height is open. Walls and curbs, which its format has no records for, are in the
table beside it. The vehicle's sensors are left out.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import pairwise
from pathlib import Path

import numpy as np

from data_tools.files.atomic_files import write_text
from data_tools.pose_graphs import write_g2o
from pipelines.slam.lidar_slam import START, LidarSlamResult
from pipelines.slam.scan_content import POLE
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import transform_points
from saga_fg.slam.pose_graph import LandmarkObservations as PoseGraphObservations
from saga_fg.slam.pose_graph import PointLandmarks, PoseGraph, PosePriors
from saga_fg.types.landmark import Landmark

_HEIGHT = 100.0  # m, standard deviation of the height of an observed pole


def pose_graph_of(result: LidarSlamResult) -> PoseGraph:
    """Keyframes 0 .. M - 1 with the odometry between them and the loops, and poles from M on; M > 1."""
    odometry = result.motions(result.drive.keyframes)
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
        _pole_landmarks(result),
        PosePriors(np.zeros(1, dtype=np.int64), result.drive.poses[0][None], np.linalg.inv(START)[None]),
    )


def _pole_landmarks(result: LidarSlamResult) -> PointLandmarks | None:
    marks = {mark.number: mark for mark in result.landmarks if mark.kind == POLE}
    seen = [one for one in result.observations if one.landmark in marks]
    if not seen:
        return None
    numbers = np.array(sorted(marks), dtype=np.int64)
    pose, landmark = (np.array([getattr(one, end) for one in seen], dtype=np.int64) for end in ("pose", "landmark"))
    z, information = np.array([one.observation.value for one in seen]), np.zeros((len(seen), 3, 3))
    information[:, :2, :2] = np.linalg.inv([one.observation.covariance for one in seen])
    information[:, 2, 2] = _HEIGHT**-2
    row = np.searchsorted(numbers, landmark)
    height = np.zeros(len(numbers))
    heights = [transform_points(result.world_T_lidar[k], point[None])[0, 2] for k, point in zip(pose, z, strict=True)]
    np.add.at(height, row, heights)
    height /= np.bincount(row, minlength=len(numbers))
    places = np.column_stack([np.array([marks[number].state for number in numbers.tolist()]), height])
    observed = PoseGraphObservations("point", pose, row, z, information)
    return PointLandmarks(len(result.keyframes) + numbers, (observed,), places)


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


Motion = tuple[FloatArray, FloatArray]

_COLUMNS = ("keyframe", "landmark", "kind", "value", "covariance")


def write_graph(folder: Path, result: LidarSlamResult) -> None:
    """Write both files to a folder that exists; a graph of one keyframe is none."""
    if len(result.keyframes) < 2:
        return
    write_g2o(folder / "graph.g2o", pose_graph_of(result))
    marks = {mark.number for mark in result.landmarks}
    rows = [",".join(_COLUMNS)]
    for one in result.observations:
        if one.landmark in marks:
            z, P = one.observation.value, one.observation.covariance
            fields = (z, P[np.triu_indices(len(P))])
            value, covariance = (" ".join(f"{x:.17g}" for x in field) for field in fields)
            rows.append(f"{one.pose},{one.landmark},{one.observation.kind.name},{value},{covariance}")
    write_text(folder / "observations.csv", "\n".join(rows) + "\n")
