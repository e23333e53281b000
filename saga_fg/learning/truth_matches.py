"""Which true object each detection of a recording is of: one to one, least distances, within a gate.

True places between two annotated moments are interpolated. An object was there to be seen where the annotations call it
visible.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from saga_fg.errors import InputError
from saga_fg.learning.detection_sample import DetectionSample
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.assignment import assign
from saga_fg.numerics.geometry import wrap_angle
from saga_fg.tracking.class_belief import ClassGroups
from saga_fg.types.dataset import Annotations, Scene
from saga_fg.types.frame import Detections, Frame
from saga_fg.types.sensor import Sensor, sensor_model

GATE = 4.0  # m; poor sensors err by metres, and wrong matches are taken account of


@dataclass(frozen=True, eq=False)
class MatchedFrame:
    """A frame in world coordinates with the truth at its time; detection[k] is of the object truth[k].

    origin (2,): place of the sensor, None where the pose is unknown
    """

    frame: Frame
    detections: Detections
    origin: FloatArray | None
    annotations: Annotations
    detection: IntArray
    truth: IntArray


def match_to_truth(
    scene: Scene, sensors: Mapping[str, Sensor], gate: float = GATE, groups: Sequence[Sequence[str]] = ()
) -> Iterator[MatchedFrame]:
    """The frames between the first and the last annotated moment, matched class by class within `gate`, m.

    Of classes in one of the `groups`, which are mistaken for each other, also across classes within half of it.
    Raises `InputError` for a scene without ground truth.
    """
    if scene.ground_truth is None:
        raise InputError(f"scene {scene.name}: expected ground truth")
    mates = ClassGroups(groups)
    for frame in scene.frames:
        sensor = sensor_model(sensors, frame.sensor)
        time = frame.timestamp + sensor.time_offset
        k = int(np.searchsorted(scene.timestamps, time - 1e-6))
        if k >= len(scene) or (k == 0 and time < scene.timestamps[0] - 1e-6):
            continue
        annotations = _truth_at(scene, k, time)
        detections = sensor.in_world(frame)
        boxes, truth = detections.boxes, annotations.boxes
        distance = np.hypot(*np.moveaxis(boxes.position[:, None, :2] - truth.position[None, :, :2], -1, 0))
        reach = np.where(
            boxes.label[:, None] == truth.label, gate, gate / 2 * mates.same_group(boxes.label, truth.label)
        )
        possible = distance < reach
        yield MatchedFrame(
            frame, detections, sensor.origin(frame), annotations, *assign(distance, possible, unmatched=gate)
        )


def sample_with_truth(
    scene: Scene, sensors: Mapping[str, Sensor], gate: float = GATE, groups: Sequence[Sequence[str]] = ()
) -> dict[str, DetectionSample]:
    """What a recording with annotations shows of each of its sensors. Raises `InputError` without annotations."""
    parts: dict[str, list[DetectionSample]] = {}
    for matched in match_to_truth(scene, sensors, gate, groups):
        sensor = sensor_model(sensors, matched.frame.sensor)
        parts.setdefault(matched.frame.sensor, []).append(_sample(matched, sensor))
    return {name: DetectionSample.pool(part) for name, part in parts.items()}


def _sample(matched: MatchedFrame, sensor: Sensor) -> DetectionSample:
    boxes, truth = matched.detections.boxes, matched.annotations.boxes
    n, d, t = len(boxes), matched.detection, matched.truth
    pose = matched.frame.world_T_ego
    distance, azimuth = sensor.polar(boxes.position[:, :2], pose)
    sight = boxes.position[d, :2] - (np.nan if matched.origin is None else matched.origin)
    u = sight / np.maximum(distance[d], 1e-9)[:, None]
    error = boxes.position[d] - truth.position[t]
    along, across, velocity, yaw, height = (np.full(shape, np.nan) for shape in (n, n, (n, 2), n, n))
    along[d] = (error[:, :2] * u).sum(axis=1)
    across[d] = error[:, 1] * u[:, 0] - error[:, 0] * u[:, 1]
    velocity[d] = boxes.velocity[d] - truth.velocity[t]
    yaw[d] = wrap_angle(2 * (boxes.yaw[d] - truth.yaw[t])) / 2
    height[d] = error[:, 2]
    true, detected = np.zeros(n, dtype=bool), np.zeros(len(truth), dtype=bool)
    true[d], detected[t] = True, True
    there = matched.annotations.visible
    object_range, object_azimuth = sensor.polar(truth.position[:, :2], pose)
    return DetectionSample(
        boxes.label,
        sensor.logit(matched.detections.score),
        distance,
        azimuth,
        true,
        along,
        across,
        velocity,
        yaw,
        height,
        truth.label[there],
        object_range[there],
        object_azimuth[there],
        detected[there],
    )


def _truth_at(scene: Scene, k: int, time: float) -> Annotations:
    """The true objects at a time between moments k - 1 and k."""
    assert scene.ground_truth is not None
    after = scene.ground_truth[k]
    if k == 0 or time >= scene.timestamps[k]:
        return after
    before = scene.ground_truth[k - 1]
    share = (scene.timestamps[k] - time) / (scene.timestamps[k] - scene.timestamps[k - 1])
    _, new, old = np.intersect1d(after.id, before.id, return_indices=True)
    position = after.boxes.position.copy()
    position[new] += share * (before.boxes.position[old] - position[new])
    return replace(after, boxes=replace(after.boxes, position=position))
