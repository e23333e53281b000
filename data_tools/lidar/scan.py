"""Sweeps of a LiDAR, de-skewed, thinned to voxels, without points on moving objects, and recordings of them.

Motion de-skew: points of a sweep transformed to one time.

While the head turns, the vehicle drives on. With constant velocity xi = (w, v) within the sweep, rad/s and m/s in the
sensor's frame, a point p measured t after the scan's timestamp lies, in the sensor's frame at the timestamp, at

    exp(t xi) p = R(t) p + u(t),      k = w / |w|,  a = |w| t
    R(t) p = p + sin(a) k x p + (1 - cos(a)) k x (k x p)
    u(t)   = t v + (1 - cos(a)) / |w| k x v + (t - sin(a) / |w|) k x (k x v)

Source: the exponential of SE(3), e.g. Barfoot, State Estimation for Robotics, 2nd ed. 2024, section 8.1.

For a sensor that turns steadily and gives no times, `azimuth_times` derives them from the azimuths of the points.

Points on grids: voxel downsampling, and clusters of points connected from above.

The voxel of a point p is floor(p / size), three integers packed into one of 3 x 21 bits. With voxels of 0.1 m the grid
extends 100 km in every direction.

Clusters are the connected components of the occupied cells of a square grid, each cell with its eight neighbours. Two
dimensions are enough, because objects on the ground are separate from above.

Open3D tells which points lie in boxes. It is imported on first use, because the import takes half a second and much
memory. On Linux its extension links `libusb-1.0.so.0` (for depth cameras), which neither its wheel nor a slim system
carries. The package `libusb-package` carries it; once loaded with global symbols, it satisfies the later link by its
name.

A recording of LiDAR scans: when and where each was taken, how to read it, and the other sensors of the vehicle.

Every layout gives one; `read` returns the scan of a row. What only the whole of a recording shows is checked here: time
that runs backwards, a last scan that was cut off, and scans of two sensors in turn. The latter are told by how
far it is in each direction: a scan is more like the one before than like that before it, if one sensor took them.
"""

import ctypes
import importlib
import logging
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType
from typing import Protocol, Self

import gtsam
import numpy as np
from scipy.ndimage import label

from saga_fg import Boxes, Frame, InputError, MissingExtraError
from saga_fg.errors import error_context
from saga_fg.numerics import BoolArray, FloatArray, IntArray, checked, checked_transform, yaw_transform
from saga_fg.slam.sensors import SensorName


@dataclass(frozen=True, eq=False)
class Scan:
    """N points of one sweep, in the sensor's frame (x ahead, y left, z up).

    points     (N, 3) m
    intensity  (N,) strength of the echo in the sensor's own unit, NaN where unknown
    time       (N,) s relative to the timestamp of the scan; None where unknown
    dropped    how many points without a place the file or message held besides, as beams without an echo

    Raises `InputError` for arrays of other shapes and positions that are not finite.
    """

    points: FloatArray
    intensity: FloatArray
    time: FloatArray | None = None
    dropped: int = 0

    def __post_init__(self) -> None:
        points = checked("points", self.points, (None, 3))
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "intensity", checked("intensity", self.intensity, (len(points),), "finite-or-nan"))
        if self.time is not None:
            object.__setattr__(self, "time", checked("time", self.time, (len(points),)))

    @classmethod
    def of(cls, points: FloatArray) -> Self:
        """A scan without intensities and times."""
        return cls(points, np.full(len(points), np.nan))

    def __len__(self) -> int:
        return len(self.points)

    def select(self, rows: BoolArray | IntArray) -> Self:
        """The points of a mask or of row indices."""
        time = None if self.time is None else self.time[rows]
        return replace(self, points=self.points[rows], intensity=self.intensity[rows], time=time)

    def within(self, nearest: float, farthest: float) -> Self:
        """The points at distances from `nearest` to `farthest` m, without echoes of the vehicle itself."""
        square = np.einsum("ni,ni->n", self.points, self.points)
        return self.select((square >= nearest**2) & (square <= farthest**2))


class ScanSequence(Protocol):
    """K recorded scans in order of time, each read on access; `data_tools.recordings.ScanRecording` is one.

    timestamps   (K,) s
    world_T_ego  (K, 4, 4) reference poses of the vehicle; None where the recording has none
    ego_T_lidar  (4, 4) pose of the sensor on the vehicle
    """

    @property
    def timestamps(self) -> FloatArray: ...
    @property
    def world_T_ego(self) -> FloatArray | None: ...
    @property
    def ego_T_lidar(self) -> FloatArray: ...
    def __len__(self) -> int: ...
    def __getitem__(self, row: int) -> Scan: ...


