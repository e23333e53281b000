"""Results of SLAM as files, in a folder that is written whole or not at all.

All runs share the forms of these:

*.tum             a path in the TUM format; trajectory.txt in KITTI's
landmarks.json    each landmark: number, kind, coordinates (m), covariance of its tangent, number of observations
covariances.csv   of each pose: its name, then the upper triangle in the pose's own frame, rad and m: (x, y, heading) or
                  (rotation vector, translation)
tracks.csv        a row for each object and moment: timestamp (s), id, class, x, y (m), vx, vy (m/s) in world
                  coordinates, the standard deviations of the last four, and the probability of being stationary
above.png         the results from above

Results of SLAM with a planar laser.

trajectory.tum, matched.tum, odometry.tum   the path at every scan: the result, by scan matching alone, by the wheels
poses.g2o       keyframes and all measurements between them that were kept
map.png         occupancy, with the path; figures.json: counts, entropy of the map, time
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from data_tools.figures import write_figures
from data_tools.files.atomic_files import atomic_directory, write_bytes, write_text
from data_tools.laser import LaserLog, OccupancyGrid
from data_tools.plots import occupancy_picture, paths_from_above, png
from data_tools.pose_graphs import write_g2o
from data_tools.trajectories import Trajectory, write_tum_poses
from pipelines.slam.laser_slam import LaserPath
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.geometry import transforms
from saga_fg.slam.joint import JointEstimate
from saga_fg.slam.pose_graph import OptimisedPoses, PoseGraph
from saga_fg.types.landmark import Landmark

_CONFIRMED = 5  # detections


def landmark_row(
    number: int, kind: str, coordinates: Mapping[str, float], covariance: FloatArray, observations: int
) -> dict[str, Any]:
    """Return the entry of landmarks.json for a landmark."""
    counts = {"covariance": covariance.tolist(), "observations": observations}
    return {"number": number, "kind": kind, **coordinates, **counts}


def landmark_rows(landmarks: Iterable[Landmark]) -> list[dict[str, Any]]:
    """Return the content of landmarks.json for a map."""
    return [
        landmark_row(mark.number, mark.kind.name, mark.kind.coordinates(mark.state), mark.covariance, mark.observations)
        for mark in landmarks
    ]


def write_covariances(
    path: Path, key: str, names: Sequence[object], covariances: FloatArray, **columns: Sequence[object]
) -> None:
    """Write covariances.csv: the covariance (N, k, k) of each pose, its name in column `key`; other columns follow."""
    upper = np.triu_indices(covariances.shape[1])
    rows = [",".join([key, *columns, *(f"P{i + 1}{j + 1}" for i, j in zip(*upper, strict=True))])]
    for *entries, covariance in zip(names, *columns.values(), covariances, strict=True):
        rows.append(",".join([*map(str, entries), *(f"{x:.9g}" for x in covariance[upper])]))
    write_text(path, "\n".join(rows) + "\n")


def object_paths(estimate: JointEstimate) -> dict[int, FloatArray]:
    """Return the places (n, 2), m, of each object, by id, from first to last."""
    found: dict[int, list[FloatArray]] = {}
    for objects in estimate.objects:
        for name, place in zip(objects.id.tolist(), objects.position, strict=True):
            found.setdefault(name, []).append(place)
    return {name: np.array(places) for name, places in found.items()}


def confirmed_paths(estimate: JointEstimate) -> dict[int, FloatArray]:
    """Return those of objects that were detected `_CONFIRMED` times at least: pictures leave clutter out."""
    seen = [estimate.assignment(row).id for row in range(len(estimate.timestamps))]
    ids, counts = np.unique(np.concatenate([np.empty(0, dtype=np.int64), *seen]), return_counts=True)
    known = set(ids[counts >= _CONFIRMED].tolist())
    return {name: path for name, path in object_paths(estimate).items() if name in known}


def write_objects(path: Path, estimate: JointEstimate) -> None:
    """Write tracks.csv."""
    rows = ["timestamp,id,class,x,y,vx,vy,sigma_x,sigma_y,sigma_vx,sigma_vy,stationary"]
    for moment, (time, objects) in enumerate(zip(estimate.timestamps, estimate.objects, strict=True)):
        sigma = np.sqrt(np.diagonal(estimate.object_covariances(moment), axis1=1, axis2=2))
        table = np.column_stack([objects.position, objects.velocity, sigma, objects.stationary])
        rows += [
            f"{time:.6f},{name},{label}," + ",".join(f"{x:.4f}" for x in row)
            for name, label, row in zip(objects.id.tolist(), objects.label, table, strict=True)
        ]
    write_text(path, "\n".join(rows) + "\n")


def planar_trajectory(time: FloatArray, world_T_pose: FloatArray) -> Trajectory:
    """Return a trajectory in the plane, (N, 3, 3), as one in space at z = 0."""
    poses = np.tile(np.eye(4), (len(world_T_pose), 1, 1))
    poses[:, :2, :2] = world_T_pose[:, :2, :2]
    poses[:, :2, 3] = world_T_pose[:, :2, 2]
    return Trajectory(time, poses)


def write_pose_graph(
    output: Path,
    graph: PoseGraph,
    optimised: OptimisedPoses,
    rows: IntArray,
    covariances: FloatArray,
    errors: Mapping[str, float],
    rejected: Sequence[str] = (),
) -> None:
    """Write poses.g2o, the graph with its optimised poses, and errors.json; rejected: measurements left out as false.

    covariances (n, k, k) of poses `rows` (n,), relative to the first one: covariances.csv, unless there are none
    errors: by name: of each start, of the guess itself, of the baselines where they were run
    """
    d, minimum = graph.dim, optimised.chordal
    figures: dict[str, object] = {"best": optimised.start, **errors, "rejected": list(rejected)}
    if minimum is not None:
        names = ("cost", "bound", "gap", "certified", "eigenvalue", "dimensions")
        figures["chordal"] = {name: getattr(minimum, name) for name in names}
    paths = {"guess": graph.world_T_pose[:, :d, d], "optimised": optimised.world_T_pose[:, :d, d]}
    best, points = graph.at(optimised.world_T_pose), {}
    if graph.landmarks is not None and optimised.landmarks is not None:
        best = best.with_landmarks(graph.landmarks.at(optimised.landmarks))
        points = {"landmarks": optimised.landmarks}
    with atomic_directory(output, known=("covariances.csv",)) as folder:
        write_g2o(folder / "poses.g2o", best)
        if len(rows):
            write_covariances(folder / "covariances.csv", "id", graph.ids[rows].tolist(), covariances)
        write_figures(folder / "errors.json", figures)
        write_bytes(folder / "above.png", png(paths_from_above(paths, points)))


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
