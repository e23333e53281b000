"""Input of the joint estimation: settings, odometry, and a record of both sensors epoch by epoch.

Record of the joint estimator's input, epoch by epoch: odometry, objects, and the detections assigned to them.

A tracker associates the detections: along a path, given or estimated so far, it steps through the frames; its
assignment and its graph of interactions are recorded (`Tracker.assignment`, `Tracker.graph`). Detections are kept in
the vehicle's frame, where they do not depend on the path.

Odometry: measured motion of a vehicle between epochs, and its noise.

Per interval of dt s and d m, an increment a_T_b has independent noise

    heading      turn_noise^2 dt                     roll, pitch   tilt_noise^2 dt
    translation  distance_noise^2 d + time_noise^2 dt,  every direction

and three slow errors, a scale of the distance, a bias of the yaw rate and an angle of the course, which start as
N(0, scale^2), N(0, bias^2), N(0, course^2) and wander as random walks (see `factors.poses`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from factors import ERROR_DIM
from saga_fg.errors import InputError
from saga_fg.model import NodeType, Sensor, Transition, discretise
from saga_fg.numerics import FloatArray, IntArray, checked, checked_covariances, checked_transform, inverse_transform
from saga_fg.settings import (
    Positive,
    PositiveInt,
    PositiveOrInf,
    Settings,
    setting,
    settings_group,
)
from saga_fg.tracking import Tracker, frame_measurements, motion_of
from saga_fg.types import DEFAULT, Detections, Frame


@dataclass(frozen=True)
class OdometryNoise(Settings):
    """Noise of an odometry: standard deviations."""

    turn_noise: Positive = setting(0.01, "standard deviation of the heading after one second, rad")
    tilt_noise: Positive = setting(0.001, "standard deviation of roll and pitch after one second, rad")
    distance_noise: Positive = setting(0.03, "standard deviation of the translation after one metre, m")
    time_noise: Positive = setting(0.01, "standard deviation of the translation after one second, m")
    scale: Positive = setting(0.02, "standard deviation of the scale of distances at the start")
    scale_drift: Positive = setting(0.002, "random walk of the scale in one second")
    bias: Positive = setting(0.005, "standard deviation of the yaw-rate bias at the start, rad/s")
    bias_drift: Positive = setting(0.0005, "random walk of the yaw-rate bias in one second, rad/s")
    course: Positive = setting(0.01, "standard deviation of the course against the sensor axes at the start, rad")
    course_drift: Positive = setting(0.0003, "random walk of that course in one second, rad")

    def covariances(self, distance: FloatArray, dt: FloatArray) -> FloatArray:
        """(n, 9, 9) of increments over `distance` (n,) m and `dt` (n,) s > 0.

        Rows: rotation (rad), translation in the frame of the earlier pose (m), change of scale, of bias (rad/s), of
        course (rad).
        """
        tilt, turn = self.tilt_noise**2 * dt, self.turn_noise**2 * dt
        shift = self.distance_noise**2 * distance + self.time_noise**2 * dt
        slow = (self.scale_drift**2 * dt, self.bias_drift**2 * dt, self.course_drift**2 * dt)
        variances = np.stack([tilt, tilt, turn, shift, shift, shift, *slow], axis=1)
        return np.asarray(variances[:, :, None] * np.eye(6 + ERROR_DIM))


@dataclass(frozen=True, eq=False)
class OdometryIncrements:
    """timestamps (n,) s, strictly increasing; a_T_b (n - 1, 4, 4): each pose in the frame of the one before.

    covariances: (n - 1, 6, 6) of the increments where the device states them, as scan registration does: (rotation
    vector, translation) in the frame of the later pose, rad^2, m^2; None: by `OdometryNoise` alone.
    Raises `InputError` for times that do not increase, increments that are not rigid, and invalid covariances.
    """

    timestamps: FloatArray
    a_T_b: FloatArray
    covariances: FloatArray | None = None

    def __post_init__(self) -> None:
        timestamps = checked("timestamps", self.timestamps, (None,))
        if not len(timestamps) or (np.diff(timestamps) <= 0).any():
            raise InputError("timestamps: expected at least one, strictly increasing")
        increments = checked("a_T_b", self.a_T_b, (len(timestamps) - 1, 4, 4))
        for k, increment in enumerate(increments):
            checked_transform(f"a_T_b[{k}]", increment)
        if self.covariances is not None:
            covariances = checked_covariances("covariances", self.covariances, len(increments), 6)
            vars(self)["covariances"] = covariances
        vars(self).update(timestamps=timestamps, a_T_b=increments)

    @classmethod
    def of(cls, timestamps: ArrayLike, world_T_ego: ArrayLike) -> Self:
        """The increments of a path (n, 4, 4)."""
        poses = checked("world_T_ego", world_T_ego, (None, 4, 4))
        return cls(np.asarray(timestamps, dtype=np.float64), inverse_transform(poses[:-1]) @ poses[1:])

    def __len__(self) -> int:
        """The number of epochs."""
        return len(self.timestamps)

    @property
    def dt(self) -> FloatArray:
        """(n - 1,) s"""
        return np.diff(self.timestamps)

    @property
    def distance(self) -> FloatArray:
        """(n - 1,) m"""
        return np.asarray(np.linalg.norm(self.a_T_b[:, :3, 3], axis=1))

    def path(self, start: ArrayLike | None = None) -> FloatArray:
        """World_T_ego (n, 4, 4): the increments one after the other from `start` (4, 4), by default the identity."""
        poses = [np.eye(4) if start is None else checked_transform("start", start)]
        for increment in self.a_T_b:
            poses.append(poses[-1] @ increment)
        return np.stack(poses)


MAX_ITERATIONS = 30  # largest number of linearisations in each pass
KEYFRAME_PERIOD = 0.15  # skip frames that follow a keyframe within this time, s


@dataclass(frozen=True)
class JointSettings(Settings):
    """Noise of the odometry, stationarity of objects, and effort of the joint estimation."""

    odometry: OdometryNoise = settings_group(OdometryNoise, "errors of the odometry")
    stationary_window: Positive = setting(
        3.0, "time over which an object is judged stationary or moving, s; higher: surer, later"
    )
    moving_speed: Mapping[str, Positive] = settings_group(
        lambda: {DEFAULT: 5.0, "pedestrian": 1.0},
        "standard deviation of the velocity of moving objects by class, m/s; default serves all others",
    )
    outlier_scale: PositiveOrInf = setting(
        3.0,
        "residual from which the Cauchy loss discounts a detection, standard deviations; usual 2 to 5; "
        "higher: outliers count more",
    )
    passes: PositiveInt = setting(
        3, "most passes of associating objects along the latest path; they end when associations repeat; higher: slower"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if DEFAULT not in self.moving_speed:
            raise InputError(f"moving_speed: expected an entry {DEFAULT}, got {dict(self.moving_speed)}")


@dataclass(frozen=True, eq=False)
class RecordedDetections:
    """Detections assigned to objects: id (m,); z (m, 3), m, in the vehicle's frame; R (m, 2, 2), m^2, in its axes.

    row          (m,) of the detection in the frame
    """

    id: IntArray
    z: FloatArray
    R: FloatArray
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
    """

    epoch: int
    time: float
    a_T_b: FloatArray
    objects: RecordedObjects
    seen: RecordedDetections
    transition: Transition | None
    covariance: FloatArray | None = None


