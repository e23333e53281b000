"""Maps as nodes of the joint state: lights, stop lines, lanes, walls; tiles joined, colours inferred.

Nodes are the elements of those classes that some edge rule reads: others would cost time alone.

Nodes of the map are stationary; their positions start at those of the map, as uncertain as the map, and are corrected
by detections of lights and through the interactions of vehicles that stop at a line or keep a lane. Ids count down from
-1, so that they are never those of tracks. Detections labelled `saga_fg.types.road_map.COLOUR_LABELS` report the
colour of the nearest known light within reach.

Elements of several maps, such as tiles along a drive: which are the same, and a name of its own for each.

Two elements of one class are the same if they have one name and lie beside each other, as in a map that was corrected
or cut elsewhere; or if they lie in one place under two names, and none of that place has this name already. Another
element of a name that is taken gets a number after it. Elements of one map are never the same.

Colours of lights inferred from traffic: the first vehicle before each stop line drives by its light.

    L_k <- L_k + r ( a_k T dv - (a_k T)^2 / 2 ) / V,    V = max( P + q T - P', q T )
    L_k <- max( L_k - max L, log h ),    p_k <- p_k exp( change of L_k ) / sum

is Bayes' rule with the likelihoods N(dv; a_k T, V) of the states k of the light. dv is the change of the vehicle's
estimated speed along its lane between two detections T seconds apart, P and P' the variances of the two estimates, so
that V is that of dv (Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001,
section 5.4), and r the probability that the track exists. a_k is the acceleration that the edge rules expect, at the
estimate at the first of the two: in red and amber that of `RedLight`, in green that of `GreenLight`; drivers who wait
have not reacted yet in the state `starting`. The exponent is linear in dv, so that the noise of the estimated speeds
does not add up over the frames.

A share h of the drivers does not comply with the light: they turn at red, or cannot leave at green. So no vehicle
says more than a factor 1 / h. All lines of a light gain by what is inferred, and by colours that are reported as well.
Hidden vehicles tell nothing.
"""

from __future__ import annotations

import logging
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import count
from typing import TypeVar

import numpy as np

from saga_fg.errors import InputError
from saga_fg.model import (
    EdgeRule,
    GreenLight,
    Motion,
    NodeTable,
    RandomWalk,
    RedLight,
    Sensor,
    coming_vehicles,
    halting,
)
from saga_fg.numerics import BoolArray, Columns, FloatArray, IntArray, StrArray, assign, gate, mahalanobis, of_classes
from saga_fg.tracking.joint_state import JointTrackState
from saga_fg.tracking.settings import ClassSettings, TrackerSettings
from saga_fg.tracking.track_filters import Kinematics
from saga_fg.types import (
    COLOUR_LABELS,
    COLOURS,
    LANE,
    LIGHT,
    MAP_CLASSES,
    MAX_LIGHT_DISTANCE,
    NON_COMPLIANCE,
    STATES,
    STOP_LINE,
    WALL,
    Frame,
    Lane,
    LanesAcross,
    RoadMap,
    SignalSettings,
    StopLine,
    TrafficLight,
    Wall,
    class_settings,
    colour_updated,
    colours,
    updated,
)

log = logging.getLogger(__name__)

Element = TrafficLight | StopLine | Lane | Wall
E = TypeVar("E", TrafficLight, StopLine, Lane, Wall)
LABELS: Mapping[type, str] = {TrafficLight: LIGHT, StopLine: STOP_LINE, Lane: LANE, Wall: WALL}

BESIDE = 4.0  # m, to which corrections move an element; others of its name are farther away
SAME = 0.1  # m, within which maps that write one place twice agree
_NUMBER = " ("  # before the number of a name that occurs again


def elements(road_map: RoadMap) -> tuple[Element, ...]:
    """All elements of a map."""
    return *road_map.lights, *road_map.stop_lines, *road_map.lanes, *road_map.walls


