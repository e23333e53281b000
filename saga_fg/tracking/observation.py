"""A frame as the tracker takes it in: the usable detections, in the world, with all that the sensor's model says."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray, of_classes
from saga_fg.tracking.settings import ClassSettings
from saga_fg.tracking.suppression import of_one_class, strongest
from saga_fg.types.boxes import Boxes
from saga_fg.types.by_class import class_values
from saga_fg.types.frame import Frame
from saga_fg.types.sensor import Sensor
from saga_fg.types.signal import COLOUR_LABELS

UNKNOWN_YAW_NOISE = np.pi  # standard deviation where nothing was measured, rad


@dataclass(frozen=True, eq=False)
class Observed:
    """m detections: boxes (world), probability (m,), R (m, 4, 4) of position and velocity, standard deviations (m,) of
    height (m) and heading (rad), whether the velocity was measured (m,), rows (m,) in the frame's detections, range
    rate (m,), m/s, NaN where not to be used, its variance (m,), what is told of positions (m,) twice (see
    `saga_fg.tracking.told_covariance`), and the place (2,), world, it was seen from."""

    boxes: Boxes
    probability: FloatArray
    R: FloatArray
    with_velocity: BoolArray
    z_noise: FloatArray
    yaw_noise: FloatArray
    row: IntArray
    range_rate: FloatArray
    range_rate_variance: FloatArray
    told: tuple[FloatArray, FloatArray]
    viewpoint: FloatArray | None

    def __len__(self) -> int:
        return len(self.boxes)


def observe(frame: Frame, sensor: Sensor, classes: Mapping[str, ClassSettings]) -> Observed:
    """The detections of a frame that are probable enough for their class and no duplicates."""
    detections = sensor.in_world(frame)
    label = detections.boxes.label
    probability = sensor.probability(detections.score, label)
    objects = ~of_classes(label, COLOUR_LABELS)  # the colours of lights are not objects of their own
    keep = np.flatnonzero(objects & (probability >= class_values(classes, ClassSettings, label, "min_score")[0]))
    names = ("nms_distance", "weak_nms_distance", "weak_nms_ratio", "cross_class_nms_iou")
    *limits, overlap = class_values(classes, ClassSettings, label[keep], *names)
    one_each = strongest(detections.boxes.select(keep), probability[keep], *limits)
    keep, overlap = keep[one_each], overlap[one_each]
    keep = keep[of_one_class(detections.boxes.select(keep), probability[keep], overlap)]
    detections, probability, viewpoint = detections.select(keep), probability[keep], sensor.origin(frame)
    boxes = detections.boxes
    R = np.zeros((len(boxes), 4, 4))
    R[:, :2, :2] = sensor.detection_covariance(detections, viewpoint)
    R[:, 2:, 2:] = sensor.velocity_covariance(boxes.label, probability)
    yaw_noise, z_noise = sensor.deviations(boxes.label, "yaw", "height")
    yaw_noise = np.where(np.isfinite(boxes.yaw), yaw_noise, UNKNOWN_YAW_NOISE)
    limit = sensor.max_speed if sensor.use_velocity else -1.0
    with_velocity = np.hypot(*boxes.velocity.T) <= limit
    with_range_rate = np.abs(detections.range_rate) <= limit
    return Observed(
        boxes,
        probability,
        R,
        with_velocity,
        z_noise,
        yaw_noise,
        keep,
        np.where(with_range_rate, detections.range_rate, np.nan),
        sensor.range_rate_variance(boxes.label, probability),
        sensor.told(boxes.label, probability),
        viewpoint,
    )
