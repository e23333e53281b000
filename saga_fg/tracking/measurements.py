"""The measurements of a frame in the world, and the vehicle itself as a measured node.

Measurements are the usable detections, with the sensor's model of their noise.

Duplicates are left out by non-maximum suppression. Of two detections of a class closer than `nms_distance` the
less probable one is suppressed; within `weak_nms_distance` only where its probability is below `WEAK_RATIO` of the
other's: two people may walk half a metre apart, but a weak detection that close to a strong one is most often a
duplicate. Boxes of classes that no sensor confuses do not suppress each other; of those that some does, boxes in one
place are one report with several labels (`saga_fg.tracking.class_belief`).

The vehicle as a node of the scene graph: it leads and follows like any other, and is never reported.

It has the id 0 and a state of its own, (position, velocity) by the motion of its class. Its position is measured by
every frame with a pose: the pose that comes with the frame, or the one estimated in the running graph, to which the
node is then tied. By the edge rules drivers behind it follow it, also while they are hidden.

A detection seen from an estimated pose (R, t) measures r = R^T (p - t) - z of the pose and the object's position p. The
errors of both depend on earlier detections, so that a detection is compared with the covariance of r, not of p.

The noise of a sensor of which nothing is known is told by its own successive detections, without ground truth, by class
and range. A
divided difference of order k of an object's k + 1 detections z_j at times t_j, `STEP` apart, is free of all motion
along a polynomial of degree k - 1 in time. What is left is noise, of a known share of the variance of a detection:

    D_k = sum over j of c_j z_j,   c_j = product over i /= j of 1 / (t_j - t_i),   cov D_k = R sum over j of c_j^2
    s^2 = least over k = 1, 2, 3 of the 90 % quantile of ( D_k^T R^-1 D_k / sum of c_j^2 ) / chi^2_2(90 %)

with R the noise by the sensor's model. Orders that motion is still part of are larger, and the quantile is that up to
which ellipses are meant to hold. The s of a class is drawn to that of all classes, as if they had `OF_GROUP`
differences in it, that of a band of range to its class, and s^2 = a^2 + (g r)^2 is fitted to the bands. Until there are
enough differences, gates are those of `UNKNOWN` times its noise: with too small ones a tracker would only see the small
errors.

More noise than the model says widens gates and slows the filter (factor max(s, 1) on the deviations R). Less noise
narrows the reported ellipses alone (min(s, 1), `saga_fg.tracking.track_life`): errors that all detections of an object
share do not show in differences, and a filter that believes too much loses objects. Where these detections differ
by less than a detector errs, their errors are mostly shared: such an s is not believed, and 1 is taken.

Source: von Neumann, Kent, Bellinson, Hart, The mean square successive difference, Annals of Mathematical Statistics
12(2), 1941.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import nnls

from factors import relative_factors
from saga_fg.errors import InputError
from saga_fg.graph import EGO_POSE, key_of
from saga_fg.model import MAX_MEASURED_SPEED, POSITION, NodeTable, NoiseModel, Sensor, sensor_model
from saga_fg.numerics import (
    BoolArray,
    FloatArray,
    IntArray,
    Matching,
    StrArray,
    checked,
    checked_covariances,
    distinct,
    gate,
    mahalanobis_of_pairs,
    near_pairs,
    of_classes,
    unchecked,
    yaw_of,
)
from saga_fg.tracking.class_belief import NONE_CONFUSED, ConfusedClasses
from saga_fg.tracking.joint_state import JointTrackState
from saga_fg.tracking.settings import ClassSettings, EgoNodeSettings, TrackerSettings
from saga_fg.tracking.track_filters import MOVING, Kinematics, RelativePositions
from saga_fg.types import COLOUR_LABELS, DEFAULT, Boxes, Frame, class_settings, class_values

WEAK_RATIO = 0.5  # of probabilities, below which a detection near another one is much weaker
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
    by_model                     (m,) whether that of the position is the sensor model's, not the detection's own
    with_velocity                (m,) whether the velocity was measured
    z_noise, yaw_noise           (m,) standard deviations of height, m, and heading, rad
    range_rate                   (m,) m/s, NaN where not to be used
    range_rate_variance          (m,) (m/s)^2
    covariance_scale             (m,) factor on the reported deviation of positions, see `saga_fg.tracking.track_life`
    position_bias                 (m,) part of the reported error of positions that does not average out, m
    class_likelihood             (m, C) of the confused classes
    identity                     (m,) given by the sensor, -1 for none
    delay                        time by which the frame is older than the state, s
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
    by_model: BoolArray
    with_velocity: BoolArray
    z_noise: FloatArray
    yaw_noise: FloatArray
    range_rate: FloatArray
    range_rate_variance: FloatArray
    covariance_scale: FloatArray
    position_bias: FloatArray
    class_likelihood: FloatArray
    identity: IntArray
    delay: float = 0.0
    relative: RelativePositions | None = None

    def __len__(self) -> int:
        return len(self.boxes)

    @property
    def distance(self) -> FloatArray:
        """(m,) distances from the sensor, m; 0 where its place is unknown."""
        if self.viewpoint is None:
            return np.zeros(len(self))
        return np.asarray(np.hypot(*(self.boxes.position[:, :2] - self.viewpoint).T))

    def with_context(self, delay: float, relative: RelativePositions | None) -> FrameMeasurements:
        """Add what the tracker knows of them."""
        return unchecked(FrameMeasurements, **vars(self) | {"delay": delay, "relative": relative})


def frame_measurements(
    frame: Frame, sensor: Sensor, classes: Mapping[str, ClassSettings], confused: ConfusedClasses = NONE_CONFUSED
) -> FrameMeasurements:
    """Return the detections that are probable enough for their class and no duplicates."""
    detections = sensor.in_world(frame)
    label = detections.boxes.label
    probability = sensor.probability(detections.score, label)
    if type(sensor) is not Sensor:
        where = f"sensors: {type(sensor).__name__}.probability"
        probability = checked(where, probability, (len(label),))
        if len(label) and not (probability.min() > 0 and probability.max() < 1):
            raise InputError(f"{where}: expected numbers above 0 and below 1")
    objects = ~of_classes(label, COLOUR_LABELS)  # the colours of lights are not objects of their own
    keep = (objects & (probability >= class_values(classes, ClassSettings, label, "min_score")[0])).nonzero()[0]
    detections, probability, viewpoint = detections.select(keep), probability[keep], sensor.origin(frame)
    near, wide = class_values(classes, ClassSettings, detections.boxes.label, "nms_distance", "weak_nms_distance")
    label = detections.boxes.label
    into = suppress_duplicates(detections.boxes, probability, near, wide, confused.numbers(label)[0])
    likelihood = confused.report_likelihood(frame.sensor, detections.boxes)
    kept = (into == np.arange(len(into))).nonzero()[0]
    if len(kept) < len(keep):
        if len(confused):
            probability, likelihood = as_one_report(label, probability, into, likelihood)
        keep, detections, probability = keep[kept], detections.select(kept), probability[kept]
        likelihood = likelihood[kept]
    boxes = detections.boxes
    R = sensor.detection_covariance(detections, viewpoint, probability)
    if type(sensor) is not Sensor:
        R = checked_covariances(f"sensors: {type(sensor).__name__}.detection_covariance", R, len(boxes), 4)
    yaw_noise, z_noise = sensor.deviations(boxes.label, "yaw", "height")
    limit = MAX_MEASURED_SPEED if sensor.use_velocity else -1.0
    covariance_scale, position_bias = sensor.covariance_calibration(boxes.label, probability)
    return FrameMeasurements(
        sensor=sensor,
        name=frame.sensor,
        world_T_ego=frame.world_T_ego,
        viewpoint=viewpoint,
        row=keep,
        boxes=boxes,
        probability=probability,
        R=R,
        by_model=np.asarray(~np.isfinite(detections.position_covariance).all(axis=(1, 2))),
        with_velocity=np.hypot(*boxes.velocity.T) <= limit,
        z_noise=z_noise,
        yaw_noise=np.where(np.isfinite(boxes.yaw), yaw_noise, UNKNOWN_YAW_NOISE),
        range_rate=np.where(np.abs(detections.range_rate) <= limit, detections.range_rate, np.nan),
        range_rate_variance=sensor.range_rate_variance(boxes.label, probability),
        covariance_scale=covariance_scale,
        position_bias=position_bias,
        class_likelihood=likelihood,
        identity=detections.identity,
    )


def suppress_duplicates(
    boxes: Boxes, probability: FloatArray, distance: FloatArray, weak_distance: FloatArray, group: IntArray
) -> IntArray:
    """The row (n,) that suppresses each box, its own where it stays, within groups of classes.

    boxes (n); probability (n,); of their classes nms_distance (n,) and weak_nms_distance (n,), m, and group (n,).
    Greedy from the most probable down, so that a suppressed box suppresses no other.
    """
    into = np.arange(len(boxes))
    if len(boxes) < 2:
        return into
    position = boxes.position[:, :2]
    a, b = near_pairs(position, position, np.full(len(boxes), max(distance.max(), weak_distance.max())))
    once = (a < b).nonzero()[0]
    a, b = a[once], b[once]
    apart = np.hypot(*(position[a] - position[b]).T)
    swap = probability[b] > probability[a]
    strong, weak = np.where(swap, b, a), np.where(swap, a, b)
    duplicate = apart < np.minimum(distance[a], distance[b])
    much_weaker = probability[weak] < WEAK_RATIO * probability[strong]
    duplicate |= (apart < np.minimum(weak_distance[a], weak_distance[b])) & much_weaker
    rival = (group[a] == group[b]) & duplicate
    strong, weak = strong[rival], weak[rival]
    for k in np.argsort(-probability[strong], kind="stable"):
        if into[strong[k]] == strong[k] and into[weak[k]] == weak[k]:
            into[weak[k]] = strong[k]
    return into


def as_one_report(
    label: StrArray, probability: FloatArray, into: IntArray, likelihood: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Probabilities (n,) and class likelihoods (n, C) of boxes with those that they suppress, where classes differ.

    label, probability, into (n,): which box suppresses each; likelihood (n, C), see `saga_fg.tracking.class_belief`
    """
    odds = np.where((into == np.arange(len(into))) | (label != label[into]), probability / (1 - probability), 0.0)
    total, joint = np.zeros(len(odds)), np.zeros_like(likelihood)
    np.add.at(total, into, odds)
    np.add.at(joint, into, odds[:, None] * likelihood)
    merged = np.bincount(into, odds > 0, minlength=len(into)) > 1
    share = joint / np.where(merged, total, 1.0)[:, None]
    return np.where(merged, total / (1 + total), probability), np.where(merged[:, None], share, likelihood)


