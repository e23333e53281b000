r"""What labels say of their own quality, without ground truth.

jerkiness       root mean square of the acceleration between neighbouring boxes of an object, m/s^2: real objects
                accelerate by a few m/s^2, jumps of a box look like tens
turned          share of neighbouring boxes whose heading differs by more than a quarter turn
resized         root mean square of the change of length between neighbouring boxes, m
gaps            share of moments between an object's first and last box at which it has none
residual        mean of r^T R^-1 r / 2 over the detections nearest to a box, r their distance, R the sensor's noise:
                about 1 for true positions, less for boxes that follow the detections, far above 1 where they are off
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data_tools.metrics.nearest_pairs import nearest_pairs
from data_tools.metrics.scene_boxes import SceneBoxes
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.numerics.geometry import wrap_angle
from saga_fg.types.boxes import Boxes

GATE = 2.0  # between a box and its detection, m


@dataclass(frozen=True)
class SelfConsistency:
    """The figures of one system; NaN where undefined."""

    objects: int
    boxes: int
    moments_each: float
    jerkiness: float
    turned: float
    resized: float
    gaps: float
    residual: float


def self_consistency(
    found: SceneBoxes, timestamps: FloatArray, detections: tuple[IntArray, Boxes, FloatArray] | None = None
) -> SelfConsistency:
    """Judge the boxes of one scene, or of several whose moments follow each other and whose ids differ.

    timestamps (K,) s of the moments; detections: (moment (M,), boxes, R (M, 2, 2) m^2)
    """
    _, number = np.unique(found.id, return_inverse=True)
    order = np.lexsort((found.moment, number))
    number, moment = number[order], found.moment[order]
    boxes = found.boxes.select(order)
    same = number[1:] == number[:-1]
    dt = timestamps[moment[1:]] - timestamps[moment[:-1]]
    step = (boxes.position[1:, :2] - boxes.position[:-1, :2]) / np.where(same, dt, np.nan)[:, None]
    acceleration = 2 * (step[1:] - step[:-1]) / (dt[1:] + dt[:-1])[:, None]
    turn = np.abs(wrap_angle(boxes.yaw[1:] - boxes.yaw[:-1]))[same]
    resized = (boxes.size[1:, 0] - boxes.size[:-1, 0])[same]
    between = (moment[1:] - moment[:-1])[same]
    lives = int(between.sum()) + len(np.unique(number))
    return SelfConsistency(
        objects=len(np.unique(number)),
        boxes=len(found),
        moments_each=len(found) / max(len(np.unique(number)), 1),
        jerkiness=_rms(np.hypot(*acceleration.T)),
        turned=_mean((turn > np.pi / 2)[np.isfinite(turn)]),
        resized=_rms(resized),
        gaps=float((between - 1).sum()) / max(lives, 1),
        residual=float("nan") if detections is None else _residual(found, *detections),
    )


def _residual(found: SceneBoxes, moment: IntArray, boxes: Boxes, R: FloatArray) -> float:
    row, column, _ = nearest_pairs((found.moment, found.boxes), (moment, boxes), GATE)
    r = (boxes.position[column] - found.boxes.position[row])[:, :2]
    return _mean(np.einsum("ni,ni->n", r, np.linalg.solve(R[column], r[..., None])[..., 0]) / 2)


def _rms(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")


def _mean(values: FloatArray | BoolArray) -> float:
    return float(np.mean(values)) if len(values) else float("nan")
