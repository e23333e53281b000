"""All that a tracker knows at one time: the tracks, the map, the vehicle, traffic and the clock.

The steps of `saga_fg.tracking.tracker` change a state; a copy goes its own way, and a snapshot is a plain value.
Times, in s:

    timestamp     of a frame, with the sensor's time offset; on the clock of the recording
    time          the same from `start` on, as returned by `relative`
    state.time    time of the estimates, that of the newest frame used
    clock.newest  its timestamp, about start + state.time; frames before it are late
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from saga_fg.graph import FactorProvider
from saga_fg.kernels.components import velocities_along
from saga_fg.model import POSITION, SceneGraph, Sensor
from saga_fg.numerics import Assignment, BoolArray, CrossCovariances, FloatArray, IntArray, StrArray, shallow_copy
from saga_fg.parts import new_part
from saga_fg.tracking.by_name import new_estimator
from saga_fg.tracking.class_belief import ConfusedClasses
from saga_fg.tracking.clock import Clock, TimeVerdict
from saga_fg.tracking.clock_offsets import SharedObservations
from saga_fg.tracking.edge_record import EdgeRecord, HaltingPlaces
from saga_fg.tracking.identities import Encounters, GivenIdentities, exchanged
from saga_fg.tracking.joint_state import JointTrackState, moved_to_present, past_position
from saga_fg.tracking.map_nodes import MapNodes, classes_read, motion_of
from saga_fg.tracking.measurements import EgoNode
from saga_fg.tracking.right_of_way import RightOfWay
from saga_fg.tracking.sensor_noise import SensorNoise
from saga_fg.tracking.settings import AssociationCost, ClassSettings, TrackerSettings
from saga_fg.tracking.track_filters import Kinematics
from saga_fg.tracking.track_table import TrackTable
from saga_fg.tracking.traffic import Traffic, speed_prior
from saga_fg.types import MAP_CLASSES, Boxes, Frame, class_values

log = logging.getLogger(__name__)

LIFETIME = 30.0  # s, mean time until an undetected object has left the scene


@dataclass(frozen=True, eq=False)
class TrackerSnapshot:
    """A tracker at one time.

    table         one row a track
    map_nodes     known lights, stop lines, lanes and walls
    ego           the vehicle as a node
    traffic       where earlier traffic went, and how fast
    graph         scene graph of the latest interval, None before the first
    edge_record   how well edges have predicted
    halting       where vehicles halt with nobody before them
    right_of_way  who yields to whom, and who goes though it should wait
    encounters    pairs of tracks that may have exchanged their objects
    start         time from which all others in here are counted, s
    time          of the state, s
    origin        (2,) of local positions in the world, m
    next_id       of the next new track
    clock         newest time, and the clocks of the sensors
    shared        objects that several sensors have seen, which tell the offsets of their clocks
    time_verdict  on the timestamp of the latest frame
    late_frames   number of frames left out because they came late
    assignment    of the latest frame
    identities    that the sensors give
    noise         of sensors with `calibrate_noise`, by name
    joint         the estimator's state
    """

    table: TrackTable
    map_nodes: MapNodes
    ego: EgoNode
    traffic: Traffic
    graph: SceneGraph | None
    edge_record: EdgeRecord
    halting: HaltingPlaces
    right_of_way: RightOfWay
    encounters: Encounters
    start: float
    time: float
    origin: FloatArray
    next_id: int
    clock: Clock
    shared: SharedObservations
    time_verdict: TimeVerdict
    late_frames: int
    assignment: Assignment
    identities: GivenIdentities
    noise: Mapping[str, SensorNoise]
    joint: Any


_VALUES = tuple(field.name for field in fields(TrackerSnapshot) if field.name != "joint")


class TrackerState:
    """The attributes of a `TrackerSnapshot`, and the joint state of the tracks as a running estimator."""

    def __init__(
        self,
        settings: TrackerSettings,
        providers: tuple[FactorProvider, ...] = (),
        sensors: Mapping[str, Sensor] | None = None,
    ) -> None:
        self.settings, self.rules, self.providers = settings, settings.edges, providers
        self.confused = ConfusedClasses.of(sensors or {}, settings.classes)
        named = (new_part("association.costs", given, AssociationCost) for given in settings.association.costs)
        self.costs: tuple[AssociationCost, ...] = tuple(named)
        self.graph: SceneGraph | None = None
        self.start, self.time, self.origin = 0.0, 0.0, np.zeros(2)
        self.next_id = 1
        self.clock, self.shared = Clock(), SharedObservations()
        self.time_verdict: TimeVerdict = "accepted"
        self.late_frames = 0
        self.assignment = Assignment.empty()
        self.noise: Mapping[str, SensorNoise] = {}
        self.clear()

    def clear(self) -> None:
        """Remove all tracks, the map and the vehicle; ids go on."""
        settings = self.settings
        values = {field.name: getattr(settings, field.name) for field in fields(settings)}
        poses = settings.ego is not None and settings.ego.estimated
        estimator = new_estimator(settings.estimator, values, self.providers, poses)
        self.joint = JointTrackState(estimator, lambda label: motion_of(settings, label))
        self.table = TrackTable.empty(len(self.confused))
        read = MAP_CLASSES if self.providers else classes_read(self.rules)
        self.map_nodes, self.ego = MapNodes(settings.signals, read), EgoNode.from_settings(settings)
        self.traffic = Traffic(settings.traffic)
        self.edge_record, self.halting, self.encounters = EdgeRecord(), HaltingPlaces(), Encounters.empty()
        self.right_of_way = RightOfWay()
        self.identities = GivenIdentities()

    def __len__(self) -> int:
        return len(self.table)

    def relative(self, timestamp: float) -> float:
        """Count a timestamp, s, from `start`, rounded to the microsecond: independent of when the scene begins."""
        return round(timestamp - self.start, 6)

    def class_values(self, label: StrArray, *names: str) -> FloatArray:
        """(k, n) class settings of these k names for each label (n,)."""
        return class_values(self.settings.classes, ClassSettings, label, *names)

    def kinematics(self) -> Kinematics:
        """The estimates of all tracks."""
        return self.joint.kinematics(self.table.id, self.table.label)

    def reported_kinematics(self, rows: IntArray | None = None) -> Kinematics:
        """The estimates of all tracks, or of some rows, allowing for those that are stationary."""
        now, still, coasting = self.kinematics(), self.table.stationarity, self.table.coasting(self.time) > 0
        if rows is not None:
            now, still, coasting = now.select(rows), still.select(rows), coasting[rows]
        return still.reported(now, coasting) if self.settings.stationary_share > 0 else now

    def class_belief(self) -> FloatArray:
        """(n, C) log-probabilities of the confused classes, by detections, size and speed."""
        table, confused = self.table, self.confused
        if not len(confused):
            return table.class_belief
        now = self.kinematics()
        speed = np.where(table.has_moved, np.hypot(*now.velocity.T), np.nan)
        return confused.with_shape(table.class_belief, table.box.size, speed, now.speed_deviation**2)

    def reclassify(self, rows: IntArray | None = None, new: StrArray | None = None) -> None:
        """Give each track its likeliest class, or those of `rows` (k,) the classes `new` (k,)."""
        if not len(self.confused):
            return
        label = self.table.label.copy()
        if rows is None or new is None:
            label = self.confused.labels(self.class_belief(), label)
        else:
            label[rows] = new
        changed = (label != self.table.label).nonzero()[0]
        (speed,) = self.class_values(label[changed], "initial_speed_deviation")
        self.joint.reclassify(self.table.id[changed], self.table.label[changed], label[changed], speed)
        self.table.label = label

    def exchange(self, a: int, b: int, since: float) -> IntArray:
        """Give each of two tracks, by id, the state and the row of the other, and its passages `since` a time, s.

        What edges and lights learn of both begins anew. Returns the row (n,) from which each now has what is known.
        """
        rows, order = self.table.rows(np.array([a, b])), np.arange(len(self))
        self.joint.exchange(self.table.id[rows], self.table.label[rows])
        order[rows] = rows[::-1]
        self.table = replace(self.table.select(order), id=self.table.id)
        self.assignment = Assignment(exchanged(self.assignment.id, a, b), self.assignment.detection)
        self.identities = self.identities.exchanged(a, b)
        self.traffic.exchange(a, b, since)
        self.edge_record, self.halting = self.edge_record.without({a, b}), self.halting.without({a, b})
        self.right_of_way = self.right_of_way.without({a, b})
        drivers = self.map_nodes.drivers
        self.map_nodes.drivers = drivers.select(~np.isin(drivers.id, [a, b]))
        return order

    def boxes(self, position: FloatArray, velocity: FloatArray) -> Boxes:
        """The boxes of all tracks, in the world, at local positions (n, 2) with velocities (n, 2)."""
        return self.table.boxes(position + self.origin, velocity)

    def past_positions(self, delay: float) -> tuple[FloatArray, FloatArray]:
        """Positions (n, 2) of all tracks `delay` s ago and their covariances (n, 2, 2)."""
        if delay == 0:
            now = self.kinematics()
            return now.position, now.P
        ids, estimator = self.table.id, self.joint.estimator
        position, P = np.zeros((len(ids), 2)), np.zeros((len(ids), 2, 2))
        for node_type, rows in self.joint.rows_by_type(self.table.label, moving=True):
            H, R = moved_to_present(node_type, node_type.selector(POSITION), np.zeros((2, 2)), delay)
            position[rows] = estimator.mean(ids[rows]) @ H.T
            P[rows] = H @ estimator.covariance(ids[rows]) @ H.T + R
        return position, P

    def past_cross_covariances(self, delay: float) -> CrossCovariances:
        """Covariances between the positions `delay` s ago of correlated pairs of tracks, by rows."""
        groups = self.joint.rows_by_type(self.table.label, moving=True)
        group = np.zeros(len(self), dtype=np.int64)
        for number, (_, rows) in enumerate(groups):
            group[rows] = number
        x = self.joint.estimator.posterior()
        nodes = x.layout.rows(self.table.id)
        first, second = x.correlated(nodes)
        past = [past_position(node_type, delay) for node_type, _ in groups]
        C = np.zeros((len(first), 2, 2))
        for a, H_a in enumerate(past):
            for b, H_b in enumerate(past):
                pairs = np.flatnonzero((group[first] == a) & (group[second] == b))
                if len(pairs):
                    C[pairs] = H_a @ x.between(nodes[first[pairs]], nodes[second[pairs]]) @ H_b.T
        return CrossCovariances(first, second, C)

    def unmeasured_velocity(
        self, label: StrArray, place: FloatArray, yaw: FloatArray, prior: float
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Velocity (k, 2), its covariance (k, 2, 2), and the probability (k,) of being stationary, of unknown objects.

        By their class and the traffic around their place (k, 2), world, m, and heading (k,), rad; prior: of the
        probability.
        """
        speed, drift = self.class_values(label, "initial_speed_deviation", "initial_lateral_speed_deviation")
        stationary, mean, variance = speed_prior(self.traffic, label, place, yaw, speed**2, prior)
        return *velocities_along(yaw, mean, variance, speed, drift), stationary

    @property
    def world_T_ego(self) -> FloatArray | None:
        """The vehicle's pose (4, 4) as estimated in the running graph; None where it is not."""
        pose = self.joint.pose()
        if pose is not None:
            pose[:2, 3] += self.origin
        return pose

    def set_origin(self, frame: Frame) -> None:
        """Choose the local origin of a scene: where the vehicle, else the first detection, is first.

        World coordinates reach 4e6 m, at which too few digits are left for filtering.
        """
        place = np.zeros(2)
        if frame.world_T_ego is not None:
            place = frame.world_T_ego[:2, 3]
        elif frame.ego is not None and frame.ego.gps is not None:
            place = frame.ego.gps.position[:2]
        elif len(frame) and frame.coordinates == "world":
            place = frame.detections.boxes.position[0, :2]
        self.origin = np.round(place)

    def accept_time(self, timestamp: float, sensor: str, max_jump: float, max_delay: float) -> bool:
        """Judge the timestamp of a frame, s; return whether it is to be used, at `clock.time_of` it.

        Where the clock was set back, all tracks are deleted; where it was set ahead, those that coast for too long.
        """
        before, known = self.clock.newest, self.clock.sensor(sensor)
        verdict, self.clock = self.clock.judged(timestamp, sensor, max_jump, max_delay)
        self.time_verdict, own = verdict, self.clock.sensor(sensor)
        if known is not None and own is not None and own.segment != known.segment:
            self.shared = self.shared.without(sensor)
        timestamp = self.clock.time_of(timestamp, sensor)
        if verdict in ("late", "unconfirmed"):
            self.late_frames += verdict == "late"
            text = "frame of %s at %.3f s is left out: %s, %+.3f s from the newest one"
            log.warning(text, sensor, timestamp, verdict, timestamp - before)
            return False
        if before == -math.inf or verdict == "set_back":
            self.remove(np.ones(len(self), dtype=bool))
            self.start = timestamp - self.time
        elif verdict == "set_ahead":
            self.remove(self.table.coasting(self.relative(timestamp)) > self.settings.max_coasting)
        if verdict != "accepted":
            log.warning("the clock was set from %.3f s to %.3f s by %s", before, timestamp, sensor)
        return True

    def remove(self, deleted: BoolArray) -> None:
        """Marginalise tracks (n,)."""
        if deleted.any():
            kept = (~deleted).nonzero()[0]
            self.joint.remove(self.table.id[deleted], kept)
            self.table = self.table.select(kept)

    def copied(self, taking_over: bool = False) -> TrackerState:
        """Return a state that changes independently of this one."""
        twin = shallow_copy(self)
        twin.joint = self.joint.copied(taking_over)
        twin._part_from_others()
        return twin

    def _part_from_others(self) -> None:
        """Copy what is changed in place: the table, the map, the vehicle and traffic; all else is never changed."""
        self.table, self.map_nodes = self.table.copied(), shallow_copy(self.map_nodes)
        self.ego, self.traffic = shallow_copy(self.ego), self.traffic.copied()

    def snapshot(self) -> TrackerSnapshot:
        """The state as a value."""
        twin = shallow_copy(self)
        twin._part_from_others()
        return TrackerSnapshot(**{name: getattr(twin, name) for name in _VALUES}, joint=self.joint.snapshot())

    def restore(self, snapshot: TrackerSnapshot) -> None:
        """Continue from a snapshot, which stays as it is. Raises `InputError` if its parts do not fit each other."""
        snapshot.map_nodes.check_lengths()
        self.joint.restore(snapshot.joint)
        for part in (snapshot.table, snapshot.map_nodes):
            self.joint.check_nodes(part.id, part.label)
        for name in _VALUES:
            setattr(self, name, getattr(snapshot, name))
        self._part_from_others()