EGO_ID = 0  # tracks begin at 1, nodes of the map count down from -1
_ID = np.array([EGO_ID])


@dataclass(eq=False)
class EgoNode:
    """settings: None if there is no such node; motion: of its class; yaw, rad; time of its latest position, s."""

    settings: EgoNodeSettings | None
    motion: ClassSettings
    present: bool = False
    yaw: float = 0.0
    time: float = -np.inf
    has_moved: bool = False

    @classmethod
    def from_settings(cls, settings: TrackerSettings) -> EgoNode:
        """A node without a position."""
        label = "" if settings.ego is None else settings.ego.label
        return cls(settings.ego, class_settings(settings.classes, ClassSettings, label))

    def __len__(self) -> int:
        return int(self.present)

    @property
    def _estimated(self) -> bool:
        return self.settings is not None and self.settings.estimated

    def located(self, frame: Frame, world_T_ego: FloatArray | None) -> Frame:
        """Return the frame, with the pose of the running graph where that is estimated."""
        if not self._estimated:
            return frame
        if world_T_ego is None:
            raise InputError("ego.estimated: expected a provider that adds the vehicle's pose (saga_fg.providers)")
        return replace(frame, world_T_ego=world_T_ego)

    def relative_positions(self, measurements: FrameMeasurements, frame: Frame) -> RelativePositions | None:
        """Measurements in the frame of a vehicle whose pose is estimated; None for measurements in the world."""
        if not self._estimated or frame.coordinates == "world" or frame.world_T_ego is None:
            return None
        return RelativePositions.from_world(frame.world_T_ego, measurements.boxes.position, measurements.R[:, :2, :2])

    def update(self, frame: Frame, time: float, origin: FloatArray, joint: JointTrackState) -> None:
        """Take in the vehicle's position at a frame of `time`, s; `origin` (2,) of local positions."""
        if self.settings is None or frame.world_T_ego is None or time <= self.time:
            return
        pose, R = frame.world_T_ego, np.zeros((1, 4, 4))
        R[0, :2, :2] = self.settings.deviation**2 * np.eye(2)
        z, label = np.concatenate([pose[:2, 3] - origin, np.zeros(2)])[None], np.array([self.settings.label])
        relative = RelativePositions(np.zeros((1, 3)), R[:, :2, :2]) if self.settings.estimated else None
        if self.present:
            joint.update(_ID, label, z, R, np.zeros(1, dtype=bool), 0.0, relative)
        else:
            speed = self.motion.initial_speed_deviation**2 * np.eye(2)[None]
            joint.add(_ID, label, Kinematics(z[:, :2], z[:, 2:], R[:, :2, :2], speed), relative=relative)
        velocity = joint.kinematics_of(_ID, label).velocity[0]
        self.present, self.time, self.yaw = True, time, float(yaw_of(pose[:3, :3]))
        self.has_moved = self.has_moved or bool(np.hypot(*velocity) > MOVING)

    def table(self, joint: JointTrackState) -> NodeTable:
        """The vehicle as a node table of one row."""
        assert self.settings is not None
        label, length = np.array([self.settings.label]), np.array([self.settings.length])
        now, types = joint.kinematics_of(_ID, label), joint.types_of(label)
        heading, moved = np.array([self.yaw]), np.array([float(self.has_moved)])
        variance = np.trace(now.P_velocity, axis1=1, axis2=2) / 2
        return NodeTable(
            id=_ID,
            label=label,
            types=types,
            position=now.position,
            velocity=now.velocity,
            heading=heading,
            length=length,
            velocity_variance=variance,
            has_moved=moved,
        )


