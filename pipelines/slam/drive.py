"""A drive: poses of all scans by odometry, and its map as a folder.

Odometry leaves poses of all scans, and motions between them with their covariances.

The map of a drive as a folder: the points of each submap in a file, and where each lies.

submaps.csv   number, file, x, y, z (m) and qx, qy, qz, qw of each submap's frame in the map
0000.ply ..   points of submap 0 .., m, in its own frame, z up; a map may have them as PCD
origin.csv    latitude [deg], longitude [deg], altitude [m] of the map's origin, if known; its x is east, its y north

A submap moves as a whole when its place is estimated anew. Any viewer of point clouds opens the files.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import gtsam
import numpy as np
import numpy.typing as npt

from data_tools.files import TextTable, read_table, write_text
from data_tools.lidar import Scan, read_scan, voxel_downsample, write_cloud
from data_tools.pose_graphs import Record, pose_columns, transforms
from pipelines.slam.odometry import OdometryStep
from saga_fg import InputError
from saga_fg.errors import require_type
from saga_fg.numerics import (
    FloatArray,
    carried_covariance,
    checked,
    inverse_transform,
    transform_points,
)

LEAST = np.diag([1e-4] * 3 + [5e-3] * 3) ** 2  # of a motion: the best accuracy of a registration, rad and m


class Drive:
    """Odometry of a drive that goes on, scan by scan.

    times (K), s; poses K times (4, 4) of the sensor by odometry alone; travelled (K), m
    covariances  K times (6, 6) of the motion to each scan from the one before: (rotation, translation) in the frame of
                 the later one, rad^2, m^2
    keyframes    rows among the scans
    closed       whether it has ended
    """

    def __init__(self) -> None:
        self.times, self.travelled = list[float](), list[float]()
        self.poses, self.covariances = list[FloatArray](), list[FloatArray]()
        self.keyframes = list[int]()
        self.closed = False

    def __len__(self) -> int:
        return len(self.poses)

    def check(self, scan: Scan | None, time: float) -> None:
        """Raise `InputError` for what cannot be the next scan."""
        if self.closed:
            raise InputError("step: expected no scan after finish; a new one takes the next drive")
        if scan is None:
            raise InputError(
                "scan: expected one in every step: what sensors measure between scans comes with the next scan, as "
                "SensorBuffer gives it; of detections between scans give those nearest to a scan"
            )
        require_type("scan", scan, Scan)
        if not (isinstance(time, int | float | np.number) and np.isfinite(time)):
            raise InputError(f"time: expected a finite number of seconds, got {time!r}")
        if self.times and not time > self.times[-1]:
            raise InputError(f"time: expected one after {self.times[-1]:.6f} s, got {time:.6f} s")

    def add(self, time: float, pose: FloatArray, step: OdometryStep) -> None:
        """Add the scan at `time` with its pose (4, 4), which stands for the poses of the scans lost before, too."""
        moved = float(np.linalg.norm(pose[:3, 3] - self.poses[-1][:3, 3])) if self.poses else 0.0
        self.times.append(time)
        self.poses.append(pose)
        self.travelled.append(moved + (self.travelled[-1] if self.travelled else 0.0))
        covariances = shared(self.poses, step)
        self.covariances[len(self.poses) - len(covariances) :] = covariances

    def close(self) -> None:
        """End the drive. Raises `InputError` for one that has ended."""
        if self.closed:
            raise InputError("finish: expected to be called once")
        self.closed = True

    def moved(self, first: int, last: int | None = None) -> tuple[FloatArray, FloatArray]:
        """The motion (4, 4) from a scan to another, by default the newest, and its covariance (6, 6) at the end."""
        end = len(self.poses) if last is None else last + 1
        return motion(self.poses[first:end], self.covariances[first + 1 : end])

    def expected(self, time: float) -> FloatArray:
        """The pose (4, 4) at `time` by the motion between the last two scans; there is one scan at least."""
        if len(self.poses) < 2:
            return self.poses[-1]
        before, last = (gtsam.Pose3(pose) for pose in self.poses[-2:])
        share = (time - self.times[-1]) / (self.times[-1] - self.times[-2])
        pose: FloatArray = last.retract(share * before.localCoordinates(last)).matrix()
        return pose

    def carried(self, world_T_lidar: FloatArray, rows: Sequence[int] | None = None) -> FloatArray:
        """Return poses (K, 4, 4) of all scans, given some, by default the keyframes: each fixed to the one before,
        or to the first."""
        known, poses = np.array(self.keyframes if rows is None else rows), np.array(self.poses)
        of = np.maximum(np.searchsorted(known, np.arange(len(poses)), side="right") - 1, 0)
        return np.asarray(world_T_lidar[of] @ inverse_transform(poses[known[of]]) @ poses)


def motion(
    poses: Sequence[FloatArray] | FloatArray, covariances: Sequence[FloatArray] | FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the motion (4, 4) from the first of n poses to the last, and its covariance (6, 6) in the frame of that.

    covariances: n - 1 of the motions from each to the next, each in the frame of the later one
    """
    later = np.reshape(poses[1:], (-1, 4, 4))
    total = carried_covariance(inverse_transform(poses[-1]) @ later, np.reshape(covariances, (-1, 6, 6))).sum(axis=0)
    return inverse_transform(poses[0]) @ poses[-1], (total + total.T) / 2


