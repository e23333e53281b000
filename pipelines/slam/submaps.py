"""Submaps from keyframes, and the map of a drive as a folder of them.

Submaps from keyframes: points are collected while a submap runs, and thinned to one cloud when it is closed.

The map of a drive as a folder: the points of each submap in a file, and where each lies.

submaps.csv   number, file, x, y, z (m) and qx, qy, qz, qw of each submap's frame in the map
0000.ply ..   points of submap 0 .., m, in its own frame, z up; or 0000.pcd ..
origin.csv    latitude [deg], longitude [deg], altitude [m] of the map's origin, if known; its x is east, its y north

A submap moves as a whole when its place is estimated anew. Any viewer of point clouds opens the files.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from data_tools.files import TextTable, read_lines, write_text
from data_tools.lidar import (
    Submap,
    read_scan,
    upright,
    voxel_downsample,
    write_cloud,
)
from saga_fg.errors import InputError
from saga_fg.numerics import FloatArray, inverse_transform, quaternion_rotation, rotation_quaternion, transform_points


class SubmapBuilder:
    """Collects the points of the running submap's keyframes.

    spacing: of the points that are kept, m
    """

    def __init__(self, spacing: float) -> None:
        self._spacing = spacing
        self._clouds: list[npt.NDArray[np.float32]] = []
        self._number, self._first, self._way = 0, 0, 0.0
        self._driven = 0.0
        self._anchor_T_submap: FloatArray = np.eye(4)

    def add(self, points: FloatArray, world_T_sensor: FloatArray, driven: float) -> None:
        """Add the next keyframe: points (N, 3), thinned to the spacing already; driven: way since the last, m."""
        self._driven += driven
        if not self._clouds:
            self._anchor_T_submap, self._way = upright(world_T_sensor), self._driven
        self._clouds.append(points.astype(np.float32))

    def close(self, world_T_sensor: FloatArray) -> Submap:
        """Return the submap, given the poses (n, 4, 4) of its keyframes, and begin the next."""
        inner = inverse_transform(world_T_sensor[0]) @ world_T_sensor
        frame = inverse_transform(self._anchor_T_submap)
        points = placed_clouds(self._clouds, frame @ inner, self._spacing).astype(np.float32)
        last, count = self._first + len(self._clouds), self._number
        submap = Submap(
            count, (self._first, last), self._first, self._anchor_T_submap, points, (self._way, self._driven)
        )
        self._clouds, self._first, self._number = [], last, count + 1
        return submap

    def __len__(self) -> int:
        return len(self._clouds)


def world_T_submap(submap: Submap, world_T_anchor: FloatArray) -> FloatArray:
    """The frame (4, 4) of a submap, given the pose of its anchor."""
    return np.asarray(world_T_anchor @ submap.anchor_T_submap)


def placed_clouds(
    clouds: Sequence[npt.NDArray[np.float32]], poses: Sequence[FloatArray] | FloatArray, spacing: float | None = None
) -> FloatArray:
    """Points (N, 3) of clouds at their poses (4, 4); spacing: one in each voxel of so many m."""
    placed = zip(poses, clouds, strict=True)
    points = np.concatenate([transform_points(pose, cloud.astype(np.float64)) for pose, cloud in placed])
    return points if spacing is None else points[voxel_downsample(points, spacing)]


_COLUMNS = ("number", "file", "x", "y", "z", "qx", "qy", "qz", "qw")
_UNIT = 1e-3  # that the norm of a quaternion may be off 1
CloudFormat = Literal["ply", "pcd"]
Origin = tuple[float, float, float]
_ORIGIN = ("latitude [deg]", "longitude [deg]", "altitude [m]")


@dataclass(frozen=True, eq=False)
class SlamMap:
    """S submaps: points (N, 3) float32 of each in its frame, z up, and map_T_submap (S, 4, 4).

    origin: latitude and longitude, deg, and altitude, m, of the map's origin, its x east and its y north
    """

    points: Sequence[npt.NDArray[np.float32]]
    map_T_submap: FloatArray
    origin: Origin | None = None

    def __post_init__(self) -> None:
        if self.map_T_submap.shape != (len(self.points), 4, 4):
            shape = self.map_T_submap.shape
            raise InputError(f"map_T_submap: expected shape ({len(self.points)}, 4, 4), got {shape}")
        if not any(map(len, self.points)):
            raise InputError("map: expected points in at least one submap, got none")


def write_map(folder: Path, slam_map: SlamMap, form: CloudFormat = "ply") -> None:
    """Write a map to a folder that exists."""
    rows = [",".join(_COLUMNS)]
    for number, (points, pose) in enumerate(zip(slam_map.points, slam_map.map_T_submap, strict=True)):
        name = f"{number:04d}.{form}"
        write_cloud(folder / name, points.astype(np.float64))
        w, x, y, z = rotation_quaternion(pose[:3, :3])
        rows.append(",".join([str(number), name, *(f"{value:.9f}" for value in (*pose[:3, 3], x, y, z, w))]))
    write_text(folder / "submaps.csv", "\n".join(rows) + "\n")
    if slam_map.origin is not None:
        numbers = ",".join(f"{value:.12g}" for value in slam_map.origin)
        write_text(folder / "origin.csv", f"{','.join(_ORIGIN)}\n{numbers}\n")


def read_map(folder: str | Path) -> SlamMap:
    """Read a map. Raises `InputError` naming the file and line of what is not as above."""
    folder = Path(folder)
    folder = folder / "map" if (folder / "map").is_dir() else folder
    path = folder / "submaps.csv"
    if not path.is_file():
        raise InputError(
            f"{folder}: expected a map: a folder with submaps.csv and a file of points for each of its lines"
        )
    lines = [(number, line.split(",")) for number, line in enumerate(read_lines(path), start=1) if line.strip()]
    if not lines or tuple(lines[0][1]) != _COLUMNS:
        raise InputError(f"{path}: line 1: expected the columns {','.join(_COLUMNS)}")
    for number, row in lines[1:]:
        if len(row) != len(_COLUMNS):
            raise InputError(f"{path}: line {number}: expected {len(_COLUMNS)} columns, got {len(row)}")
    table = TextTable.from_rows(path, [row for _, row in lines[1:]], [number for number, _ in lines[1:]], len(_COLUMNS))
    numbers = table.numbers(slice(2, 9), _COLUMNS[2:])
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    off = np.abs(np.linalg.norm(numbers[:, 3:], axis=1) - 1)
    if (off > _UNIT).any():
        raise table.fault(int(np.argmax(off > _UNIT)), "expected a quaternion qx, qy, qz, qw of length 1")
    poses[:, :3, :3] = quaternion_rotation(numbers[:, [6, 3, 4, 5]])
    poses[:, :3, 3] = numbers[:, :3]
    points = []
    for at, name in enumerate(table.values[:, 1].tolist()):
        if Path(name).name != name:
            raise table.fault(at, f"file: expected a file beside {path.name}, got {name[:40]!r}")
        points.append(read_scan(folder / name).points.astype(np.float32))
    return SlamMap(points, poses, _read_origin(folder / "origin.csv"))


def _read_origin(path: Path) -> Origin | None:
    if not path.is_file():
        return None
    lines = [line.split(",") for line in read_lines(path) if line.strip()]
    if len(lines) != 2 or tuple(lines[0]) != _ORIGIN or len(lines[1]) != len(_ORIGIN):
        raise InputError(f"{path}: expected a line of columns, {','.join(_ORIGIN)}, and a line of numbers")
    table = TextTable.from_rows(path, lines[1:], [2])
    latitude, longitude, altitude = table.numbers(slice(0, 3), _ORIGIN, (85.0, 180.0, 1e5))[0].tolist()
    return latitude, longitude, altitude
