"""The KITTI tracking dataset: poses, calibration, labels, detections, scans and images in; `Scene`s out.

A sequence has a moment for every record of its GPS/IMU (10 Hz; times count from 0). World coordinates are east, north,
up from the place of the first record; the ego frame is the IMU's (x ahead, y left, z up). Every moment has a frame of
detections, which may be empty. Classes are KITTI's in lower case: car, pedestrian, cyclist, van, ...

Ground truth leaves out `DontCare` regions. An object counts as visible if it is labelled as fully visible or partly
occluded (0, 1), not as largely occluded or unknown (2, 3). Its velocity is the central difference of its positions two
frames (0.2 s) to either side; the poses it rests on jump by decimetres in places, so it is good to some 0.5 m/s.

The calibration of a KITTI sequence: what leads from the vehicle to the camera and on to the image.

    x_camera = R_rect Tr_velo_cam Tr_imu_velo x_imu         rectified camera 0: x right, y down, z ahead
    (u w, v w, w) = P2 (x_camera, 1)                        pixel (u, v) of the left colour image

A calibration file holds one `key: numbers` a line, row-major. The tracking benchmark's own files leave out some colons
and shorten some keys; both spellings are read. Source: development kit of https://www.cvlibs.net/datasets/kitti
(tracking) and Geiger et al., Vision meets robotics: the KITTI dataset, IJRR 2013.

Poses of the vehicle from KITTI's GPS/IMU records (oxts).

A record gives latitude, longitude (degrees), altitude (m) and roll, pitch, yaw (rad) first, then velocities and more.
As in the official development kit, positions come from the Mercator projection scaled at the first latitude, and
rotations are R = Rz(yaw) Ry(pitch) Rx(roll):

    s = cos(lat_0),  x = s r lon,  y = s r ln tan(pi/4 + lat/2),  z = alt,      r = 6378137 m

World coordinates have their axes east, north, up and their origin at the first record: unlike the kit's, which are
turned into the first vehicle frame, they are level, so that z is up. The ego frame is the IMU's: x ahead, y left, z up.
Source: Geiger et al., Vision meets robotics: the KITTI dataset, IJRR 2013.

The LiDAR scans of a KITTI tracking sequence: velodyne/NNNN/KKKKKK.bin, one for each frame that has one.

The Velodyne turns clockwise, ten times a second, and looks ahead when the cameras are triggered, which is the time of
the frame. Its points carry no times; those of their azimuths are given here, for scans that are not compensated for the
vehicle's motion. A copy of the dataset does not say whether its scans are. Sources:
Geiger et al., Vision meets robotics: the KITTI dataset, IJRR 2013; KISS-ICP, which takes azimuths for times as well.
"""

from collections.abc import Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from data_tools.datasets.kitti.labels import (
    CLASS_CODES,
    detection_files,
    lower_case_classes,
    read_kitti_detections,
    read_kitti_labels,
)
from data_tools.datasets.source import Images
from data_tools.files import TextTable, local_tree, read_lines, read_table
from data_tools.lidar import KITTI, Scan, ScanRecording, azimuth_times, read_records
from data_tools.metrics.kitti_boxes import KittiObjects, camera_boxes_to_world, has_box
from data_tools.trajectories import central_differences
from saga_fg.errors import InputError, error_context, unknown_name
from saga_fg.numerics import FloatArray, inverse_transform, is_rotation, refuse, rigid_transforms
from saga_fg.types import Annotations, Detections, Frame, Scene

_KEYS: dict[str, tuple[tuple[int, int], tuple[str, ...]]] = {
    "P2": ((3, 4), ("P2",)),
    "R_rect": ((3, 3), ("R_rect", "R0_rect")),
    "Tr_velo_cam": ((3, 4), ("Tr_velo_cam", "Tr_velo_to_cam")),
    "Tr_imu_velo": ((3, 4), ("Tr_imu_velo", "Tr_imu_to_velo")),
    "Tr": ((3, 4), ("Tr",)),  # of the odometry benchmark
}


@dataclass(frozen=True, eq=False)
class Calibration:
    """camera_T_velodyne (4, 4) and camera_T_imu (4, 4), rigid, to the rectified camera; projection (3, 4) = P2."""

    camera_T_velodyne: FloatArray
    camera_T_imu: FloatArray
    projection: FloatArray


def read_calibration(path: str | Path) -> Calibration:
    """Read a calibration file. Raises `InputError` for missing keys, missing numbers, rotations that are none."""
    path = Path(path)
    found = _calibration_lines(path)
    matrices = {name: _matrix(path, found, name) for name in _KEYS if name != "Tr"}
    camera_T_velodyne = _rigid(matrices["R_rect"]) @ _rigid(matrices["Tr_velo_cam"])
    return Calibration(
        camera_T_velodyne=camera_T_velodyne,
        camera_T_imu=camera_T_velodyne @ _rigid(matrices["Tr_imu_velo"]),
        projection=matrices["P2"],
    )


