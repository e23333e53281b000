"""Scans from files, by the suffix of their name, and point clouds written as PLY or PCD.

A file is read as named columns, one value a point, and these make the scan, as those of a message of ROS do
(`scan_of_columns`): places `x`, `y`, `z`, m, in the sensor's frame, an intensity, and the time of each point. Columns
of other names are left out. Points without a place, by which files say "no echo", are dropped and counted.

    .bin       records of floats: x, y, z, then perhaps intensity, ring, time (`columns_of_records`)
    .pcd.bin   nuScenes: float32 x, y, z, intensity, ring
    .pcd       Point Cloud Library: ascii, binary or binary_compressed
    .ply       polygon file format: ascii, little- and big-endian
    .las .laz  ASPRS, by laspy (extra [las]; lazrs for .laz): places, `intensity`, `gps_time`
    .npy       an array (N, 3) or wider, with the columns of .bin
    .npz       arrays `points` (N, 3), and optionally `intensity` (N,) and `time` (N,), or one array for each column

Records have no header. Which floats they are (4 or 8 bytes, of either byte order) is known by what is plausible, and
how many a point has by how unlike the columns are: with a wrong number each column mixes x, y and z, and

    (1 / C) sum_c log(deviation of column c)

is larger, as the entropy of a mixture is. Points that no sensor measures are an error, not a scan.

Headers of PCD and PLY are checked against the data after them. Sources: development kits of KITTI
(https://www.cvlibs.net/datasets/kitti) and nuScenes (https://github.com/nutonomy/nuscenes-devkit, LidarPointCloud);
https://pointclouds.org/documentation/tutorials/pcd_file_format.html; G. Turk, The PLY polygon file format, 1994; LAS
specification 1.4 R15.

Open3D reads compressed PCD.
"""

import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib.util import find_spec
from io import SEEK_END
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_tools.files import isolated, load_archive, load_array, open_bytes, read_bytes, write_bytes
from data_tools.lidar.scan import Scan, load_open3d
from saga_fg import InputError, MissingExtraError
from saga_fg.errors import error_context
from saga_fg.numerics import BoolArray, FloatArray, checked

Columns = Mapping[str, NDArray[Any]]
"""Values (N,) of the points by name."""

_INTENSITIES = ("intensity", "intensities", "reflectivity", "reflectance", "i", "signal")
_TIMES = ("time", "timestamp", "t", "time_stamp", "timestamps", "offset_time", "time_offset", "gps_time", "stamps")
_TURN = 1.5  # s, more than a scan takes
_UNITS = {1.0: _TURN, 1e-3: 1e3 * _TURN, 1e-6: 1e6 * _TURN, 1e-9: 1e9 * _TURN}  # s: longest scan in that unit
_NEAREST, _FARTHEST = 0.01, 1000.0  # m, of what sensors measure
_MEASURED = 0.5  # least share of the points that must lie so


def read_scan(path: str | Path) -> Scan:
    """Read one scan. Raises `InputError` naming the file and what was expected of it."""
    columns = read_columns(path)
    with error_context(str(path)):
        return scan_of_columns(columns)


def read_columns(path: str | Path) -> Columns:
    """The columns of a file, by the suffix of its name. Raises `InputError` as `read_scan` does."""
    path = Path(path)
    name = path.name.lower()
    suffix = next((suffix for suffix in SUFFIXES if name.endswith(suffix)), None)
    if suffix is None:
        raise InputError(f"{path}: expected a name that ends in {', '.join(SUFFIXES)}")
    if path.is_file() and not path.stat().st_size:  # without points, in every format
        return {axis: np.empty(0) for axis in "xyz"}
    with error_context(str(path)):
        return _READERS[suffix](path)


def scan_of_columns(columns: Columns, stamp: float | None = None) -> Scan:
    """The scan of columns; stamp: its timestamp, s, for times of points that are of the same clock.

    Raises `InputError` where a place is missing, and for points that lie where no sensor measures any.
    """
    if missing := [axis for axis in "xyz" if axis not in columns]:
        raise InputError(f"expected a column {missing[0]}, there are {', '.join(columns) or 'none'}")
    with np.errstate(invalid="ignore", over="ignore"):  # a signalling NaN
        points = np.stack([np.asarray(columns[axis], dtype=np.float64) for axis in "xyz"], axis=1)
        known: BoolArray = np.asarray(np.isfinite(points).all(axis=1))
        points = points if (whole := bool(known.all())) else points[known]
        named = next((columns[name] for name in _INTENSITIES if name in columns), None)
        intensity = np.full(len(points), np.nan)
        if named is not None:
            intensity = np.array(named if whole else named[known], dtype=np.float64)  # a copy: files are read-only
            intensity[~np.isfinite(intensity)] = np.nan
        times = next((columns[name] for name in _TIMES if name in columns), None)
        time = None if times is None else relative_times(times if whole else times[known], stamp)
        if len(points) and not plausible(points):
            middle = float(np.median(np.linalg.norm(points, axis=1)))
            raise InputError(
                f"expected points in metres, at distances from {_NEAREST:g} to {_FARTHEST:g} m, "
                f"the median is {middle:.4g}: another unit or another layout"
            )
    return Scan(points, intensity, time, int(len(known) - len(points)))


