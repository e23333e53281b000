"""The map of a drive as a folder: the points of each submap in a file, and where each lies.

submaps.csv   number, file, x, y, z (m) and qx, qy, qz, qw of each submap's frame in the map
0000.ply ..   points of submap 0 .., m, in its own frame, z up; or 0000.pcd ..
origin.csv    latitude [deg], longitude [deg], altitude [m] of the map's origin, if known; its x is east, its y north

A submap moves as a whole when its place is estimated anew. Any viewer of point clouds opens the files.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from data_tools.files.atomic_files import write_text
from data_tools.files.text_tables import TextTable, read_lines
from data_tools.lidar import read_scan, write_cloud
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import quaternion_rotation, rotation_quaternion

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
    table = TextTable.of(path, [row for _, row in lines[1:]], [number for number, _ in lines[1:]], len(_COLUMNS))
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
    table = TextTable.of(path, lines[1:], [2])
    latitude, longitude, altitude = table.numbers(slice(0, 3), _ORIGIN, (85.0, 180.0, 1e5))[0].tolist()
    return latitude, longitude, altitude
