"""Layouts of recordings of LiDAR scans, found by looking at a folder. Each is a short function beside its source.

A layout of one's own is a function `open(source, options)` that returns a `ScanRecording`: MODULE:NAME, or an entry
point of the group `saga_fg.scans` of an installed package.

Marked *untested on originals*: written by the specification, and tested with files that were made by it.
"""

import logging
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from data_tools.datasets.kitti import KittiTracking, kitti_scans, read_origin, read_transform
from data_tools.datasets.nuscenes import nuscenes_scans, read_table, table_folder
from data_tools.files import read_lines
from data_tools.files import read_table as read_rows
from data_tools.lidar import (
    KITTI,
    SUFFIXES,
    RecordingOptions,
    Scan,
    ScanRecording,
    read_columns,
    read_records,
    scan_of_columns,
)
from data_tools.recordings.bags import is_bag, open_bag
from data_tools.sensor_logs import kitti_sensor_log
from data_tools.trajectories import read_kitti_poses, read_tum_poses
from saga_fg import InputError
from saga_fg.errors import error_context, unknown_name
from saga_fg.numerics import FloatArray, inverse_transform, quaternion_rotation, rigid_transforms
from saga_fg.parts import find
from saga_fg.providers.vehicle_sensors import mounting
from saga_fg.tables import seconds_of_dates

GROUP = "saga_fg.scans"
"""Group of entry points of packages that bring layouts."""

Opener = Callable[[Path, RecordingOptions], ScanRecording]
_TABLES = ("times.txt", "timestamps.txt", "times.csv", "timestamps.csv")
_UNITS = {1e17: 1e-9, 1e14: 1e-6, 1e11: 1e-3, 0.0: 1.0}  # numbers from these on are in units of so many s
_OUSTER = (64, 1024)  # beams and columns of a turn
_log = logging.getLogger(__name__)


def open_recording(
    source: str | Path, options: RecordingOptions | None = None, layout: str | None = None
) -> ScanRecording:
    """Open a recording; layout: one of `LAYOUTS`, MODULE:NAME or an entry point, found by looking if None.

    Raises `InputError` naming the source where it is none, and what is wrong in it.
    """
    source, options = Path(source), options or RecordingOptions()
    if layout is not None:
        opener = _opener(layout)
    else:
        if not source.exists():
            raise InputError(f"{source}: expected a recording of scans, there is no such file or folder")
        opener = next((opener for fits, opener in LAYOUTS.values() if fits(source)), _folder)
    try:
        found = opener(source, options)
        if not isinstance(found, ScanRecording):
            raise InputError(f"layout {layout}: expected a ScanRecording, got {type(found).__name__}")
        return found.chosen(options)
    except InputError as error:
        if str(source) in str(error):  # a file of it
            raise
        raise InputError(f"{source}: {error}") from error


def _opener(layout: str) -> Opener:
    opener: Opener = find("layout", layout, GROUP, {name: opener for name, (_, opener) in LAYOUTS.items()})
    return opener


def _folder(source: Path, options: RecordingOptions) -> ScanRecording:
    """Scans in files of one format, with times in a table (`times.txt`, ... there or above) or in their names.

    A table has a time on each line, in the order of the numbers in the names, or the name of a file before it. Times
    are s, ms, us or ns, known by their size, or dates. Names with less than a time in them are numbers of scans,
    `period` s apart.
    """
    there = list(source.iterdir()) if source.is_dir() else [source]
    files = _in_order(path for path in there if path.name.lower().endswith(SUFFIXES))
    if not files:
        if any(path.suffix == ".bag" for path in there):
            raise InputError("expected a bag of ROS 2 or MCAP: convert that of ROS 1 first: rosbags-convert --src FILE")
        raise InputError(f"expected scans {', '.join(SUFFIXES)}, a bag, or one of {', '.join(LAYOUTS)}; there are none")
    kinds = sorted({_suffix(path) for path in files})
    if len(kinds) > 1:
        raise InputError(f"expected scans of one format, there are {', '.join(kinds)}")
    table = next((each for at in (source, source.parent) for name in _TABLES if (each := at / name).is_file()), None)
    if table is not None and source.is_dir():
        times, lines, by_name = _times_of_table(table, files)
        if by_name:
            order = np.argsort(times, kind="stable").tolist()
            files, times, lines = [files[k] for k in order], times[order], [lines[k] for k in order]
        return _of_files(
            "folder", files, times, _read_alike(files, times), clock=lambda row: f"{table}: line {lines[row]}"
        )
    times = _times_of_names(files, options.period)
    return _of_files("folder", files, times, _read_alike(files, times))