def scan_columns(columns: Columns) -> dict[str, NDArray[Any]]:
    """Those of the columns that `scan_of_columns` takes."""
    named = [next((name for name in names if name in columns), None) for names in (_INTENSITIES, _TIMES)]
    return {name: columns[name] for name in ("x", "y", "z", *named) if name is not None and name in columns}


def plausible(points: FloatArray) -> bool:
    """True if half of the points (N, 3) that are not at the sensor itself lie where sensors measure."""
    square = np.einsum("ni,ni->n", points, points)
    near = square < _NEAREST**2
    here = near & (square == 0)  # "no echo", as some drivers say it
    return bool((~near & (square < _FARTHEST**2)).sum() >= _MEASURED * (len(points) - here.sum()))


def relative_times(values: NDArray[Any], stamp: float | None = None) -> FloatArray | None:
    """Times (N,) of points, s relative to the scan's stamp, from values in s, ms, us or ns; None where all are one.

    The unit is told by the span, as no scan takes longer than 1.5 s; whole numbers are no seconds. Times of a clock are
    relative to `stamp` if that is of the same one (the first is nearer to it than to 0), to the first point else.
    Raises `InputError` for a longer span, and for times that are not finite.
    """
    if not len(values):
        return None
    first, last = values.min(), values.max()
    span = float(last) - float(first)
    if not np.isfinite(span):
        raise InputError("time: expected finite times of the points")
    if span == 0:
        return None
    units = [unit for unit, longest in _UNITS.items() if span <= longest and (unit < 1 or values.dtype.kind == "f")]
    if not units:
        raise InputError(f"time: expected the times of one scan, in s, ms, us or ns, they span {span:g}")
    begin, since = float(first) * units[0], (values - first).astype(np.float64) * units[0]
    if stamp is not None and abs(begin - stamp) < min(_TURN, abs(begin)):
        return np.asarray(since + (begin - stamp))
    return np.asarray(since + begin if abs(begin) < _TURN else since)


def read_records(path: str | Path, record: np.dtype[Any]) -> Scan:
    """Read a scan of records of a known layout. Raises `InputError` as `read_scan` does."""
    with error_context(str(path)):
        return scan_of_columns(record_columns(read_bytes(path), record))


def record_columns(content: bytes, record: np.dtype[Any]) -> Columns:
    """The columns of records of a known layout. Raises `InputError` for a size that is no multiple of theirs."""
    if len(content) % record.itemsize:
        names = ", ".join(record.names or ())
        raise InputError(f"expected records of {record.itemsize} bytes ({names}), got {len(content)} bytes")
    points = np.frombuffer(content, dtype=record)
    return {name: points[name] for name in record.names or ()}


NUSCENES = np.dtype([(name, "<f4") for name in ("x", "y", "z", "intensity", "ring")])
KITTI = np.dtype([(name, "<f4") for name in ("x", "y", "z", "intensity")])
_FLOATS = ("<f4", "<f8", ">f4")
_WIDTHS = range(3, 9)  # floats of a point
_SAMPLE = 30_000  # numbers that tell the layout
_MAX_SIZE, _MIN_SIZE, _GARBAGE = 1e7, 1e-12, 0.01  # sizes of numbers, and the share beyond and below that is garbage
_UNLIKE = 0.05  # of log deviations that differ; within it the fewest columns are taken
_FEW = 100  # points