def relative_covariances(joint: JointTrackState, ids: IntArray, label: StrArray) -> FloatArray:
    """Covariances (n, 2, 2) of positions relative to the vehicle's estimated pose, in the axes of the world."""
    estimator = joint.estimator
    key = key_of(EGO_POSE, 0, estimator.auxiliary.epoch)
    pose = estimator.auxiliary.state(key)
    T, d, result = pose.matrix(), pose.dim(), np.zeros((len(ids), 2, 2))
    n, turn = len(T) - 1, T[:2, :2]
    for node_type, rows in joint.rows_by_type(label):
        x, y = node_type.index(POSITION).tolist()
        states, poses = estimator.mean(ids[rows]), np.broadcast_to(T, (len(rows), *T.shape))
        places = np.tile(T[:n, n], (len(rows), 1))
        places[:, :2] = states[:, [x, y]]
        keys = np.stack([np.zeros(len(rows)), np.arange(1, len(rows) + 1)], axis=1).astype(np.uint64)
        seen = relative_factors(keys, (places - T[:n, n]) @ T[:n, :n], np.eye(2), node_type.dim, (x, y))
        assert seen.jacobians is not None
        J_pose, J_state = (np.asarray(J) for J in seen.jacobians(poses, states))
        G = turn @ np.concatenate([J_pose, J_state], axis=2)
        P = estimator.covariance_with([key], ids[rows])
        for k, row in enumerate(rows.tolist()):
            mine = np.r_[0:d, d + k * node_type.dim : d + (k + 1) * node_type.dim]
            result[row] = G[k] @ P[np.ix_(mine, mine)] @ G[k].T
    return result