class EpochRecorder:
    """Record one frame after the other with a tracker."""

    def __init__(self, tracker: Tracker) -> None:
        self._tracker = tracker
        self._types: dict[str, NodeType] = {}
        self._last: RecordedEpoch | None = None

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
        tracker.step(Frame(frame.timestamp, frame.sensor, detections, world_T_ego, "ego"))
        seen, label = self._seen(frame, detections)
        objects, transition = self._objects(seen, label), None
        if last is not None and tracker.graph is not None and tracker.graph is not before:
            graph = tracker.graph.only(last.objects.id)
            stay = np.isin(last.objects.id, graph.nodes)
            objects = _joined(last.objects.select(np.flatnonzero(stay)), objects)
            if len(graph):
                transition = discretise(graph, frame.timestamp - last.time)
        self._last = RecordedEpoch(epoch, frame.timestamp, a_T_b, objects, seen, transition, covariance)
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
        seen = RecordedDetections(ids[order], z, R, measurements.row[rows])
        return seen, tracker.classes_of(seen.id).tolist()

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


def _joined(before: RecordedObjects, seen: RecordedObjects) -> RecordedObjects:
    """Objects of the epoch before that stay, and new ones, sorted by id."""
    new = seen.select(np.flatnonzero(~np.isin(seen.id, before.id)))
    ids = np.concatenate([before.id, new.id])
    both = RecordedObjects(ids, (*before.types, *new.types), (*before.label, *new.label))
    return both.select(np.argsort(both.id))
