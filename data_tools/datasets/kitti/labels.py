"""KITTI's text formats: labels, detections, and boxes in the image.

KITTI tracking labels and results: one object a line,

    frame id type truncated occluded alpha x1 y1 x2 y2 h w l x y z rotation_y [score]

2D boxes in pixels, sizes and positions in m in the rectified camera frame (bottom centre), angles in rad. `DontCare`
lines mark regions of the image and have id -1. `Person` is a person that sits, `Person_sitting` in KITTI's other
benchmarks. Source: development kit of the tracking benchmark, https://www.cvlibs.net/datasets/kitti/eval_tracking.php.

Detections in the text format of AB3DMOT: a folder for each class, in it a file for each sequence, one box a line,

    frame, type, x1, y1, x2, y2, score, h, w, l, x, y, z, rotation_y, alpha

type is 1 for pedestrians, 2 for cars, 3 for cyclists; boxes are as in KITTI's labels. The score is the detector's
own, for PointRCNN a logit, any real number. Source: Weng et al., 3D multi-object tracking: a baseline and new
evaluation metrics, IROS 2020, and https://github.com/xinshuoweng/AB3DMOT.

Boxes of the camera frame in the image: 2D boxes and observation angles.

The 2D box encloses the projection of the twelve edges, cut at a plane just before the camera, and is clipped to the
image. The observation angle is alpha = rotation_y - atan2(x, z). Pixels count from 0.
"""

import logging
from pathlib import Path

import numpy as np

from data_tools.files import TextTable, read_table
from data_tools.metrics.kitti_boxes import CameraBoxes, KittiObjects, has_box
from saga_fg.errors import InputError, unknown_name
from saga_fg.numerics import FloatArray, IntArray, StrArray, refuse, wrap_angle

TYPES = ("Car", "Van", "Truck", "Pedestrian", "Person", "Person_sitting", "Cyclist", "Tram", "Misc", "DontCare")

_IMAGE_COLUMNS = ("truncated", "occluded", "alpha", "x1", "y1", "x2", "y2")
_BOX_COLUMNS = ("h", "w", "l", "x", "y", "z", "rotation_y", "score")
_POSITIVE = "h w l: expected a positive size in m"


def read_kitti_labels(path: str | Path) -> KittiObjects:
    """Read a label or result file. Raises `InputError` naming line and column of what is not as it should be."""
    table = read_table(Path(path), (17, 18), "frame id type truncated ... rotation_y [score]")
    with_score = table.values.shape[1] == 18
    numbers = table.numbers(slice(3, None), _IMAGE_COLUMNS + _BOX_COLUMNS)
    objects = KittiObjects(
        frame=table.integers(0, "frame", 0),
        track_id=table.integers(1, "id", -1),
        type=table.values[:, 2],
        truncated=numbers[:, 0],
        occluded=numbers[:, 1],
        alpha=numbers[:, 2],
        bbox=numbers[:, 3:7],
        boxes=CameraBoxes(numbers[:, 7:10], numbers[:, 10:13], numbers[:, 13]),
        score=numbers[:, 14] if with_score else np.full(len(table), np.nan),
    )
    _check(table, objects)
    return objects


def lower_case_classes(type_: StrArray) -> StrArray:
    """(N,) classes of objects in the world for the types of a file: in lower case, with one name for who sits."""
    names = np.strings.lower(type_)
    return np.where(names == "person", "person_sitting", names)


def _check(table: TextTable, objects: KittiObjects) -> None:
    type_, size = objects.type, objects.boxes.size
    refuse(
        ~np.isin(type_, TYPES), lambda row: table.fault(row, f"type: {unknown_name('class', str(type_[row]), TYPES)}")
    )
    refuse(
        has_box(objects) & (size <= 0).any(axis=1),
        lambda row: table.fault(row, f"{_POSITIVE}, got {size[row].tolist()}"),
    )
    tracked = np.flatnonzero(objects.track_id >= 0)
    pairs = np.stack([objects.frame[tracked], objects.track_id[tracked]], axis=1)
    _, first = np.unique(pairs, axis=0, return_index=True)
    if len(first) < len(tracked):
        row = int(np.setdiff1d(np.arange(len(tracked)), first)[0])
        frame, id_ = pairs[row].tolist()
        raise table.fault(int(tracked[row]), f"id: expected each track once a frame, {id_} is in frame {frame} again")


log = logging.getLogger(__name__)

CLASS_CODES = {"Pedestrian": 1, "Car": 2, "Cyclist": 3}

_NUMBERS = ("x1", "y1", "x2", "y2", "score", "h", "w", "l", "x", "y", "z", "rotation_y", "alpha")


