"""The tracks of a scene and its road at one time, and what a frame does to them, stage by stage.

    predict (with the graph) -> associate -> update -> existence -> initiate -> delete

(figure 2 of Sani and Anand, arXiv 2411.03702).
"""

from __future__ import annotations

import copy
import logging
import math
from dataclasses import replace

import numpy as np

from saga_fg.graph import FactorProvider, SceneFactorGraph
from saga_fg.model.edge_rules import EdgeRule, build_graph
from saga_fg.model.interactions import NodeTable
from saga_fg.model.scene_graph import SceneGraph
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray, StrArray
from saga_fg.numerics.assignment import Assignment, Matching
from saga_fg.numerics.chi_square import chi_square_quantile
from saga_fg.numerics.pairwise_costs import CrossCovariances
from saga_fg.tracking.births import newborn
from saga_fg.tracking.box_filter import MOVING, BoxFilter
from saga_fg.tracking.class_belief import ClassEvidence, ClassGroups
from saga_fg.tracking.columns import TrackColumns
from saga_fg.tracking.ego_pose import RelativePositions
from saga_fg.tracking.existence import after_hit, after_miss
from saga_fg.tracking.joint_state import JointTrackState, Kinematics, new_estimator
from saga_fg.tracking.limits import trackable
from saga_fg.tracking.matching import associate
from saga_fg.tracking.merging import duplicates
from saga_fg.tracking.observation import Observed, observe
from saga_fg.tracking.observer import Observer, Stage, TrackerView
from saga_fg.tracking.occlusion import HIDDEN, covered
from saga_fg.tracking.roadside import Roadside, motion_of
from saga_fg.tracking.settings import ClassSettings, TrackerSettings
from saga_fg.tracking.snapshot import TrackSetState, TrackTables
from saga_fg.tracking.standing import Standing
from saga_fg.tracking.views import boxes_of, local_origin, nodes_of, passages_of, reported_tracks, speed_deviation
from saga_fg.types.boxes import Boxes
from saga_fg.types.by_class import class_values
from saga_fg.types.frame import Frame
from saga_fg.types.sensor import Sensor
from saga_fg.types.track import Tracks

log = logging.getLogger(__name__)

MOST_STEPS = 100  # that an interval is predicted in