def moved_pose(
    pose: FloatArray, covariance: FloatArray, since: tuple[FloatArray, FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Return a pose (4, 4) and the covariance (6, 6) of its tangent after the motion `since`, as `motion` gives it."""
    return pose @ since[0], carried_covariance(inverse_transform(since[0]), covariance) + since[1]


def shared(poses: Sequence[FloatArray], step: OdometryStep) -> list[FloatArray]:
    """Covariances (6, 6) of the motions to a scan, the last of `poses`, and to the `step.lost` scans before it.

    They have equal shares of that of the whole motion, which registration in the map knows; `motion` adds them up.
    """
    lost = min(step.lost, len(poses) - 1)
    them = np.array(poses[len(poses) - 1 - lost :])
    return list(carried_covariance(inverse_transform(them) @ poses[-1], (step.covariance + LEAST) / (lost + 1)))


def placed_clouds(
    clouds: Sequence[npt.NDArray[np.float32]], poses: Sequence[FloatArray] | FloatArray, spacing: float | None = None
) -> FloatArray:
    """Points (N, 3) of clouds at their poses (4, 4); spacing: one in each voxel of so many m."""
    placed = zip(poses, clouds, strict=True)
    points = np.concatenate([transform_points(pose, cloud.astype(np.float64)) for pose, cloud in placed])
    return points if spacing is None else points[voxel_downsample(points, spacing)]


_COLUMNS = ("number", "file", "x", "y", "z", "qx", "qy", "qz", "qw")
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
        checked("map_T_submap", self.map_T_submap, (len(self.points), 4, 4))
        if not any(map(len, self.points)):
            raise InputError("map: expected points in at least one submap, got none")


def write_map(folder: Path, slam_map: SlamMap) -> None:
    """Write a map to a folder that exists."""
    rows = [",".join(_COLUMNS)]
    for number, (points, pose) in enumerate(zip(slam_map.points, pose_columns(slam_map.map_T_submap), strict=True)):
        name = f"{number:04d}.ply"
        write_cloud(folder / name, points.astype(np.float64))
        rows.append(",".join([str(number), name, *(f"{value:.9f}" for value in pose)]))
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
    table = rows_below(path, _COLUMNS)
    poses, names = transforms(table, Record(3, _COLUMNS[:2], _COLUMNS[2:])), table.values[:, 1].tolist()
    beside = np.array([Path(name).name == name for name in names], dtype=np.bool_)
    table.check(beside, lambda row: f"file: expected a file beside {path.name}, got {names[row][:40]!r}")
    points = [read_scan(folder / name).points.astype(np.float32) for name in names]
    return SlamMap(points, poses, _read_origin(folder / "origin.csv"))


def covariance_columns(dim: int) -> list[str]:
    """Names of the upper triangle of a covariance (dim, dim) in a table."""
    return [f"P{i + 1}{j + 1}" for i, j in zip(*np.triu_indices(dim), strict=True)]


def rows_below(path: Path, columns: tuple[str, ...]) -> TextTable:
    """The rows of a table below the line of its columns. Raises `InputError` for other columns."""
    table = read_table(path, (len(columns),), ",".join(columns), ",")
    if not len(table) or tuple(table.values[0]) != columns:
        raise InputError(f"{path}: line 1: expected the columns {','.join(columns)}")
    return TextTable(path, table.values[1:], table.line[1:])


def _read_origin(path: Path) -> Origin | None:
    if not path.is_file():
        return None
    table = rows_below(path, _ORIGIN)
    if len(table) != 1:
        raise InputError(f"{path}: expected one line of numbers, got {len(table)}")
    latitude, longitude, altitude = table.numbers(slice(0, 3), _ORIGIN, (85.0, 180.0, 1e5))[0].tolist()
    return latitude, longitude, altitude