def _read_alike(files: Sequence[Path], times: FloatArray) -> Callable[[Path], Scan]:
    """A reader of files at some times (K,), s, that must have the columns of the first one with points."""
    first: dict[str, tuple[str, ...]] = {}
    stamps = dict(zip(files, times.tolist(), strict=True))

    def read(path: Path) -> Scan:
        columns = read_columns(path)
        if len(columns["x"]):
            names = first.setdefault("names", tuple(columns))
            if set(columns) != set(names):
                raise InputError(
                    f"expected the columns {', '.join(names)} of the scans before, got {', '.join(columns)}: "
                    "a scan of another sensor?"
                )
        return scan_of_columns(columns, stamps[path])

    for path in files:
        if path.stat().st_size:
            with error_context(str(path)):
                read(path)
            break
    return read


def _of_files(
    layout: str, files: Sequence[Path], times: FloatArray, read: Callable[[Path], Scan], **given: Any
) -> ScanRecording:
    return ScanRecording(layout, times, lambda row: read(files[row]), lambda row: str(files[row]), **given)


def _suffix(path: Path) -> str:
    return next(suffix for suffix in SUFFIXES if path.name.lower().endswith(suffix))


def _stem(path: Path) -> str:
    return path.name[: -len(_suffix(path))]


def _seconds(text: str) -> float:
    """A time, s, of a number in s, ms, us or ns, or of a date, UTC unless it says another zone; else `ValueError`."""
    if ":" in text:
        return float(seconds_of_dates([text])[0])
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(text)
    return value * next(unit for least, unit in _UNITS.items() if abs(value) >= least)


def _in_order(files: Iterable[Path]) -> list[Path]:
    """Files by the times or numbers at the end of their names; where these tell them not apart, by all numbers."""

    def words(path: Path) -> list[tuple[str, int]]:
        found = re.split(r"(\d+)", _stem(path))  # text and numbers by turns
        return [(text, int(number)) for text, number in zip(found[::2], [*found[1::2], "-1"], strict=True)]

    there = sorted(sorted(files), key=words)
    values, _ = _ends_of_names(there)
    return there if _twins(values) else [there[k] for k in np.argsort(values).tolist()]


def _twins(values: FloatArray) -> tuple[int, int] | None:
    """The first two rows of one value."""
    order = np.argsort(values, kind="stable")
    same = np.flatnonzero(np.diff(values[order]) == 0)
    return (int(order[same[0]]), int(order[same[0] + 1])) if len(same) else None


def _ends_of_names(files: Sequence[Path]) -> tuple[FloatArray, bool]:
    """Times (K,), s, and True, else numbers of scans, and False.

    Times: 1583836591_182590976, 0.25, 1532402927647951 or 1403715273262142976 at the end of a name.
    """
    times, numbers = list[float](), list[int]()
    for path in files:
        if found := re.search(r"(\d+)\.(\d+)$|(\d{9,})[_-](\d{9})$|(\d{12,20})$", _stem(path)):
            whole, fraction, seconds, nanoseconds, stamp = found.groups()
            if whole:
                times.append(float(f"{whole}.{fraction}"))
            else:
                times.append(_seconds(stamp) if stamp else int(seconds) + 1e-9 * int(nanoseconds))
        elif number := re.search(r"(\d{1,11})$", _stem(path)):
            numbers.append(int(number[1]))
    if len(times) == len(files):
        return np.array(times), True
    return np.array(numbers if len(numbers) == len(files) else range(len(files)), dtype=np.float64), False