def azimuth_times(points: FloatArray, period: float) -> FloatArray:
    """Times (N,), s, from -period / 2 to period / 2, of points (N, 3) of a head that turns once a `period` (s).

    At the timestamp the head looks ahead (along x); the scan begins and ends behind. It turns clockwise as seen from
    above, as KITTI's Velodyne does.
    """
    return np.asarray(-np.arctan2(points[:, 1], points[:, 0]) * (period / (2 * np.pi)))


def deskewed(scan: Scan, velocity: FloatArray) -> Scan:
    """The scan with all points at its timestamp; `velocity` (6,): turn rate, rad/s, and velocity, m/s, sensor's frame.

    Raises `InputError` for a scan without times.
    """
    if scan.time is None:
        raise InputError("time: expected the time of each point, the scan has none; see azimuth_times")
    velocity = checked("velocity", velocity, (6,))
    w, v = velocity[:3], velocity[3:]
    rate = float(np.linalg.norm(w))
    t = scan.time[:, None]
    if rate < 1e-9:
        return Scan(scan.points + t * v, scan.intensity, np.zeros(len(scan)))
    k, a = w / rate, rate * t
    K = np.array([[0.0, -k[2], k[1]], [k[2], 0.0, -k[0]], [-k[1], k[0], 0.0]])
    sine, rest = np.sin(a), 1 - np.cos(a)
    points = scan.points + sine * (scan.points @ K.T) + rest * (scan.points @ (K @ K).T)
    points += t * v + rest / rate * (K @ v) + (t - sine / rate) * (K @ K @ v)
    return Scan(points, scan.intensity, np.zeros(len(scan)))


def constant_velocity(before_T_now: FloatArray, duration: float) -> FloatArray:
    """Velocity (6,), rad/s and m/s, of a rigid motion (4, 4) within `duration` s."""
    return np.asarray(gtsam.Pose3.Logmap(gtsam.Pose3(before_T_now)) / duration)


MARGIN = 0.3  # m, by which boxes are enlarged on all sides: errors of detectors, and motion during a scan


def inside_boxes(points: FloatArray, boxes: Boxes, margin: float = MARGIN) -> BoolArray:
    """Mask (N,) of the points (N, 3) inside boxes enlarged by `margin`, m, all in one frame.

    Boxes without a size or heading are left out.
    """
    known = np.isfinite(boxes.size).all(axis=1) & np.isfinite(boxes.yaw)
    result = np.zeros(len(points), dtype=bool)
    if not known.any() or not len(points):
        return result
    open3d = load_open3d()
    cloud = open3d.utility.Vector3dVector(np.array(points))
    for row in np.flatnonzero(known).tolist():
        turn, size = yaw_transform(yaw=float(boxes.yaw[row]))[:3, :3], boxes.size[row] + 2 * margin
        box = open3d.geometry.OrientedBoundingBox(boxes.position[row], turn, size)
        result[box.get_point_indices_within_bounding_box(cloud)] = True
    return result


def without_objects(scan: Scan, boxes: Boxes) -> Scan:
    """The scan without points inside boxes, all in one frame."""
    return scan.select(~inside_boxes(scan.points, boxes)) if len(boxes) else scan


_BITS = 21
_HALF = 1 << (_BITS - 1)


def voxel_keys(points: FloatArray, size: float) -> IntArray:
    """The voxels (N,) of points (N, 3), m; `size` in m. Raises `InputError` for points off the grid."""
    cell = _cells(points, size) + _HALF
    return np.asarray((cell[0] << 2 * _BITS) | (cell[1] << _BITS) | cell[2])


def voxel_groups(points: FloatArray, size: float) -> tuple[IntArray, IntArray]:
    """Rows (N,) of points (N, 3) voxel by voxel, ascending in each, and where (M,) each of the M voxels begins."""
    if not len(points):
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    cell = _cells(points, size)
    low = cell.min(axis=1)
    bits = [int(span).bit_length() for span in cell.max(axis=1) - low]
    row_bits = len(points).bit_length()
    key = ((cell[0] - low[0]) << bits[1] | (cell[1] - low[1])) << bits[2] | (cell[2] - low[2])
    if sum(bits) + row_bits < 63:  # voxel and row as one number: sorting numbers is far quicker than sorting rows
        packed = np.sort(key << row_bits | np.arange(len(points)))
        order, key = packed & ((1 << row_bits) - 1), packed >> row_bits
    else:
        key = voxel_keys(points, size)
        order = np.argsort(key, kind="stable")
        key = key[order]
    return order, np.flatnonzero(np.concatenate([[True], key[1:] != key[:-1]]))