ORDERS = (1, 2, 3)
STEP = 0.4  # s between detections that are compared: errors that last longer are shared by all of them
QUANTILE = 0.9
LEAST, MOST = 1 / 3, 10 / 3  # bounds of s
SHARED = (0.18, 0.28)  # s, from which differences are no longer believed, and are believed
UNKNOWN = 2.0  # s of gates, before it is known
FEWEST, LATEST = 15, 300  # differences of an order: for an estimate, that are kept of a class and a band
PRIOR, OF_GROUP = 3, 30  # differences that s = 1 counts for, and that the s of the whole counts for in a part
ROUGHLY = 300  # differences, from which gates follow s
SETTLED = 10.0  # s from a sensor's first detections, after which s stays
BANDS = (20.0, 40.0)  # m, limits of the bands of range
MIDDLES = np.array([12.0, 30.0, 55.0])  # m, ranges that stand for the bands

_Detections = tuple[float, IntArray, FloatArray]  # time, s, tracks (n,) and positions (n, 2), m, of a frame
_Squares = tuple[FloatArray, ...]  # by order, the latest squared differences in units of the model's noise


@dataclass(frozen=True, eq=False)
class SensorNoise:
    """The noise of a sensor, as far as its detections tell it.

    scale    s of all of them: factor on the standard deviations of its model
    growing  by class, (a, g) of s^2 = a^2 + (g r)^2 at the range r, m
    settled  whether these stay
    start    time of its first detections, s, NaN before
    seen     number of differences so far
    frames   the latest frames, oldest first, as far back as they are compared
    squares  by class and band of range
    """

    scale: float = 1.0
    growing: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    settled: bool = False
    start: float = math.nan
    seen: int = 0
    frames: tuple[_Detections, ...] = ()
    squares: Mapping[tuple[str, int], _Squares] = field(default_factory=dict)

    def observed(
        self, time: float, track: IntArray, position: FloatArray, R: FloatArray, label: StrArray, distance: FloatArray
    ) -> SensorNoise:
        """Take in a frame at a time, s: positions (n, 2), m, of tracks (n,), with R (n, 2, 2) by the model.

        label (n,): their classes; distance (n,): from the sensor, m, 0 where unknown
        """
        if self.settled or not len(track) or (self.frames and time <= self.frames[-1][0]):
            return self
        start = time if math.isnan(self.start) else self.start
        if time > start + SETTLED:
            return SensorNoise(self.scale, self.growing, settled=True, seen=self.seen)
        frames = (*self.frames, (time, track, position))
        compared = _apart(frames)
        band = np.searchsorted(BANDS, distance)
        common, rows, squares, seen = track, np.arange(len(track)), dict(self.squares), 0
        columns = [position]
        for order, (_, tracks, places) in enumerate(compared[1:], 1):
            common, kept, before = np.intersect1d(common, tracks, assume_unique=True, return_indices=True)
            rows, columns = rows[kept], [*(column[kept] for column in columns), places[before]]
            found = _squares(np.array([at for at, _, _ in compared[: order + 1]]), np.stack(columns), R[rows])
            seen += len(found)
            for group in set(zip(label[rows].tolist(), band[rows].tolist(), strict=True)):
                mine = (label[rows] == group[0]) & (band[rows] == group[1])
                known = list(squares.get(group, (np.empty(0),) * len(ORDERS)))
                known[order - 1] = np.concatenate([known[order - 1], found[mine]])[-LATEST:]
                squares[group] = tuple(known)
        needed = frames if len(compared) <= ORDERS[-1] else tuple(f for f in frames if f[0] >= compared[-1][0])
        scale = _scale(list(squares.values()), 1.0, PRIOR)
        return SensorNoise(scale, _growing(squares, scale), False, start, self.seen + seen, needed, squares)

    def scales(self, label: StrArray, distance: FloatArray) -> FloatArray:
        """(n,) s of detections of these classes (n,) at these distances (n,) from the sensor, m."""
        occurring, index = distinct(label)
        a, g = np.array([self.growing.get(each, (self.scale, 0.0)) for each in occurring]).reshape(-1, 2)[index].T
        return np.asarray(np.hypot(a, g * distance))


