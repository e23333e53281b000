"""Scans and clouds in files: headers checked before Open3D reads them.

Scans read from files, by the suffix of their name, and point clouds written as PLY or PCD, by Open3D.

    .bin      KITTI: float32 x, y, z, intensity of each point, without a header
    .pcd.bin  nuScenes: float32 x, y, z, intensity, ring of each point, without a header
    .pcd      Point Cloud Library, read by Open3D; the field `intensity` is kept
    .ply      polygon file format, read by Open3D; the property `intensity` is kept
    .npy      an array (N, 3) or wider: x, y, z and, in a fourth column, intensity
    .npz      arrays `points` (N, 3), and optionally `intensity` (N,) and `time` (N,)

Points are metres in the sensor's frame. Points that are not finite mean "no echo" in PCD files and are left out there;
elsewhere they are errors. Sources: development kits of KITTI (https://www.cvlibs.net/datasets/kitti) and nuScenes
(https://github.com/nutonomy/nuscenes-devkit, LidarPointCloud); G. Turk, The PLY polygon file format, 1994.

Validation of PCD and PLY files before Open3D reads them.

A wrong header makes a C++ reader read or allocate out of bounds. Therefore every number in the header is checked, and
that the file contains the announced points.

Sources: https://pointclouds.org/documentation/tutorials/pcd_file_format.html and
http://paulbourke.net/dataformats/ply.

Open3D, imported on first use, because the import takes half a second and much memory.

On Linux its extension links `libusb-1.0.so.0` (for depth cameras), which neither its wheel nor a slim system carries.
The package `libusb-package` carries it; once loaded with global symbols, it satisfies the later link by its name.
"""

from __future__ import annotations

import ctypes
import importlib
import struct
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import BinaryIO, NoReturn

import numpy as np
from numpy.typing import NDArray

from data_tools.files.atomic_files import write_bytes
from data_tools.files.input_files import error_context, open_bytes
from data_tools.files.isolated_reading import isolated
from data_tools.files.readers import load_archive, load_array
from data_tools.lidar.scan import Scan
from saga_fg.errors import InputError, MissingExtraError
from saga_fg.numerics.arrays import FloatArray, checked

_PCD_KEYS = ("FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "POINTS", "DATA")
_PCD_TYPES = {("F", 4), ("F", 8), *((kind, size) for kind in "IU" for size in (1, 2, 4, 8))}
_PLY_SIZES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "float", "int32", "uint32", "float32"), 4),
    **dict.fromkeys(("double", "float64"), 8),
}
LONGEST_HEADER = 20_000  # bytes
LONGEST_LINE = 1000  # of a header, bytes
LONGEST_WORD = 100  # bytes; RPly, which reads PLY files for Open3D, writes beyond its buffer from 256 on
MOST_VALUES = 100  # of a point


def check_pcd(content: bytes) -> None:
    """Raises `InputError` where the header of a PCD file is broken or promises more than there is."""
    lines, body = _header(content, b"DATA")
    found: dict[str, list[str]] = {}
    for line in lines:
        key, *values = line.split() or ["#"]
        if not key.startswith("#"):
            found[key] = values
    missing = [key for key in _PCD_KEYS if key not in found and key != "COUNT"]
    if missing:
        _fault(f"a line {missing[0]}")
    fields = found["FIELDS"]
    sizes, counts = (
        _numbers(key, found.get(key, ["1"] * len(fields)), len(fields), 8 if key == "SIZE" else MOST_VALUES)
        for key in ("SIZE", "COUNT")
    )
    if len(found["TYPE"]) != len(fields) or not {"x", "y", "z"} <= set(fields):
        _fault("fields x, y and z, and a TYPE for each")
    if not set(zip(found["TYPE"], sizes, strict=True)) <= _PCD_TYPES:
        _fault("types F of 4 or 8 bytes, I or U of 1 to 8")
    if any(count != 1 for name, count in zip(fields, counts, strict=True) if name in ("x", "y", "z")):
        _fault("one x, one y and one z a point")
    width, height, points = (_numbers(key, found[key], 1, 2**31 - 1, 0)[0] for key in ("WIDTH", "HEIGHT", "POINTS"))
    if points != width * height:
        _fault("POINTS to be WIDTH x HEIGHT")
    size = points * sum(size * count for size, count in zip(sizes, counts, strict=True))
    kind = found["DATA"][:1]
    if kind == ["ascii"]:
        _rows(body, points, sum(counts))
    elif kind == ["binary"]:
        _room(body, size)
    elif kind == ["binary_compressed"]:
        packed, unpacked = struct.unpack("<II", body[:8]) if len(body) >= 8 else (0, -1)
        if unpacked != size:
            _fault(f"{size} bytes of compressed points")
        _room(body[8:], packed)
    else:
        _fault("DATA to be ascii, binary or binary_compressed")


