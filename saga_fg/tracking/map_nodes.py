"""Lights, stop lines, lanes and walls of a map as nodes of the joint state, with the colours of the lights.

Nodes of the map are stationary; their positions start at those of the map, as uncertain as the map, and are corrected
by detections of lights and through the interactions of vehicles that stop at a line or keep a lane. Ids count down from
-1, so that they are never those of tracks. Detections labelled `saga_fg.types.signal.COLOUR_LABELS` report the
colour of the nearest known light within reach.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from saga_fg.model.interactions import NodeTable
from saga_fg.model.motion import Motion, RandomWalk
from saga_fg.model.sensor import Sensor
from saga_fg.numerics.arrays import FloatArray, IntArray, StrArray, of_classes
from saga_fg.numerics.assignment import assign, gate, mahalanobis
from saga_fg.tracking.joint_state import JointTrackState
from saga_fg.tracking.kinematics import Kinematics
from saga_fg.tracking.settings import ClassSettings, TrackerSettings
from saga_fg.types.by_class import class_settings
from saga_fg.types.frame import Frame
from saga_fg.types.road_map import LANE, LIGHT, MAP_CLASSES, STOP_LINE, WALL, RoadMap
from saga_fg.types.signal import COLOUR_LABELS, COLOURS, SignalSettings, colour_updated


def motion_of(settings: TrackerSettings, label: str) -> Motion:
    """Own motion of a class: nodes of the map are stationary unless the settings name their class."""
    if label in MAP_CLASSES and label not in settings.classes:
        return RandomWalk()
    return class_settings(settings.classes, ClassSettings, label).motion


GATE = 0.999  # gate probability of the detections of a light


@dataclass(frozen=True)
class Place:
    """Place of a node on the map, world: middle (2,), polyline (k, 2) about it, direction of travel, m and rad."""

    middle: FloatArray
    outline: FloatArray
    heading: float
    width: float


@dataclass(eq=False)
class MapNodes:
    """Nodes of the map.

    settings  how lights change
    id, label, name, place  (n,) of the nodes
    light     (n,) name of the light that governs each, "" for none
    beliefs   by light, the probabilities of its colours
    """

    settings: SignalSettings
    id: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    label: StrArray = field(default_factory=lambda: np.empty(0, dtype="<U16"))
    name: tuple[str, ...] = ()
    place: tuple[Place, ...] = ()
    light: tuple[str, ...] = ()
    beliefs: Mapping[str, FloatArray] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.id)

    def belief(self, light: str) -> Mapping[str, float]:
        """Probabilities of the colours of a light, by colour; raises `KeyError` for one that no map has."""
        return dict(zip(COLOURS, self.beliefs[light].tolist(), strict=True))

    def add(self, road_map: RoadMap, origin: FloatArray, joint: JointTrackState) -> None:
        """Add the new elements of a map to the nodes and to the joint state, whose positions are from `origin` (2,)."""
        new = [(name, *rest) for name, *rest in _elements(road_map) if name not in self.name]
        if not new:
            return
        names, labels, places, lights = zip(*new, strict=True)
        ids = -np.arange(len(self) + 1, len(self) + len(new) + 1, dtype=np.int64)
        self.id, self.label = np.concatenate([self.id, ids]), np.concatenate([self.label, np.array(labels)])
        self.name += names
        self.place += places
        self.light += lights
        fresh = {name: self.settings.stationary for name in lights if name and name not in self.beliefs}
        self.beliefs = {**self.beliefs, **fresh}
        n, P = len(ids), road_map.deviation**2 * np.eye(2)
        middle = np.array([place.middle for place in places]) - origin
        still = np.zeros((n, 2)), np.zeros((n, 2, 2))
        joint.add(ids, np.array(labels), Kinematics(middle, still[0], np.tile(P, (n, 1, 1)), still[1]))

    def predict(self, dt: float) -> None:
        """Predict the colours of the lights by `dt` s."""
        if self.beliefs and dt > 0:
            later = self.settings.predicted(np.array(list(self.beliefs.values())), dt)
            self.beliefs = dict(zip(self.beliefs, later, strict=True))

    def update(self, frame: Frame, sensor: Sensor, origin: FloatArray, joint: JointTrackState, delay: float) -> None:
        """Take in the colours and positions of lights in a frame taken `delay` s ago."""
        lights = np.flatnonzero(self.label == LIGHT)
        if len(lights) == 0 or not of_classes(frame.detections.boxes.label, COLOUR_LABELS).any():
            return
        seen = sensor.in_world(frame)
        seen = seen.select(of_classes(seen.boxes.label, COLOUR_LABELS))
        R = sensor.detection_covariance(seen, sensor.origin(frame))
        position, _, P, _ = joint.kinematics_of(self.id[lights], self.label[lights])
        z = seen.boxes.position[:, :2] - origin
        d2, log_det = mahalanobis(position, P, z, R)
        apart = np.hypot(*np.moveaxis(z[None] - position[:, None], -1, 0))
        possible = (d2 < gate(GATE)) & (apart < self.settings.max_distance)
        cost = d2 + log_det
        row, column = assign(cost, possible, cost.max(initial=0.0) + 1.0)
        belief = dict(self.beliefs)
        for light, detection in zip(lights[row].tolist(), column.tolist(), strict=True):
            colour = COLOUR_LABELS.index(str(seen.boxes.label[detection]))
            name = self.name[light]
            belief[name] = colour_updated(belief[name], colour, sensor.colour_accuracy)
        self.beliefs = belief
        k = len(row)
        if k:
            full = np.zeros((k, 4, 4))
            full[:, :2, :2] = R[column]
            measured = np.concatenate([z[column], np.zeros((k, 2))], axis=1)
            ids, label = self.id[lights[row]], self.label[lights[row]]
            joint.update(ids, label, measured, full, np.zeros(k, dtype=bool), delay)

    def appended_to(self, tracks: NodeTable, origin: FloatArray, joint: JointTrackState) -> NodeTable:
        """Return the node table of the tracks with the nodes of the map after them."""
        n, m = len(tracks), len(self)
        if m == 0:
            return tracks
        position = joint.kinematics_of(self.id, self.label).position
        moved, existence = tracks.has_moved, tracks.existence
        beliefs = [self.beliefs[light] for light in self.light if light]
        closed = self.settings.closed(np.array(beliefs).reshape(-1, len(COLOURS)))
        governed = np.array([bool(light) for light in self.light])
        weight = np.zeros(n + m)
        weight[n:][governed] = closed
        outline = {n + k: place.outline + position[k] for k, place in enumerate(self.place) if len(place.outline)}
        width = {n + k: place.width for k, place in enumerate(self.place) if place.width > 0}
        return NodeTable(
            np.concatenate([tracks.id, self.id]),
            np.concatenate([tracks.label, self.label]),
            tracks.types + joint.types_of(self.label),
            np.concatenate([tracks.position, position]),
            np.concatenate([tracks.velocity, np.zeros((m, 2))]),
            np.concatenate([tracks.heading, [place.heading for place in self.place]]),
            np.concatenate([tracks.length, np.zeros(m)]),
            np.concatenate([tracks.velocity_variance, np.zeros(m)]),
            None if moved is None else np.concatenate([moved, np.zeros(m, dtype=bool)]),
            weight,
            outline,
            width,
            None if tracks.unseen is None else np.concatenate([tracks.unseen, np.zeros(m)]),
            None if existence is None else np.concatenate([existence, np.ones(m)]),
        )


def _elements(road_map: RoadMap) -> list[tuple[str, str, Place, str]]:
    """Name, class, place and governing light of every element of a map."""
    none = np.empty((0, 2))
    elements = [
        (light.name, LIGHT, Place(np.array(light.position), none, 0.0, 0.0), light.name) for light in road_map.lights
    ]
    for line in road_map.stop_lines:
        middle = line.ends.mean(axis=0)
        elements.append((line.name, STOP_LINE, Place(middle, line.ends - middle, line.heading, 0.0), line.light))
    for lane in road_map.lanes:
        centre = np.array(lane.centre)
        middle = centre[len(centre) // 2]
        elements.append((lane.name, LANE, Place(middle, centre - middle, 0.0, lane.width), ""))
    for wall in road_map.walls:
        middle = np.mean(wall.points, axis=0)
        elements.append((wall.name, WALL, Place(middle, np.array(wall.points) - middle, 0.0, 0.0), ""))
    return elements