UNMEASURED = SensorNoise()


def _apart(frames: Sequence[_Detections]) -> list[_Detections]:
    """The newest frame and those before it that are `STEP` and more from one another, as many as are compared."""
    found = [frames[-1]]
    for frame in reversed(frames[:-1]):
        if len(found) <= ORDERS[-1] and found[-1][0] - frame[0] >= STEP - 1e-6:
            found.append(frame)
    return found


def _squares(time: FloatArray, position: FloatArray, R: FloatArray) -> FloatArray:
    """(n,) squared divided differences, in units of R (n, 2, 2), of positions (k + 1, n, 2) at times (k + 1,)."""
    apart = time[:, None] - time[None, :]
    np.fill_diagonal(apart, 1.0)
    c = 1 / apart.prod(axis=1)
    c = c / np.sqrt((c**2).sum())
    D = np.einsum("k,knj->nj", c, position)
    return mahalanobis_of_pairs(D, R)[0]


def _scale(parts: Sequence[_Squares], whole: float, prior: float) -> float:
    """The s of some groups together; whole: that of more of them, which counts for `prior` differences."""
    orders = [np.concatenate(each) for each in zip(*parts, strict=True)]
    known = [each for each in orders if len(each) >= FEWEST]
    if not known:
        return whole
    variance = min(float(np.quantile(each, QUANTILE)) for each in known) / gate(QUANTILE)
    count = max(len(each) for each in known)
    s = math.exp((math.log(max(variance, 1e-12)) / 2 * count + math.log(whole) * prior) / (count + prior))
    trust = min(max((s - SHARED[0]) / (SHARED[1] - SHARED[0]), 0.0), 1.0)
    return float(min(max(s, LEAST), MOST) ** trust * whole ** (1 - trust))