def voxel_downsample(points: FloatArray, size: float) -> IntArray:
    """Rows (M,) of `points` (N, 3), ascending: the first point in each voxel of `size` m.

    Means of several points would not lie on the surface near corners.
    """
    order, start = voxel_groups(points, size)
    return np.sort(order[start])


def _cells(points: FloatArray, size: float) -> IntArray:
    """Voxels (3, N) of points (N, 3)."""
    if not size > 0:
        raise InputError(f"size: expected a voxel size > 0 m, got {size!r}")
    index = np.floor(np.ascontiguousarray(points.T) / size)
    if index.size and max(-index.min(), index.max()) >= _HALF:
        raise InputError(f"points: expected coordinates within {_HALF * size:g} m for voxels of {size:g} m")
    return index.astype(np.int64)


def clusters_from_above(points: FloatArray, cell: float) -> list[IntArray]:
    """Rows of points (N, 3), m, of each cluster on a grid of `cell` m."""
    if not len(points):
        return []
    index = np.floor(points[:, :2] / cell).astype(np.int64)
    index -= index.min(axis=0)
    occupied = np.zeros(index.max(axis=0) + 1, dtype=bool)
    occupied[index[:, 0], index[:, 1]] = True
    part = label(occupied, np.ones((3, 3)))[0][index[:, 0], index[:, 1]]
    order = np.argsort(part, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(part[order])) + 1)


