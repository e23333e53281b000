"""Record of the joint estimator's input, epoch by epoch: odometry, objects, and the detections assigned to them.

A tracker associates the detections: along a path, given or estimated so far, it steps through the frames; its
assignment and its graph of interactions are recorded (`Tracker.assignment`, `Tracker.graph`). Detections are kept in
the vehicle's frame, where they do not depend on the path.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from saga_fg.errors import InputError
from saga_fg.model.discretisation import discretise
from saga_fg.model.edge_rules import VEHICLES
from saga_fg.model.motion import NodeType
from saga_fg.model.sensor import Sensor
from saga_fg.model.transition import Transition
from saga_fg.numerics.arrays import FloatArray, IntArray, of_classes
from saga_fg.numerics.geometry import inverse_transform
from saga_fg.slam.joint.odometry import OdometryIncrements
from saga_fg.slam.joint.settings import JointSettings
from saga_fg.tracking import Tracker
from saga_fg.tracking.map_nodes import motion_of
from saga_fg.tracking.measurements import frame_measurements
from saga_fg.types.frame import Detections, Frame
from saga_fg.types.track import Tracks


@dataclass(frozen=True, eq=False)
class RecordedDetections:
    """Detections assigned to objects: id (m,); z (m, 3), m, in the vehicle's frame; R (m, 2, 2), m^2, in its axes.

    probability  (m,) that the detection is of this object
    row          (m,) of the detection in the frame
    """

    id: IntArray
    z: FloatArray
    R: FloatArray
    probability: FloatArray
    row: IntArray


@dataclass(frozen=True, eq=False)
class RecordedObjects:
    """Objects of an epoch: id (n,), sorted; types: n node types; label: their n classes."""

    id: IntArray
    types: tuple[NodeType, ...]
    label: tuple[str, ...]

    def select(self, rows: IntArray) -> RecordedObjects:
        chosen = rows.tolist()
        return RecordedObjects(
            self.id[rows], tuple(self.types[k] for k in chosen), tuple(self.label[k] for k in chosen)
        )


@dataclass(frozen=True, eq=False)
class RecordedEpoch:
    """One epoch.

    epoch       its number in the graph
    time        s
    a_T_b       (4, 4) odometry from the epoch before; the identity for the first one
    objects     at this epoch
    seen        detections of them
    transition  of the objects that the epoch before has as well; None if there are none
    covariance  (6, 6) of a_T_b, as in `OdometryIncrements`, where the device states one
    headings    of vehicles at the epoch before by id, rad from the vehicle's heading
    """

    epoch: int
    time: float
    a_T_b: FloatArray
    objects: RecordedObjects
    seen: RecordedDetections
    transition: Transition | None
    covariance: FloatArray | None = None
    headings: Mapping[int, float] = field(default_factory=dict)


class EpochRecorder:
    """Record one frame after the other with a tracker."""

    def __init__(self, tracker: Tracker) -> None:
        self._tracker = tracker
        self._types: dict[str, NodeType] = {}
        self._last: RecordedEpoch | None = None
        self._headings: Mapping[int, float] = {}

    def add(
        self, epoch: int, frame: Frame, world_T_ego: FloatArray, a_T_b: FloatArray, covariance: FloatArray | None = None
    ) -> RecordedEpoch:
        """Record a frame seen from `world_T_ego` (4, 4), after the vehicle moved by a_T_b (4, 4), covariance (6, 6).

        Raises `InputError` for a frame that is not later than the last one, or in world coordinates without a pose.
        """
        last, tracker = self._last, self._tracker
        if last is not None and frame.timestamp <= last.time:
            raise InputError(f"frame at {frame.timestamp:.6f} s: expected one after {last.time:.6f} s")
        detections = in_ego(frame, tracker.sensor(frame.sensor))
        before = tracker.graph
        tracks = tracker.step(Frame(frame.timestamp, frame.sensor, detections, world_T_ego, "ego"))
        seen, label = self._seen(frame, detections)
        objects, transition = self._objects(seen, label), None
        if last is not None and tracker.graph is not None and tracker.graph is not before:
            graph = tracker.graph.only(last.objects.id)
            stay = np.isin(last.objects.id, graph.nodes)
            objects = _joined(last.objects.select(np.flatnonzero(stay)), objects)
            if len(graph):
                transition = discretise(graph, frame.timestamp - last.time)
        headings, self._headings = self._headings, _headings(tracks, world_T_ego)
        self._last = RecordedEpoch(epoch, frame.timestamp, a_T_b, objects, seen, transition, covariance, headings)
        return self._last

    def _seen(self, frame: Frame, detections: Detections) -> tuple[RecordedDetections, list[str]]:
        """The assigned detections, in order of ids, and their classes."""
        here = Frame(frame.timestamp, frame.sensor, detections, np.eye(4), "ego")
        tracker = self._tracker
        measurements = frame_measurements(here, tracker.sensor(frame.sensor), tracker.settings.classes)
        _, mine, rows = np.intersect1d(tracker.assignment.detection, measurements.row, return_indices=True)
        ids = tracker.assignment.id[mine]
        order = np.argsort(ids)
        rows = rows[order]
        z, R = measurements.boxes.position[rows], measurements.R[rows, :2, :2]
        seen = RecordedDetections(ids[order], z, R, np.ones(len(rows)), measurements.row[rows])
        return seen, measurements.boxes.label[rows].tolist()

    def _objects(self, seen: RecordedDetections, label: list[str]) -> RecordedObjects:
        for name in label:
            if name not in self._types:
                motion = motion_of(self._tracker.settings, name)
                self._types[name] = NodeType(type(motion).__name__, motion)
        return RecordedObjects(seen.id, tuple(self._types[name] for name in label), tuple(label))


def record_epochs(
    frames: Sequence[Frame],
    world_T_ego: FloatArray,
    odometry: OdometryIncrements,
    tracker: Tracker,
) -> list[RecordedEpoch]:
    """The record of `frames` (n) along a path (n, 4, 4), with odometry between them.

    An object belongs to all epochs from its first to its last detection.
    """
    recorder = EpochRecorder(tracker)
    steps = [np.eye(4), *odometry.a_T_b]
    covariances = [None] * len(steps) if odometry.covariances is None else [None, *odometry.covariances]
    inputs = zip(range(len(frames)), frames, world_T_ego, steps, covariances, strict=True)
    record = [recorder.add(*one) for one in inputs]
    last = {int(name): now.epoch for now in record for name in now.seen.id}
    trimmed = []
    for now in record:
        kept = np.array([last[int(name)] >= now.epoch for name in now.objects.id], dtype=bool)
        transition = now.transition
        if transition is not None:
            graph = transition.graph.only(now.objects.id[kept])
            transition = discretise(graph, transition.dt) if len(graph) else None
        trimmed.append(replace(now, objects=now.objects.select(np.flatnonzero(kept)), transition=transition))
    return trimmed


def motion_covariances(record: Sequence[RecordedEpoch], settings: JointSettings) -> FloatArray:
    """(n - 1, 9, 9) of the increments to n epochs, each from the one before, as in `OdometryNoise.covariances`.

    Where the device states covariances, these hold for rotation and translation.
    """
    later = record[1:]
    distance = np.array([np.linalg.norm(now.a_T_b[:3, 3]) for now in later])
    P = settings.odometry.covariances(distance, np.diff([now.time for now in record]))
    for row, now in enumerate(later):
        if now.covariance is not None:
            axes = np.eye(6)
            axes[3:, 3:] = now.a_T_b[:3, :3]
            P[row, :6, :6] = axes @ now.covariance @ axes.T
    return P


def in_ego(frame: Frame, sensor: Sensor) -> Detections:
    """A frame's detections in the vehicle's frame. Raises `InputError` for world coordinates without a pose."""
    if frame.coordinates == "ego":
        return frame.detections
    if frame.coordinates == "sensor":
        return frame.detections.transformed(sensor.extrinsics.ego_T_sensor)
    if frame.world_T_ego is None:
        raise InputError(
            f"frame at {frame.timestamp:.6f} s: expected a pose, or detections in ego or sensor coordinates"
        )
    return frame.detections.transformed(inverse_transform(frame.world_T_ego))


def _headings(tracks: Tracks, world_T_ego: FloatArray) -> dict[int, float]:
    """Headings of vehicles from that of the vehicle, rad."""
    yaw = tracks.boxes.yaw - np.arctan2(world_T_ego[1, 0], world_T_ego[0, 0])
    known = of_classes(tracks.boxes.label, VEHICLES) & np.isfinite(yaw)
    return dict(zip(tracks.id[known].tolist(), yaw[known].tolist(), strict=True))


def _joined(before: RecordedObjects, seen: RecordedObjects) -> RecordedObjects:
    """Objects of the epoch before that stay, and new ones, sorted by id."""
    new = seen.select(np.flatnonzero(~np.isin(seen.id, before.id)))
    ids = np.concatenate([before.id, new.id])
    both = RecordedObjects(ids, (*before.types, *new.types), (*before.label, *new.label))
    return both.select(np.argsort(both.id))
