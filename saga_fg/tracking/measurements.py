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
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from factors import relative_factors
from saga_fg.errors import InputError
from saga_fg.graph import EGO_POSE, key_of
from saga_fg.model import MAX_MEASURED_SPEED, POSITION, NodeTable, Sensor
from saga_fg.numerics import (
    BoolArray,
    FloatArray,
    IntArray,
    StrArray,
    checked,
    checked_covariances,
    near_pairs,
    of_classes,
    unchecked,
    yaw_of,
)
from saga_fg.tracking.class_belief import NONE_CONFUSED, ConfusedClasses
from saga_fg.tracking.joint_state import JointTrackState
from saga_fg.tracking.settings import ClassSettings, EgoNodeSettings, TrackerSettings
from saga_fg.tracking.track_filters import MOVING, Kinematics, RelativePositions
from saga_fg.types import COLOUR_LABELS, Boxes, Frame, class_settings, class_values

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
