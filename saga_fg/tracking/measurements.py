"""The measurements of a frame: its usable detections, in the world, with the sensor's model of their noise.

Duplicates are left out by non-maximum suppression. Of two detections of a class closer than `nms_distance` the
less probable one is suppressed; within `weak_nms_distance` only where its probability is below `weak_nms_ratio` of the
other's: two people may walk half a metre apart, but a weak detection that close to a strong one is most often a
duplicate. Boxes of different classes suppress each other only where they overlap.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from saga_fg.model.sensor import Sensor, measurement_covariance
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray, of_classes, unchecked
from saga_fg.numerics.near_pairs import near_pairs
from saga_fg.tracking.kinematics import RelativePositions
from saga_fg.tracking.settings import ClassSettings
from saga_fg.types.boxes import Boxes
from saga_fg.types.by_class import class_values
from saga_fg.types.frame import Frame
from saga_fg.types.overlap import paired_bev_iou, touching_pairs
from saga_fg.types.signal import COLOUR_LABELS

UNKNOWN_YAW_NOISE = np.pi  # standard deviation where nothing was measured, rad


@dataclass(frozen=True, eq=False)
class FrameMeasurements:
    """m measurements of a sensor.

    sensor                       its model
    name                         its name
    world_T_ego                  (4, 4) pose of the vehicle, None where unknown
    viewpoint                    (2,) place of the sensor, world, m, None where unknown
    row                          (m,) rows in the frame's detections
    boxes                        in the world
    probability                  (m,)
    R                            (m, 4, 4) covariance of position and velocity
    with_velocity                (m,) whether the velocity was measured
    z_noise, yaw_noise           (m,) standard deviations of height, m, and heading, rad
    range_rate                   (m,) m/s, NaN where not to be used
    range_rate_variance          (m,) (m/s)^2
    covariance_scale             (m,) factor on the reported deviation of positions, see `saga_fg.tracking.reporting`
    position_bias                 (m,) part of the reported error of positions that does not average out, m
    delay                        time by which the frame is older than the state, s
    class_likelihood             (m, C) of the classes of `saga_fg.tracking.class_belief`
    relative                     positions seen from a vehicle whose pose is estimated, else None
    """

    sensor: Sensor
    name: str
    world_T_ego: FloatArray | None
    viewpoint: FloatArray | None
    row: IntArray
    boxes: Boxes
    probability: FloatArray
    R: FloatArray
    with_velocity: BoolArray
    z_noise: FloatArray
    yaw_noise: FloatArray
    range_rate: FloatArray
    range_rate_variance: FloatArray
    covariance_scale: FloatArray
    position_bias: FloatArray
    delay: float = 0.0
    class_likelihood: FloatArray = field(default_factory=lambda: np.empty((0, 0)))
    relative: RelativePositions | None = None

    def __len__(self) -> int:
        return len(self.boxes)

    def with_context(
        self, delay: float, class_likelihood: FloatArray, relative: RelativePositions | None
    ) -> FrameMeasurements:
        """Add what the tracker knows of them."""
        known = {"delay": delay, "class_likelihood": class_likelihood, "relative": relative}
        return unchecked(FrameMeasurements, **vars(self) | known)


def frame_measurements(frame: Frame, sensor: Sensor, classes: Mapping[str, ClassSettings]) -> FrameMeasurements:
    """Return the detections that are probable enough for their class and no duplicates."""
    detections = sensor.in_world(frame)
    label = detections.boxes.label
    probability = sensor.probability(detections.score, label)
    objects = ~of_classes(label, COLOUR_LABELS)  # the colours of lights are not objects of their own
    keep = (objects & (probability >= class_values(classes, ClassSettings, label, "min_score")[0])).nonzero()[0]
    detections, probability, viewpoint = detections.select(keep), probability[keep], sensor.origin(frame)
    names = ("nms_distance", "weak_nms_distance", "weak_nms_ratio", "cross_class_nms_iou")
    *limits, overlap = class_values(classes, ClassSettings, detections.boxes.label, *names)
    kept = suppress_duplicates(detections.boxes, probability, *limits)
    if len(kept) < len(keep):
        keep, detections, probability, overlap = keep[kept], detections.select(kept), probability[kept], overlap[kept]
    kept = suppress_other_classes(detections.boxes, probability, overlap)
    if len(kept) < len(keep):
        keep, detections, probability = keep[kept], detections.select(kept), probability[kept]
    boxes = detections.boxes
    R = measurement_covariance(sensor, detections, viewpoint, probability)
    yaw_noise, z_noise = sensor.deviations(boxes.label, "yaw", "height")
    limit = sensor.max_speed if sensor.use_velocity else -1.0
    covariance_scale, position_bias = sensor.covariance_calibration(boxes.label, probability)
    return FrameMeasurements(
        sensor,
        frame.sensor,
        frame.world_T_ego,
        viewpoint,
        keep,
        boxes,
        probability,
        R,
        with_velocity=np.hypot(*boxes.velocity.T) <= limit,
        z_noise=z_noise,
        yaw_noise=np.where(np.isfinite(boxes.yaw), yaw_noise, UNKNOWN_YAW_NOISE),
        range_rate=np.where(np.abs(detections.range_rate) <= limit, detections.range_rate, np.nan),
        range_rate_variance=sensor.range_rate_variance(boxes.label, probability),
        covariance_scale=covariance_scale,
        position_bias=position_bias,
    )


def suppress_duplicates(
    boxes: Boxes, probability: FloatArray, distance: FloatArray, weak_distance: FloatArray, weak_ratio: FloatArray
) -> IntArray:
    """Rows of the boxes that stay, ascending, after suppression within the classes.

    boxes (n); probability (n,); of their classes nms_distance (n,), weak_nms_distance (n,), m, and weak_nms_ratio (n,).
    Greedy from the most probable down, so that a suppressed box suppresses no other.
    """
    if len(boxes) < 2:
        return np.arange(len(boxes))
    position = boxes.position[:, :2]
    a, b = near_pairs(position, position, np.full(len(boxes), max(distance.max(), weak_distance.max())))
    once = (a < b).nonzero()[0]
    if len(once) == 0:
        return np.arange(len(boxes))
    a, b = a[once], b[once]
    apart = np.hypot(*(position[a] - position[b]).T)
    strong, weak = _ordered(a, b, probability)
    duplicate = apart < np.minimum(distance[a], distance[b])
    much_weaker = probability[weak] < weak_ratio[strong] * probability[strong]
    duplicate |= (apart < np.minimum(weak_distance[a], weak_distance[b])) & much_weaker
    rival = (boxes.label[a] == boxes.label[b]) & duplicate
    return _survivors(strong[rival], weak[rival], probability)


def suppress_other_classes(boxes: Boxes, probability: FloatArray, overlap: FloatArray) -> IntArray:
    """Rows of the boxes that stay, ascending, where detectors report one object as several classes.

    boxes (n); probability (n,); overlap (n,): a box whose bird's-eye IoU with a more probable one of another class is
    larger than this is suppressed; from 1 on never.
    """
    if len(boxes) < 2 or (overlap >= 1).all():
        return np.arange(len(boxes))
    a, b = touching_pairs(boxes, boxes)
    across = (a < b) & (boxes.label[a] != boxes.label[b])
    strong, weak = _ordered(a[across], b[across], probability)
    rival = paired_bev_iou(boxes.select(strong), boxes.select(weak)) > overlap[weak]
    return _survivors(strong[rival], weak[rival], probability)


def _ordered(a: IntArray, b: IntArray, probability: FloatArray) -> tuple[IntArray, IntArray]:
    """The more probable and the less probable row of each pair."""
    swap = probability[b] > probability[a]
    return np.where(swap, b, a), np.where(swap, a, b)


def _survivors(strong: IntArray, weak: IntArray, probability: FloatArray) -> IntArray:
    """Rows that stay where strong[k] suppresses weak[k], the most probable first."""
    alive = np.ones(len(probability), dtype=bool)
    for k in np.argsort(-probability[strong], kind="stable"):
        if alive[strong[k]]:
            alive[weak[k]] = False
    return alive.nonzero()[0]
