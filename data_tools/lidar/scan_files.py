"""Scans read from files, by the suffix of their name, and point clouds written as PLY or PCD, by Open3D.

    .bin      KITTI: float32 x, y, z, intensity of each point, without a header
    .pcd.bin  nuScenes: float32 x, y, z, intensity, ring of each point, without a header
    .pcd      Point Cloud Library, read by Open3D; the field `intensity` is kept
    .ply      polygon file format, read by Open3D; the property `intensity` is kept
    .npy      an array (N, 3) or wider: x, y, z and, in a fourth column, intensity
    .npz      arrays `points` (N, 3), and optionally `intensity` (N,) and `time` (N,)

Points are metres in the sensor's frame. Points that are not finite mean "no echo" in PCD files and are left out there;
elsewhere they are errors. Sources: development kits of KITTI (https://www.cvlibs.net/datasets/kitti) and nuScenes
(https://github.com/nutonomy/nuscenes-devkit, LidarPointCloud); G. Turk, The PLY polygon file format, 1994.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from data_tools.files.atomic_files import write_bytes
from data_tools.files.error_messages import error_context
from data_tools.files.input_files import open_bytes
from data_tools.files.isolated_reading import isolated
from data_tools.files.numpy_files import load_archive, load_array
from data_tools.lidar.cloud_headers import check_pcd, check_ply
from data_tools.lidar.open3d_loader import load_open3d
from data_tools.lidar.scan import Scan
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, checked

_PROBLEM = "expected a point cloud that Open3D can read"


def read_scan(path: str | Path) -> Scan:
    """Read one scan. Raises `InputError` naming the file and what was expected of it."""
    path = Path(path)
    name = path.name.lower()
    ending = next((ending for ending in _READERS if name.endswith(ending)), None)
    if ending is None:
        raise InputError(f"{path}: expected a name that ends in {', '.join(_READERS)}")
    with open_bytes(path) as file, error_context(str(path)):
        return _READERS[ending](file, path)


def write_cloud(path: str | Path, points: FloatArray, colours: NDArray[np.uint8] | None = None) -> None:
    """Write points (N, 3), m, as float32, and red, green, blue (N, 3) from 0 to 255 if given, atomically.

    path: .ply or .pcd
    Raises `InputError` for another suffix, positions that are not finite, and colours of another shape or type.
    """
    points, suffix = checked("points", points, (None, 3)), Path(path).suffix.lower()
    if suffix not in (".ply", ".pcd"):
        raise InputError(f"{path}: expected a name that ends in .ply or .pcd")
    if colours is not None and (colours.shape != points.shape or colours.dtype != np.uint8):
        raise InputError(f"colours: expected {points.shape} bytes, got {colours.dtype} {colours.shape}")
    if not len(points) and suffix == ".ply":  # which Open3D refuses
        write_bytes(path, _EMPTY.encode("ascii"))
        return
    open3d = load_open3d()
    cloud = open3d.t.geometry.PointCloud(open3d.core.Tensor(np.ascontiguousarray(points, dtype=np.float32)))
    if colours is not None:
        cloud.point.colors = open3d.core.Tensor(np.ascontiguousarray(colours))
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder) / f"cloud{suffix}"
        if not open3d.t.io.write_point_cloud(str(whole), cloud):
            raise InputError(f"{path}: Open3D cannot write it")
        write_bytes(path, whole.read_bytes())


def _kitti(file: BinaryIO, _: Path) -> Scan:
    return _of_columns(_records(file.read(), 4))


def _nuscenes(file: BinaryIO, _: Path) -> Scan:
    return _of_columns(_records(file.read(), 5))


def _records(content: bytes, columns: int) -> FloatArray:
    size = 4 * columns
    if not content or len(content) % size:
        raise InputError(f"expected records of {size} bytes ({columns} float32 a point), got {len(content)} bytes")
    with np.errstate(invalid="ignore"):  # NaN is refused by the scan
        return np.frombuffer(content, dtype="<f4").reshape(-1, columns).astype(np.float64)


def _array(file: BinaryIO, _: Path) -> Scan:
    array = load_array(file)
    if array.ndim != 2 or array.shape[1] < 3 or array.dtype.kind not in "fiu":
        raise InputError(f"expected numbers (N, 3) or wider, got {array.dtype} {array.shape}")
    return _of_columns(np.asarray(array, dtype=np.float64))


def _arrays(_: BinaryIO, path: Path) -> Scan:
    columns = load_archive(path, ("points", "intensity", "time"))[1]
    if "points" not in columns:
        raise InputError("expected the array points (N, 3)")
    scan = Scan.of(columns["points"])
    return Scan(scan.points, columns.get("intensity", scan.intensity), columns.get("time"))


def _cloud(file: BinaryIO, path: Path) -> Scan:
    check = check_pcd if path.suffix.lower() == ".pcd" else check_ply
    check(file.read())
    ((points, intensity),) = isolated(_PROBLEM, _open3d_columns, path)
    finite = np.isfinite(points).all(axis=1)
    scan = Scan.of(points[finite])
    return scan if intensity is None else Scan(scan.points, intensity.reshape(len(points))[finite])


def _open3d_columns(path: Path) -> Iterator[tuple[FloatArray, FloatArray | None]]:
    """Points (N, 3) and intensities (N,) or (N, 1), as they are in the file."""
    cloud = load_open3d().t.io.read_point_cloud(str(path)).point
    if "positions" not in cloud:
        raise InputError(f"{path}: {_PROBLEM}, with x, y, z of each point")
    intensity = cloud["intensity"].numpy().astype(np.float64) if "intensity" in cloud else None
    yield cloud["positions"].numpy().astype(np.float64), intensity


def _of_columns(columns: FloatArray) -> Scan:
    intensity = columns[:, 3] if columns.shape[1] > 3 else np.full(len(columns), np.nan)
    return Scan(columns[:, :3], intensity)


_EMPTY = "\n".join(
    ["ply", "format ascii 1.0", "element vertex 0", *(f"property float {axis}" for axis in "xyz"), "end_header", ""]
)
_READERS: dict[str, Callable[[BinaryIO, Path], Scan]] = {
    ".pcd.bin": _nuscenes,
    ".bin": _kitti,
    ".pcd": _cloud,
    ".ply": _cloud,
    ".npy": _array,
    ".npz": _arrays,
}
