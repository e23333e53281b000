"""Input of the joint estimation, epoch by epoch: odometry, objects with their detections, and which are stationary.

A tracker associates the detections: along a path, given or estimated so far, it steps through the frames; its
assignment and its graph of interactions are recorded (`Tracker.assignment`, `Tracker.graph`). Detections are kept in
the vehicle's frame, where they do not depend on the path.

Stationarity of objects: the probability that each one is at rest, from its detections along a path.

Around each detection of an object, within a window, D is the mean place of the later half of the detections less that
of the earlier half, in the world along the path assumed so far, and T the time between the two. A stationary object
has D ~ N(0, S): noise of the detections and of the odometry over the T seconds and s metres in between,

    S = R (1/n_1 + 1/n_2) + shift + (scale^2 + course^2) s^2 + range^2 (turn + (bias T)^2)

where shift and turn are the summed variances of the increments in between, in translation and in heading; scale, bias
and course are the odometry's deviations as known so far. A moving object has D ~ N(0, S + (u T)^2), with the usual
speed u_2 of its class (`moving_speed`), or u_1 = 0.3 u_2 where traffic creeps. By Bayes, with u_0 = 0 and shares q_k,

    P(stationary | D) = q_0 N(D; 0, S) / sum_k q_k N(D; 0, S + (u_k T)^2)

Where T is short, all these variances are nearly equal, and P is about q_0; so it is for slow classes far away.

In a queue, cars too far to be seen creeping look parked, and the vehicle's path would bend until they are. But others,
nearer, are seen to creep. So q_0 is one half, and the other half is divided as the traffic moves then, within 10 s:
maximum likelihood of all detections by expectation maximisation, with a Dirichlet prior worth a few detections.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from saga_fg.errors import InputError
from saga_fg.model import NodeType, SceneGraph, Sensor, Transition, discretise
from saga_fg.numerics import (
    BoolArray,
    Columns,
    FloatArray,
    IntArray,
    StrArray,
    checked,
    checked_covariances,
    checked_transform,
    inverse_transform,
    transform_points,
)
from saga_fg.settings import (
    Positive,
    PositiveInt,
    PositiveOrInf,
    Settings,
    setting,
    settings_group,
)
from saga_fg.slam.joint.odometry_noise import OdometryNoise
from saga_fg.tracking import Tracker, frame_measurements, motion_of
from saga_fg.types import DEFAULT, Detections, Frame, Tracks, class_numbers


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

    def path(self, start: ArrayLike | None = None) -> FloatArray:
        """World_T_ego (n, 4, 4): the increments one after the other from `start` (4, 4), by default the identity."""
        first = np.eye(4) if start is None else checked_transform("start", start)
        return np.stack(list(accumulate(self.a_T_b, np.matmul, initial=first)))


STATIONARY_WINDOW = 3.0  # s, over which an object is judged stationary or moving; longer is surer, and later
MAX_ITERATIONS = 30  # largest number of linearisations in each pass
KEYFRAME_PERIOD = 0.15  # skip frames that follow a keyframe within this time, s


@dataclass(frozen=True)
class JointSettings(Settings):
    """Noise of the odometry, stationarity of objects, and effort of the joint estimation."""

    odometry: OdometryNoise = settings_group(OdometryNoise, "errors of the odometry")
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
class RecordedObjects(Columns):
    """Objects of an epoch: id (n,), sorted; types (n,) `NodeType`; label (n,) their classes."""

    id: IntArray
    types: NDArray[np.object_]
    label: StrArray


@dataclass(frozen=True, eq=False)
class RecordedEpoch:
    """One epoch.

    epoch       its number in the graph
    time        s
    a_T_b       (4, 4) odometry from the epoch before; the identity for the first one
    objects     at this epoch
    seen        detections of them
    graph       scene graph of the objects that the epoch before has as well; None if there are none
    dt          s since the epoch before
    covariance  (6, 6) of a_T_b, as in `OdometryIncrements`, where the device states one
    """

    epoch: int
    time: float
    a_T_b: FloatArray
    objects: RecordedObjects
    seen: RecordedDetections
    graph: SceneGraph | None
    dt: float
    covariance: FloatArray | None = None

    @cached_property
    def transition(self) -> Transition | None:
        """Of the objects of `graph`; None if there are none."""
        return None if self.graph is None else discretise(self.graph, self.dt)


class EpochRecorder:
    """Record one frame after the other with a tracker; `tracks`: those of the newest."""

    def __init__(self, tracker: Tracker) -> None:
        self.tracks = Tracks.empty(0.0)
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
        self.tracks = tracker.step(Frame(frame.timestamp, frame.sensor, detections, world_T_ego, "ego"))
        seen = self._seen(frame, detections)
        objects, graph = self._objects(seen), None
        if last is not None and tracker.graph is not None and tracker.graph is not before:
            graph = tracker.graph.only(last.objects.id)
            stay = last.objects.select(np.isin(last.objects.id, graph.nodes))
            objects = stay.append(objects.select(~np.isin(objects.id, stay.id)))
            objects = objects.select(np.argsort(objects.id))
        dt = 0.0 if last is None else frame.timestamp - last.time
        self._last = RecordedEpoch(epoch, frame.timestamp, a_T_b, objects, seen, _or_none(graph), dt, covariance)
        return self._last

    def _seen(self, frame: Frame, detections: Detections) -> RecordedDetections:
        """The assigned detections, in order of ids."""
        here, tracker = Frame(frame.timestamp, frame.sensor, detections, np.eye(4), "ego"), self._tracker
        measurements = frame_measurements(here, tracker.sensor(frame.sensor), tracker.settings.classes)
        _, mine, rows = np.intersect1d(tracker.assignment.detection, measurements.row, return_indices=True)
        ids = tracker.assignment.id[mine]
        order = np.argsort(ids)
        rows = rows[order]
        z, R = measurements.boxes.position[rows], measurements.R[rows, :2, :2]
        return RecordedDetections(ids[order], z, R, measurements.row[rows])

    def _objects(self, seen: RecordedDetections) -> RecordedObjects:
        label = self._tracker.classes_of(seen.id)
        for name in label.tolist():
            if name not in self._types:
                motion = motion_of(self._tracker.settings, name)
                self._types[name] = NodeType(type(motion).__name__, motion)
        return RecordedObjects(seen.id, np.array([self._types[name] for name in label.tolist()], dtype=object), label)


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
        graph = None if now.graph is None else _or_none(now.graph.only(now.objects.id[kept]))
        trimmed.append(replace(now, objects=now.objects.select(kept), graph=graph))
    return trimmed


def _or_none(graph: SceneGraph | None) -> SceneGraph | None:
    """A graph with objects, None in place of one without."""
    return graph if graph is not None and len(graph) else None


def motion_covariances(record: Sequence[RecordedEpoch], settings: JointSettings) -> FloatArray:
    """(n - 1, 9, 9) of the increments to n epochs, each from the one before, as in `OdometryNoise.covariances`.

    Where the device states covariances, these hold for rotation and translation.
    """
    later = record[1:]
    steps = np.array([now.a_T_b for now in later]).reshape(-1, 4, 4)
    dt = np.diff([now.time for now in record])
    return settings.odometry.of_increments(steps, dt, [now.covariance for now in later])


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


_CREEPING = 0.3  # speed of creeping traffic, as a share of the usual one
_ALIKE = 10.0  # s, time over which traffic keeps its shares
_PRIOR = 10.0  # detections of each hypothesis that the prior of the shares is worth
_ROUNDS = 30  # of expectation maximisation


@dataclass(frozen=True, eq=False)
class _PlacedDetections(Columns):
    """All detections, by object and time: object, row of the record, time (N,), place (N, 2), variance, range, u (N,).

    drift (N, 3): way driven, m, variance of the translation, m^2, and of the heading, rad^2, from the first epoch on
    """

    object: IntArray
    row: IntArray
    time: FloatArray
    place: FloatArray
    variance: FloatArray
    range: FloatArray
    speed: FloatArray
    drift: FloatArray


def stationary_probabilities(
    record: Sequence[RecordedEpoch], path: FloatArray, slow: FloatArray, settings: JointSettings
) -> list[FloatArray]:
    """For each epoch the probabilities (n,) that its objects are stationary; path (K, 4, 4) assumed so far.

    slow: deviations (3,) of the odometry's scale, bias and course, as known

    0 where there are too few detections. Between two detections it is the smaller one of theirs.
    """
    seen = _place(record, path, settings)
    p = _probabilities(seen, slow)
    result = [np.zeros(len(now.objects.id)) for now in record]
    if not len(p):
        return result
    first = np.flatnonzero(np.append(True, seen.object[1:] != seen.object[:-1]))
    for start, end in zip(first, np.append(first[1:], len(p)), strict=True):
        name, rows, mine = seen.object[start], seen.row[start:end], p[start:end]
        for k in range(int(rows[0]), int(rows[-1]) + 1):
            after = int(np.searchsorted(rows, k))
            value = mine[after] if rows[after] == k else min(mine[after - 1], mine[after])
            row = int(np.searchsorted(record[k].objects.id, name))
            if row < len(record[k].objects.id) and record[k].objects.id[row] == name:
                result[k][row] = value
    return result


def _probabilities(seen: _PlacedDetections, slow: FloatArray) -> FloatArray:
    """P(stationary) (N,) of the object of each detection, around it."""
    n = len(seen.object)
    if n == 0:
        return np.empty(0)
    far = 4 * (seen.time.max() - seen.time.min() + STATIONARY_WINDOW)  # puts objects apart on one axis
    axis = seen.time - seen.time.min() + far * np.unique(seen.object, return_inverse=True)[1]
    low = np.searchsorted(axis, axis - STATIONARY_WINDOW / 2, "left")
    high = np.searchsorted(axis, axis + STATIONARY_WINDOW / 2, "right")
    start = np.searchsorted(seen.object, seen.object, "left")
    end = np.searchsorted(seen.object, seen.object, "right")
    # at the ends of its lifespan the window is shifted into it
    low = np.where(high == end, np.searchsorted(axis, axis[end - 1] - STATIONARY_WINDOW, "left"), low)
    low = np.maximum(low, start)
    high = np.where(low == start, np.searchsorted(axis, axis[start] + STATIONARY_WINDOW, "right"), high)
    high = np.minimum(high, end)
    middle = (low + high) // 2
    n1, n2 = middle - low, high - middle

    def half(values: FloatArray, a: IntArray, b: IntArray) -> FloatArray:
        total = np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0)])
        count = np.maximum(b - a, 1).reshape(-1, *(1,) * (values.ndim - 1))
        return np.asarray((total[b] - total[a]) / count)

    columns = np.column_stack([seen.place, seen.time - seen.time.min(), seen.drift])
    between = half(columns, middle, high) - half(columns, low, middle)
    D, (T, s, shift, turn) = between[:, :2], between[:, 2:].T
    S = half(seen.variance, low, high) * (1 / np.maximum(n1, 1) + 1 / np.maximum(n2, 1))
    scale, bias, course = slow
    S = S + shift + (scale**2 + course**2) * s**2
    turned = half(seen.range, low, high) ** 2 * (turn + (bias * T) ** 2)
    d2 = (D**2).sum(axis=1)
    usual = (seen.speed * T) ** 2
    S = S + turned
    variances = np.stack([S, S + _CREEPING**2 * usual, S + usual])
    log = -(np.log(variances) + d2 / variances / 2)
    shares = _shares_of_traffic(log, seen.time, n1 > 0)
    p = _posteriors(log, shares)[0]
    return np.where(n1 > 0, p, 0.0)


def _posteriors(log: FloatArray, shares: FloatArray) -> FloatArray:
    """Probabilities (K, N) of hypotheses with log-likelihoods (K, N) and prior shares (K, N) or (K, 1)."""
    weight = np.log(shares) + log
    weight = np.exp(weight - weight.max(axis=0))
    return np.asarray(weight / weight.sum(axis=0))


def _shares_of_traffic(log: FloatArray, time: FloatArray, judged: BoolArray) -> FloatArray:
    """Shares (K, N) of the hypotheses around each detection; log-likelihoods (K, N), time (N,); judged (N,) count."""
    order = np.argsort(time, kind="stable")
    low = np.searchsorted(time[order], time - _ALIKE, "left")
    high = np.searchsorted(time[order], time + _ALIKE, "right")
    shares = np.tile([[0.5], [0.25], [0.25]], (1, log.shape[1]))
    for _ in range(_ROUNDS):
        p = np.where(judged, _posteriors(log, shares), 0.0)[:, order]
        total = np.concatenate([np.zeros((len(p), 1)), np.cumsum(p, axis=1)], axis=1)
        count = (total[:, high] - total[:, low] + _PRIOR)[1:]
        shares[1:] = 0.5 * count / count.sum(axis=0)
    return shares


def _place(record: Sequence[RecordedEpoch], path: FloatArray, settings: JointSettings) -> _PlacedDetections:
    row = np.repeat(np.arange(len(record)), [len(now.seen.id) for now in record]).astype(np.int64)
    place = [transform_points(pose, now.seen.z)[:, :2] for now, pose in zip(record, path, strict=True)]
    label = [now.objects.label[np.isin(now.objects.id, now.seen.id)] for now in record]
    P = motion_covariances(record, settings)
    drift = np.zeros((len(record), 3))
    drift[:, 0] = np.cumsum([np.linalg.norm(now.a_T_b[:3, 3]) for now in record])
    drift[1:, 1] = np.cumsum((P[:, 3, 3] + P[:, 4, 4]) / 2)
    drift[1:, 2] = np.cumsum(P[:, 2, 2])
    placed = _PlacedDetections(
        np.concatenate([now.seen.id for now in record]),
        row,
        np.array([now.time for now in record])[row],
        np.concatenate(place),
        np.concatenate([np.trace(now.seen.R, axis1=1, axis2=2) / 2 for now in record]),
        np.concatenate([np.hypot(now.seen.z[:, 0], now.seen.z[:, 1]) for now in record]),
        class_numbers(settings.moving_speed, float, np.concatenate(label)),
        drift[row],
    )
    return placed.select(np.lexsort((placed.row, placed.object)))