def cell_order_statistics(values: FloatArray, cell: IntArray, cells: int, divisor: int) -> FloatArray:
    """Value (cells,) of rank count // divisor in each cell, NaN in empty ones; values (N,) and their cells (N,)."""
    count = np.bincount(cell, minlength=cells)
    start = np.cumsum(count) - count
    filled = count > 0
    result = np.full(cells, np.nan)
    if len(values):
        by_value = np.empty(len(values), dtype=np.int64)
        ranked = np.argsort(values)
        by_value[ranked] = np.arange(len(values))
        bits = len(values).bit_length()
        ordered = np.sort(cell.astype(np.int64) << bits | by_value) & ((1 << bits) - 1)  # ranks, cell by cell
        result[filled] = values[ranked[ordered[(start + count // divisor)[filled]]]]
    return result


def load_open3d() -> ModuleType:
    """The module `open3d`. Raises `MissingExtraError` with the reason where it cannot be imported."""
    if "open3d" not in sys.modules:
        _preload_libusb()
    try:
        return importlib.import_module("open3d")
    except (ImportError, OSError) as error:
        raise MissingExtraError(f"open3d cannot be imported: {error}; `pip install open3d libusb-package`") from error


def _preload_libusb() -> None:
    if sys.platform.startswith("linux"):
        with suppress(ImportError, OSError):  # the system may have its own libusb
            ctypes.CDLL(str(importlib.import_module("libusb_package").get_library_path()), mode=ctypes.RTLD_GLOBAL)


PERIOD = 0.1  # s between scans of which no time is known
_BEARINGS = 36  # directions in which distances are compared
_UNLIKE = 1.5  # times as far from the scan before as from the one before that: none of a moving sensor, or hardly any
_WINDOW, _IN_TURN = 20, 6  # scans that are compared, and those so that tell two sensors
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class RecordingOptions:
    """Selection of the scans and sensors of a recording.

    sequence  one of several in the source, such as a sequence of KITTI or a scene of nuScenes
    period    s between scans whose times are unknown
    timed     False: without the times of points
    most      scans, from the first on
    topics    of bags, by `lidar`, `laser` and the names of sensors, where there are several
    ego       frame of the vehicle in bags
    mount     (4, 4) place of the sensor on the vehicle, in place of what the recording says
    seed      of the noise of sensors that are made from KITTI's GPS/IMU
    """

    sequence: str | None = None
    period: float = PERIOD
    timed: bool = True
    most: int | None = None
    topics: Mapping[str, str] = field(default_factory=dict)
    ego: str = "base_link"
    mount: FloatArray | None = None
    seed: int = 0


@dataclass(frozen=True, eq=False)
class ScanRecording:
    """K scans in order of time, read on access, a `ScanSequence`.

    layout       its name
    timestamps   (K,) s
    read         gives the scan of a row; place: what errors call a row, such as its file; clock: where its time is from
    ego_T_lidar  (4, 4) place of the sensor on the vehicle; world_T_ego (K, 4, 4) of the recording, None without
    origin       latitude, longitude (deg) and altitude (m) of that world, None where it is unknown
    sensors      gives tables of the vehicle's sensors by name, as `SensorLog` has them, fixes in that world
    mounts       ego_T_sensor (4, 4) of sensors, where the recording says them; known once `sensors` was called
    objects      gives frames with the detections of a folder, None where there are none
    dropped      points without a place by row, of the scans that were read

    Raises `InputError` for no scans, and for time that does not go on.
    """

    layout: str
    timestamps: FloatArray
    read: Callable[[int], Scan]
    place: Callable[[int], str]
    ego_T_lidar: FloatArray = field(default_factory=lambda: np.eye(4))
    world_T_ego: FloatArray | None = None
    origin: tuple[float, float, float] | None = None
    sensors: Callable[[], Mapping[SensorName, FloatArray]] = dict
    mounts: Mapping[SensorName, FloatArray] = field(default_factory=dict)
    objects: Callable[[Path | None], Sequence[Frame]] | None = None
    clock: Callable[[int], str] | None = None
    timed: bool = True
    dropped: dict[int, int] = field(default_factory=dict)
    _profiles: dict[int, FloatArray] = field(default_factory=dict)  # of the rows that were read
    _unlike: set[int] = field(default_factory=set)  # rows that are hardly like the one before

    def __post_init__(self) -> None:
        if not len(self.timestamps):
            raise InputError("expected scans, there are none")
        checked("timestamps", self.timestamps, (None,))
        checked_transform("ego_T_lidar", self.ego_T_lidar)
        if len(back := np.flatnonzero(np.diff(self.timestamps) <= 0)):
            where = (self.clock or self.place)(int(back[0]) + 1)
            before, now = self.timestamps[back[0] : back[0] + 2].tolist()
            raise InputError(f"{where}: time: expected one after {before:.6f} s, of the scan before, got {now:.6f} s")

    def __len__(self) -> int:
        return len(self.timestamps)

    def __getitem__(self, row: int) -> Scan:
        """The scan of a row. Raises `InputError` naming it."""
        with error_context(self.place(row)):
            scan = self.read(row)
        if scan.dropped and row not in self.dropped:
            self.dropped[row] = scan.dropped
        self._compare(row, scan)
        return scan if self.timed else replace(scan, time=None)

    def chosen(self, options: RecordingOptions) -> Self:
        """Without what the options leave out, and without a last scan that cannot be read, as one cut off."""
        world_T_ego, count = self.world_T_ego, len(self) if options.most is None else min(options.most, len(self))
        if options.most is None and count > 1:
            try:
                with error_context(self.place(count - 1)):
                    self.read(count - 1)
            except InputError as error:
                _log.warning("%s; the last scan is left out", error)
                count -= 1
        return replace(
            self,
            timestamps=self.timestamps[:count],
            world_T_ego=None if world_T_ego is None else world_T_ego[:count],
            ego_T_lidar=self.ego_T_lidar if options.mount is None else options.mount,
            timed=options.timed,
        )

    def _compare(self, row: int, scan: Scan) -> None:
        """Raise `InputError` where scans are those of two sensors in turn."""
        now = self._profiles[row] = _profile(scan.points)
        earlier, before = (self._profiles.get(row - back) for back in (2, 1))
        if earlier is not None and before is not None and _change(before, now) > _UNLIKE * _change(earlier, now):
            self._unlike.add(row)
        if (count := sum(row - back in self._unlike for back in range(_WINDOW))) >= _IN_TURN:
            raise InputError(
                f"{self.place(row)}: expected scans of one sensor: {count} of the last {_WINDOW} are far less like the "
                "scan before than like the one before that, as those of two sensors in turn"
            )


def _profile(points: FloatArray) -> FloatArray:
    """Logarithms (`_BEARINGS`,) of the median distance in each direction from above, NaN where there are no points."""
    bearing = (np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) + 0.5) * _BEARINGS
    distance = np.log(np.maximum(np.hypot(points[:, 0], points[:, 1]), 0.1))
    return cell_order_statistics(distance, bearing.astype(np.int64) % _BEARINGS, _BEARINGS, 2)


def _change(before: FloatArray, now: FloatArray) -> float:
    """Mean change of two profiles, 0 where they have no direction in common."""
    change = np.abs(now - before)
    known = np.isfinite(change)
    return float(change[known].mean()) if known.any() else 0.0


def scan_context(scans: ScanSequence, row: int) -> AbstractContextManager[None]:
    """Prefix every `InputError` of the block with what the recording calls the scan, if it is one."""
    return error_context(scans.place(row)) if isinstance(scans, ScanRecording) else nullcontext()