def read_transform(path: Path, key: str) -> FloatArray:
    """The rigid transform (4, 4) of one key. Raises `InputError` as `read_calibration` does."""
    return _rigid(_matrix(path, _calibration_lines(path), key))


def _calibration_lines(path: Path) -> dict[str, tuple[int, list[str]]]:
    """Line number and values by key."""
    found: dict[str, tuple[int, list[str]]] = {}
    for number, line in enumerate(read_lines(path), start=1):
        key, *values = line.split() or [""]
        found[key.rstrip(":")] = (number, values)
    return found


def _matrix(path: Path, found: dict[str, tuple[int, list[str]]], name: str) -> FloatArray:
    shape, spellings = _KEYS[name]
    key = next((spelling for spelling in spellings if spelling in found), None)
    if key is None:
        there = ", ".join(k for k in found if k) or "none"
        raise InputError(f"{path}: expected the key {' or '.join(spellings)}, the keys there are {there}")
    line, values = found[key]
    count = shape[0] * shape[1]
    try:
        numbers = np.array([float(value) for value in values])
    except ValueError as error:
        raise InputError(f"{path}: line {line}: {key}: expected {count} numbers: {error}") from error
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise InputError(f"{path}: line {line}: {key}: expected {count} finite numbers, got {len(numbers)} values")
    matrix = numbers.reshape(shape)
    R = matrix[:, :3]
    if name != "P2" and not is_rotation(R, 1e-4):
        raise InputError(f"{path}: line {line}: {key}: expected a rotation in the first three columns")
    return matrix


def _rigid(matrix: FloatArray) -> FloatArray:
    """(4, 4) transform with the rotation nearest to that of the file, which is rounded to seven digits."""
    U, _, Vt = np.linalg.svd(matrix[:, :3])
    transform = np.eye(4)
    transform[:3, :3] = U @ Vt
    transform[:3, 3] = matrix[:, 3] if matrix.shape[1] == 4 else 0.0
    return transform


EARTH_RADIUS = 6378137.0  # m
_COLUMNS = ("latitude", "longitude", "altitude", "roll", "pitch", "yaw")


def read_origin(path: str | Path) -> tuple[float, float, float]:
    """Latitude, longitude (deg) and altitude (m) of the first record. Raises `InputError` as `read_poses` does."""
    read_poses(path)
    latitude, longitude, altitude = _records(path).numbers(slice(0, 3), _COLUMNS[:3])[0].tolist()
    return latitude, longitude, altitude


def read_poses(path: str | Path) -> FloatArray:
    """world_T_imu (K, 4, 4) of the K records of a sequence. Raises `InputError` for records that are not as above."""
    table = _records(path)
    if not len(table):
        raise InputError(f"{path}: expected a record per frame, the file is empty")
    latitude, longitude, altitude, roll, pitch, yaw = table.numbers(slice(0, 6), _COLUMNS).T
    expected = "expected degrees within {} of 0, got {:g}"
    refuse(np.abs(latitude) > 85, lambda row: table.fault(row, f"latitude: {expected.format(85, latitude[row])}"))
    refuse(np.abs(longitude) > 180, lambda row: table.fault(row, f"longitude: {expected.format(180, longitude[row])}"))
    position = world_position(latitude, longitude, altitude, np.array([latitude[0], longitude[0], altitude[0]]))
    return rigid_transforms(_turn(yaw, 0, 1) @ _turn(pitch, 2, 0) @ _turn(roll, 1, 2), position)


def world_position(latitude: FloatArray, longitude: FloatArray, altitude: FloatArray, origin: FloatArray) -> FloatArray:
    """Positions (K, 3) east, north and up of an origin (3,), m; latitudes and longitudes in degrees, altitudes in m."""
    scale = EARTH_RADIUS * np.cos(np.radians(origin[0]))
    above = [np.log(np.tan(np.radians(90 + angle) / 2)) for angle in (latitude, origin[0])]
    return np.stack(
        [scale * np.radians(longitude - origin[1]), scale * (above[0] - above[1]), altitude - origin[2]], axis=1
    )


def read_sensors(path: str | Path) -> dict[str, FloatArray]:
    """Measurements of each sensor in K records, in the vehicle's axes. Raises `InputError` as `read_poses` does.

    gps (K, 3): positions as in `read_poses`, m; wheels (K, 1): speed ahead, m/s; imu (K, 6): specific force, m/s^2,
    and turn rate, rad/s
    """
    numbers = _records(path).numbers([8, 11, 12, 13, 17, 18, 19], ("vf", "ax", "ay", "az", "wx", "wy", "wz"))
    return {"imu": numbers[:, 1:], "wheels": numbers[:, :1], "gps": read_poses(path)[:, :3, 3]}