def _times_of_names(files: Sequence[Path], period: float) -> FloatArray:
    """Times (K,), s, of files in order. Raises `InputError` for two files of one time or number."""
    values, timed = _ends_of_names(files)
    if same := _twins(values):
        raise InputError(
            f"expected scans of one sensor, of different {'times' if timed else 'numbers'}, "
            f"got {values[same[0]]:.15g} twice: {files[same[0]].name} and {files[same[1]].name}"
        )
    if timed:
        return values
    _log.warning(
        "%s: no times in the names and no table: the scans are taken to be %g s apart", files[0].parent, period
    )
    return np.asarray(period * (values - values[0]))


def _times_of_table(table: Path, files: Sequence[Path]) -> tuple[FloatArray, list[int], bool]:
    """Times (K,), s, of the files in their order, the lines that say them, and whether these name files."""
    times, lines = list[float](), list[int]()
    by_name: dict[str, tuple[float, int]] = {}
    for number, line in enumerate(read_lines(table), start=1):
        words = re.split(r"[,;\s]+", line.strip())
        if not words[0] or words[0].startswith("#"):
            continue
        name, text = ("", line) if len(words) == 1 or ":" in words[1] else (words[0], words[1])
        try:
            time = _seconds(text)
        except ValueError:
            if times or by_name:
                raise InputError(f"{table}: line {number}: expected a time, got {text[:40]!r}") from None
            continue  # a line of titles
        if name:
            by_name[name] = (time, number)
        else:
            times.append(time)
            lines.append(number)
    for path in files if by_name else ():
        found = by_name.get(path.name) or by_name.get(_stem(path))
        if found is None:
            raise InputError(f"{table}: expected a line for {path.name}, there is none")
        times.append(found[0])
        lines.append(found[1])
    if len(times) != len(files):
        raise InputError(f"{table}: expected {len(files)} times, one for each scan, got {len(times)}")
    return np.array(times), lines, bool(by_name)


def _one_of(what: str, chosen: str | None, there: Iterable[str]) -> str:
    """The sequence of a name, or the only one there is."""
    known = tuple(sorted(there))
    if chosen is None and len(known) == 1:
        return known[0]
    if chosen is None:
        raise InputError(f"expected --sequence with a {what} of {', '.join(known[:12]) or 'several, there is none'}")
    if chosen not in known:
        raise InputError(f"--sequence: {unknown_name(what, chosen, known)}")
    return chosen


def _nearest(times: FloatArray, poses: FloatArray, wanted: FloatArray, longest: float = 0.1) -> FloatArray | None:
    """The poses (K, 4, 4) nearest to some times (K,), s, from the first place on; None where some are too far off."""
    order = np.argsort(times)
    times, poses = times[order], poses[order]
    after = np.clip(np.searchsorted(times, wanted), 1, len(times) - 1) if len(times) > 1 else np.zeros(len(wanted), int)
    row = np.where(np.abs(times[after - 1] - wanted) < np.abs(times[after] - wanted), after - 1, after)
    if (off := np.abs(times[row] - wanted) > longest).any():
        _log.warning("%d of %d scans have no pose within %g s: poses are left out", off.sum(), len(wanted), longest)
        return None
    found = poses[row].copy()
    found[:, :3, 3] -= np.round(found[0, :3, 3])
    return found


