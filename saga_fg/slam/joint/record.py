"""What the joint estimator is told, moment by moment: odometry, which objects there are, which of them are seen where.

Association is the tracker's: along a path, given or estimated so far, it takes in one frame after the other, and tells
which detection it registered to which track and how the tracks act on each other (`Tracker.assignment`,
`Tracker.graph`). The record keeps detections in the vehicle's frame, in which they do not depend on where it was.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from saga_fg.errors import InputError
from saga_fg.model.discretisation import discretise
from saga_fg.model.node import NodeType
from saga_fg.model.transition import Transition
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.geometry import inverse_transform
from saga_fg.slam.joint.odometry import Odometry
from saga_fg.slam.joint.settings import JointSettings
from saga_fg.tracking import Tracker
from saga_fg.tracking.measurements import frame_measurements
from saga_fg.types.frame import Detections, Frame
from saga_fg.types.sensor import Sensor


@dataclass(frozen=True, eq=False)
class Seen:
    """Detections registered to objects: id (m,); z (m, 3), m, in the vehicle's frame; R (m, 2, 2), m^2, in its axes."""

    id: IntArray
    z: FloatArray
    R: FloatArray

    def select(self, rows: IntArray) -> Seen:
        return Seen(self.id[rows], self.z[rows], self.R[rows])


@dataclass(frozen=True, eq=False)
class Objects:
    """Those of a moment: id (n,), sorted; types: n node types; label: their n classes."""

    id: IntArray
    types: tuple[NodeType, ...]
    label: tuple[str, ...]

    def select(self, rows: IntArray) -> Objects:
        chosen = rows.tolist()
        return Objects(self.id[rows], tuple(self.types[k] for k in chosen), tuple(self.label[k] for k in chosen))


@dataclass(frozen=True, eq=False)
class EgoMoment:
    """A moment of the record.

    time        s
    a_T_b       (4, 4) odometry from the moment before; the identity for the first one
    covariance  (6, 6) of it, as in `Odometry`, where the device states one
    objects     that there are
    seen        detections of them
    transition  of the objects that were there at the moment before as well; None if there are none
    """

    time: float
    a_T_b: FloatArray
    objects: Objects
    seen: Seen
    transition: Transition | None
    covariance: FloatArray | None = None


class Registration:
    """Makes a record, a frame at a time, with a tracker of its own; motion_noise: factor on that of the objects."""

    def __init__(self, tracker: Tracker, motion_noise: float = 1.0) -> None:
        self._tracker = tracker
        self._motion_noise = motion_noise
        self._types: dict[str, NodeType] = {}
        self._last: EgoMoment | None = None

    @property
    def tracker(self) -> Tracker:
        """The tracker, as of the last frame."""
        return self._tracker

    def add(
        self, frame: Frame, world_T_ego: FloatArray, a_T_b: FloatArray, covariance: FloatArray | None = None
    ) -> EgoMoment:
        """Take in a frame seen from `world_T_ego` (4, 4), after the vehicle moved by a_T_b (4, 4), covariance (6, 6).

        Raises `InputError` for a frame that is not later than the last one, or in world coordinates without a pose.
        """
        last, tracker = self._last, self._tracker
        if last is not None and frame.timestamp <= last.time:
            raise InputError(f"frame at {frame.timestamp:.6f} s: expected one after {last.time:.6f} s")
        detections = in_ego(frame, tracker.sensor(frame.sensor))
        before = tracker.graph
        tracker.step(Frame(frame.timestamp, frame.sensor, detections, world_T_ego, "ego"))
        seen, label = self._seen(frame, detections)
        objects, transition = self._objects(seen, label), None
        if last is not None and tracker.graph is not None and tracker.graph is not before:
            graph = tracker.graph.only(last.objects.id)
            graph = replace(graph, diffusion_scale=self._motion_noise * graph.diffusion_scale)
            stay = np.isin(last.objects.id, graph.nodes)
            objects = _joined(last.objects.select(np.flatnonzero(stay)), objects)
            if len(graph):
                transition = discretise(graph, frame.timestamp - last.time)
        self._last = EgoMoment(frame.timestamp, a_T_b, objects, seen, transition, covariance)
        return self._last

    def _seen(self, frame: Frame, detections: Detections) -> tuple[Seen, list[str]]:
        """The registered detections, in order of ids, and their classes."""
        here = Frame(frame.timestamp, frame.sensor, detections, np.eye(4), "ego")
        tracker = self._tracker
        measurements = frame_measurements(here, tracker.sensor(frame.sensor), tracker.settings.classes)
        _, mine, rows = np.intersect1d(tracker.assignment.detection, measurements.row, return_indices=True)
        ids = tracker.assignment.id[mine]
        order = np.argsort(ids)
        rows = rows[order]
        seen = Seen(ids[order], measurements.boxes.position[rows], measurements.R[rows, :2, :2])
        return seen, measurements.boxes.label[rows].tolist()

    def _objects(self, seen: Seen, label: list[str]) -> Objects:
        for name in label:
            if name not in self._types:
                motion = self._tracker.class_settings(name).motion
                self._types[name] = NodeType(type(motion).__name__, motion)
        return Objects(seen.id, tuple(self._types[name] for name in label), tuple(label))


def register(
    frames: Sequence[Frame],
    world_T_ego: FloatArray,
    odometry: Odometry,
    tracker: Tracker,
    motion_noise: float = 1.0,
) -> list[EgoMoment]:
    """The record of `frames` (n) along a path (n, 4, 4), with odometry between them.

    Objects are there from the first to the last time they are seen.
    """
    registration = Registration(tracker, motion_noise)
    steps = [np.eye(4), *odometry.a_T_b]
    covariances = [None] * len(steps) if odometry.covariances is None else [None, *odometry.covariances]
    record = [registration.add(*one) for one in zip(frames, world_T_ego, steps, covariances, strict=True)]
    last = {int(name): k for k, moment in enumerate(record) for name in moment.seen.id}
    trimmed = []
    for k, moment in enumerate(record):
        kept = np.array([last[int(name)] >= k for name in moment.objects.id], dtype=bool)
        transition = moment.transition
        if transition is not None:
            graph = transition.graph.only(moment.objects.id[kept])
            transition = discretise(graph, transition.dt) if len(graph) else None
        trimmed.append(replace(moment, objects=moment.objects.select(np.flatnonzero(kept)), transition=transition))
    return trimmed


def motion_covariances(record: Sequence[EgoMoment], settings: JointSettings) -> FloatArray:
    """(n - 1, 9, 9) of the increments to n moments, each from the one before, as in `OdometryNoise.covariances`.

    Where the device states covariances, rotation and translation are by these.
    """
    later = record[1:]
    distance = np.array([np.linalg.norm(moment.a_T_b[:3, 3]) for moment in later])
    P = settings.odometry.covariances(distance, np.diff([moment.time for moment in record]))
    for row, moment in enumerate(later):
        if moment.covariance is not None:
            axes = np.eye(6)
            axes[3:, 3:] = moment.a_T_b[:3, :3]
            P[row, :6, :6] = axes @ moment.covariance @ axes.T
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


def _joined(before: Objects, seen: Objects) -> Objects:
    """Objects of a moment: those that stayed and those that are new, sorted by id."""
    new = np.flatnonzero(~np.isin(seen.id, before.id))
    fresh = seen.select(new)
    ids = np.concatenate([before.id, fresh.id])
    both = Objects(ids, (*before.types, *fresh.types), (*before.label, *fresh.label))
    return both.select(np.argsort(both.id))
