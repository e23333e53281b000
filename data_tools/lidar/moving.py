"""Points on objects: which points of a scan lie inside boxes that move, and don't belong into a map."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from data_tools.lidar.scan import Scan
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import BoolArray, FloatArray, checked
from saga_fg.numerics.geometry import yaw_transform
from saga_fg.types.boxes import Boxes

MARGIN = 0.3  # m, by which boxes are enlarged on all sides: errors of detectors, and motion during a scan
LIKELY = 0.5  # probability from which an object counts as moving


def on_moving_objects(
    points: ArrayLike, boxes: Boxes, moving: ArrayLike, margin: float = MARGIN, likely: float = LIKELY
) -> BoolArray:
    """Mask (N,) of the points (N, 3) inside boxes of probably moving objects, all in one frame.

    moving: (n,) probability that each object moves; margin: m; likely: probability from which it counts. Boxes without
    a size or heading are left out. Raises `InputError` for arrays that don't fit the boxes and a negative margin.
    """
    places = checked("points", points, (None, 3))
    probability = checked("moving", moving, (len(boxes),))
    if not margin >= 0:
        raise InputError(f"margin: expected metres >= 0, got {margin!r}")
    known = np.isfinite(boxes.size).all(axis=1) & np.isfinite(boxes.yaw)
    result = np.zeros(len(places), dtype=bool)
    for row in np.flatnonzero(known & (probability >= likely)).tolist():
        half = boxes.size[row] / 2 + margin
        near = np.flatnonzero(_within(places - boxes.position[row], np.full(3, np.linalg.norm(half))))
        local = (places[near] - boxes.position[row]) @ yaw_transform(yaw=float(boxes.yaw[row]))[:3, :3]
        result[near[_within(local, half)]] = True
    return result


def without_objects(scan: Scan, boxes: Boxes) -> Scan:
    """The scan without points inside boxes, all in one frame."""
    return scan.select(~on_moving_objects(scan.points, boxes, np.ones(len(boxes)))) if len(boxes) else scan


def _within(offset: FloatArray, half: FloatArray) -> BoolArray:
    return np.asarray((np.abs(offset) <= half).all(axis=1))