def read_kitti_detections(
    folder: str | Path, sequence: str, frames: int
) -> tuple[IntArray, StrArray, CameraBoxes, FloatArray]:
    """The detections of all classes of one sequence of so many frames, sorted by frame.

    They are given as frame (N,), type (N,) as KITTI names it, boxes (N), score (N,). Raises `InputError` if no class
    has a file for the sequence, and for lines that are not as above.
    """
    present = detection_files(Path(folder), sequence)
    for name in CLASS_CODES.keys() - present.keys():
        log.warning("%s: no detections of class %s in sequence %s", folder, name, sequence)
    tables = [_read(path, name, frames) for name, path in present.items()]
    frame = np.concatenate([table[0] for table in tables])
    numbers = np.concatenate([table[1] for table in tables])
    type_ = np.repeat(np.array(list(present)), [len(table[0]) for table in tables])
    order = np.argsort(frame, kind="stable")
    numbers = numbers[order]
    boxes = CameraBoxes(numbers[:, 5:8], numbers[:, 8:11], numbers[:, 11])
    return frame[order], type_[order], boxes, numbers[:, 4]


def detection_files(folder: Path, sequence: str) -> dict[str, Path]:
    """The files of a sequence by class. Raises `InputError` if there is none."""
    paths = {name: folder / name / f"{sequence}.txt" for name in CLASS_CODES}
    present = {name: path for name, path in paths.items() if path.is_file()}
    if not present:
        raise InputError(f"{folder}: expected {' or '.join(f'{name}/{sequence}.txt' for name in CLASS_CODES)}")
    return present


def _read(path: Path, name: str, frames: int) -> tuple[IntArray, FloatArray]:
    table: TextTable = read_table(path, (15,), "frame, type, x1, y1, x2, y2, score, h, w, l, x, y, z, ...", ",")
    frame = table.integers(0, "frame", 0, frames - 1)
    code = table.integers(1, "type", 0)
    expected = f"type: expected {CLASS_CODES[name]} in a file of class {name}"
    refuse(code != CLASS_CODES[name], lambda row: table.fault(row, f"{expected}, got {code[row]}"))
    numbers = table.numbers(slice(2, None), _NUMBERS)
    size = numbers[:, 5:8]
    refuse((size <= 0).any(axis=1), lambda row: table.fault(row, f"{_POSITIVE}, got {size[row].tolist()}"))
    return frame, numbers


NEAREST = 0.1  # m ahead of the camera where edges are cut

_FROM = np.array([0, 1, 2, 3, 4, 5, 6, 7, 0, 1, 2, 3])
_TO = np.array([1, 2, 3, 0, 5, 6, 7, 4, 4, 5, 6, 7])


def image_boxes(boxes: CameraBoxes, projection: FloatArray, image_size: tuple[int, int]) -> FloatArray:
    """2D boxes (N, 4): left, top, right, bottom in pixels; NaN for a box that does not show.

    projection (3, 4) is P2; image_size is width, height in pixels.
    """
    corners = boxes.corners()
    start, end = corners[:, _FROM], corners[:, _TO]  # (N, 12, 3)
    depth_start, depth_end = start[..., 2], end[..., 2]
    span = depth_end - depth_start
    crossing = (NEAREST - depth_start) / np.where(span == 0, 1.0, span)
    cut = start + crossing[..., None] * (end - start)
    visible = (depth_start >= NEAREST) | (depth_end >= NEAREST)
    start = np.where((depth_start < NEAREST)[..., None], cut, start)
    end = np.where((depth_end < NEAREST)[..., None], cut, end)
    points = np.concatenate([start, end], axis=1)  # (N, 24, 3)
    ahead = np.concatenate([visible, visible], axis=1)[..., None]
    image = points @ projection[:, :3].T + projection[:, 3]
    pixels = image[..., :2] / np.where(ahead, image[..., 2:], 1.0)
    low = np.where(ahead, pixels, np.inf).min(axis=1)
    high = np.where(ahead, pixels, -np.inf).max(axis=1)
    last = np.array(image_size) - 1.0
    shows = ((high > 0) & (low < last)).all(axis=1)
    result = np.concatenate([np.clip(low, 0, last), np.clip(high, 0, last)], axis=1)
    result[~shows] = np.nan
    return result


def observation_angles(boxes: CameraBoxes) -> FloatArray:
    """alpha (N,), rad, in [-pi, pi)."""
    return wrap_angle(boxes.rotation_y - np.arctan2(boxes.location[:, 0], boxes.location[:, 2]))
