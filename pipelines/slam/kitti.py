"""The results of SLAM on a recording, as files.

trajectory.txt, times.txt   poses of the vehicle, KITTI's format: world_T_ego of every scan, and its time
trajectory.tum              the same in the TUM format
odometry.tum                by odometry alone; online.tum: as estimated when each keyframe came
covariances.csv             of the sensor's pose at the keyframes: time, then the upper triangle of (rotation vector,
                            translation) in the sensor's frame, rad and m
map.ply                     the accumulated points of the keyframes, one a voxel, in world coordinates
landmarks.json              kind, number of observations, coordinates and covariance of each landmark
landmarks.ply               the same to look at: points along the poles and on the seen pieces of the walls
tracks.csv                  with objects: those in the world at every moment of the graph, see `object_tracks`
above.png                   map, paths, landmarks and the objects' tracks from above
metrics.json                errors of the trajectories against the recording's own poses, and the map's sharpness

World coordinates are those of the recording (KITTI: x east, y north, z up, from the first pose).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from data_tools.files.atomic_files import atomic_directory, write_bytes, write_text
from data_tools.lidar import scan_to_map_residual, voxel_downsample, write_ply
from data_tools.plots import png, scan_map_from_above
from data_tools.trajectories import Trajectory, trajectory_errors, write_kitti_poses, write_tum_poses
from pipelines.figures import write_figures
from pipelines.scan_sequence import ScanSequence
from pipelines.slam.lidar_slam import LidarSlam
from pipelines.slam.object_tracks import tracks, tracks_csv
from pipelines.slam.sightings import GROUND, LINE, WALL
from pipelines.slam.with_objects import SlamWithObjects
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import transform_points
from saga_fg.types.landmark import Landmark

POLE_HEIGHT = 3.0  # m above the first pose, to which poles are drawn
_GAP = 2.0  # m between observations of a wall, beyond which two pieces of it are drawn
_EDGE_COLOUR = (148, 103, 189)
_COLOURS = {True: (255, 127, 14), False: (214, 39, 40)}  # of poles, of planes


def metrics(result: LidarSlam, scans: ScanSequence) -> dict[str, Any]:
    """Errors (start aligned) of the three trajectories against the recording's poses, residuals, and counts."""
    truth = Trajectory(scans.timestamps, scans.world_T_ego)
    kinds = [landmark.kind.name for landmark in result.landmarks]
    return {
        "keyframes": len(result.keyframes),
        "landmarks": {name: kinds.count(name) for name in sorted(set(kinds))},
        "loops": len(result.loops),
        "scan_to_map_residual": scan_to_map_residual(result.clouds, result.world_T_lidar),
        **{
            name: asdict(trajectory_errors(getattr(result, name), truth, "start"))
            for name in ("odometry", "online", "trajectory")
        },
    }


def write_lidar_slam(
    output: Path, found: LidarSlam | SlamWithObjects, scans: ScanSequence, spacing: float = 0.2
) -> dict[str, Any]:
    """Write all files of a run to a folder, or none; returns the metrics. `spacing` of the map's points, m."""
    result, objects = (found, None) if isinstance(found, LidarSlam) else (found.slam, found.estimate)
    points = accumulated_map(result, spacing)
    figures = metrics(result, scans)
    if isinstance(found, SlamWithObjects):
        figures["objects"] = len(tracks(found.estimate))
        figures["without_objects"] = metrics(found.alone, scans)["trajectory"]
    with atomic_directory(output) as folder:
        write_kitti_poses(folder / "trajectory.txt", result.trajectory, folder / "times.txt")
        for name, trajectory in (
            ("trajectory", result.trajectory), ("odometry", result.odometry), ("online", result.online)
        ):  # fmt: skip
            write_tum_poses(folder / f"{name}.tum", trajectory)
        _write_covariances(folder / "covariances.csv", result)
        write_ply(folder / "map.ply", points)
        _write_landmarks(folder, result)
        paths = {"reference": scans.world_T_ego[:, :3, 3], "trajectory": result.trajectory.positions}
        if objects is not None:
            write_text(folder / "tracks.csv", tracks_csv(objects))
        driven = () if objects is None else tuple(tracks(objects).values())
        figure = scan_map_from_above(points, paths, _poles(result.landmarks), _lines(result), driven)
        write_bytes(folder / "above.png", png(figure))
        write_figures(folder / "metrics.json", figures)
    return figures