def check_ply(content: bytes) -> None:
    """Raises `InputError` where the header of a PLY file is broken or promises more than there is."""
    lines, body = _header(content, b"end_header")
    words = [line.split() for line in lines if line.split() and line.split()[0] not in ("comment", "obj_info")]
    if not words or words[0] != ["ply"] or len(words) < 2 or words[1][:1] != ["format"] or len(words[1]) != 3:
        _fault("the lines ply and format")
    form = words[1][1]
    if form not in ("ascii", "binary_little_endian", "binary_big_endian"):
        _fault("the format ascii, binary_little_endian or binary_big_endian")
    if words[-1] != ["end_header"]:
        _fault("a line with end_header alone")
    if len(words) < 4 or words[2][:2] != ["element", "vertex"] or len(words[2]) != 3:
        _fault("vertices as the first element")
    (points,) = _numbers("element vertex", words[2][2:], 1, 2**31 - 1, 0)
    properties = []
    for line in words[3:-1]:
        if line[0] != "property":
            break
        if len(line) != 3 or line[1] not in _PLY_SIZES:
            _fault("vertices with properties of one number each")
        properties.append(line)
    names = [line[2] for line in properties]
    if not {"x", "y", "z"} <= set(names) or len(set(names)) != len(names) or len(names) > MOST_VALUES:
        _fault("properties x, y and z, and each once")
    if any(line[:1] == ["element"] and _numbers("element", line[2:], 1, 2**31 - 1, 0) != [0] for line in words[3:]):
        _fault("vertices alone")
    if form == "ascii":
        _rows(body, points, len(properties))
    else:
        _room(body, points * sum(_PLY_SIZES[line[1]] for line in properties))


def _header(content: bytes, last: bytes) -> tuple[list[str], bytes]:
    """The lines up to the one that begins with `last`, and what follows."""
    lines, at = [], 0
    while at < min(len(content), LONGEST_HEADER):
        end = content.find(b"\n", at)
        end = len(content) if end < 0 else end
        line = content[at:end]
        at = end + 1
        if not line.isascii() or b"\0" in line:
            _fault("a header of plain text")
        if len(line) > LONGEST_LINE or max(map(len, line.split()), default=0) > LONGEST_WORD:
            _fault(f"a header with lines of at most {LONGEST_LINE} and words of at most {LONGEST_WORD} bytes")
        lines.append(line.decode("ascii").rstrip("\r"))
        if line.startswith(last):
            return lines, content[at:]
    raise InputError(f"expected a header that ends in a line {last.decode()}")


def _numbers(what: str, words: Sequence[str], count: int, most: int, least: int = 1) -> list[int]:
    if len(words) != count or not all(word.isdigit() and least <= int(word[:20]) <= most for word in words):
        _fault(f"{what} to be {count} whole numbers from {least} to {most}")
    return [int(word) for word in words]


def _rows(body: bytes, points: int, values: int) -> None:
    rows = [line.split() for line in body.splitlines() if line.strip()]
    if len(rows) < points or any(len(row) != values for row in rows[:points]):
        _fault(f"{points} lines of {values} numbers after the header")
    if any(len(word) > LONGEST_WORD for row in rows[:points] for word in row):
        _fault(f"numbers of at most {LONGEST_WORD} bytes after the header")
    try:
        for row in rows[:points]:
            for word in row:
                float(word)
    except ValueError:
        _fault("numbers after the header")


def _room(body: bytes, size: int) -> None:
    if len(body) < size:
        _fault(f"{size} bytes after the header, there are {len(body)}")


def _fault(expected: str) -> NoReturn:
    raise InputError(f"expected {expected}")


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