def _records(path: str | Path) -> TextTable:
    return read_table(Path(path), (30,), "latitude, longitude, altitude, roll, pitch, yaw, ...")


def _turn(angle: FloatArray, from_axis: int, to_axis: int) -> FloatArray:
    """Rotations (K, 3, 3) that turn one axis towards another."""
    R = np.tile(np.eye(3), (len(angle), 1, 1))
    R[:, from_axis, from_axis] = R[:, to_axis, to_axis] = np.cos(angle)
    R[:, to_axis, from_axis] = np.sin(angle)
    R[:, from_axis, to_axis] = -np.sin(angle)
    return R


FRAME_PERIOD = 0.1  # s
_LONGEST_GAP = 0.5  # s between labels of an object, for a velocity
_REACH = 2  # frames to either side, for a velocity


class KittiTracking:
    """Sequences of the KITTI tracking benchmark.

    dataroot      holds oxts/, calib/ and, for ground truth, label_02/; or a folder training/ that does
    detections    folder of a detector: Car/, Pedestrian/, Cyclist/ with NNNN.txt each; None for scenes without frames
    sequences     their names, such as "0000"; None for all that have GPS/IMU records
    ground_truth  whether to read the labels as well
    sensor        the name the frames carry

    Sequences are read when asked for. Raises `InputError` for whatever is missing or broken.
    """

    def __init__(
        self,
        dataroot: str | Path,
        detections: str | Path | None = None,
        sequences: Collection[str] | None = None,
        ground_truth: bool = False,
        sensor: str = "lidar",
    ) -> None:
        root = Path(dataroot)
        if not root.is_dir():
            raise InputError(f"{root}: expected a folder with oxts/ and calib/, there is no such folder")
        self._root = root / "training" if (root / "training").is_dir() else root
        self._detections = None if detections is None else Path(detections)
        self._ground_truth, self._sensor = ground_truth, sensor
        present = tuple(sorted(path.stem for path in (self._root / "oxts").glob("*.txt")))
        if not present:
            raise InputError(f"{self._root / 'oxts'}: expected GPS/IMU records NNNN.txt, there are none")
        self.scenes: tuple[str, ...] = present if sequences is None else tuple(dict.fromkeys(sequences))
        for name in self.scenes:
            if name not in present:
                raise InputError(f"{self._root / 'oxts'}: {unknown_name('sequence', name, present)}")
        if self._detections is not None and not self._detections.is_dir():
            raise InputError(f"{self._detections}: expected a folder with Car/, Pedestrian/, Cyclist/")

    def calibration(self, name: str) -> Calibration:
        """The calibration of a sequence."""
        return read_calibration(self._file("calib", name))

    def labels(self, name: str) -> KittiObjects:
        """The lines of a sequence's label file, `DontCare` regions included."""
        return read_kitti_labels(self._file("label_02", name))

    def files(self, name: str) -> tuple[Path, ...]:
        """The files that a sequence is read from, but for its ground truth."""
        found = () if self._detections is None else detection_files(self._detections, name).values()
        return (self._file("oxts", name), self._file("calib", name), *found)

    def scene(self, name: str) -> Scene:
        """Read one of the chosen sequences; raises `InputError` for another name or a broken file."""
        poses = read_poses(self._file("oxts", name))
        times = np.arange(len(poses), dtype=np.float64) * FRAME_PERIOD
        world_T_camera = poses @ inverse_transform(self.calibration(name).camera_T_imu)
        frames = [] if self._detections is None else self._frames(name, times, poses, world_T_camera)
        truth = self._annotations(name, times, world_T_camera) if self._ground_truth else None
        tokens = tuple(f"{k:06d}" for k in range(len(poses)))
        with error_context(str(self._root)):
            return Scene(name, times, poses, tokens, frames, truth)

    def _file(self, folder: str, name: str) -> Path:
        if name not in self.scenes:
            raise InputError(f"{self._root}: {unknown_name('sequence', name, self.scenes)}")
        return self._root / folder / f"{name}.txt"

    def _frames(self, name: str, times: FloatArray, poses: FloatArray, world_T_camera: FloatArray) -> list[Frame]:
        assert self._detections is not None
        frame, type_, found, score = read_kitti_detections(self._detections, name, len(times))
        with error_context(f"{self._detections}: sequence {name}"):
            boxes = camera_boxes_to_world(found, np.strings.lower(type_), world_T_camera[frame])
            seen = Detections(boxes, score)
        bounds = np.searchsorted(frame, np.arange(len(times) + 1)).tolist()
        return [
            Frame(time, self._sensor, seen.select(slice(bounds[k], bounds[k + 1])), poses[k], token=f"{k:06d}")
            for k, time in enumerate(times.tolist())
        ]

    def _annotations(self, name: str, times: FloatArray, world_T_camera: FloatArray) -> list[Annotations]:
        path = self._file("label_02", name)
        objects = self.labels(name)
        objects = objects.select(has_box(objects))
        if len(objects) and objects.frame.max() >= len(times):
            raise InputError(f"{path}: frame {objects.frame.max()}: expected frames 0 to {len(times) - 1} only")
        with error_context(f"{path}"):
            boxes = camera_boxes_to_world(
                objects.boxes, lower_case_classes(objects.type), world_T_camera[objects.frame]
            )
        ids = objects.track_id.astype(np.str_)
        velocity = central_differences(ids, times[objects.frame], boxes.position[:, :2], _LONGEST_GAP, _REACH)
        boxes = replace(boxes, velocity=velocity)
        visible = objects.occluded < 2
        order = np.argsort(objects.frame, kind="stable")
        bounds = np.searchsorted(objects.frame[order], np.arange(len(times) + 1)).tolist()
        moments = (order[bounds[k] : bounds[k + 1]] for k in range(len(times)))
        return [Annotations(ids[rows], boxes.select(rows), visible[rows]) for rows in moments]


