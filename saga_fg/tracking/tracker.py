"""The graph-aware tracker: predict with the graph, associate, update, births and deaths, new edges.

One frame of one sensor at a time, from any sensor at any time (figure 2 of Sani and Anand, arXiv 2411.03702). With no
edge rules it is the classical tracker of independent Kalman filters, by the same code.
"""

from __future__ import annotations

import copy
import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from saga_fg.arrays import FloatArray, IntArray, StrArray
from saga_fg.association import Assignment, Matching
from saga_fg.boxes import Boxes
from saga_fg.by_class import class_settings, class_values
from saga_fg.edge_rules import EdgeRule, build_graph
from saga_fg.errors import InputError
from saga_fg.frame import Frame
from saga_fg.interactions import NodeTable
from saga_fg.pairwise_costs import CrossCovariances
from saga_fg.scene_graph import SceneGraph
from saga_fg.sensor import Sensor, sensor_model
from saga_fg.track import Tracks
from saga_fg.tracking.births import newborn
from saga_fg.tracking.box_filter import MOVING, BoxFilter
from saga_fg.tracking.class_belief import ClassEvidence, ClassGroups
from saga_fg.tracking.columns import TrackColumns
from saga_fg.tracking.existence import after_hit, after_miss
from saga_fg.tracking.joint_state import JointTrackState, Kinematics, new_estimator
from saga_fg.tracking.matching import associate
from saga_fg.tracking.merging import duplicates
from saga_fg.tracking.observation import Observed, observe
from saga_fg.tracking.observer import Observer, Stage, TrackerView
from saga_fg.tracking.occlusion import HIDDEN, covered
from saga_fg.tracking.roadside import Roadside, motion_of
from saga_fg.tracking.sensor_evidence import SensorEvidence
from saga_fg.tracking.settings import ClassSettings, TrackerSettings
from saga_fg.tracking.standing import Standing
from saga_fg.tracking.traffic_flow import TrafficFlow
from saga_fg.tracking.views import boxes_of, local_origin, nodes_of, passages_of, reported_tracks, speed_deviation

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A tracker at one moment, see `Tracker.snapshot`."""

    state: Any
    own: tuple[TrackColumns, BoxFilter, SensorEvidence, TrafficFlow, Roadside, Standing, FloatArray]
    numbers: tuple[float, FloatArray, int, int]
    graph: SceneGraph | None
    assignment: Assignment


class Tracker:
    """Tracks all objects of one scene. `step(frame)` takes a frame of any sensor and returns the tracks at its time.

    settings  the tracker's settings
    sensors   models by sensor name; the entry named "default" serves all others
    rules     edge rules, in place of `settings.edges`
    observer  is told how things stand at the end of every stage

    A frame older than the newest one by up to `max_delay` is used: the fixed-lag estimator puts its measurements where
    they belong, a filter moves them to the present along the objects' own motion. An older one is left out and counted
    in `late_frames`.
    """

    def __init__(
        self,
        settings: TrackerSettings | None = None,
        sensors: Mapping[str, Sensor] | None = None,
        rules: tuple[EdgeRule, ...] | None = None,
        observer: Observer | None = None,
    ) -> None:
        self.settings = settings or TrackerSettings()
        self._observer = observer
        self.sensors = dict(sensors or {})
        self.rules: tuple[EdgeRule, ...] = self.settings.edges if rules is None else rules
        self.late_frames = 0
        self.graph: SceneGraph | None = None  # of the latest interval
        self.assignment = Assignment.empty()  # of the latest frame
        self._state = JointTrackState(
            new_estimator(self.settings.estimator, self.settings.lag), lambda label: motion_of(self.settings, label)
        )
        self._time = -math.inf  # of the state; no frame yet
        self._origin = np.zeros(2)
        self._next_id = 1
        self._columns = TrackColumns.empty()
        self._evidence = SensorEvidence()
        self._flow = TrafficFlow(self.settings.flow)
        self._box = BoxFilter.empty()
        self.roadside = Roadside(self.settings.signals)
        self._standing = Standing.empty()
        self._groups = ClassGroups(self.settings.class_groups)
        self._belief = np.empty((0, len(self._groups)))  # of the tracks, which class

    def step(self, frame: Frame) -> Tracks:
        """Take in one frame and return all reported tracks, in world coordinates, at the newest time seen so far."""
        sensor = self.sensor(frame.sensor)
        timestamp = frame.timestamp + sensor.time_offset
        if self._time == -math.inf:
            self._time = timestamp
        if len(self._columns.id) == 0 and len(self.roadside) == 0:
            self._origin = local_origin(frame)
        delay = max(0.0, self._time - timestamp)
        self.assignment = Assignment.empty()
        if delay > self.max_delay:
            self.late_frames += 1
            log.warning("frame of %s at %.3f s comes %.3f s late and is left out", frame.sensor, timestamp, delay)
            return self._report(self._time)
        before = self._time
        for road_map in (self.settings.road_map, frame.road_map):
            if road_map is not None:
                self.roadside.learn(road_map, self._origin, self._state)
        self._predict(max(timestamp, self._time))
        self._tell("predict", frame)
        self.roadside.heed(frame, sensor, self._origin, self._state, delay)
        observed = observe(frame, sensor, self.settings.classes)
        self._tell("observe", frame, observed)
        said = self._groups.likelihood(observed.boxes.label, sensor)
        matching = self._associate(observed, sensor, delay, said)
        self._tell("associate", frame, observed, matching)
        self._classify(matching, said)
        self._update(observed, matching, delay)
        self._tell("update", frame, observed, matching)
        self._believe(observed, matching, sensor, frame, self._time - before, delay)
        self._tell("believe", frame, observed, matching)
        self._watch_traffic(matching)
        born = self._bear(observed, matching, frame.sensor, delay, said)
        self._tell("births", frame, observed, matching, born)
        rows = np.concatenate([matching.detection, born])
        ids = np.concatenate([self._columns.id[matching.track], self._columns.id[len(self._columns.id) - len(born) :]])
        self.assignment = Assignment(ids, observed.row[rows])
        self._bury()
        self._columns.ready |= speed_deviation(self._told()) <= self.settings.report_speed_known
        self._tell("deaths", frame, observed, matching)
        tracks = self._report(self._time)
        self._tell("report", frame, observed, matching)
        return tracks

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
        state, now, graph, roadside = self._state.snapshot(), self._time, self.graph, self.roadside
        box, standing, rows = self._box, self._standing, np.arange(len(self._box.z))
        self._box, self._standing, self.roadside = box.select(rows), standing.select(rows), copy.copy(roadside)
        try:
            self._predict(timestamp)
            return self._report(timestamp)
        finally:
            self._state.restore(state)
            self._box, self._standing, self.roadside = box, standing, roadside
            self._time, self.graph = now, graph

    def snapshot(self) -> Snapshot:
        """All that the tracker knows; what it does later leaves it as it is."""
        told = (self._columns, self._box, self._evidence, self._flow, self.roadside, self._standing, self._belief)
        own = copy.deepcopy(told)
        numbers = (self._time, self._origin, self._next_id, self.late_frames)
        return Snapshot(self._state.snapshot(), own, numbers, self.graph, self.assignment)

    def restore(self, snapshot: Snapshot) -> None:
        """Go on from where a tracker of the same settings was; as often as wanted from one snapshot."""
        self._state.restore(snapshot.state)
        own = copy.deepcopy(snapshot.own)
        self._columns, self._box, self._evidence, self._flow, self.roadside, self._standing, self._belief = own
        self._time, self._origin, self._next_id, self.late_frames = snapshot.numbers
        self.graph, self.assignment = snapshot.graph, snapshot.assignment

    def sensor(self, name: str) -> Sensor:
        """The model of a sensor."""
        return sensor_model(self.sensors, name)

    def class_settings(self, label: str) -> ClassSettings:
        """The settings of a class."""
        return class_settings(self.settings.classes, ClassSettings, label)

    @property
    def max_delay(self) -> float:
        """How late a frame may come and still be used, s."""
        settings = self.settings
        return max(settings.max_delay, settings.lag) if settings.estimator == "fixed-lag" else settings.max_delay

    # one frame, step by step

    def _predict(self, timestamp: float) -> None:
        dt = timestamp - self._time
        if dt > 0 and len(self._columns.id) + len(self.roadside):
            steps = max(1, math.ceil(dt / self.settings.max_step - 1e-9))
            hidden = self._columns.last_seen < self._time
            for _ in range(steps):
                noise = self._standing_noise(dt / steps)
                nodes, explained = self._nodes(), self.settings.explained_noise
                self.graph = build_graph(nodes, self.rules, explained_noise=explained, noise_scale=noise)
                before = self._kinematics().velocity
                self._state.predict(self.graph, dt / steps)
                self._box.turn_with(before, self._kinematics().velocity, hidden)
                self.roadside.predict(dt / steps)
            self._box.predict(dt, self._of_class(self._columns.label, "yaw_drift")[0])
        self._time = timestamp

    def _standing_noise(self, dt: float) -> FloatArray | None:
        """`dt` s pass for the belief that tracks stand; factors on the nodes' noise over this time."""
        settings = self.settings.standing
        if settings.prior == 0:
            return None
        self._standing.predict(dt, self._kinematics(), settings)
        return np.concatenate([self._standing.noise_scale(settings), np.ones(len(self.roadside))])

    def _associate(self, observed: Observed, sensor: Sensor, delay: float, said: FloatArray) -> Matching:
        """Register what was observed to the prediction, as of `delay` s ago; said (m, C) of classes."""
        columns = self._columns
        if len(columns.id) == 0 or len(observed) == 0:
            return Matching.empty()
        position, P, cross = self._predicted_positions(delay)
        predicted = self._boxes(position, np.full_like(position, np.nan))
        expected = columns.existence * sensor.detection_chance(columns.label)
        area = self.settings.association.clutter_area if sensor.clutter_area is None else sensor.clutter_area
        evidence = ClassEvidence(self._groups, self._belief, said) if len(self._groups) else None
        return associate(predicted, P, expected, observed, self.settings, area, cross, evidence)

    def _predicted_positions(self, delay: float) -> tuple[FloatArray, FloatArray, CrossCovariances | None]:
        """Of all tracks `delay` s ago; with the covariances between them where they are needed."""
        ids, label = self._columns.id, self._columns.label
        position, P = self._state.positions_before(ids, label, delay)
        if self.settings.association.method != "graph":
            return position, P, None
        return position, P, self._state.cross_covariances_before(ids, label, delay)

    def _classify(self, matching: Matching, said: FloatArray) -> None:
        """What detections say (m, C) of the classes of their tracks."""
        if len(self._groups):
            t = matching.track
            self._belief[t] = self._groups.updated(self._belief[t], said[matching.detection])
            self._columns.label = self._groups.labels(self._belief, self._columns.label)

    def _update(self, observed: Observed, matching: Matching, delay: float) -> None:
        columns, boxes = self._columns, observed.boxes
        t, d = matching.track, matching.detection
        z = np.concatenate([boxes.position[d, :2] - self._origin, boxes.velocity[d]], axis=1)
        if self.settings.standing.prior > 0:
            position, P = self._state.positions_before(columns.id, columns.label, delay)
            then = self._kinematics()._replace(position=position, P=P)
            moving = Kinematics._make(column[t] for column in then)
            self._standing.update(t, z, observed.R[d], moving, observed.with_velocity[d])
        self._state.update(columns.id[t], columns.label[t], z, observed.R[d], observed.with_velocity[d], delay)
        self._update_range_rate(observed, d, columns.id[t], columns.label[t], delay)
        p = observed.probability[d]
        self._box.update(
            t, boxes.size[d], p, boxes.position[d, 2], observed.z_noise[d], boxes.yaw[d], observed.yaw_noise[d]
        )
        if len(columns.id):
            now = self._told()
            speed = np.hypot(*now.velocity.T)
            moves = (speed > MOVING) & (speed > 3 * speed_deviation(now))
            self._box.face_motion(np.where(moves[:, None], now.velocity, 0.0))
            columns.has_moved[t] |= moves[t]

    def _update_range_rate(
        self, observed: Observed, rows: IntArray, ids: IntArray, label: StrArray, delay: float
    ) -> None:
        """After the position, which says where the line of sight is: the range rates of detections `rows` of tracks."""
        measured = np.isfinite(observed.range_rate[rows])
        if observed.viewpoint is None or not measured.any():
            return
        rows, ids, label = rows[measured], ids[measured], label[measured]
        rate, variance = observed.range_rate[rows], observed.range_rate_variance[rows]
        self._state.update_range_rate(ids, label, rate, variance, observed.viewpoint - self._origin, delay)

    def _believe(
        self, observed: Observed, matching: Matching, sensor: Sensor, frame: Frame, elapsed: float, delay: float
    ) -> None:
        """Existence: fewer odds for a miss where a detection was to be expected, more for a match by its score.

        elapsed: since the latest frame, s; delay: by which this one comes late, s
        """
        columns = self._columns
        if len(columns.id) == 0:
            return
        visible = sensor.sees(self._kinematics().position + self._origin, frame.world_T_ego)
        columns.last_in_view[visible] = self._time
        missed = np.ones(len(columns.id), dtype=bool)
        missed[matching.track] = False
        p_detect = np.where(visible, sensor.detection_chance(columns.label), 0.0)
        if self.settings.existence.occlusion > 0 and observed.viewpoint is not None and missed.any():
            now = self._kinematics()
            boxes = self._boxes(now.position, now.velocity)
            hidden = self.settings.existence.occlusion * covered(boxes, observed.viewpoint, ~missed)
            p_detect, visible = p_detect * (1 - hidden), visible & (hidden < HIDDEN)
        p, settings = observed.probability[matching.detection], self.settings.existence
        # what another sensor has just seen exists, whatever this one misses
        excused = self._evidence.seen_by_others(frame.sensor, self._time - delay, self.settings.score_memory)
        p_miss = np.where(excused, 0.0, p_detect)[missed]
        columns.existence[missed] = after_miss(columns.existence[missed], p_miss, elapsed, settings)
        columns.existence[matching.track] = after_hit(columns.existence[matching.track], p, settings)
        self._evidence.hear(frame.sensor, self._time - delay, matching.track, p, missed & visible, p_detect)
        fused = self._evidence.probability(self._time, max(self.settings.score_memory, delay))
        columns.score = np.where(np.isfinite(fused), fused, columns.score)
        columns.hits, columns.looks = self._evidence.steadiest()
        columns.accepted |= self._evidence.confirmed(self.settings.confirmations)
        for column, told in zip((columns.told, columns.shared), observed.told, strict=True):
            column[matching.track] = told[matching.detection]
        columns.last_seen[matching.track] = np.maximum(columns.last_seen[matching.track], self._time - delay)
        columns.last_in_view[matching.track] = self._time
        columns.confirmed |= columns.existence >= settings.confirm

    def _watch_traffic(self, matching: Matching) -> None:
        """Where detected tracks pass, for those that are born after them."""
        if self.settings.flow.weight == 0:
            return
        now, stands = self._kinematics(), self._standing.belief
        passages = passages_of(self._columns, self._box, matching.track, now, stands, self._origin, self._time)
        self._flow.pass_by(passages)

    def _bear(self, observed: Observed, matching: Matching, sensor: str, delay: float, said: FloatArray) -> IntArray:
        """New tracks, at the end, from the detections returned, which no track explains.

        Those of `delay` s ago have moved on since.
        """
        free = np.ones(len(observed), dtype=bool)
        free[matching.detection] = False
        born = np.flatnonzero(free & (observed.probability >= self._of_class(observed.boxes.label, "birth_score")[0]))
        if len(born) == 0:
            return born
        boxes, p = observed.boxes.select(born), observed.probability[born]
        ids = np.arange(self._next_id, self._next_id + len(born), dtype=np.int64)
        self._next_id += len(born)
        kinematics, stands = newborn(
            observed, born, self._origin, self.settings.classes, self._flow, self.settings.standing.prior
        )
        self._state.add(ids, boxes.label, kinematics, delay)
        self._update_range_rate(observed, born, ids, boxes.label, delay)
        confirmed, accepted = p >= self.settings.existence.confirm, self.sensor(sensor).births == "alone"
        seen, told = self._time - delay, (observed.told[0][born], observed.told[1][born])
        self._columns = self._columns.extended(
            TrackColumns.born(ids, boxes.label, p, told, seen, self._time, confirmed, accepted)
        )
        self._evidence.born(sensor, p, seen)
        self._belief = np.concatenate([self._belief, self._groups.updated(0 * said[born], said[born])])
        self._standing = self._standing.extended(Standing.born(kinematics, stands))
        self._box = self._box.extended(
            BoxFilter.born(
                boxes.size, p, boxes.position[:, 2], observed.z_noise[born], boxes.yaw, observed.yaw_noise[born]
            )
        )
        return born

    def _bury(self) -> None:
        """Tracks not seen for too long, or no longer believed, are marginalised."""
        columns = self._columns
        coasting = self._time - columns.last_seen
        max_coasting, merging = self._of_class(columns.label, "max_coasting", "merge_distance")
        dead = coasting > max_coasting
        dead |= self._time - columns.last_in_view > self.settings.max_out_of_view
        dead |= ~columns.confirmed & (columns.existence < self.settings.existence.give_up)
        if (merging > 0).any():
            dead |= duplicates(self._kinematics().position, columns.label, coasting <= 0, merging)
        if dead.any():
            self._state.remove(columns.id[dead])
            self._columns, self._box = columns.select(~dead), self._box.select(~dead)
            self._standing, self._belief = self._standing.select(~dead), self._belief[~dead]
            self._evidence.select(~dead)

    def _report(self, timestamp: float) -> Tracks:
        columns = self._columns
        if len(self._groups):
            columns = replace(columns, score=columns.score * self._groups.certainty(self._belief))
        return reported_tracks(timestamp, columns, self._box, self._told(), self._origin, self._time, self.settings)

    # views on the state

    def _tell(
        self,
        stage: Stage,
        frame: Frame,
        observed: Observed | None = None,
        matching: Matching | None = None,
        born: IntArray | None = None,
    ) -> None:
        if self._observer is not None:
            fresh = np.empty(0, dtype=np.int64) if born is None else born
            self._observer.after(stage, lambda: self._view(frame.sensor, observed, matching, fresh))

    def _view(self, sensor: str, observed: Observed | None, matching: Matching | None, born: IntArray) -> TrackerView:
        columns = self._columns.select(np.arange(len(self._columns.id)))
        P = self._kinematics().P
        return TrackerView(
            self._time, sensor, columns, self._nodes(), P, self._origin, self.graph, observed, matching, born
        )

    def _boxes(self, position: FloatArray, velocity: FloatArray) -> Boxes:
        """All tracks at local positions (n, 2) with velocities (n, 2), in the world."""
        rows = np.arange(len(self._columns.id))
        return boxes_of(self._columns, self._box, rows, position + self._origin, velocity)

    def _kinematics(self) -> Kinematics:
        return self._state.kinematics(self._columns.id, self._columns.label)

    def _told(self) -> Kinematics:
        """What is told of the tracks: the joint state, the velocity with the belief that they stand."""
        now = self._kinematics()
        return self._standing.told(now) if self.settings.standing.prior > 0 else now

    def _nodes(self) -> NodeTable:
        """The present estimates as edge rules see them: the tracks, then the nodes of the roadside."""
        types = self._state.types_of(self._columns.label)
        tracks = nodes_of(self._columns, self._box, types, self._told(), self._time)
        return self.roadside.beside(tracks, self._origin, self._state)

    def _of_class(self, label: StrArray, *names: str) -> FloatArray:
        """(k, n) class settings for each label."""
        return class_values(self.settings.classes, ClassSettings, label, *names)