def _growing(squares: Mapping[tuple[str, int], _Squares], whole: float) -> dict[str, tuple[float, float]]:
    """(a, g) by class, closest to the s of its bands."""
    found = {}
    for label in sorted({label for label, _ in squares}):
        bands = {band: each for (of, band), each in squares.items() if of == label}
        s = _scale(list(bands.values()), whole, OF_GROUP)
        by_band = [_scale([bands[k]], s, OF_GROUP) if k in bands else s for k in range(len(MIDDLES))]
        a2, g2 = nnls(np.column_stack([np.ones(len(MIDDLES)), MIDDLES**2]), np.square(by_band))[0]
        found[label] = math.sqrt(a2), math.sqrt(g2)
    return found


def with_scale(measurements: FrameMeasurements, noise: SensorNoise) -> FrameMeasurements:
    """The measurements with the noise that was found, where it did not come with the detections."""
    free = measurements.by_model
    s = noise.scales(measurements.boxes.label[free], measurements.distance[free])
    R, reported = measurements.R.copy(), measurements.covariance_scale.copy()
    R[free, :2, :2] *= np.maximum(s, 1.0)[:, None, None] ** 2
    reported[free] *= np.minimum(s, 1.0)
    return replace(measurements, R=R, covariance_scale=reported)


def for_gates(measurements: FrameMeasurements, noise: SensorNoise) -> FrameMeasurements:
    """The measurements of `with_scale` as they are to be gated: with more noise as long as it is not known."""
    if noise.settled or noise.seen >= ROUGHLY:
        return measurements
    free, R = measurements.by_model, measurements.R.copy()
    R[free, :2, :2] *= UNKNOWN**2
    return replace(measurements, R=R)


def observed(
    noise: SensorNoise, measurements: FrameMeasurements, matching: Matching, track: IntArray, time: float
) -> SensorNoise:
    """Take in the measurements of a frame at `time`, s, as they were before `with_scale`.

    Measurements count that are matched beyond doubt and have the noise of the model. track (k,): of the matching
    """
    sure = (matching.share >= 1) & measurements.by_model[matching.detection]
    d = matching.detection[sure]
    boxes, R = measurements.boxes.select(d), measurements.R[d, :2, :2]
    return noise.observed(time, track[sure], boxes.position[:, :2], R, boxes.label, measurements.distance[d])


def scaled_sensors(sensors: Mapping[str, Sensor], found: Mapping[str, SensorNoise]) -> dict[str, Sensor]:
    """The models with the noise of positions that was found."""
    result = dict(sensors)
    for name, noise in found.items():
        model = sensor_model(sensors, name)
        grown = dict.fromkeys([DEFAULT, *model.noise], (noise.scale, 0.0)) | dict(noise.growing)
        by_class = {label: _scaled(class_settings(model.noise, NoiseModel, label), *s) for label, s in grown.items()}
        result[name] = replace(model, noise=by_class)
    return result


def _scaled(noise: NoiseModel, a: float, g: float) -> NoiseModel:
    along, across = (math.hypot(a * each, g * noise.position) for each in (noise.range_noise, noise.bearing_noise))
    return replace(noise, position=a * noise.position, range_noise=along, bearing_noise=across)