class TrackSet:
    """n tracks and the nodes of the road; all times in here are counted from `start`, s.

    `copied` gives a set that goes its own way, at the cost of its tables; `snapshot` a value.
    """

    def __init__(
        self,
        settings: TrackerSettings,
        rules: tuple[EdgeRule, ...],
        observer: Observer | None = None,
        providers: tuple[FactorProvider, ...] = (),
    ) -> None:
        self.settings, self.rules, self.observer, self.providers = settings, rules, observer, providers
        self.start = 0.0
        self.graph: SceneGraph | None = None  # of the latest interval
        self._time = 0.0  # of the state
        self._origin = np.zeros(2)
        self._next_id = 1
        self._groups = ClassGroups(settings.class_groups)
        self.forget()

    def __len__(self) -> int:
        return len(self._columns.id)

    @property
    def window(self) -> float:
        """How far back a late measurement is put where it belongs, s."""
        return self._state.window

    @property
    def running_graph(self) -> SceneFactorGraph:
        """The estimator's graph."""
        return self._state.running_graph()

    @property
    def roadside(self) -> Roadside:
        """What is known of the road."""
        return self._tables.roadside

    @property
    def ids(self) -> list[int]:
        """Of all tracks, reported or not."""
        return list(self._columns.id.tolist())

    @property
    def world_T_ego(self) -> FloatArray | None:
        """The vehicle's pose (4, 4) as estimated in the running graph; None where it is not."""
        pose = self._state.pose()
        if pose is not None:
            pose[:2, 3] += self._origin
        return pose

    @property
    def _columns(self) -> TrackColumns:
        return self._tables.columns

    def take_in(self, frame: Frame, sensor: Sensor, timestamp: float) -> Assignment:
        """Move on to a frame's `timestamp` (s), unless it is in the past, and use what is in it."""
        if self._state.bare:
            self._origin = local_origin(frame)
        before, now = self._time, self.relative(timestamp)
        delay = max(0.0, before - now)
        for road_map in (self.settings.road_map, frame.road_map):
            if road_map is not None:
                self.roadside.learn(road_map, self._origin, self._state)
        self._state.hear(frame, self._origin)
        self.predict(max(now, before))
        frame = self._tables.ego.located(frame, self.world_T_ego)
        if delay == 0:
            self._tables.ego.place(frame, self._time, self._origin, self._state)
        observed = observe(frame, sensor, self.settings.classes)
        seen = self._tables.ego.sightings(frame, observed)
        self._tell("predict", frame)
        self.roadside.heed(frame, sensor, self._origin, self._state, delay)
        self._tell("observe", frame, observed)
        said = self._groups.likelihood(observed.boxes.label, sensor)
        matching = self._associate(observed, sensor, delay, said, seen)
        self._tell("associate", frame, observed, matching)
        self._classify(matching, said)
        self._update(observed, matching, delay, seen)
        self._tell("update", frame, observed, matching)
        self._believe(observed, matching, sensor, frame, self._time - before, delay)
        self._tell("believe", frame, observed, matching)
        self._watch_traffic(matching)
        born = self._bear(observed, matching, frame.sensor, sensor.initiation == "alone", delay, said, seen)
        self._state.ask_providers()
        self._state.hear(None, self._origin)
        self._tell("births", frame, observed, matching, born)
        rows = np.concatenate([matching.detection, born])
        ids = np.concatenate([self._columns.id[matching.track], self._columns.id[len(self) - len(born) :]])
        self._bury()
        self._columns.ready |= speed_deviation(self._told()) <= self.settings.report_speed_deviation_below
        self._tell("deaths", frame, observed, matching)
        self._tell("report", frame, observed, matching)
        return Assignment(ids, observed.row[rows])

    def relative(self, timestamp: float) -> float:
        """A time in here, s: to the microsecond, so that it is the same whatever time the scene begins at."""
        return round(timestamp - self.start, 6)

    def predict(self, time: float) -> None:
        """Move on to a `time` in here, s."""
        dt = time - self._time
        if dt > 0 and not self._state.bare:
            wanted = dt / self.settings.max_step
            steps = max(1, math.ceil(min(wanted, MOST_STEPS) - 1e-9))
            if wanted > MOST_STEPS:
                log.warning("%g s are predicted in %d steps, max_step asks for %.3g", dt, steps, wanted)
            for _ in range(steps):
                hidden = self._columns.last_seen < self._time
                noise = self._standing_noise(dt / steps)
                nodes, explained = self._nodes(), self.settings.explained_noise
                self.graph = build_graph(nodes, self.rules, explained_noise=explained, noise_scale=noise)
                before = self._kinematics().velocity
                self._state.predict(self.graph, dt / steps)
                self._tables.box.turn_with(before, self._kinematics().velocity, hidden)
                self.roadside.predict(dt / steps)
                self._delete(self._untrackable())
            self._tables.box.predict(dt, self._of_class(self._columns.label, "yaw_drift")[0])
        self._time = time

    def _standing_noise(self, dt: float) -> FloatArray | None:
        """`dt` s pass for the belief that tracks stand; factors on the nodes' noise over this time."""
        settings = self.settings.stationarity
        if settings.prior == 0:
            return None
        self._tables.standing.predict(dt, self._kinematics(), settings)
        others = len(self._tables.ego) + len(self.roadside)
        return np.concatenate([self._tables.standing.noise_scale(settings), np.ones(others)])

    def _associate(
        self, observed: Observed, sensor: Sensor, delay: float, said: FloatArray, seen: RelativePositions | None
    ) -> Matching:
        """Register what was observed to the prediction, as of `delay` s ago; said (m, C) of classes."""
        columns = self._columns
        if len(columns.id) == 0 or len(observed) == 0:
            return Matching.empty()
        position, P, cross = self._predicted_positions(delay)
        if seen is not None:
            P = self._state.relative_covariances(columns.id, columns.label)
        predicted = self._boxes(position, np.full_like(position, np.nan))
        expected = columns.existence * sensor.detection_chance(columns.label)
        area = self.settings.association.clutter_area if sensor.clutter_area is None else sensor.clutter_area
        evidence = ClassEvidence(self._groups, self._tables.belief, said) if len(self._groups) else None
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
            self._tables.belief[t] = self._groups.updated(self._tables.belief[t], said[matching.detection])
            self._columns.label = self._groups.labels(self._tables.belief, self._columns.label)

    def _update(self, observed: Observed, matching: Matching, delay: float, seen: RelativePositions | None) -> None:
        columns, boxes = self._columns, observed.boxes
        t, d = matching.track, matching.detection
        z = np.concatenate([boxes.position[d, :2] - self._origin, boxes.velocity[d]], axis=1)
        if self.settings.stationarity.prior > 0:
            position, P = self._state.positions_before(columns.id, columns.label, delay)
            then = self._kinematics()._replace(position=position, P=P)
            moving = Kinematics._make(column[t] for column in then)
            self._tables.standing.update(t, z, observed.R[d], moving, observed.with_velocity[d])
        mine = None if seen is None else seen.select(d)
        self._state.update(columns.id[t], columns.label[t], z, observed.R[d], observed.with_velocity[d], delay, mine)
        self._update_range_rate(observed, d, columns.id[t], columns.label[t], delay)
        p = observed.probability[d]
        self._tables.box.update(
            t, boxes.size[d], p, boxes.position[d, 2], observed.z_noise[d], boxes.yaw[d], observed.yaw_noise[d]
        )
        if len(columns.id):
            now = self._told()
            speed = np.hypot(*now.velocity.T)
            moves = (speed > MOVING) & (speed > 3 * speed_deviation(now))
            self._tables.box.face_motion(np.where(moves[:, None], now.velocity, 0.0))
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
        gate = np.array([chi_square_quantile(share, 1) for share in self._of_class(label, "gate")[0]])
        self._state.update_range_rate(ids, label, rate, variance, observed.viewpoint - self._origin, gate, delay)

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
        if self.settings.existence.occlusion_weight > 0 and observed.viewpoint is not None and missed.any():
            now = self._kinematics()
            boxes = self._boxes(now.position, now.velocity)
            hidden = self.settings.existence.occlusion_weight * covered(boxes, observed.viewpoint, ~missed)
            p_detect, visible = p_detect * (1 - hidden), visible & (hidden < HIDDEN)
        p, settings = observed.probability[matching.detection], self.settings.existence
        # what another sensor has just seen exists, whatever this one misses
        excused = self._tables.evidence.seen_by_others(frame.sensor, self._time - delay, self.settings.score_memory)
        p_miss = np.where(excused, 0.0, p_detect)[missed]
        columns.existence[missed] = after_miss(columns.existence[missed], p_miss, elapsed, settings)
        columns.existence[matching.track] = after_hit(columns.existence[matching.track], p, settings)
        self._tables.evidence.hear(frame.sensor, self._time - delay, matching.track, p, missed & visible, p_detect)
        fused = self._tables.evidence.probability(self._time, max(self.settings.score_memory, delay))
        columns.score = np.where(np.isfinite(fused), fused, columns.score)
        columns.hits, columns.looks = self._tables.evidence.steadiest()
        columns.accepted |= self._tables.evidence.confirmed(self.settings.confirming_detections)
        for column, told in zip((columns.told, columns.shared), observed.told, strict=True):
            column[matching.track] = told[matching.detection]
        columns.last_seen[matching.track] = np.maximum(columns.last_seen[matching.track], self._time - delay)
        columns.last_in_view[matching.track] = self._time
        columns.confirmed |= columns.existence >= settings.confirm_above

    def _watch_traffic(self, matching: Matching) -> None:
        """Where detected tracks pass, for those that are born after them."""
        if self.settings.traffic_flow_prior.weight == 0:
            return
        now, stands = self._kinematics(), self._tables.standing.belief
        passages = passages_of(self._columns, self._tables.box, matching.track, now, stands, self._origin, self._time)
        self._tables.flow.pass_by(passages)

    def _bear(
        self,
        observed: Observed,
        matching: Matching,
        sensor: str,
        accepted: bool,
        delay: float,
        said: FloatArray,
        sightings: RelativePositions | None,
    ) -> IntArray:
        """New tracks, at the end, from the detections returned, which no track explains.

        Those of `delay` s ago have moved on since. accepted: whether the sensor is trusted alone
        """
        free = np.ones(len(observed), dtype=bool)
        free[matching.detection] = False
        born = np.flatnonzero(
            free & (observed.probability >= self._of_class(observed.boxes.label, "initiation_score")[0])
        )
        if len(born) == 0:
            return born
        boxes, p = observed.boxes.select(born), observed.probability[born]
        ids = np.arange(self._next_id, self._next_id + len(born), dtype=np.int64)
        self._next_id += len(born)
        kinematics, stands = newborn(
            observed, born, self._origin, self.settings.classes, self._tables.flow, self.settings.stationarity.prior
        )
        mine = None if sightings is None else sightings.select(born)
        self._state.add(ids, boxes.label, kinematics, delay, mine)
        self._update_range_rate(observed, born, ids, boxes.label, delay)
        confirmed = p >= self.settings.existence.confirm_above
        seen, told = self._time - delay, (observed.told[0][born], observed.told[1][born])
        self._tables.columns = self._columns.extended(
            TrackColumns.born(ids, boxes.label, p, told, seen, self._time, confirmed, accepted)
        )
        self._tables.evidence.born(sensor, p, seen)
        self._tables.belief = np.concatenate([self._tables.belief, self._groups.updated(0 * said[born], said[born])])
        self._tables.standing = self._tables.standing.extended(Standing.born(kinematics, stands))
        self._tables.box = self._tables.box.extended(
            BoxFilter.born(
                boxes.size, p, boxes.position[:, 2], observed.z_noise[born], boxes.yaw, observed.yaw_noise[born]
            )
        )
        return born

    def _bury(self) -> None:
        """Tracks not seen for too long, or no longer believed, are marginalised."""
        columns = self._columns
        coasting = columns.coasting(self._time)
        max_coasting, merging = self._of_class(columns.label, "max_coasting", "merge_distance")
        dead = coasting > max_coasting
        dead |= np.round(self._time - columns.last_in_view, 6) > self.settings.max_out_of_view
        dead |= ~columns.confirmed & (columns.existence < self.settings.existence.delete_below)
        dead |= self._untrackable()
        if (merging > 0).any():
            dead |= duplicates(self._kinematics().position, columns.label, coasting <= 0, merging)
        self._delete(dead)

    def _delete(self, dead: BoolArray) -> None:
        """Marginalise tracks (n,)."""
        if dead.any():
            self._state.remove(self._columns.id[dead])
            self._tables.keep(~dead)

    def _untrackable(self) -> BoolArray:
        """Tracks (n,) whose numbers have left all bounds."""
        dead = ~trackable(self._kinematics(), self._origin)
        if dead.any():
            log.warning("deleted, since their states are out of bounds: tracks %s", self._columns.id[dead].tolist())
        return dead

    def forget(self) -> None:
        """Begin without tracks and road; ids go on."""
        self._state = JointTrackState(
            new_estimator(
                self.settings.estimator, self.settings.lag, self.providers, self.settings.nonlinear(self.rules)
            ),
            lambda label: motion_of(self.settings, label),
        )
        self._tables = TrackTables.empty(self.settings, len(self._groups))

    def restart(self, timestamp: float) -> None:
        """Without tracks, at another `timestamp` (s); the road stays."""
        self._delete(np.ones(len(self), dtype=bool))
        self.start = timestamp - self._time

    def outlive(self, timestamp: float) -> None:
        """Delete the tracks that can't be alive at a `timestamp` (s), because they were seen too long ago."""
        columns = self._columns
        self._delete(columns.coasting(self.relative(timestamp)) > self._of_class(columns.label, "max_coasting")[0])

    def copied(self) -> TrackSet:
        """A set that goes its own way from here."""
        twin = copy.copy(self)
        twin._state, twin._tables = self._state.copied(), self._tables.copied()
        return twin

    def snapshot(self) -> TrackSetState:
        """The set as a value."""
        state, tables = self._state.snapshot(), self._tables.copied()
        return TrackSetState(state, tables, self.start, self._time, self._origin, self._next_id, self.graph)

    def restore(self, held: TrackSetState) -> None:
        """Go on from a snapshot, as often as wanted."""
        self._state.restore(held.state)
        self._tables = held.tables.copied()
        self.start, self._time, self._origin, self._next_id = held.start, held.time, held.origin, held.next_id
        self.graph = held.graph

    def report(self, timestamp: float) -> Tracks:
        """The tracks to be reported, called those of `timestamp` (s)."""
        columns = self._columns
        if len(self._groups):
            columns = replace(columns, score=columns.score * self._groups.certainty(self._tables.belief))
        return reported_tracks(
            timestamp, columns, self._tables.box, self._told(), self._origin, self._time, self.settings
        )

    # views on the state

    def _tell(
        self,
        stage: Stage,
        frame: Frame,
        observed: Observed | None = None,
        matching: Matching | None = None,
        born: IntArray | None = None,
    ) -> None:
        if self.observer is not None:
            fresh = np.empty(0, dtype=np.int64) if born is None else born
            self.observer.after(stage, lambda: self._view(frame.sensor, observed, matching, fresh))

    def _view(self, sensor: str, observed: Observed | None, matching: Matching | None, born: IntArray) -> TrackerView:
        columns, now = self._columns.select(np.arange(len(self))), self._kinematics()
        columns.last_seen += self.start
        columns.last_in_view += self.start
        return TrackerView(
            self.start + self._time,
            sensor,
            columns,
            self._nodes(),
            now.P,
            self._origin,
            self.graph,
            observed,
            matching,
            born,
            self._boxes(now.position, now.velocity),
            self.running_graph if self.providers else None,
        )

    def _boxes(self, position: FloatArray, velocity: FloatArray) -> Boxes:
        """All tracks at local positions (n, 2) with velocities (n, 2), in the world."""
        rows = np.arange(len(self))
        return boxes_of(self._columns, self._tables.box, rows, position + self._origin, velocity)

    def _kinematics(self) -> Kinematics:
        return self._state.kinematics(self._columns.id, self._columns.label)

    def _told(self) -> Kinematics:
        """What is told of the tracks: the joint state, the velocity with the belief that they stand."""
        now = self._kinematics()
        return self._tables.standing.told(now) if self.settings.stationarity.prior > 0 else now

    def _nodes(self) -> NodeTable:
        """The present estimates as edge rules see them: the tracks, then the nodes of the roadside."""
        types = self._state.types_of(self._columns.label)
        tracks = nodes_of(self._columns, self._tables.box, types, self._told(), self._time)
        return self.roadside.beside(self._tables.ego.beside(tracks, self._state), self._origin, self._state)

    def _of_class(self, label: StrArray, *names: str) -> FloatArray:
        """(k, n) class settings for each label."""
        return class_values(self.settings.classes, ClassSettings, label, *names)
