"""What `saga-fg slam` wrote, as rerun's entities: paths, the map's points, landmarks with their names.

    ROOT/trajectory, ROOT/odometry, ROOT/online   paths, those that are there
    ROOT/pose                                     the vehicle along the trajectory, on the timeline `time`
    ROOT/map, ROOT/landmarks                      points of map.ply and landmarks.ply
    ROOT/names                                    kind and number of the landmarks that are at a place (planes are not)

Metres, about `origin`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from data_tools.lidar import read_scan
from data_tools.trajectories import Trajectory, read_tum_poses
from pipelines.view.stream import load_rerun
from saga_fg.arrays import FloatArray, checked
from saga_fg.errors import InputError

PATHS = {"trajectory": (90, 90, 200), "odometry": (200, 120, 60), "online": (120, 180, 120)}
MAP, LANDMARK = (130, 130, 130), (240, 100, 40)


@dataclass(frozen=True, eq=False)
class SlamView:
    """paths: trajectories by name; points: clouds (N, 3) of `map` and `landmarks`; names, places (M, 3) of landmarks.

    A landmark known in the plane alone is at height 0.
    """

    paths: Mapping[str, Trajectory]
    points: Mapping[str, FloatArray]
    names: tuple[str, ...]
    places: FloatArray


def read_slam_view(folder: Path) -> SlamView:
    """Read the files of a run of SLAM. Raises `InputError` for a folder without trajectory.tum and for broken files."""
    if not (folder / "trajectory.tum").is_file():
        raise InputError(f"{folder}: expected a folder that `saga-fg slam` wrote, with trajectory.tum")
    paths = {name: read_tum_poses(file) for name in PATHS if (file := folder / f"{name}.tum").is_file()}
    clouds = {name: file for name in ("map", "landmarks") if (file := folder / f"{name}.ply").is_file()}
    names, places = _named(folder / "landmarks.json")
    return SlamView(paths, {name: read_scan(file).points for name, file in clouds.items()}, names, places)


def log_slam(stream: Any, view: SlamView, root: str, origin: FloatArray | None = None) -> None:
    """Log all of it to a `rerun.RecordingStream` below `root`; origin (3,) in its coordinates, the first pose if None.

    Times count from the first pose.
    """
    rerun = load_rerun()
    trajectory = view.paths["trajectory"]
    origin = trajectory.positions[0] if origin is None else origin
    stream.log(root, rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for name, path in view.paths.items():
        strip = rerun.LineStrips3D([path.positions - origin], colors=[PATHS[name]], radii=[0.08])
        stream.log(f"{root}/{name}", strip, static=True)
    for name, points in view.points.items():
        radius, colour = (0.03, MAP) if name == "map" else (0.08, LANDMARK)
        stream.log(f"{root}/{name}", rerun.Points3D(points - origin, radii=[radius], colors=[colour]), static=True)
    if view.names:
        marks = rerun.Points3D(view.places - origin, radii=[0.15], colors=[LANDMARK], labels=view.names)
        stream.log(f"{root}/names", marks, static=True)
    stream.log(f"{root}/pose", rerun.Boxes3D(sizes=[(4.6, 1.9, 1.6)], colors=[PATHS["trajectory"]]), static=True)
    times = trajectory.timestamps - trajectory.timestamps[0]
    stream.reset_time()
    for time, pose in zip(times.tolist(), trajectory.world_T_ego, strict=True):
        stream.set_time("time", duration=time)
        stream.log(f"{root}/pose", rerun.Transform3D(translation=pose[:3, 3] - origin, mat3x3=pose[:3, :3]))


def _named(path: Path) -> tuple[tuple[str, ...], FloatArray]:
    """Kind and number of each landmark that is at a place, and the places (M, 3)."""
    if not path.is_file():
        return (), np.empty((0, 3))
    try:
        rows: Any = json.loads(path.read_text(encoding="utf-8"))
        marks = [row for row in rows if "nx" not in row]
        names = tuple(f"{row.get('kind', row.get('type'))} {row.get('id', row.get('number'))}" for row in marks)
        places = np.array([[row["x"], row["y"], row.get("z", 0.0)] for row in marks], dtype=np.float64)
        return names, checked("places", places.reshape(-1, 3), (len(names), 3))
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: expected a list of landmarks with x, y: {error!r}") from error
