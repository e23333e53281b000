"""The graph-aware tracker: predict with the graph, associate, update, births and deaths, new edges.

One frame of one sensor at a time, from any sensor at any time (figure 2 of Sani and Anand, arXiv 2411.03702). With no
edge rules it is the classical tracker of independent Kalman filters, by the same code.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np

from saga_fg.arrays import BoolArray, FloatArray, IntArray, StrArray
from saga_fg.association import Matching, assign, gate, mahalanobis
from saga_fg.boxes import Boxes
from saga_fg.discretisation import discretise
from saga_fg.edge_rules import EdgeRule, build_graph
from saga_fg.errors import InputError
from saga_fg.estimators import JointKalmanFilter, Measurements
from saga_fg.frame import Frame
from saga_fg.interactions import POSITION, VELOCITY, NodeTable
from saga_fg.node import Motion, NodeType
from saga_fg.scene_graph import SceneGraph
from saga_fg.sensor import DEFAULT, Sensor
from saga_fg.track import Tracks
from saga_fg.tracking.box_filter import BoxFilter
from saga_fg.tracking.settings import ClassSettings, TrackerSettings
from saga_fg.tracking.suppression import strongest

log = logging.getLogger(__name__)

UNKNOWN_YAW_NOISE = np.pi  # standard deviation where nothing was measured, rad


@dataclass(eq=False)
class _Columns:
    """What the tracker keeps of its n tracks besides their joint state and boxes."""

    id: IntArray
    label: StrArray
    existence: FloatArray
    score: FloatArray
    last_seen: FloatArray
    last_in_view: FloatArray
    confirmed: BoolArray

    def select(self, rows: IntArray | BoolArray) -> _Columns:
        return _Columns(*(getattr(self, f.name)[rows] for f in fields(self)))

    def extended(self, other: _Columns) -> _Columns:
        return _Columns(*(np.concatenate([getattr(self, f.name), getattr(other, f.name)]) for f in fields(self)))


class _Kinematics(NamedTuple):
    """Of n tracks, in local coordinates: position (n, 2), velocity (n, 2) and their covariances (n, 2, 2)."""

    position: FloatArray
    velocity: FloatArray
    P: FloatArray
    P_velocity: FloatArray


@dataclass(frozen=True, eq=False)
class _Observed:
    """The usable detections of a frame, in local coordinates, with all that the sensor's model says of them."""

    boxes: Boxes
    probability: FloatArray
    R: FloatArray
    R_velocity: FloatArray
    z_noise: FloatArray
    yaw_noise: FloatArray

    def __len__(self) -> int:
        return len(self.boxes)