def _ouster(path: Path) -> Scan:
    """A scan without times of the Ouster of MulRan and Newer College, column by column in a turn."""
    scan = read_records(path, KITTI) if path.suffix == ".bin" else scan_of_columns(read_columns(path))
    beams, columns = _OUSTER
    if scan.time is not None or len(scan) != beams * columns:
        return scan
    return replace(scan, time=np.repeat(np.arange(columns) / columns * 0.1, beams))


def kitti_tracking(source: Path, options: RecordingOptions) -> ScanRecording:
    """KITTI tracking: velodyne/NNNN/KKKKKK.bin, oxts/NNNN.txt, calib/NNNN.txt, in training/ or there.

    Sensors are made from the GPS/IMU records: inertial samples are those recorded, fixes and speeds get noise, 1 m by
    axis and 0.05 m/s. Source: https://www.cvlibs.net/datasets/kitti (development kit of tracking).
    """
    root = source / "training" if (source / "training").is_dir() else source
    name = _one_of("sequence", options.sequence, (path.stem for path in (root / "velodyne").glob("*")))
    records = root / "oxts" / f"{name}.txt"
    return replace(
        kitti_scans(source, name),
        origin=read_origin(records),
        sensors=lambda: kitti_sensor_log(records, ("imu", "wheels", "gps"), options.seed).tables,
        objects=lambda folder: (
            KittiTracking(source, folder or source / "detections" / "pointrcnn", [name]).scene(name).frames
        ),
    )


def kitti_odometry(source: Path, options: RecordingOptions) -> ScanRecording:
    """KITTI odometry: sequences/NN/velodyne/KKKKKK.bin, times.txt, calib.txt, and poses/NN.txt; or one such sequence.

    Scans are compensated for motion. Poses are those of the left camera. Source:
    https://www.cvlibs.net/datasets/kitti/eval_odometry.php (development kit). Untested on originals.
    """
    if (source / "sequences").is_dir():
        there = (path.name for path in (source / "sequences").iterdir() if (path / "velodyne").is_dir())
        source = source / "sequences" / _one_of("sequence", options.sequence, there)
    files = _in_order((source / "velodyne").glob("*.bin"))
    table = source / "times.txt"
    times, lines, _ = _times_of_table(table, files)
    poses, truth = None, source.parents[1] / "poses" / f"{source.name}.txt" if len(source.parts) > 1 else source
    if truth.is_file():
        camera_T_lidar = read_transform(source / "calib.txt", "Tr")
        poses = inverse_transform(camera_T_lidar) @ read_kitti_poses(truth).world_T_ego @ camera_T_lidar
        if len(poses) != len(files):
            raise InputError(f"{truth}: expected {len(files)} poses, one for each scan, got {len(poses)}")
    return _of_files(
        "kitti-odometry",
        files,
        times,
        lambda path: read_records(path, KITTI),
        world_T_ego=poses,
        clock=lambda row: f"{table}: line {lines[row]}",
    )


def mulran(source: Path, options: RecordingOptions) -> ScanRecording:
    """MulRan: Ouster/NANOSECONDS.bin of x, y, z, intensity; global_pose.csv: ns, 12 numbers of the vehicle's pose.

    Sources: Kim et al., MulRan, ICRA 2020; https://sites.google.com/view/mulran-pr, whose calib_base2ouster.txt the
    place of the LiDAR is from. Untested on originals.
    """
    files = _in_order((source / "Ouster").glob("*.bin"))
    times, poses = _times_of_names(files, options.period), None
    if (table := source / "global_pose.csv").is_file():
        numbers = read_rows(table, (13,), "time, r11, ..., tz", ",").numbers(slice(0, 13), ("pose",) * 13, np.inf)
        every = numbers[:, 1:].reshape(-1, 3, 4)
        poses = _nearest(numbers[:, 0] * 1e-9, rigid_transforms(every[:, :, :3], every[:, :, 3]), times)
    ego_T_lidar = mounting("calib", (1.7042, -0.021, 1.8047, *np.radians([0.0001, 0.0003, 179.6654]).tolist())).matrix()
    return _of_files("mulran", files, times, _ouster, ego_T_lidar=ego_T_lidar, world_T_ego=poses)


