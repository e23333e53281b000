"""Sweeps of a LiDAR: de-skewed, thinned to voxels, without points on moving objects.

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
"""

import ctypes
import importlib
import sys
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Protocol, Self

import gtsam
import numpy as np
from scipy.ndimage import label

from saga_fg.errors import InputError, MissingExtraError
from saga_fg.numerics import BoolArray, FloatArray, IntArray, checked, yaw_transform
from saga_fg.types import Boxes


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
    if not sys.platform.startswith("linux"):
        return
    try:
        path = importlib.import_module("libusb_package").get_library_path()
    except ImportError:
        return  # the system may have its own libusb
    if path is not None:
        ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)