def accumulated_map(result: LidarSlam, spacing: float) -> FloatArray:
    """Points (N, 3) of all keyframes in world coordinates, m, one in each voxel of `spacing` m."""
    placed = zip(result.world_T_lidar, result.clouds, strict=True)
    points = np.concatenate([transform_points(pose, cloud) for pose, cloud in placed])
    return points[voxel_downsample(points, spacing)]


def _write_covariances(path: Path, result: LidarSlam) -> None:
    upper = np.triu_indices(6)
    names = ["time", *(f"P{i + 1}{j + 1}" for i, j in zip(*upper, strict=True))]
    times = result.trajectory.timestamps[result.keyframes].tolist()
    rows = [
        ",".join([repr(time), *(f"{x:.9g}" for x in covariance[upper])])
        for time, covariance in zip(times, result.covariances, strict=True)
    ]
    write_text(path, "\n".join([",".join(names), *rows]) + "\n")


def _write_landmarks(folder: Path, result: LidarSlam) -> None:
    records = [
        {
            "id": landmark.number,
            "kind": landmark.kind.name,
            "observations": landmark.observations,
            **landmark.kind.coordinates(landmark.state),
            "covariance": landmark.covariance.tolist(),
        }
        for landmark in result.landmarks
    ]
    write_figures(folder / "landmarks.json", records)
    start = float(result.world_T_lidar[0, 2, 3])
    drawn, colours = [np.empty((0, 3))], [np.empty((0, 3), dtype=np.uint8)]
    for pole in _poles(result.landmarks):
        z = np.arange(start - 1.5, start + POLE_HEIGHT, 0.1)
        drawn.append(np.column_stack([np.broadcast_to(pole, (len(z), 2)), z]))
        colours.append(np.full((len(z), 3), _COLOURS[True], dtype=np.uint8))
    for a, b in _pieces(result, LINE.name):
        share = np.linspace(0.0, 1.0, max(2, int(np.linalg.norm(b - a) / 0.2)))
        drawn.append(np.column_stack([a + share[:, None] * (b - a), np.full(len(share), start - 1.7)]))
        colours.append(np.full((len(share), 3), _EDGE_COLOUR, dtype=np.uint8))
    for a, b in _pieces(result, WALL.name):
        share = np.linspace(0.0, 1.0, max(2, int(np.linalg.norm(b - a) / 0.2)))
        z = np.arange(start - 1.0, start + POLE_HEIGHT, 0.4)
        foot = np.repeat(a + share[:, None] * (b - a), len(z), axis=0)
        drawn.append(np.column_stack([foot, np.tile(z, len(share))]))
        colours.append(np.full((len(foot), 3), _COLOURS[False], dtype=np.uint8))
    write_ply(folder / "landmarks.ply", np.concatenate(drawn), np.concatenate(colours))


def _lines(result: LidarSlam) -> dict[str, FloatArray]:
    """Pieces of walls and road lines, under their names."""
    return {"walls": _pieces(result, WALL.name), "road lines": _pieces(result, LINE.name)}


def _poles(landmarks: Sequence[Landmark]) -> FloatArray:
    """Places (P, 2) of all but planes and lines."""
    places = [mark.kind.coordinates(mark.state) for mark in landmarks if mark.kind not in (LINE, GROUND, WALL)]
    return np.array([[place["x"], place["y"]] for place in places], dtype=np.float64).reshape(-1, 2)


def _pieces(result: LidarSlam, kind: str) -> FloatArray:
    """Ends (W, 2, 2), from above, of the pieces of walls or road lines that were seen, one or several of each."""
    ends = []
    for mark in result.landmarks:
        if mark.kind.name != kind:
            continue
        place = mark.kind.coordinates(mark.state)
        normal = np.array([place["nx"], place["ny"]]) / np.hypot(place["nx"], place["ny"])
        along = np.array([-normal[1], normal[0]])
        foot = (np.array([place["x"], place["y"]]) @ normal) * normal
        spans = []
        for seen, extent in zip(result.observations, result.extents, strict=True):
            if seen.landmark == mark.number:
                u = transform_points(result.world_T_lidar[seen.pose], extent)[:, :2] @ along
                spans.append((float(u.min()), float(u.max())))
        ends += [np.stack([foot + low * along, foot + high * along]) for low, high in covered_spans(spans)]
    return np.array(ends).reshape(-1, 2, 2)


def covered_spans(spans: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """What spans cover together, gaps up to `_GAP` filled: houses on both sides of a street may lie in one plane."""
    covered: list[tuple[float, float]] = []
    for low, high in sorted(spans):
        if covered and low <= covered[-1][1] + _GAP:
            covered[-1] = (covered[-1][0], max(high, covered[-1][1]))
        else:
            covered.append((low, high))
    return covered
