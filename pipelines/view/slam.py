"""Results of `saga-fg slam kitti` as drawings: paths, the map, landmarks with their names.

    ROOT/trajectory, ROOT/odometry, ROOT/online   paths, those that are there
    ROOT/pose                                     a moving frame along the trajectory; ROOT/pose/body: the vehicle
    ROOT/map, ROOT/landmarks                      points of map.ply and landmarks.ply
    ROOT/names                                    kind and number of landmarks with a place (planes have none)

Metres, about `origin`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_tools.files.input_files import read_bytes
from data_tools.files.json_stream import parsed_json
from data_tools.lidar import read_scan
from data_tools.trajectories import Trajectory, read_tum_poses
from pipelines.view.drawing import VEHICLE, Drawing, Lines, Points, Pose, Solids, one_colour
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, checked

PATHS = {
    "trajectory": one_colour((90, 90, 200)),
    "odometry": one_colour((200, 120, 60)),
    "online": one_colour((120, 180, 120)),
}
MAP, LANDMARK = one_colour((130, 130, 130)), one_colour((240, 100, 40))


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
        raise InputError(f"{folder}: expected trajectory.tum, as `saga-fg slam kitti` writes")
    paths = {name: read_tum_poses(file) for name in PATHS if (file := folder / f"{name}.tum").is_file()}
    clouds = {name: file for name in ("map", "landmarks") if (file := folder / f"{name}.ply").is_file()}
    names, places = _named(folder / "landmarks.json")
    return SlamView(paths, {name: read_scan(file).points for name, file in clouds.items()}, names, places)


def draw_slam(view: SlamView, root: str, origin: FloatArray | None = None) -> Iterator[Drawing]:
    """Draw a run in the frame `root`; origin (3,) in its coordinates, the first pose if None.

    Times count from the first pose.
    """
    trajectory = view.paths["trajectory"]
    origin = trajectory.positions[0] if origin is None else origin
    for name, path in view.paths.items():
        yield Drawing(root, name, Lines([path.positions - origin], PATHS[name], np.array([0.08])))
    for name, points in view.points.items():
        radius, colour = (0.03, MAP) if name == "map" else (0.08, LANDMARK)
        yield Drawing(root, name, Points(points - origin, colour, radius))
    if view.names:
        yield Drawing(root, "names", Points(view.places - origin, LANDMARK, 0.15, view.names))
    body = Solids(np.zeros((1, 3)), np.array([VEHICLE]), np.zeros(1), PATHS["trajectory"])
    yield Drawing(f"{root}/pose", "body", body)
    times = trajectory.timestamps - trajectory.timestamps[0]
    for time, world_T_ego in zip(times.tolist(), trajectory.world_T_ego, strict=True):
        pose = world_T_ego.copy()
        pose[:3, 3] -= origin
        yield Drawing(root, "pose", Pose(pose), time)


def _named(path: Path) -> tuple[tuple[str, ...], FloatArray]:
    """Return kind and number of each landmark with a place, and the places (M, 3)."""
    if not path.is_file():
        return (), np.empty((0, 3))
    rows = parsed_json(read_bytes(path), str(path))
    try:
        marks = [row for row in rows if "nx" not in row]
        names = tuple(f"{row['kind']} {row['number']}" for row in marks)
        places = np.array([[row["x"], row["y"], row.get("z", 0.0)] for row in marks], dtype=np.float64)
        return names, checked("places", places.reshape(-1, 3), (len(names), 3))
    except (ValueError, OverflowError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: expected a list of landmarks with x, y: {error!r}") from error