def columns_of_records(content: bytes) -> Columns:
    """The columns of records of which nothing is known. Raises `InputError` where no layout gives a scan.

    Points that tell nothing, as they are too few or all without a place, are taken for KITTI's, where their size allows
    it.
    """
    fits = len(content) % KITTI.itemsize == 0
    few = len(content) < _FEW * KITTI.itemsize
    if fits and (few or np.isnan(np.frombuffer(content, dtype="<f4").reshape(-1, 4)[:, :3]).all()):
        return record_columns(content, KITTI)
    for kind in _FLOATS:
        found: dict[int, float] = {}
        for width in _WIDTHS:
            if len(content) % (width * int(kind[2])):
                continue
            with np.errstate(all="ignore"):
                table = np.frombuffer(content, dtype=kind).reshape(-1, width)[: _SAMPLE // width].astype(np.float64)
                table = table[np.isfinite(table).all(axis=1)]
                size = np.abs(table)
                if not size.size or ((size > _MAX_SIZE) | ((size > 0) & (size < _MIN_SIZE))).mean() > _GARBAGE:
                    break
                spread = np.log(table.std(axis=0) + 1e-3)
            if np.ptp(spread) > _UNLIKE:  # else each column is a mixture
                found[width] = float(spread.mean())
        if found:
            width = min(width for width, value in found.items() if value <= min(found.values()) + _UNLIKE)
            return _named(np.frombuffer(content, dtype=kind).reshape(-1, width))
    raise InputError(
        f"expected records of 3 to 8 floats, x, y, z first, in metres; the {len(content)} bytes are none, or cut off"
    )


def _named(table: NDArray[Any]) -> Columns:
    """Columns of numbers by name: after the intensity small whole numbers are rings, and fractions that grow times."""
    names = ["x", "y", "z", "intensity"][: table.shape[1]]
    for column in table[:, 4:].T:
        name = f"column {len(names) + 1}"
        with np.errstate(invalid="ignore"):  # a signalling NaN
            whole = bool((column == np.floor(column)).all())
        if whole and "ring" not in names and column.min() >= 0 and column.max() < 256:
            name = "ring"
        elif not whole and "time" not in names and np.abs(column).max() < _TURN and _grows(column):
            name = "time"
        names.append(name)
    return dict(zip(names, table.T, strict=True))


def _grows(values: NDArray[Any]) -> bool:
    return len(values) > 1 and bool((np.diff(values) >= 0).mean() > 0.9)


_PCD_KEYS = ("FIELDS", "SIZE", "TYPE", "WIDTH", "HEIGHT", "POINTS", "DATA")
_PCD_TYPES = {("F", 4), ("F", 8), *((kind, size) for kind in "IU" for size in (1, 2, 4, 8))}
_PLY_FORMATS = ("ascii", "binary_little_endian", "binary_big_endian")
_PLY_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
LONGEST_HEADER = 20_000  # bytes
LONGEST_LINE = 1000  # of a header, bytes
LONGEST_WORD = 100  # bytes
MOST_VALUES = 100  # of a point


def pcd_columns(path: Path) -> Columns:
    """The fields of a PCD file, of a compressed one by Open3D.

    Raises `InputError` where the header is broken or promises more than there is.
    """
    lines, body = _header(read_bytes(path), b"DATA")
    found = {words[0]: words[1:] for words in map(str.split, lines) if words}
    for key in _PCD_KEYS:
        _expect(key in found, f"a line {key}")
    fields = found["FIELDS"]
    sizes, counts = (
        _numbers(key, found.get(key, ["1"] * len(fields)), len(fields), 8 if key == "SIZE" else MOST_VALUES)
        for key in ("SIZE", "COUNT")
    )
    _expect(
        len(found["TYPE"]) == len(fields) and {"x", "y", "z"} <= set(fields), "fields x, y and z, and a TYPE for each"
    )
    _expect(set(zip(found["TYPE"], sizes, strict=True)) <= _PCD_TYPES, "types F of 4 or 8 bytes, I or U of 1 to 8")
    places = {count for name, count in zip(fields, counts, strict=True) if name in ("x", "y", "z")}
    _expect(places == {1}, "one x, one y and one z a point")
    width, height, points = (_numbers(key, found[key], 1, 2**31 - 1, 0)[0] for key in ("WIDTH", "HEIGHT", "POINTS"))
    _expect(points == width * height, "POINTS to be WIDTH x HEIGHT")
    kinds = [f"<{kind.lower()}{size}" for kind, size in zip(found["TYPE"], sizes, strict=True)]
    record = np.dtype([(str(k), kind, (count,)) for k, (kind, count) in enumerate(zip(kinds, counts, strict=True))])
    match found["DATA"][:1]:
        case ["ascii"]:
            table = _rows(body, points, sum(counts))
            columns = np.split(table, np.cumsum(counts)[:-1], axis=1)
        case ["binary"]:
            rows = _records(body, record, points)
            columns = [rows[str(k)] for k in range(len(fields))]
        case ["binary_compressed"]:
            packed, unpacked = struct.unpack("<II", body[:8]) if len(body) >= 8 else (0, -1)
            _expect(unpacked == points * record.itemsize, f"{points * record.itemsize} bytes of compressed points")
            _room(body[8:], packed)
            return dict(isolated("expected a point cloud that Open3D can read", _open3d_columns, path))
        case _:
            raise InputError("expected DATA to be ascii, binary or binary_compressed")
    single = [k for k, count in enumerate(counts) if count == 1]
    return {fields[k]: columns[k][:, 0] for k in reversed(single)}  # of two of one name the first


def _open3d_columns(path: Path) -> Iterator[tuple[str, NDArray[Any]]]:
    cloud = load_open3d().t.io.read_point_cloud(str(path)).point
    places = cloud["positions"].numpy()
    for k, axis in enumerate("xyz"):
        yield axis, places[:, k].copy()
    for name in cloud:
        if cloud[name].shape[1:] == [1]:
            yield name, cloud[name].numpy()[:, 0].copy()


def ply_columns(content: bytes) -> Columns:
    """Raises `InputError` where the header of a PLY file is broken or promises more than there is."""
    lines, body = _header(content, b"end_header")
    words = [line.split() for line in lines if line.split() and line.split()[0] not in ("comment", "obj_info")]
    begins = [line[:1] for line in words[:2]] == [["ply"], ["format"]]
    _expect(begins and len(words[0]) == 1 and len(words[1]) == 3, "the lines ply and format")
    form = words[1][1]
    _expect(form in _PLY_FORMATS, f"the format {', '.join(_PLY_FORMATS)}")
    _expect(words[-1] == ["end_header"], "a line with end_header alone")
    first = words[2] if len(words) > 3 else []
    _expect(first[:2] == ["element", "vertex"] and len(first) == 3, "vertices as the first element")
    (points,) = _numbers("element vertex", words[2][2:], 1, 2**31 - 1, 0)
    properties = []
    for line in words[3:-1]:
        if line[0] != "property":
            break
        _expect(len(line) == 3 and line[1] in _PLY_TYPES, "vertices with properties of one number each")
        properties.append(line)
    names = [line[2] for line in properties]
    once = len(set(names)) == len(names) <= MOST_VALUES
    _expect(once and {"x", "y", "z"} <= set(names), "properties x, y and z, and each once")
    others = [_numbers("element", line[2:], 1, 2**31 - 1, 0) for line in words[3:] if line[0] == "element"]
    _expect(not any(map(any, others)), "vertices alone")
    if form == "ascii":
        return dict(zip(names, _rows(body, points, len(properties)).T, strict=True))
    order = "<" if form == "binary_little_endian" else ">"
    rows = _records(body, np.dtype([(name, order + _PLY_TYPES[kind]) for _, kind, name in properties]), points)
    return {name: rows[name] for name in names}


def _header(content: bytes, last: bytes) -> tuple[list[str], bytes]:
    """The lines up to the one that begins with `last`, and what follows."""
    lines, at = [], 0
    while at < min(len(content), LONGEST_HEADER):
        end = content.find(b"\n", at)
        end = len(content) if end < 0 else end
        line = content[at:end]
        at = end + 1
        _expect(line.isascii() and b"\0" not in line, "a header of plain text")
        short = len(line) <= LONGEST_LINE and max(map(len, line.split()), default=0) <= LONGEST_WORD
        _expect(short, f"a header with lines of at most {LONGEST_LINE} and words of at most {LONGEST_WORD} bytes")
        lines.append(line.decode("ascii").rstrip("\r"))
        if line.startswith(last):
            return lines, content[at:]
    raise InputError(f"expected a header that ends in a line {last.decode()}")


def _numbers(what: str, words: Sequence[str], count: int, most: int, least: int = 1) -> list[int]:
    whole = len(words) == count and all(word.isdecimal() and least <= int(word[:20]) <= most for word in words)
    _expect(whole, f"{what} to be {count} whole numbers from {least} to {most}")
    return [int(word) for word in words]


def _rows(body: bytes, points: int, values: int) -> FloatArray:
    """The numbers (points, values) of lines."""
    if not points:
        return np.empty((0, values))
    lines = [line for line in body.splitlines() if line.strip()][:points]
    try:
        table = np.loadtxt(lines, comments=None, ndmin=2, encoding="latin-1") if len(lines) == points else np.empty(0)
    except ValueError:
        table = np.empty(0)
    _expect(table.shape == (points, values), f"{points} lines of {values} numbers after the header")
    return table


def _records(body: bytes, record: np.dtype[Any], points: int) -> NDArray[Any]:
    _room(body, points * record.itemsize)
    return np.frombuffer(body, dtype=record, count=points)


def _room(body: bytes, size: int) -> None:
    _expect(len(body) >= size, f"{size} bytes after the header, there are {len(body)}")


def _expect(found: bool, what: str) -> None:
    """Raise `InputError` unless what was expected is found."""
    if not found:
        raise InputError(f"expected {what}")


def _array(path: Path) -> Columns:
    with open_bytes(path) as file:
        array = load_array(file)
    if array.shape == (0,):
        array = array.reshape(0, 3)
    if array.ndim != 2 or not 3 <= array.shape[1] <= MOST_VALUES or array.dtype.kind not in "fiu":
        raise InputError(f"expected numbers (N, 3) or wider, got {array.dtype} {array.shape}")
    return _named(array) if len(array) else {axis: array[:, k] for k, axis in enumerate("xyz")}


def _arrays(path: Path) -> Columns:
    columns = dict(load_archive(path)[1])
    if "points" in columns:
        points = columns.pop("points")
        if points.ndim != 2 or points.shape[1] != 3:
            raise InputError(f"points: expected shape (N, 3), got {points.shape}")
        columns |= {axis: points[:, k] for k, axis in enumerate("xyz")}
    if not {"x", "y", "z"} <= set(columns):
        raise InputError("expected the array points (N, 3), or arrays x, y and z")
    size = columns["x"].shape
    if bad := [name for name, each in columns.items() if each.shape != size or each.dtype.kind not in "fiub"]:
        raise InputError(f"{bad[0]}: expected numbers of shape {size}, got {columns[bad[0]].shape}")
    return columns


_LAS_HEADER, _MIN_LAS_HEADER, _LAS_RECORD = 247, 227, 54  # bytes: checked of a header, of the shortest one, of a record


def _las(path: Path) -> Columns:
    if find_spec("laspy") is None:
        raise MissingExtraError("files .las and .laz need laspy: pip install 'saga-fg[las]'")
    with open_bytes(path) as file:
        header, size = file.read(_LAS_HEADER).ljust(_LAS_HEADER, b"\0"), file.seek(0, SEEK_END)
    start, records = struct.unpack_from("<II", header, 96)
    extended = struct.unpack_from("<I", header, 243)[0] if header[25] >= 4 else 0
    if header[:4] != b"LASF" or not _MIN_LAS_HEADER <= start <= size or _LAS_RECORD * (records + extended) > size:
        raise InputError(f"expected a header of LAS, with its records in the {size} bytes of the file")
    return dict(isolated("expected a file that laspy can read", _las_columns, path))


def _las_columns(path: Path) -> Iterator[tuple[str, NDArray[Any]]]:
    import laspy

    with open_bytes(path) as file, laspy.open(file, closefd=False) as reader:
        points, cloud = reader.header.point_count, reader.read()
    if len(cloud.points) != points:
        raise InputError(f"{path}: expected {points} points as the header says, got {len(cloud.points)}")
    for name in (
        "x",
        "y",
        "z",
        *(name for name in ("intensity", "gps_time") if name in cloud.point_format.dimension_names),
    ):
        yield name, np.asarray(cloud[name])


_READERS: dict[str, Callable[[Path], Columns]] = {
    ".pcd.bin": lambda path: record_columns(read_bytes(path), NUSCENES),
    ".bin": lambda path: columns_of_records(read_bytes(path)),
    ".pcd": pcd_columns,
    ".ply": lambda path: ply_columns(read_bytes(path)),
    ".las": _las,
    ".laz": _las,
    ".npy": _array,
    ".npz": _arrays,
}
SUFFIXES = tuple(_READERS)


_CLOUD_HEADERS = {
    ".ply": "ply\nformat binary_little_endian 1.0\nelement vertex {0}\n"
    "property float x\nproperty float y\nproperty float z\nend_header\n",
    ".pcd": "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {0}\nHEIGHT 1\n"
    "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {0}\nDATA binary\n",
}


def write_cloud(path: str | Path, points: FloatArray) -> None:
    """Write points (N, 3), m, as float32, atomically.

    path: .ply or .pcd
    Raises `InputError` for another suffix, and positions that are not finite.
    """
    header = _CLOUD_HEADERS.get(Path(path).suffix.lower())
    if header is None:
        raise InputError(f"{path}: expected a name that ends in .ply or .pcd")
    content = checked("points", points, (None, 3)).astype("<f4").tobytes()
    write_bytes(path, header.format(len(points)).encode("ascii") + content)