@contextmanager
def local_kitti(
    dataroot: str, detections: str | None = None, sequences: Collection[str] | None = None, ground_truth: bool = False
) -> Iterator[KittiTracking]:
    """The sequences (None: all), for the length of the block; the folders of `KittiTracking` by path or URL.

    Raises `InputError` as `KittiTracking` does, naming the URL, and for what cannot be fetched.
    """
    names = ["*"] if sequences is None else list(dict.fromkeys(sequences))
    folders = ("oxts", "calib", *(["label_02"] * ground_truth))
    files = [f"{root}{folder}/{name}.txt" for root in ("training/", "") for folder in folders for name in names]
    found = [f"{label}/{name}.txt" for label in CLASS_CODES for name in names]
    with ExitStack() as stack:
        root = stack.enter_context(local_tree(dataroot, files))
        boxes = None if detections is None else stack.enter_context(local_tree(detections, found))
        yield KittiTracking(root, boxes, sequences, ground_truth)


def kitti_scans(dataroot: str | Path, sequence: str, most: int | None = None) -> ScanRecording:
    """The scans of a sequence, the first `most` or all of them, with times of points, and poses by GPS/IMU.

    Raises `InputError` where there are none, and for a scan without a GPS/IMU record.
    """
    root = Path(dataroot)
    root = root / "training" if (root / "training").is_dir() else root
    dataset = KittiTracking(dataroot, sequences=[sequence])
    calibration, poses = dataset.calibration(sequence), dataset.scene(sequence).world_T_ego
    folder = root / "velodyne" / sequence
    rows = np.array([int(path.stem) for path in _files(folder, len(poses))])[:most]

    def read(row: int) -> Scan:
        scan = read_records(folder / f"{rows[row]:06d}.bin", KITTI)
        return replace(scan, time=azimuth_times(scan.points, FRAME_PERIOD))

    return ScanRecording(
        "kitti-tracking",
        np.asarray(rows * FRAME_PERIOD),
        read,
        lambda row: str(folder / f"{rows[row]:06d}.bin"),
        inverse_transform(calibration.camera_T_imu) @ calibration.camera_T_velodyne,
        poses[rows],
    )


def _files(folder: Path, records: int) -> tuple[Path, ...]:
    """The scans in a folder, in order."""
    files = tuple(sorted(path for path in folder.glob("*.bin") if path.stem.isdecimal()))
    if not files:
        raise InputError(f"{folder}: expected LiDAR scans KKKKKK.bin, there are none")
    if int(files[-1].stem) >= records:
        raise InputError(f"{files[-1]}: expected frames 0 to {records - 1}, as there are GPS/IMU records")
    return files


FOLDERS = {"image_02": "left", "image_03": "right"}


def kitti_images(root: Path, scenes: Mapping[str, Scene]) -> dict[str, Images]:
    """Return the images of each sequence by camera, one or None for each moment; sequences without any are left out."""
    found: dict[str, Images] = {}
    for name, scene in scenes.items():
        images: dict[str, list[Path | None]] = {}
        for folder, camera in FOLDERS.items():
            files = [root / folder / name / f"{k:06d}.png" for k in range(len(scene))]
            if any(there := [file.is_file() for file in files]):
                images[camera] = [file if is_there else None for file, is_there in zip(files, there, strict=True)]
                break  # the other eye sees the same
        if images:
            found[name] = images
    return found
