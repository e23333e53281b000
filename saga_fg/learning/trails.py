"""What a tracker made of a recording without annotations: the detections it took for one object, from all sensors.

A trail counts as an object when it is long and was seen most of the times that it was in view; what of the detections
belongs to no such trail counts as false. This takes the tracker's word where the truth is not known: clutter that stays
in one place passes for an object, and an object seen only now and then for clutter.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from saga_fg.learning.detection_sample import DetectionSample
from saga_fg.numerics.arrays import FloatArray, IntArray, StrArray
from saga_fg.numerics.assignment import Assignment
from saga_fg.tracking import Tracker
from saga_fg.types.dataset import Scene
from saga_fg.types.frame import Detections, Frame
from saga_fg.types.sensor import Sensor, sensor_model

FEWEST_DETECTIONS = 5  # of a trail that counts as an object
SEEN_SHARE = 0.5  # of the frames in which it was in view, at least


@dataclass(frozen=True, eq=False)
class Trail:
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


class _Linked(NamedTuple):
    """A frame in world coordinates, at the time of measurement, with the track (N,) of each detection, -1 for none."""

    frame: Frame
    time: float
    detections: Detections
    track: IntArray


def follow(
    scene: Scene, tracker: Tracker, sensors: Mapping[str, Sensor]
) -> tuple[list[Trail], dict[str, DetectionSample]]:
    """The objects that a fresh tracker finds in a scene, and what that says of each sensor; errors stay unknown."""
    linked = []
    for frame in scene.frames:
        tracker.step(frame)
        sensor = sensor_model(sensors, frame.sensor)
        linked.append(_linked(frame, sensor, tracker.assignment))
    trails = _trails(linked, sensors)
    chances = _chances(trails, linked, sensors)
    in_view = Counter(number for tracks, _ in chances.values() for number in tracks.tolist())
    objects = {
        number: trail
        for number, trail in trails.items()
        if len(trail) >= max(FEWEST_DETECTIONS, SEEN_SHARE * in_view[number])
    }
    samples = {}
    for name in scene.sensors:
        of_sensor = [entry for entry in linked if entry.frame.sensor == name]
        sample = _sample(of_sensor, sensor_model(sensors, name), objects)
        if name in chances:
            tracks, seen = chances[name]
            none = np.ones(len(seen), dtype=bool)
            sample = DetectionSample.pool([sample, seen.select(none, np.isin(tracks, list(objects)))])
        samples[name] = sample
    return list(objects.values()), samples


def _linked(frame: Frame, sensor: Sensor, assignment: Assignment) -> _Linked:
    track = np.full(len(frame), -1, dtype=np.int64)
    track[assignment.detection] = assignment.id
    return _Linked(frame, frame.timestamp + sensor.time_offset, sensor.in_world(frame), track)


def _trails(linked: Sequence[_Linked], sensors: Mapping[str, Sensor]) -> dict[int, Trail]:
    """Track -> what was linked to it."""
    if not linked:
        return {}
    parts = []
    for frame, time, detections, track in linked:
        rows = np.flatnonzero(track >= 0)
        sensor, boxes, n = sensor_model(sensors, frame.sensor), detections.boxes, len(rows)
        origin = sensor.origin(frame)
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
            found[int(track[rows[0]])] = Trail(str(names[count.argmax()]), *(column[rows] for column in columns))
    return found


def _chances(
    trails: Mapping[int, Trail], linked: Sequence[_Linked], sensors: Mapping[str, Sensor]
) -> dict[str, tuple[IntArray, DetectionSample]]:
    """Sensor -> tracks (M,) and these as objects in view of the frames between their first and their last detection.

    The first and the last do not count themselves: they were bound to be seen.
    """
    ids = np.array(list(trails), dtype=np.int64)
    label = np.array([trail.label for trail in trails.values()], dtype=np.str_)
    times = np.array([entry.time for entry in linked])
    first, last = (np.array([trail.time[end] for trail in trails.values()]) for end in (0, -1))
    place = np.array([[np.interp(times, t.time, t.position[:, axis]) for axis in (0, 1)] for t in trails.values()])
    parts: dict[str, list[tuple[IntArray, DetectionSample]]] = {}
    for k, (frame, time, _, track) in enumerate(linked):
        alive = np.flatnonzero((first < time) & (time < last))
        if len(alive):
            sensor = sensor_model(sensors, frame.sensor)
            distance, azimuth = sensor.polar(place[alive, :, k], frame.world_T_ego)
            inside = sensor.field_of_view.holds(distance, azimuth)
            rows = alive[inside]
            seen = np.isin(ids[rows], track)
            chances = DetectionSample.of_objects(label[rows], distance[inside], azimuth[inside], seen)
            parts.setdefault(frame.sensor, []).append((ids[rows], chances))
    return {
        name: (np.concatenate([track for track, _ in part]), DetectionSample.pool([sample for _, sample in part]))
        for name, part in parts.items()
    }


def _sample(linked: Sequence[_Linked], sensor: Sensor, objects: Mapping[int, Trail]) -> DetectionSample:
    """The detections of one sensor, true where they belong to one of the objects."""
    ids = np.array(list(objects), dtype=np.int64)
    parts = []
    for frame, _, detections, track in linked:
        distance, azimuth = sensor.polar(detections.boxes.position[:, :2], frame.world_T_ego)
        parts.append(
            DetectionSample.of_detections(
                detections.boxes.label, sensor.logit(detections.score), distance, azimuth, np.isin(track, ids)
            )
        )
    return DetectionSample.pool(parts)