def _record(fields: str) -> np.dtype[Any]:
    """Records of fields like "x f4 y f4", without gaps, in little-endian order."""
    words = fields.split()
    return np.dtype([(name, f"<{kind}") for name, kind in zip(words[::2], words[1::2], strict=True)])


_HELIPR = {
    "Avia": _record("x f4 y f4 z f4 reflectivity u1 tag u1 line u1 offset_time u4"),
    "Aeva": _record("x f4 y f4 z f4 reflectivity f4 velocity f4 time_offset i4 line u1 intensity f4"),
    "Ouster": _record("x f4 y f4 z f4 intensity f4 t u4 reflectivity u2 ring u2 ambient u2"),
    "Velodyne": _record("x f4 y f4 z f4 intensity f4 ring u2 time f4"),
}
_EARLY_AEVA = _record("x f4 y f4 z f4 reflectivity f4 velocity f4 time_offset i4 line u1")
_LAST_EARLY = 1691936557946849179  # ns, until when


def helipr(source: Path, options: RecordingOptions) -> ScanRecording:
    """HeLiPR: LiDAR/SENSOR/NANOSECONDS.bin, LiDAR_GT/global_SENSOR_gt.txt: ns, x, y, z, qx, qy, qz, qw of the LiDAR.

    The sensor is the sequence. Sources: Jung et al., HeLiPR, IJRR 2024;
    https://github.com/minwoo0611/HeLiPR-File-Player (ROSThread.cpp). Untested on originals.
    """
    there = (path.name for path in (source / "LiDAR").iterdir() if path.name in _HELIPR)
    sensor = _one_of("sensor", options.sequence, there)
    files = _in_order((source / "LiDAR" / sensor).glob("*.bin"))
    times, poses = _times_of_names(files, options.period), None
    if (truth := source / "LiDAR_GT" / f"global_{sensor}_gt.txt").is_file():
        names = ("time", *_TUM)
        numbers = read_rows(truth, (8,), ", ".join(names)).numbers(slice(0, 8), names, np.inf)
        poses = _nearest(numbers[:, 0] * 1e-9, _poses(numbers[:, 1:]), times)

    def read(path: Path) -> Scan:
        early = sensor == "Aeva" and int(path.stem) <= _LAST_EARLY
        return read_records(path, _EARLY_AEVA if early else _HELIPR[sensor])

    return _of_files("helipr", files, times, read, world_T_ego=poses)


def newer_college(source: Path, options: RecordingOptions) -> ScanRecording:
    """Newer College: raw_format/ouster_scan/cloud_SECONDS_NANOSECONDS.pcd, and ground_truth/registered_poses.csv: s,
    ns, x, y, z, qx, qy, qz, qw of the camera.

    Sources: Ramezani et al., The Newer College Dataset, IROS 2020; https://ori-drs.github.io/newer-college-dataset.
    Untested on originals.
    """
    files = _in_order((source / "raw_format" / "ouster_scan").glob("*.pcd"))
    times, poses = _times_of_names(files, options.period), None
    if (truth := source / "ground_truth" / "registered_poses.csv").is_file():
        names = ("sec", "nsec", *_TUM)
        numbers = read_rows(truth, (9,), ", ".join(names), ",", "#").numbers(slice(0, 9), names, np.inf)
        camera_T_lidar = _poses(np.array([[-0.084, -0.025, 0.050, 0.0, 0.0, 0.924, 0.383]]))[0]
        poses = _nearest(numbers[:, 0] + 1e-9 * numbers[:, 1], _poses(numbers[:, 2:]) @ camera_T_lidar, times)
    return _of_files("newer-college", files, times, _ouster, world_T_ego=poses)


_TUM = ("x", "y", "z", "qx", "qy", "qz", "qw")


