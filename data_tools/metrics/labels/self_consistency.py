r"""Quality of labels without ground truth.

jerkiness       root mean square of the acceleration between neighbouring boxes of an object, m/s^2: real objects
                accelerate by a few m/s^2, jumps of a box look like tens
turned          share of neighbouring boxes whose heading differs by more than a quarter turn
resized         root mean square of the change of length between neighbouring boxes, m
gaps            share of frames between the first and last box of an object in which it has none
residual        mean of r^T R^-1 r / 2 over the detections nearest to a box, r their distance, R the sensor's noise:
                about 1 for true positions, less for boxes that follow the detections, far above 1 where they are off
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data_tools.metrics.error_sample import ErrorSample
from data_tools.metrics.nearest_pairs import nearest_pairs
from data_tools.metrics.scene_boxes import SceneBoxes
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.geometry import wrap_angle
from saga_fg.types.boxes import Boxes

GATE = 2.0  # between a box and its detection, m


@dataclass(frozen=True)
class SelfConsistency:
    """The figures of one system, see the module; NaN where undefined."""

    objects: int
    boxes: int
    frames_each: float
    jerkiness: float
    turned: float
    resized: float
    gaps: float
    residual: float


def self_consistency(
    found: SceneBoxes, timestamps: FloatArray, detections: tuple[IntArray, Boxes, FloatArray] | None = None
) -> SelfConsistency:
    """The figures of one scene, or of several whose frames are numbered consecutively and whose ids differ.

    timestamps (K,) s of the frames; detections: (frame (M,), boxes, R (M, 2, 2) m^2)
    """
    _, number = np.unique(found.id, return_inverse=True)
    order = np.lexsort((found.frame, number))
    number, frame = number[order], found.frame[order]
    boxes = found.boxes.select(order)
    same = number[1:] == number[:-1]
    dt = timestamps[frame[1:]] - timestamps[frame[:-1]]
    step = (boxes.position[1:, :2] - boxes.position[:-1, :2]) / np.where(same, dt, np.nan)[:, None]
    acceleration = 2 * (step[1:] - step[:-1]) / (dt[1:] + dt[:-1])[:, None]
    turn = np.abs(wrap_angle(boxes.yaw[1:] - boxes.yaw[:-1]))[same]
    resized = (boxes.size[1:, 0] - boxes.size[:-1, 0])[same]
    between = (frame[1:] - frame[:-1])[same]
    lifespan = int(between.sum()) + len(np.unique(number))  # frames, summed over objects
    return SelfConsistency(
        objects=len(np.unique(number)),
        boxes=len(found),
        frames_each=len(found) / max(len(np.unique(number)), 1),
        jerkiness=ErrorSample.known(np.hypot(*acceleration.T)).rmse,
        turned=ErrorSample((turn > np.pi / 2)[np.isfinite(turn)].astype(np.float64)).mean,
        resized=ErrorSample.known(resized).rmse,
        gaps=float((between - 1).sum()) / max(lifespan, 1),
        residual=float("nan") if detections is None else _residual(found, *detections),
    )


def _residual(found: SceneBoxes, frame: IntArray, boxes: Boxes, R: FloatArray) -> float:
    row, column, _ = nearest_pairs((found.frame, found.boxes), (frame, boxes), GATE)
    r = (boxes.position[column] - found.boxes.position[row])[:, :2]
    return ErrorSample(np.einsum("ni,ni->n", r, np.linalg.solve(R[column], r[..., None])[..., 0]) / 2).mean
