"""Detections in the text format of AB3DMOT: a folder for each class, in it a file for each sequence, one box a line,

    frame, type, x1, y1, x2, y2, score, h, w, l, x, y, z, rotation_y, alpha

type is 1 for pedestrians, 2 for cars, 3 for cyclists; boxes are as in KITTI's labels. The score is the detector's
own, for PointRCNN a logit, any real number. Source: Weng et al., 3D multi-object tracking: a baseline and new
evaluation metrics, IROS 2020, and https://github.com/xinshuoweng/AB3DMOT.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_tools.files.text_tables import TextTable, read_table
from data_tools.kitti_objects import CameraBoxes
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, IntArray, StrArray

log = logging.getLogger(__name__)

CLASS_CODES = {"Pedestrian": 1, "Car": 2, "Cyclist": 3}

_NUMBERS = ("x1", "y1", "x2", "y2", "score", "h", "w", "l", "x", "y", "z", "rotation_y", "alpha")


@dataclass(frozen=True, eq=False)
class KittiDetections:
    """Detections of a sequence, sorted by frame: frame (N,), type (N,) as KITTI names it, boxes (N), score (N,)."""

    frame: IntArray
    type: StrArray
    boxes: CameraBoxes
    score: FloatArray


def read_kitti_detections(folder: str | Path, sequence: str, frames: int) -> KittiDetections:
    """The detections of all classes of one sequence of so many frames.

    Raises `InputError` if no class has a file for the sequence, and for lines that are not as above.
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
    return KittiDetections(frame[order], type_[order], boxes, numbers[:, 4])


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
    if (code != CLASS_CODES[name]).any():
        row = int(np.argmax(code != CLASS_CODES[name]))
        raise table.fault(row, f"type: expected {CLASS_CODES[name]} in a file of class {name}, got {code[row]}")
    numbers = table.numbers(slice(2, None), _NUMBERS)
    flat = (numbers[:, 5:8] <= 0).any(axis=1)
    if flat.any():
        row = int(np.argmax(flat))
        raise table.fault(row, f"h w l: expected a positive size in m, got {numbers[row, 5:8].tolist()}")
    return frame, numbers
