"""The KITTI tracking dataset: official poses, calibration and labels, and detections as text, in; `Scene`s out.

A sequence has a moment for every record of its GPS/IMU (10 Hz; times count from 0). World coordinates are east, north,
up from the place of the first record; the ego frame is the IMU's (x ahead, y left, z up). Every moment has a frame of
detections, which may be empty. Classes are KITTI's in lower case: car, pedestrian, cyclist, van, ...

Ground truth leaves out `DontCare` regions. An object counts as visible if it is labelled as fully visible or partly
occluded (0, 1), not as largely occluded or unknown (2, 3). Its velocity is the central difference of its positions two
frames (0.2 s) to either side; the poses it rests on jump by decimetres in places, so it is good to some 0.5 m/s.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from data_tools.datasets.central_differences import central_differences
from data_tools.datasets.kitti.calibration import Calibration, read_calibration
from data_tools.datasets.kitti.detections import CLASS_CODES, detection_files, read_kitti_detections
from data_tools.datasets.kitti.labels import lower_case_classes, read_kitti_labels
from data_tools.datasets.kitti.oxts import read_poses
from data_tools.files.error_messages import error_context, unknown_name
from data_tools.files.remote_files import local_tree
from data_tools.kitti_objects import KittiObjects, camera_boxes_to_world, has_box
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import inverse_transform
from saga_fg.types.dataset import Annotations, Scene
from saga_fg.types.frame import Detections, Frame

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
        self._sequences = present if sequences is None else tuple(dict.fromkeys(sequences))
        for name in self._sequences:
            if name not in present:
                raise InputError(f"{self._root / 'oxts'}: {unknown_name('sequence', name, present)}")
        if self._detections is not None and not self._detections.is_dir():
            raise InputError(f"{self._detections}: expected a folder with Car/, Pedestrian/, Cyclist/")

    @property
    def scenes(self) -> tuple[str, ...]:
        """The names of the chosen sequences."""
        return self._sequences

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
        if name not in self._sequences:
            raise InputError(f"{self._root}: {unknown_name('sequence', name, self._sequences)}")
        return self._root / folder / f"{name}.txt"

    def _frames(self, name: str, times: FloatArray, poses: FloatArray, world_T_camera: FloatArray) -> list[Frame]:
        assert self._detections is not None
        found = read_kitti_detections(self._detections, name, len(times))
        with error_context(f"{self._detections}: sequence {name}"):
            boxes = camera_boxes_to_world(found.boxes, np.strings.lower(found.type), world_T_camera[found.frame])
            seen = Detections(boxes, found.score)
        bounds = np.searchsorted(found.frame, np.arange(len(times) + 1)).tolist()
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