def in_known_names(road_map: RoadMap, known: Mapping[str, Element]) -> RoadMap:
    """A map with the names of the `known` elements for those that are the same, and new names for all others."""
    if not known or all(known.get(each.name) == each for each in elements(road_map)):
        return road_map
    own = {each.name for each in elements(road_map)}
    name: dict[str, str] = {}
    for each in elements(road_map):
        alike = (other for found, other in known.items() if found.partition(_NUMBER)[0] == each.name)
        same = next((other for other in alike if _beside(each, other)), None)
        if same is not None:
            name[each.name] = same.name
    left = [other for other in known.values() if other.name not in name.values()]
    for each in elements(road_map):
        if each.name in name:
            continue
        same = next((other for other in left if _in_place(each, other)), None)
        if same is not None:
            left.remove(same)
        name[each.name] = _free(each.name, known, own) if same is None else same.name
    if all(old == new for old, new in name.items()):
        return road_map

    def named(group: Iterable[E]) -> tuple[E, ...]:
        return tuple(replace(each, name=name[each.name]) for each in group)

    lines = tuple(replace(line, light=name.get(line.light, "")) for line in named(road_map.stop_lines))
    return replace(
        road_map,
        lights=named(road_map.lights),
        stop_lines=lines,
        lanes=named(road_map.lanes),
        walls=named(road_map.walls),
    )


def _free(name: str, *taken: Container[str]) -> str:
    """The name, if no known element has it, or with the first number with which it is free."""
    if name not in taken[0]:
        return name
    numbered = (f"{name}{_NUMBER}{k})" for k in count(2))
    return next(each for each in numbered if not any(each in names for names in taken))


def _points(element: Element) -> FloatArray:
    """(k, 2) m."""
    if isinstance(element, TrafficLight):
        return np.array([element.position])
    if isinstance(element, StopLine):
        return element.ends
    return np.array(element.centre if isinstance(element, Lane) else element.points)


def _in_place(a: Element, b: Element) -> bool:
    """True if two elements of one class are the same points."""
    if type(a) is not type(b):
        return False
    p, q = _points(a), _points(b)
    return p.shape == q.shape and bool(np.abs(p - q).max() < SAME)