def _poses(rows: FloatArray) -> FloatArray:
    """Poses (n, 4, 4) of rows (n, 7): x, y, z, qx, qy, qz, qw."""
    norm = np.linalg.norm(rows[:, 3:], axis=1, keepdims=True)
    if (norm < 0.9).any() or (norm > 1.1).any():
        raise InputError(f"pose {int(np.argmax((norm < 0.9) | (norm > 1.1))) + 1}: expected a unit quaternion")
    return rigid_transforms(quaternion_rotation((rows[:, 3:] / norm)[:, [3, 0, 1, 2]]), rows[:, :3])


def hilti(source: Path, options: RecordingOptions) -> ScanRecording:
    """Hilti SLAM challenges: a bag, converted by rosbags-convert, and beside it poses of the IMU in TUM's format.

    Source: https://hilti-challenge.com, 2021 to 2023. The poses are sparse, or those of a part: they are taken where
    each scan has one. Untested on originals.
    """
    truth = _tum_file(source)
    found = open_bag(source if is_bag(source) else next(filter(is_bag, sorted(source.iterdir()))), options)
    if truth is None:
        return found
    path = read_tum_poses(truth)
    return replace(found, layout="hilti", world_T_ego=_nearest(path.timestamps, path.world_T_ego, found.timestamps))


def _tum_file(source: Path) -> Path | None:
    """A file of poses beside a bag; None for none."""
    if not source.is_dir() or not (is_bag(source) or any(map(is_bag, source.iterdir()))):
        return None
    for path in sorted(source.iterdir()):
        if path.suffix in (".txt", ".tum") and path.is_file():
            with path.open("rb") as file:
                words = next((line.split() for line in file.readlines(10_000) if line[:1] not in (b"#", b"\n")), [])
            if len(words) == len(_TUM) + 1:
                return path
    return None


def nuscenes(source: Path, options: RecordingOptions) -> ScanRecording:
    """nuScenes: sweeps and keyframes of LIDAR_TOP of a scene, with poses and places by the tables in v1.0-VERSION/.

    Source: https://www.nuscenes.org/nuscenes (schema), https://github.com/nutonomy/nuscenes-devkit. Untested on
    originals.
    """
    folder = table_folder(source, next(path.name for path in sorted(source.glob("v1.0-*")) if path.is_dir()))
    scene = _one_of("scene", options.sequence, (name for (name,) in read_table(folder, "scene", ("name",))))
    found = nuscenes_scans(source, folder, scene)
    if found is None:
        raise InputError(f"expected scans of LIDAR_TOP of {scene}, none of those that the tables name is there")
    return found


def _has(*patterns: str) -> Callable[[Path], bool]:
    return lambda source: source.is_dir() and all(any(source.glob(pattern)) for pattern in patterns)


LAYOUTS: Mapping[str, tuple[Callable[[Path], bool], Opener]] = {
    "hilti": (lambda source: _tum_file(source) is not None, hilti),
    "bag": (is_bag, open_bag),
    "kitti-tracking": (
        lambda source: (
            _has("oxts/*.txt", "calib/*.txt")(source / "training") or _has("oxts/*.txt", "calib/*.txt")(source)
        ),
        kitti_tracking,
    ),
    "kitti-odometry": (
        lambda source: _has("sequences/*/velodyne")(source) or _has("velodyne/*.bin", "times.txt")(source),
        kitti_odometry,
    ),
    "mulran": (_has("Ouster/*.bin"), mulran),
    "helipr": (_has("LiDAR/*/*.bin"), helipr),
    "newer-college": (_has("raw_format/ouster_scan/*.pcd"), newer_college),
    "nuscenes": (_has("v1.0-*/sample_data.json"), nuscenes),
    "folder": (lambda source: True, _folder),
}
"""Layouts by name: whether a source has it, and how it is opened. The first that fits is taken."""
