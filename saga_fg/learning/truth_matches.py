"""Match the detections of a recording to the true objects: one to one, by least distances, within a gate.

True positions between two annotated times are interpolated. An object was in view where the annotations call it
visible.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from saga_fg.errors import InputError
from saga_fg.learning.detection_sample import DetectionSample, SampledDetections, SampledObjects
from saga_fg.learning.process_noise import MeasuredTrajectory
from saga_fg.model.sensor import Sensor, sensor_model
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.assignment import assign
from saga_fg.numerics.geometry import wrap_angle
from saga_fg.tracking.class_belief import ClassGroups
from saga_fg.types.dataset import Annotations, Scene
from saga_fg.types.frame import Detections, Frame

GATE = 4.0  # m; poor sensors err by metres, and the fits allow for wrong matches


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
    """A sample of each sensor of an annotated scene. Raises `InputError` for a scene without ground truth."""
    parts: dict[str, list[DetectionSample]] = {}
    for matched in match_to_truth(scene, sensors, gate, groups):
        sensor = sensor_model(sensors, matched.frame.sensor)
        parts.setdefault(matched.frame.sensor, []).append(_sample(matched, sensor))
    return {name: DetectionSample.pool(part) for name, part in parts.items()}


def measured_trajectories(
    scenes: Iterable[Scene], sensors: Mapping[str, Sensor], gate: float = 2.0, step: float = 0.05
) -> dict[str, list[MeasuredTrajectory]]:
    """Class -> the measured positions and headings of each of its objects, by the nearest detection of the class within
    `gate` m.

    Of detections of one object closer in time than `step` s only the first is taken. Their covariances are those of the
    sensors' models. Raises `InputError` for a scene without ground truth.
    """
    found: dict[str, list[MeasuredTrajectory]] = {}
    for scene in scenes:
        objects: dict[tuple[str, str], list[tuple[float, FloatArray, FloatArray, float, float]]] = {}
        for matched in match_to_truth(scene, sensors, gate):
            truth, sensor = matched.annotations, sensor_model(sensors, matched.frame.sensor)
            time = matched.frame.timestamp + sensor.time_offset
            boxes, R = matched.detections.boxes, sensor.detection_covariance(matched.detections, matched.origin)
            (yaw_noise,) = sensor.deviations(boxes.label, "yaw")
            for j, i in zip(matched.detection.tolist(), matched.truth.tolist(), strict=True):
                rows = objects.setdefault((str(truth.boxes.label[i]), str(truth.id[i])), [])
                if not rows or time - rows[-1][0] >= step:
                    rows.append((time, boxes.position[j, :2], R[j], boxes.yaw[j], yaw_noise[j]))
        for (label, _), rows in objects.items():
            found.setdefault(label, []).append(MeasuredTrajectory(*map(np.array, zip(*rows, strict=True))))
    return found


def _sample(matched: MatchedFrame, sensor: Sensor) -> DetectionSample:
    boxes, truth = matched.detections.boxes, matched.annotations.boxes
    n, d, t = len(boxes), matched.detection, matched.truth
    pose = matched.frame.world_T_ego
    distance, azimuth = sensor.polar(boxes.position[:, :2], pose)
    sight = boxes.position[d, :2] - (np.nan if matched.origin is None else matched.origin)
    u = sight / np.maximum(distance[d], 1e-9)[:, None]
    error = boxes.position[d] - truth.position[t]
    true, detected = np.zeros(n, dtype=bool), np.zeros(len(truth), dtype=bool)
    true[d], detected[t] = True, True
    detections = SampledDetections.without_errors(
        boxes.label, sensor.logit(matched.detections.score), distance, azimuth, true
    )
    errors = {
        "along": (error[:, :2] * u).sum(axis=1),
        "across": error[:, 1] * u[:, 0] - error[:, 0] * u[:, 1],
        "velocity": boxes.velocity[d] - truth.velocity[t],
        "yaw": wrap_angle(2 * (boxes.yaw[d] - truth.yaw[t])) / 2,
        "height": error[:, 2],
    }
    for name, values in errors.items():
        column = np.full((n, *values.shape[1:]), np.nan)
        column[d] = values
        errors[name] = column
    objects = SampledObjects(truth.label, *sensor.polar(truth.position[:, :2], pose), detected)
    return DetectionSample(replace(detections, **errors), objects.select(matched.annotations.visible))


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
