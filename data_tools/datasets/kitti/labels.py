"""KITTI tracking labels and results: one object a line,

    frame id type truncated occluded alpha x1 y1 x2 y2 h w l x y z rotation_y [score]

2D boxes in pixels, sizes and positions in m in the rectified camera frame (bottom centre), angles in rad. `DontCare`
lines mark regions of the image and have id -1. `Person` is a person that sits, `Person_sitting` in KITTI's other
benchmarks. Source: development kit of the tracking benchmark, https://www.cvlibs.net/datasets/kitti/eval_tracking.php.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from data_tools.files.error_messages import unknown_name
from data_tools.files.text_tables import TextTable, read_table
from data_tools.kitti_objects import CameraBoxes, KittiObjects, has_box
from saga_fg.numerics.arrays import StrArray

TYPES = ("Car", "Van", "Truck", "Pedestrian", "Person", "Person_sitting", "Cyclist", "Tram", "Misc", "DontCare")

_IMAGE_COLUMNS = ("truncated", "occluded", "alpha", "x1", "y1", "x2", "y2")
_BOX_COLUMNS = ("h", "w", "l", "x", "y", "z", "rotation_y", "score")


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
    strange = ~np.isin(objects.type, TYPES)
    if strange.any():
        row = int(np.argmax(strange))
        raise table.fault(row, f"type: {unknown_name('class', str(objects.type[row]), TYPES)}")
    flat = has_box(objects) & (objects.boxes.size <= 0).any(axis=1)
    if flat.any():
        row = int(np.argmax(flat))
        raise table.fault(row, f"h w l: expected a positive size in m, got {objects.boxes.size[row].tolist()}")
    tracked = np.flatnonzero(objects.track_id >= 0)
    pairs = np.stack([objects.frame[tracked], objects.track_id[tracked]], axis=1)
    _, first = np.unique(pairs, axis=0, return_index=True)
    if len(first) < len(tracked):
        row = int(np.setdiff1d(np.arange(len(tracked)), first)[0])
        frame, id_ = pairs[row].tolist()
        raise table.fault(int(tracked[row]), f"id: expected each track once a frame, {id_} is in frame {frame} again")