class Tracker:
    """Tracks all objects of one scene. `step(frame)` takes a frame of any sensor and returns the tracks at its time.

    settings  the tracker's settings
    sensors   models by sensor name; the entry named "default" serves all others
    rules     edge rules, in place of `settings.edges`

    A frame older than the newest one by up to `settings.max_delay` is used, its measurements moved to the present along
    the objects' own motion; an older one is left out and counted in `late_frames`.
    """

    def __init__(
        self,
        settings: TrackerSettings | None = None,
        sensors: Mapping[str, Sensor] | None = None,
        rules: tuple[EdgeRule, ...] | None = None,
    ) -> None:
        self.settings = settings or TrackerSettings()
        self.sensors = dict(sensors or {})
        self.rules: tuple[EdgeRule, ...] = self.settings.edges if rules is None else rules
        self.late_frames = 0
        self.graph: SceneGraph | None = None  # of the latest interval
        self._estimator = JointKalmanFilter()
        self._time = -math.inf  # of the state; no frame yet
        self._origin = np.zeros(2)
        self._types: dict[Motion, NodeType] = {}  # classes that move alike share one
        self._next_id = 1
        none = np.empty(0)
        self._columns = _Columns(
            np.empty(0, dtype=np.int64), np.empty(0, dtype="<U1"), none, none, none, none, none.astype(bool)
        )
        self._box = BoxFilter(np.empty((0, 3)), none, none, none, none, none)
        self._kinematics_now: _Kinematics | None = None  # until the estimator's state changes

    def step(self, frame: Frame) -> Tracks:
        """Take in one frame and return all reported tracks, in world coordinates, at the newest time seen so far."""
        sensor = self.sensor(frame.sensor)
        timestamp = frame.timestamp + sensor.time_offset
        if self._time == -math.inf:
            self._time = timestamp
        if len(self._columns.id) == 0:
            self._origin = _origin(frame)
        delay = max(0.0, self._time - timestamp)
        if delay > self.settings.max_delay:
            self.late_frames += 1
            log.warning("frame of %s at %.3f s comes %.3f s late and is left out", frame.sensor, timestamp, delay)
            return self._report(self._time)
        before = self._time
        self._predict(max(timestamp, self._time))
        world_T_sensor = None if frame.world_T_ego is None else frame.world_T_ego @ sensor.extrinsics.ego_T_sensor
        observed = self._observe(frame, sensor, world_T_sensor)
        matching = self._associate(observed, delay)
        self._update(observed, matching, delay)
        self._believe(observed, matching, sensor, frame, self._time - before, delay)
        self._bear(observed, matching, delay)
        self._bury()
        return self._report(self._time)

    def tracks(self, timestamp: float) -> Tracks:
        """The tracks predicted to `timestamp` (s), without taking anything in; the present ones for an earlier time.

        Raises `InputError` for a timestamp that is not finite.
        """
        if not math.isfinite(timestamp):
            raise InputError(f"timestamp: expected a finite number of seconds, got {timestamp!r}")
        if self._time == -math.inf:
            return Tracks.empty(timestamp)
        if timestamp <= self._time:
            return self._report(timestamp)
        state, box, now, graph = self._estimator.snapshot(), self._box, self._time, self.graph
        self._box = box.select(np.arange(len(box.z)))
        try:
            self._predict(timestamp)
            return self._report(timestamp)
        finally:
            self._kinematics_now = None
            self._estimator.restore(state)
            self._box, self._time, self.graph = box, now, graph

    def sensor(self, name: str) -> Sensor:
        """The model of a sensor."""
        return self.sensors.get(name) or self.sensors.get(DEFAULT) or Sensor()

    def class_settings(self, label: str) -> ClassSettings:
        """The settings of a class."""
        classes = self.settings.classes
        return classes.get(label) or classes.get(DEFAULT) or ClassSettings()

    # one frame, step by step

    def _predict(self, timestamp: float) -> None:
        dt = timestamp - self._time
        if dt > 0 and len(self._columns.id):
            graph = build_graph(self._nodes(), self.rules, explained_noise=self.settings.explained_noise)
            self._estimator.predict(discretise(graph, dt))
            self._kinematics_now = None
            self._box.predict(dt, self._of_class("yaw_drift", self._columns.label))
            self.graph = graph
        self._time = timestamp

    def _observe(self, frame: Frame, sensor: Sensor, world_T_sensor: FloatArray | None) -> _Observed:
        detections = frame.detections
        if frame.coordinates == "sensor":
            assert world_T_sensor is not None
            detections = detections.transformed(world_T_sensor)
        elif frame.coordinates == "ego":
            assert frame.world_T_ego is not None
            detections = detections.transformed(frame.world_T_ego)
        probability = sensor.probability(detections.score)
        keep = np.flatnonzero(probability >= self._of_class("min_score", detections.boxes.label))
        apart = self._of_class("duplicate_distance", detections.boxes.label[keep])
        keep = keep[strongest(detections.boxes.select(keep), probability[keep], apart)]
        boxes, probability = detections.boxes.select(keep), probability[keep]
        # where the sensor stood is unknown without a pose, and so is the range: its part of the noise is left out
        place = boxes.position[:, :2] if world_T_sensor is None else world_T_sensor[:2, 3]
        known_yaw = np.isfinite(boxes.yaw)
        return _Observed(
            boxes,
            probability,
            sensor.position_covariance(boxes.label, boxes.position[:, :2], probability, place),
            sensor.velocity_covariance(boxes.label, probability)
            if sensor.use_velocity
            else np.full((len(boxes), 2, 2), np.nan),
            sensor.deviations(boxes.label, "height"),
            np.where(known_yaw, sensor.deviations(boxes.label, "yaw"), UNKNOWN_YAW_NOISE),
        )

    def _associate(self, observed: _Observed, delay: float) -> Matching:
        """Class by class, the assignment of least cost on the joint filter's covariance, as of `delay` s ago."""
        columns = self._columns
        tracks, detections, distances = [], [], []
        if len(columns.id) and len(observed):
            position, P = self._positions_before(delay)
            measured = observed.boxes.position[:, :2] - self._origin
            for label in np.unique(columns.label):
                t = np.flatnonzero(columns.label == label)
                z = np.flatnonzero(observed.boxes.label == label)
                if len(z) == 0:
                    continue
                settings = self.class_settings(str(label))
                d2, log_det = mahalanobis(position[t], P[t], measured[z], observed.R[z])
                apart = np.hypot(*np.moveaxis(measured[z][None] - position[t][:, None], -1, 0))
                possible = (d2 < gate(settings.gate)) & (apart < settings.max_distance)
                row, column = assign(d2 + log_det, possible, gate(settings.gate) + log_det.max(initial=0.0))
                tracks.append(t[row])
                detections.append(z[column])
                distances.append(d2[row, column])
        if not tracks:
            return Matching(np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64), np.empty(0))
        return Matching(np.concatenate(tracks), np.concatenate(detections), np.concatenate(distances))

    def _update(self, observed: _Observed, matching: Matching, delay: float) -> None:
        columns, boxes = self._columns, observed.boxes
        z = boxes.position[:, :2] - self._origin
        fast = np.isfinite(np.concatenate([boxes.velocity, observed.R_velocity[:, 0]], axis=1)).all(axis=1)
        for node_type, rows in self._by_type(columns.label[matching.track]):
            for with_velocity in (True, False):
                chosen = rows[fast[matching.detection[rows]] == with_velocity]
                if len(chosen) == 0:
                    continue
                t, d = matching.track[chosen], matching.detection[chosen]
                names = POSITION + VELOCITY if with_velocity else POSITION
                H = node_type.selector(names)
                R = observed.R[d]
                value = z[d]
                if with_velocity:
                    R = np.concatenate(
                        [
                            np.concatenate([R, np.zeros((len(d), 2, 2))], axis=2),
                            np.concatenate([np.zeros((len(d), 2, 2)), observed.R_velocity[d]], axis=2),
                        ],
                        axis=1,
                    )
                    value = np.concatenate([value, boxes.velocity[d]], axis=1)
                if delay > 0:
                    H, R = _moved_to_present(node_type, H, R, delay)
                self._kinematics_now = None
                self._estimator.update(Measurements(columns.id[t], value, H, R))
        t, d = matching.track, matching.detection
        p = observed.probability[d]
        self._box.update(
            t, boxes.size[d], p, boxes.position[d, 2], observed.z_noise[d], boxes.yaw[d], observed.yaw_noise[d]
        )
        if len(columns.id):
            self._box.face_motion(self._kinematics()[1])

    def _believe(
        self, observed: _Observed, matching: Matching, sensor: Sensor, frame: Frame, elapsed: float, delay: float
    ) -> None:
        """Existence: fewer odds for a miss where a detection was to be expected, more for a match by its score.

        elapsed: since the latest frame, s; delay: by which this one comes late, s
        """
        columns, settings = self._columns, self.settings.existence
        n = len(columns.id)
        if n == 0:
            return
        position = self._kinematics()[0] + self._origin
        visible = sensor.sees(position, frame.world_T_ego)
        columns.last_in_view[visible] = self._time
        p_detect = np.where(visible, sensor.detection_probability, 0.0)
        r = columns.existence
        missed = np.ones(n, dtype=bool)
        missed[matching.track] = False
        lost = r * (1 - p_detect) / np.maximum(1 - r * p_detect, 1e-9)
        columns.existence = np.where(missed, lost * math.exp(-elapsed / settings.lifetime), r)
        p = observed.probability[matching.detection]
        odds = p / (1 - p) * (1 - settings.clutter_score) / settings.clutter_score
        before = np.clip(r[matching.track], 1e-3, 1 - 1e-3)
        after = before / (1 - before) * odds
        columns.existence[matching.track] = np.clip(after / (1 + after), 0.0, 0.999)
        columns.score[matching.track] = p
        columns.last_seen[matching.track] = np.maximum(columns.last_seen[matching.track], self._time - delay)
        columns.last_in_view[matching.track] = self._time
        columns.confirmed |= columns.existence >= settings.confirm

    def _bear(self, observed: _Observed, matching: Matching, delay: float) -> None:
        """New tracks from detections that no track explains; those of `delay` s ago have moved on since."""
        free = np.ones(len(observed), dtype=bool)
        free[matching.detection] = False
        born = np.flatnonzero(free & (observed.probability >= self._of_class("birth_score", observed.boxes.label)))
        if len(born) == 0:
            return
        boxes, p = observed.boxes.select(born), observed.probability[born]
        ids = np.arange(self._next_id, self._next_id + len(born), dtype=np.int64)
        self._next_id += len(born)
        measured = np.isfinite(np.concatenate([boxes.velocity, observed.R_velocity[born, 0]], axis=1)).all(axis=1)
        P_velocity = np.where(
            measured[:, None, None], observed.R_velocity[born], self._birth_velocity_covariance(boxes)
        )
        velocity = np.where(measured[:, None], boxes.velocity, 0.0)
        for node_type, rows in self._by_type(boxes.label):
            mean = np.zeros((len(rows), node_type.dim))
            P = np.tile(np.eye(node_type.dim), (len(rows), 1, 1))
            at_p, at_v = node_type.index(POSITION), node_type.index(VELOCITY)
            mean[:, at_p] = boxes.position[rows, :2] - self._origin
            mean[:, at_v] = velocity[rows]
            P[:, at_p[:, None], at_p] = observed.R[born[rows]]
            P[:, at_v[:, None], at_v] = P_velocity[rows]
            if delay > 0:
                F, Q = _own_motion(node_type, delay)
                mean, P = mean @ F.T, F @ P @ F.T + Q
            self._kinematics_now = None
            self._estimator.add(ids[rows], mean, P)
        seen, now = np.full(len(born), self._time - delay), np.full(len(born), self._time)
        self._columns = self._columns.extended(
            _Columns(ids, boxes.label, p.copy(), p.copy(), seen, now, p >= self.settings.existence.confirm)
        )
        self._box = self._box.extended(
            BoxFilter.born(
                boxes.size, p, boxes.position[:, 2], observed.z_noise[born], boxes.yaw, observed.yaw_noise[born]
            )
        )

    def _birth_velocity_covariance(self, boxes: Boxes) -> FloatArray:
        """(n, 2, 2) of a velocity that nothing is known of but the class and the heading."""
        speed, drift = (self._of_class(name, boxes.label) for name in ("birth_speed", "birth_drift"))
        ahead = np.stack([np.cos(boxes.yaw), np.sin(boxes.yaw)], axis=-1)
        known = np.isfinite(boxes.yaw)
        along = np.where(known, speed**2 - drift**2, 0.0)[:, None, None] * np.nan_to_num(
            ahead[:, :, None] * ahead[:, None]
        )
        return np.asarray(along + (np.where(known, drift, speed) ** 2)[:, None, None] * np.eye(2))

    def _bury(self) -> None:
        """Tracks not seen for too long, or no longer believed, are marginalised."""
        columns = self._columns
        coasting = self._time - columns.last_seen
        dead = coasting > self._of_class("max_coasting", columns.label)
        dead |= self._time - columns.last_in_view > self.settings.max_out_of_view
        dead |= ~columns.confirmed & (columns.existence < self.settings.existence.give_up)
        if dead.any():
            self._kinematics_now = None
            self._estimator.marginalise(columns.id[dead])
            self._columns, self._box = columns.select(~dead), self._box.select(~dead)

    def _report(self, timestamp: float) -> Tracks:
        columns, settings = self._columns, self.settings
        coasting = np.maximum(self._time - columns.last_seen, 0.0)
        shown = (columns.confirmed | (columns.existence >= settings.existence.report)) & (
            coasting <= settings.report_coasting
        )
        rows = np.flatnonzero(shown)
        position, velocity, P, P_velocity = (column[rows] for column in self._kinematics())
        box = self._box
        boxes = Boxes(
            columns.label[rows],
            np.concatenate([position + self._origin, box.z[rows, None]], axis=1),
            box.size[rows],
            box.yaw[rows],
            velocity,
        )
        score = columns.score[rows] * np.where(coasting[rows] > 0, columns.existence[rows], 1.0)
        return Tracks(timestamp, columns.id[rows], boxes, score, P, P_velocity, coasting[rows])

    # views on the state

    def _type(self, label: str) -> NodeType:
        motion = self.class_settings(label).motion
        if motion not in self._types:
            self._types[motion] = NodeType(type(motion).__name__, motion)
        return self._types[motion]

    def _by_type(self, label: StrArray) -> list[tuple[NodeType, IntArray]]:
        """Rows of equal node type, with the type."""
        classes, index = np.unique(label, return_inverse=True)
        types = [self._type(str(c)) for c in classes]
        distinct = list(dict.fromkeys(map(id, types)))
        number = np.array([distinct.index(id(t)) for t in types], dtype=np.int64)[index]
        by_id = {id(t): t for t in types}
        return [(by_id[key], np.flatnonzero(number == k)) for k, key in enumerate(distinct)]

    def _kinematics(self) -> _Kinematics:
        """Of all tracks, local: position (n, 2), velocity (n, 2) and their covariances (n, 2, 2)."""
        if self._kinematics_now is None:
            self._kinematics_now = self._read_kinematics()
        return self._kinematics_now

    def _read_kinematics(self) -> _Kinematics:
        columns = self._columns
        n = len(columns.id)
        position, velocity = np.zeros((n, 2)), np.zeros((n, 2))
        P, P_velocity = np.zeros((n, 2, 2)), np.zeros((n, 2, 2))
        for node_type, rows in self._by_type(columns.label):
            mean, covariance = self._estimator.mean(columns.id[rows]), self._estimator.covariance(columns.id[rows])
            at_p, at_v = node_type.index(POSITION), node_type.index(VELOCITY)
            position[rows], velocity[rows] = mean[:, at_p], mean[:, at_v]
            P[rows], P_velocity[rows] = covariance[:, at_p[:, None], at_p], covariance[:, at_v[:, None], at_v]
        return _Kinematics(position, velocity, P, P_velocity)

    def _positions_before(self, delay: float) -> tuple[FloatArray, FloatArray]:
        """Of all tracks, local: positions (n, 2) `delay` s ago and their covariances (n, 2, 2)."""
        if delay == 0:
            position, _, P, _ = self._kinematics()
            return position, P
        columns = self._columns
        position, P = np.zeros((len(columns.id), 2)), np.zeros((len(columns.id), 2, 2))
        for node_type, rows in self._by_type(columns.label):
            H, R = _moved_to_present(node_type, node_type.selector(POSITION), np.zeros((2, 2)), delay)
            position[rows] = self._estimator.mean(columns.id[rows]) @ H.T
            P[rows] = H @ self._estimator.covariance(columns.id[rows]) @ H.T + R
        return position, P

    def _nodes(self) -> NodeTable:
        """The present estimates as edge rules see them."""
        columns, box = self._columns, self._box
        position, velocity, _, P_velocity = self._kinematics()
        heading = np.where(np.isfinite(box.yaw), box.yaw, np.arctan2(velocity[:, 1], velocity[:, 0]))
        return NodeTable(
            columns.id,
            columns.label,
            tuple(self._type(str(c)) for c in columns.label),
            position,
            velocity,
            heading,
            np.where(np.isfinite(box.size[:, 0]), box.size[:, 0], 0.0),
            np.trace(P_velocity, axis1=1, axis2=2) / 2,
        )

    def _of_class(self, name: str, label: StrArray) -> FloatArray:
        """(n,) a class setting for each label."""
        classes, index = np.unique(label, return_inverse=True)
        values = np.array([getattr(self.class_settings(str(c)), name) for c in classes], dtype=np.float64)
        return values[index] if len(label) else np.empty(0)


def _origin(frame: Frame) -> FloatArray:
    """The local origin of a scene, (2,): where the vehicle, else the first detection, is first.

    Global coordinates reach 4e6 m and would eat the digits.
    """
    if frame.world_T_ego is not None:
        return np.round(frame.world_T_ego[:2, 3])
    if len(frame):
        return np.round(frame.detections.boxes.position[0, :2])
    return np.zeros(2)


def _moved_to_present(node_type: NodeType, H: FloatArray, R: FloatArray, delay: float) -> tuple[FloatArray, FloatArray]:
    """A measurement `delay` s old as one of the present state, x(t - delay) = exp(-A delay) x(t) + noise."""
    F, Q = _own_motion(node_type, delay)
    H_past = H @ np.linalg.inv(F)
    return H_past, R + H_past @ Q @ H_past.T


def _own_motion(node_type: NodeType, dt: float) -> tuple[FloatArray, FloatArray]:
    """F (d, d) and Q (d, d) of a node on its own over `dt` s."""
    transition = discretise(SceneGraph.of([0], node_type), dt)
    return transition.F[0].values[0], transition.Q[0].values[0]
