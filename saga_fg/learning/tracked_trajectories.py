"""Trajectories of objects in a recording without annotations: the detections that a tracker assigned to one track.

A trajectory counts as an object when it is long and was detected most of the times that it was in view; detections that
belong to no such trajectory count as false. The tracker's word stands for the truth: clutter that stays in one place
passes for an object, and an object detected only now and then for clutter.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from saga_fg.learning.detection_sample import DetectionSample, SampledDetections, SampledObjects
from saga_fg.learning.process_noise import MeasuredTrajectory
from saga_fg.model.sensor import Sensor, sensor_model
from saga_fg.numerics.arrays import FloatArray, IntArray, StrArray
from saga_fg.numerics.assignment import Assignment
from saga_fg.tracking import Tracker
from saga_fg.types.dataset import Scene
from saga_fg.types.frame import Detections, Frame

FEWEST_DETECTIONS = 5  # of a trajectory that counts as an object
DETECTED_SHARE = 0.5  # of the frames in which it was in view, at least


@dataclass(frozen=True, eq=False)
class DetectedTrajectory:
    """T detections of one object in order of time, world coordinates; NaN where something was not measured.

    label; sensor (T,) names; time (T,) s; position (T, 2), velocity (T, 2); origin (T, 2) places of the sensors;
    logit (T,) of the scores; yaw (T,), height (T,)
    """

    label: str
    sensor: StrArray
    time: FloatArray
    position: FloatArray
    velocity: FloatArray
    origin: FloatArray
    logit: FloatArray
    yaw: FloatArray
    height: FloatArray

    def __len__(self) -> int:
        return len(self.time)

    def measured(self, sensors: Mapping[str, Sensor]) -> MeasuredTrajectory:
        """The positions and headings, with the noise that the sensors' models give them."""
        R, yaw_noise = np.empty((len(self), 2, 2)), np.empty(len(self))
        origin = np.where(np.isfinite(self.origin), self.origin, self.position)
        for name in np.unique(self.sensor).tolist():
            rows = np.flatnonzero(self.sensor == name)
            model, label = sensor_model(sensors, name), np.full(len(rows), self.label)
            p = model.calibrated(self.logit[rows], label)
            R[rows] = model.position_covariance(label, self.position[rows], p, origin[rows])
            (yaw_noise[rows],) = model.deviations(label, "yaw")
        return MeasuredTrajectory(self.time, self.position, R, self.yaw, yaw_noise)


class _Linked(NamedTuple):
    """A frame in world coordinates, at the time of measurement, with the track (N,) of each detection, -1 for none."""

    frame: Frame
    sensor: Sensor
    time: float
    detections: Detections
    track: IntArray

    @property
    def polar(self) -> tuple[FloatArray, FloatArray]:
        """Range and azimuth of the detections from the sensor."""
        return self.sensor.polar(self.detections.boxes.position[:, :2], self.frame.world_T_ego)


def sample_with_tracker(
    scene: Scene, tracker: Tracker, sensors: Mapping[str, Sensor]
) -> tuple[list[DetectedTrajectory], dict[str, DetectionSample]]:
    """The objects that a new tracker finds in a scene, and a sample of each sensor, whose errors are not known."""
    linked = []
    for frame in scene.frames:
        tracker.step(frame)
        linked.append(_linked(frame, sensor_model(sensors, frame.sensor), tracker.assignment))
    trajectories = _trajectories(linked)
    in_view = _in_view(trajectories, linked)
    count = Counter(number for tracks, _ in in_view.values() for number in tracks.tolist())
    objects = {
        number: trajectory
        for number, trajectory in trajectories.items()
        if len(trajectory) >= max(FEWEST_DETECTIONS, DETECTED_SHARE * count[number])
    }
    ids = np.array(list(objects), dtype=np.int64)
    samples = {}
    for name in scene.sensors:
        detections = [
            SampledDetections.without_errors(
                e.detections.boxes.label, e.sensor.logit(e.detections.score), *e.polar, np.isin(e.track, ids)
            )
            for e in linked
            if e.frame.sensor == name
        ]
        tracks, seen = in_view.get(name, (ids[:0], SampledObjects.empty()))
        samples[name] = DetectionSample(SampledDetections.concatenate(detections), seen.select(np.isin(tracks, ids)))
    return list(objects.values()), samples


def _linked(frame: Frame, sensor: Sensor, assignment: Assignment) -> _Linked:
    track = np.full(len(frame), -1, dtype=np.int64)
    track[assignment.detection] = assignment.id
    return _Linked(frame, sensor, frame.timestamp + sensor.time_offset, sensor.in_world(frame), track)


def _trajectories(linked: Sequence[_Linked]) -> dict[int, DetectedTrajectory]:
    """Track -> the detections linked to it."""
    if not linked:
        return {}
    parts = []
    for frame, sensor, time, detections, track in linked:
        rows = np.flatnonzero(track >= 0)
        boxes, n, origin = detections.boxes, len(rows), sensor.origin(frame)
        parts.append(
            (
                track[rows],
                boxes.label[rows],
                np.full(n, frame.sensor),
                np.full(n, time),
                boxes.position[rows, :2],
                boxes.velocity[rows],
                np.tile(np.full(2, np.nan) if origin is None else origin, (n, 1)),
                sensor.logit(detections.score[rows]),
                boxes.yaw[rows],
                boxes.position[rows, 2],
            )
        )
    track, label, *columns = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.lexsort((columns[1], track))
    found = {}
    for rows in np.split(order, np.flatnonzero(np.diff(track[order])) + 1):
        if len(rows):
            names, count = np.unique(label[rows], return_counts=True)
            columns_of = (column[rows] for column in columns)
            found[int(track[rows[0]])] = DetectedTrajectory(str(names[count.argmax()]), *columns_of)
    return found


def _in_view(
    trajectories: Mapping[int, DetectedTrajectory], linked: Sequence[_Linked]
) -> dict[str, tuple[IntArray, SampledObjects]]:
    """Sensor -> tracks (M,), and these as objects in view of the frames between their first and last detection.

    The first and last detection themselves are left out: a trajectory has them by definition.
    """
    ids = np.array(list(trajectories), dtype=np.int64)
    label = np.array([one.label for one in trajectories.values()], dtype=np.str_)
    times = np.array([entry.time for entry in linked])
    first, last = (np.array([one.time[end] for one in trajectories.values()]) for end in (0, -1))
    place = np.array(
        [[np.interp(times, one.time, one.position[:, axis]) for axis in (0, 1)] for one in trajectories.values()]
    )
    parts: dict[str, list[tuple[IntArray, SampledObjects]]] = {}
    for k, (frame, sensor, time, _, track) in enumerate(linked):
        alive = np.flatnonzero((first < time) & (time < last))
        if len(alive):
            distance, azimuth = sensor.polar(place[alive, :, k], frame.world_T_ego)
            inside = sensor.field_of_view.holds(distance, azimuth)
            rows = alive[inside]
            seen = SampledObjects(label[rows], distance[inside], azimuth[inside], np.isin(ids[rows], track))
            parts.setdefault(frame.sensor, []).append((ids[rows], seen))
    return {
        name: (np.concatenate([track for track, _ in part]), SampledObjects.concatenate([seen for _, seen in part]))
        for name, part in parts.items()
    }