def _beside(a: Element, b: Element) -> bool:
    """True if two elements are of one class and the middle of each is beside the other."""
    if type(a) is not type(b):
        return False
    p, q = (_dense(_points(each)) for each in (a, b))
    return all(np.hypot(*(x - y[len(y) // 2]).T).min() < BESIDE for x, y in ((p, q), (q, p)))


def _dense(points: FloatArray) -> FloatArray:
    """Points every metre or so along a line."""
    if len(points) == 1:
        return points
    distance = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    at = np.linspace(0.0, distance[-1], max(3, round(distance[-1]) | 1))
    return np.stack([np.interp(at, distance, each) for each in points.T], axis=-1)


def _crossed(line: StopLine, lanes: tuple[Lane, ...]) -> bool:
    """False, with a warning, for a line without a light that none of the lanes crosses."""
    if line.light or not lanes or len(LanesAcross.from_lanes(lanes, [line]).line):
        return True
    log.warning("stop line %s: no lane of the map crosses it; vehicles are not expected to halt there", line.name)
    return False


LONGEST = 1.0  # s between two detections of a vehicle

Rule = TypeVar("Rule")


@dataclass(frozen=True, eq=False)
class FirstVehicles(Columns):
    """First vehicles before lines as last detected.

    id, line (n,) of the tracks and of the nodes of the lines; time (n,) s; speed (n,) along direction (n, 2), m/s;
    variance (n,) of the speed; expected (n, 4) accelerations in each state of the light, m/s^2; weight (n,)
    probability that the track exists; log_likelihood (n, 4) L
    """

    id: IntArray
    line: IntArray
    time: FloatArray
    speed: FloatArray
    direction: FloatArray
    variance: FloatArray
    expected: FloatArray
    weight: FloatArray
    log_likelihood: FloatArray

    @classmethod
    def none(cls) -> FirstVehicles:
        """No vehicle."""
        ids, times, states = np.empty(0, dtype=np.int64), np.empty(0), np.empty((0, len(STATES)))
        return cls(
            id=ids,
            line=ids,
            time=times,
            speed=times,
            direction=np.empty((0, 2)),
            variance=times,
            expected=states,
            weight=times,
            log_likelihood=states,
        )

    def later(self, nodes: NodeTable, rules: Sequence[EdgeRule], detected: BoolArray, time: float) -> FirstVehicles:
        """First vehicles of a node table: tracks (its first rows) `detected` at `time`, and others seen just before."""
        stop, go = _first(rules, RedLight), _first(rules, GreenLight)
        if stop is None:
            return self
        first = stop.able(coming_vehicles(nodes).first())
        first = first.select((first.target < len(detected)) & ((nodes.closed + nodes.open)[first.source] > 0))
        first = first.select(detected[first.target])
        v, ids, line = first.speed, nodes.id[first.target], nodes.id[first.source]
        ramp, braking = stop.brakes(nodes, first)
        free = np.zeros_like(v) if go is None else go.acceleration(v)
        closed = ramp * braking + (1 - ramp) * free
        waiting = np.where(halting(v, first.front), 0.0, free)
        same = (ids[:, None] == self.id) & (line[:, None] == self.line)
        log_likelihood = np.where(same.any(axis=1)[:, None], same.astype(np.float64) @ self.log_likelihood, 0.0)
        expected = np.column_stack([closed, closed, waiting, free])
        variance = nodes.velocity_variance[first.target]
        then = np.full(len(v), time)
        now = FirstVehicles(
            id=ids,
            line=line,
            time=then,
            speed=v,
            direction=first.approach.direction,
            variance=variance,
            expected=expected,
            weight=nodes.existence[first.target],
            log_likelihood=log_likelihood,
        )
        kept = self.select(~np.isin(self.id, nodes.id[: len(detected)][detected]) & (self.time > time - LONGEST))
        return kept.append(now)

    def updated(
        self, ids: IntArray, velocity: FloatArray, variance: FloatArray, time: float, settings: SignalSettings
    ) -> FirstVehicles:
        """With what tracks `ids` (k,) tell that were detected at `time`: velocity (k, 2), variance (k,) of its
        components."""
        mine, row = np.nonzero((self.id[:, None] == ids) & (time > self.time)[:, None])
        dv = np.einsum("ni,ni->n", velocity[row], self.direction[mine]) - self.speed[mine]
        T, own = time - self.time[mine], settings.driver_noise * (time - self.time[mine])
        V = np.maximum(self.variance[mine] + own - variance[row], own)
        change = self.expected[mine] * T[:, None]
        log_likelihood = self.log_likelihood.copy()
        log_likelihood[mine] += (self.weight[mine] / V)[:, None] * change * (dv[:, None] - change / 2)
        log_likelihood -= log_likelihood.max(axis=1, keepdims=True, initial=-np.inf) if len(log_likelihood) else 0.0
        return replace(self, log_likelihood=np.maximum(log_likelihood, np.log(NON_COMPLIANCE)))


def _first(rules: Sequence[EdgeRule], kind: type[Rule]) -> Rule | None:
    """The first rule of a kind, None without one; further rules of the kind do not count for the inference."""
    return next((rule for rule in rules if isinstance(rule, kind)), None)


def motion_of(settings: TrackerSettings, label: str) -> Motion:
    """Own motion of a class: nodes of the map are stationary unless the settings name their class."""
    of_map = label in MAP_CLASSES and label not in settings.classes
    return RandomWalk() if of_map else class_settings(settings.classes, ClassSettings, label).motion


def classes_read(rules: Sequence[EdgeRule]) -> tuple[str, ...]:
    """Classes of nodes of the map that edge rules read; all, where a rule does not say."""
    read = {label for rule in rules for label in getattr(rule, "map_classes", MAP_CLASSES)}
    return tuple(label for label in MAP_CLASSES if label in read)


GATE = 0.999  # gate probability of the detections of a light


@dataclass(frozen=True)
class Place:
    """Place of a node on the map, world: middle (2,), polyline (k, 2) about it, direction of travel, m and rad."""

    middle: FloatArray
    outline: FloatArray
    heading: float
    width: float

    @classmethod
    def from_element(cls, element: Element) -> Place:
        """The place of an element; a lane's middle is one of its points."""
        points = _points(element)
        middle = points[len(points) // 2] if isinstance(element, Lane) else points.mean(axis=0)
        outline = np.empty((0, 2)) if isinstance(element, TrafficLight) else points - middle
        return cls(middle, outline, getattr(element, "heading", 0.0), getattr(element, "width", 0.0))


@dataclass(eq=False)
class MapNodes:
    """Nodes of the map.

    settings  how lights change
    classes   of elements that become nodes
    id, label, name, place  (n,) of the nodes
    light     (n,) name of the light that governs each, "" for none
    across    the stop lines of the map, in order of their nodes, and the lanes that cross them; None without lines
    beliefs   by light, the probabilities of its states
    drivers   first vehicles before the lines, from which the states are inferred
    """

    settings: SignalSettings
    classes: tuple[str, ...] = MAP_CLASSES
    id: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    label: StrArray = field(default_factory=lambda: np.empty(0, dtype="<U16"))
    name: tuple[str, ...] = ()
    place: tuple[Place, ...] = ()
    light: tuple[str, ...] = ()
    across: LanesAcross | None = None
    beliefs: Mapping[str, FloatArray] = field(default_factory=dict)
    drivers: FirstVehicles = field(default_factory=FirstVehicles.none)
    _known: Mapping[str, Element] = field(default_factory=dict)
    _latest: RoadMap | None = None

    def __len__(self) -> int:
        return len(self.id)

    def check_lengths(self) -> None:
        """Raise `InputError` unless all that is known of the nodes has their number."""
        for name in ("label", "name", "place", "light"):
            if len(getattr(self, name)) != len(self):
                raise InputError(f"{name}: expected one for each of {len(self)} nodes of the map")

    def belief(self, light: str) -> Mapping[str, float]:
        """Probabilities of the colours of a light, by colour; raises `KeyError` for one that is no node."""
        return dict(zip(COLOURS, colours(self.beliefs[light]).tolist(), strict=True))

    def add(self, road_map: RoadMap, origin: FloatArray, joint: JointTrackState) -> RoadMap | None:
        """Add the new elements of a map to the nodes and to the joint state, whose positions are from `origin` (2,).

        Returned is the map in the names that its elements have here, with the new ones among its stop lines; None where
        it is the latest one again. Stop lines without a light that no lane crosses are left out, with a warning.
        """
        if road_map is self._latest:
            return None
        self._latest = road_map
        road_map = in_known_names(road_map, self._known)
        wanted = [each for each in elements(road_map) if LABELS[type(each)] in self.classes]
        new = [each for each in wanted if each.name not in self.name]
        if new:
            self._add_nodes(new, road_map.deviation, origin, joint)
        self._add_roads(road_map)
        lines = tuple(line for line in road_map.stop_lines if line.name not in self._known)
        self._known = {each.name: each for each in elements(road_map)} | dict(self._known)
        return replace(road_map, stop_lines=tuple(line for line in lines if _crossed(line, road_map.lanes)))

    def _add_nodes(self, new: Sequence[Element], deviation: float, origin: FloatArray, joint: JointTrackState) -> None:
        """Add elements of a map of this deviation, m."""
        labels, places = [LABELS[type(each)] for each in new], tuple(map(Place.from_element, new))
        lights = tuple(each.name if isinstance(each, TrafficLight) else getattr(each, "light", "") for each in new)
        ids = -np.arange(len(self) + 1, len(self) + len(new) + 1, dtype=np.int64)
        self.id, self.label = np.concatenate([self.id, ids]), np.concatenate([self.label, np.array(labels)])
        self.name += tuple(each.name for each in new)
        self.place += places
        self.light += lights
        fresh = {name: self.settings.stationary for name in lights if name and name not in self.beliefs}
        self.beliefs = {**self.beliefs, **fresh}
        n, P = len(ids), deviation**2 * np.eye(2)
        middle = np.array([place.middle for place in places]) - origin
        still = np.zeros((n, 2)), np.zeros((n, 2, 2))
        joint.add(ids, np.array(labels), Kinematics(middle, still[0], np.tile(P, (n, 1, 1)), still[1]))

    def _add_roads(self, road_map: RoadMap) -> None:
        """Find out which known lanes cross which known stop lines, where the map brings new ones."""
        lanes_and_lines: tuple[Lane | StopLine, ...] = (*road_map.lanes, *road_map.stop_lines)
        roads = {each.name: each for each in lanes_and_lines}
        if STOP_LINE not in self.classes or roads.keys() <= self._known.keys():
            return
        known = {**roads, **self._known}
        nodes = [known.get(self.name[k]) for k in (self.label == STOP_LINE).nonzero()[0].tolist()]
        lanes = [each for each in known.values() if isinstance(each, Lane)]
        lines = [each for each in nodes if isinstance(each, StopLine)]
        self.across = LanesAcross.from_lanes(lanes, lines) if lines else None

    def predict(self, dt: float) -> None:
        """Predict the states of the lights by `dt` s."""
        if self.beliefs and dt > 0:
            later = self.settings.predicted(np.array(list(self.beliefs.values())), dt)
            self.beliefs = dict(zip(self.beliefs, later, strict=True))

    def infer(self, ids: IntArray, velocity: FloatArray, variance: FloatArray, time: float) -> None:
        """Update the states of the lights by tracks (k,) detected at `time`, s, with velocities (k, 2) of variances
        (k,)."""
        before, belief = self.drivers.log_likelihood, dict(self.beliefs)
        self.drivers = self.drivers.updated(ids, velocity, variance, time, self.settings)
        change = self.drivers.log_likelihood - before
        for k in np.flatnonzero(change.any(axis=1)).tolist():
            light = self.light[-1 - int(self.drivers.line[k])]  # ids count down from -1
            belief[light] = updated(belief[light], change[k])
        self.beliefs = belief

    def update(self, frame: Frame, sensor: Sensor, origin: FloatArray, joint: JointTrackState, delay: float) -> None:
        """Take in the colours and positions of lights in a frame taken `delay` s ago."""
        lights = (self.label == LIGHT).nonzero()[0] if len(self) else self.id
        if len(lights) == 0 or not of_classes(frame.detections.boxes.label, COLOUR_LABELS).any():
            return
        seen = sensor.in_world(frame)
        seen = seen.select(of_classes(seen.boxes.label, COLOUR_LABELS))
        R = sensor.detection_covariance(seen, sensor.origin(frame))[:, :2, :2]
        position, _, P, _ = joint.kinematics_of(self.id[lights], self.label[lights])
        z = seen.boxes.position[:, :2] - origin
        d2, log_det = mahalanobis(position, P, z, R)
        apart = np.hypot(*np.moveaxis(z[None] - position[:, None], -1, 0))
        possible = (d2 < gate(GATE)) & (apart < MAX_LIGHT_DISTANCE)
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

    def table(self, first: int, origin: FloatArray, joint: JointTrackState) -> NodeTable:
        """The nodes of the map, which are rows of a larger table from `first` on; positions are from `origin` (2,)."""
        position = joint.kinematics_of(self.id, self.label).position
        governed = np.flatnonzero([bool(light) for light in self.light])
        states = np.array([self.beliefs[light] for light in self.light if light]).reshape(-1, len(STATES))
        closed, opened = np.zeros((2, len(self)))
        closed[governed], opened[governed] = self.settings.closed(states), self.settings.open(states)
        lanes = None
        if self.across is not None:
            lines = (self.label == STOP_LINE).nonzero()[0]
            middles = np.array([self.place[k].middle for k in lines.tolist()])
            lanes = self.across.placed(origin, position[lines] + origin - middles, first + lines)
        none = np.zeros(len(self))
        return NodeTable(
            id=self.id,
            label=self.label,
            types=joint.types_of(self.label),
            position=position,
            velocity=np.zeros((len(self), 2)),
            heading=np.array([place.heading for place in self.place]),
            length=none,
            velocity_variance=none,
            has_moved=none,
            closed=closed,
            open=opened,
            outline={k: place.outline + position[k] for k, place in enumerate(self.place) if len(place.outline)},
            width={k: place.width for k, place in enumerate(self.place) if place.width > 0},
            lanes=lanes,
        )
