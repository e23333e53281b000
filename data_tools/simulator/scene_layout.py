"""The layout of a simulated scene, sampled from its settings, with disturbances and surroundings."""

from dataclasses import dataclass, replace

import numpy as np

from data_tools.simulator.road import (
    CAR,
    KINDS,
    TRUCK,
    VAN,
    Fleet,
    Lanes,
    Road,
    attach_trailers,
    curved_road,
    equilibrium_gap,
    sample_fleet,
    sample_sizes,
)
from data_tools.simulator.settings import SimulatorSettings, TrafficSettings
from saga_fg.numerics import BoolArray, FloatArray, IntArray
from saga_fg.types import Boxes


@dataclass(frozen=True, eq=False)
class ClosingLine:
    """A line at travelled distance s, m, in some lanes, closed during red intervals (K, 2), s."""

    lanes: IntArray
    s: float
    red: FloatArray

    def closed(self, time: float) -> bool:
        """True while the light is red."""
        return bool(((self.red[:, 0] <= time) & (time < self.red[:, 1])).any())


@dataclass(frozen=True, eq=False)
class SlowZone:
    """Section [start, end), m, of some lanes with a speed limit `speed`, m/s, during intervals `active` (K, 2), s."""

    lanes: IntArray
    start: float
    end: float
    speed: float
    active: FloatArray

    def limit(self, lane: IntArray, s: FloatArray, time: float) -> FloatArray:
        """Speed limit (N,), m/s, infinite outside the zone."""
        if not ((self.active[:, 0] <= time) & (time < self.active[:, 1])).any():
            return np.full(len(s), np.inf)
        inside: BoolArray = np.isin(lane, self.lanes) & (s >= self.start) & (s < self.end)
        return np.where(inside, self.speed, np.inf)


def sample_intervals(
    on: tuple[float, float], off: tuple[float, float], until: float, rng: np.random.Generator
) -> FloatArray:
    """On intervals (K, 2), s, of alternating on and off durations, from a random phase at time 0 up to `until`."""
    time = -rng.uniform(0, on[1] + off[1])
    intervals = []
    while time < until:
        duration = rng.uniform(*on)
        intervals.append((time, time + duration))
        time += duration + rng.uniform(*off)
    return np.array(intervals)


JUNCTION = 10.0  # m between the stop lines of the two directions
FOCUS = 0.55  # share of the road's length
ROAD_LENGTH = 1000.0  # length of the simulated road, m
LANE_WIDTH = 3.5  # width of a lane, m
CURVE_PROBABILITY = 0.5  # share of scenes on a curved road
CURVE_RADIUS = (100.0, 300.0)  # smallest radius of a curve's centre line, m
MEDIAN_PROBABILITY = 0.5  # share of scenes with a hedge between the directions
MEDIAN_WIDTH = 3.0  # width of the strip that carries the hedge, m
DESIRED_SPEED = (10.0, 16.0)  # mean desired speed of a scene's drivers, m/s: 36 to 58 km/h, as in towns
RED_DURATION = (8.0, 18.0)  # duration of a red phase, s
GREEN_DURATION = (8.0, 16.0)  # duration of a green phase, s
LANE_WISE_PROBABILITY = 0.5  # share of scenes with lights or slow zones of each lane
SLOW_SPEED = (1.0, 4.0)  # speed in a slow zone while it is active, m/s
SLOW_DURATION = (5.0, 12.0)  # duration of the active and of the inactive phases of a slow zone, s
TAPER = (30.0, 45.0)  # length of the taper, m
NOTICE = (60.0, 110.0)  # distance before the taper at which drivers begin to merge, m


@dataclass(frozen=True, eq=False)
class SceneLayout:
    """Initial state of a scene with N vehicles.

    focus    distance along the road at which traffic is disturbed, m
    hedge    offset of the hedge between the directions, m, or None
    lane, s, speed  (N,) lane, distance along it in m, and speed in m/s of each vehicle
    trailer  (N,) lengths of the vehicles' trailers, included in their length, m; 0 for none
    """

    lanes: Lanes
    focus: float
    hedge: float | None
    fleet: Fleet
    lane: IntArray
    s: FloatArray
    speed: FloatArray
    stop_lines: tuple[ClosingLine, ...]
    slow_zones: tuple[SlowZone, ...]
    trailer: FloatArray

    @property
    def borders(self) -> tuple[float, float]:
        """Offsets d of the outer borders of all traffic, m: right (negative), left."""
        half = abs(self.lanes.offset[1] - self.lanes.offset[0]) / 2
        outermost = self.lanes.offset.min() - self.lanes.approach
        return float(outermost - half), float(self.lanes.offset.max() + half)


def sample_layout(settings: SimulatorSettings, rng: np.random.Generator) -> SceneLayout:
    """A random layout."""
    lanes, hedge = _sample_lanes(settings, rng)
    focus = FOCUS * ROAD_LENGTH
    until = settings.warm_up + settings.duration
    stop_lines, slow_zones = _sample_disturbances(lanes, focus, until, settings.traffic, rng)
    desired_speed = float(rng.uniform(*DESIRED_SPEED))
    fleet, trailer, lane, s = _sample_vehicles(lanes, desired_speed, settings, rng)
    speed = np.full(len(fleet), _start_speed(desired_speed))
    return SceneLayout(
        lanes=lanes,
        focus=focus,
        hedge=hedge,
        fleet=fleet,
        lane=lane,
        s=s,
        speed=speed,
        stop_lines=stop_lines,
        slow_zones=slow_zones,
        trailer=trailer,
    )


def _start_speed(desired_speed: float) -> float:
    return 0.6 * desired_speed


def _sample_lanes(settings: SimulatorSettings, rng: np.random.Generator) -> tuple[Lanes, float | None]:
    """Lanes, and the offset of the hedge between the directions, m, or None."""
    focus = FOCUS * ROAD_LENGTH
    bends = []
    if rng.random() < CURVE_PROBABILITY:
        turn = rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 1.2)
        extent = 2 * abs(turn) * rng.uniform(*CURVE_RADIUS)
        bends.append((focus + rng.uniform(-60.0, 100.0), turn, extent))
    road = curved_road(ROAD_LENGTH, bends, rng.uniform(300.0, 2500.0, 2), rng.uniform(-np.pi, np.pi))
    merge = rng.random() < settings.merge_probability
    hedge = rng.random() < MEDIAN_PROBABILITY
    forward = int(rng.integers(settings.lanes[0], settings.lanes[1] + 1))
    oncoming = int(rng.integers(settings.oncoming_lanes[0], settings.oncoming_lanes[1] + 1))
    half = MEDIAN_WIDTH / 2 if hedge else 0.25
    width = LANE_WIDTH
    right = -(half + width * (np.arange(forward + merge) + 0.5))
    left = half + width * (np.arange(oncoming) + 0.5)
    lanes = Lanes(
        road,
        np.concatenate([right, left]),
        np.repeat([1, -1], [len(right), len(left)]),
        ending=forward if merge else -1,
        end=focus if merge else np.inf,
        opening=focus - rng.uniform(80.0, 150.0) if merge else 0.0,
        approach=float(rng.choice([0.0, 25.0])) if merge else 0.0,
    )
    if merge and settings.roadworks_probability > 0 and rng.random() < settings.roadworks_probability:
        taper = float(rng.uniform(*TAPER))
        opening = focus - taper - float(rng.uniform(*NOTICE))
        lanes = replace(lanes, taper=taper, opening=opening, approach=0.0)
    return lanes, 0.0 if hedge else None


def _sample_disturbances(
    lanes: Lanes, focus: float, until: float, settings: TrafficSettings, rng: np.random.Generator
) -> tuple[tuple[ClosingLine, ...], tuple[SlowZone, ...]]:
    opposite = lanes.road.length - (focus + JUNCTION)
    light = lanes.ending < 0 and rng.random() < settings.signal_probability
    lane_wise = rng.random() < LANE_WISE_PROBABILITY
    stop_lines, zones = [], []
    shared = sample_intervals(RED_DURATION, GREEN_DURATION, until, rng)
    for mine, place in ((lanes.forward, focus), (lanes.oncoming, opposite)):
        if light:
            turning = mine[:1] if lane_wise and len(mine) > 1 else mine[:0]  # the innermost lane turns off
            own = sample_intervals(RED_DURATION, GREEN_DURATION, until, rng)
            stop_lines += [ClosingLine(np.setdiff1d(mine, turning), place, shared), ClosingLine(turning, place, own)]
        elif lanes.taper == 0:  # cones are disturbance enough
            for group in mine[:, None] if lane_wise else [mine]:
                speed = float(rng.uniform(*SLOW_SPEED))
                active = sample_intervals(SLOW_DURATION, SLOW_DURATION, until, rng)
                zones.append(SlowZone(group, place + 20.0, place + 80.0, speed, active))
    return tuple(stop_lines), tuple(zones)


def _sample_vehicles(
    lanes: Lanes, desired_speed: float, settings: SimulatorSettings, rng: np.random.Generator
) -> tuple[Fleet, FloatArray, IntArray, FloatArray]:
    """Vehicles in platoons at equilibrium gaps on all lanes.

    Returns the fleet, the lengths of its trailers (N,), m, its lanes (N,) and distances s (N,), m.
    """
    length = lanes.road.length
    most = int(length / 6.0) * len(lanes.offset)
    fleet = sample_fleet(most, desired_speed, settings.traffic, rng)
    fleet, trailer = attach_trailers(fleet, settings.traffic.trailer_share, rng)
    gaps = equilibrium_gap(_start_speed(desired_speed), fleet.drivers)
    rows, lane, s, row = [], [], [], 0
    for number in range(len(lanes.offset)):
        place = (lanes.opening if number == lanes.ending else length) - rng.uniform(5.0, 40.0)
        left = 0
        while place - fleet.length[row] > 0:
            if left == 0:
                left = int(rng.integers(settings.traffic.platoon_size[0], settings.traffic.platoon_size[1] + 1))
                place -= rng.uniform(*settings.traffic.platoon_gap)
            place -= gaps[row] + fleet.length[row]
            rows.append(row)
            lane.append(number)
            s.append(place + fleet.length[row] / 2)
            row, left = row + 1, left - 1
    chosen = np.array(rows)
    return fleet.select(chosen), trailer[chosen], np.array(lane), np.array(s)


_HEDGE_LENGTH = (4.0, 14.0)  # length of a hedge, m
_HEDGE_GAP = (5.0, 18.0)  # gap between hedges, m
_HEDGE_HEIGHT = 2.2  # height of a hedge, m
_BUILDING_LENGTH = (10.0, 30.0)  # length of a building, m
_BUILDING_GAP = (2.0, 25.0)  # gap between buildings, m
PARKING_WIDTH = 2.4  # m
PAVEMENT_WIDTH = 3.5  # m
SEGMENT = 8.0  # m, longest straight segment of a hedge
CONE = (0.45, 0.45, 0.75)  # length, width, height, m
CONE_DEVIATION = 0.1  # standard deviation of a cone's position, m
CONE_ROW = (25.0, 50.0)  # length of the row of cones behind the taper, m
CONE_SPACING = 4.0  # distance between cones, m
PARKING_OCCUPANCY = 0.5  # share of parking places taken


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Parked vehicles, objects that only hide others, and pavements (lowest and highest offset d, m)."""

    parked: Boxes
    occluders: Boxes
    pavements: list[tuple[float, float]]


def sample_surroundings(
    layout: SceneLayout, window: tuple[float, float], parking: float, rng: np.random.Generator
) -> Surroundings:
    """Random surroundings of the road for s within `window`, m; no parking and no pavement beside an ending lane.

    parking: probability of a strip of parked cars beside the road
    """
    road, parked, occluders, pavements = layout.lanes.road, [], [], []
    for side, offset in zip((-1.0, 1.0), layout.borders, strict=True):
        border = abs(offset) + 0.3
        if side > 0 or layout.lanes.ending < 0:
            if rng.random() < parking:
                parked.append(_parked(road, side * (border + PARKING_WIDTH / 2), side, window, rng))
                border += PARKING_WIDTH
            inner, outer = side * (border + 0.9), side * (border + PAVEMENT_WIDTH - 0.9)
            pavements.append((min(inner, outer), max(inner, outer)))
        border += PAVEMENT_WIDTH
        depth = 10.0
        intervals = _intervals(window, _BUILDING_LENGTH, _BUILDING_GAP, rng)
        occluders.append(_row(road, intervals, side * (border + depth / 2), depth, 9.0, "building"))
    if layout.hedge is not None:
        intervals = _intervals(window, _HEDGE_LENGTH, _HEDGE_GAP, rng)
        pieces = [
            piece
            for start, end in intervals
            for piece in np.lib.stride_tricks.sliding_window_view(
                np.linspace(start, end, int(np.ceil((end - start) / SEGMENT)) + 1), 2
            )
        ]
        occluders.append(_row(road, np.array(pieces), layout.hedge, 1.0, _HEDGE_HEIGHT, "hedge"))
    return Surroundings(Boxes.concatenate(parked), Boxes.concatenate(occluders), pavements)


def sample_cones(lanes: Lanes, rng: np.random.Generator) -> Boxes:
    """Cones that close the ending lane: a taper to its inner border, then a row along it; none for an open lane."""
    if lanes.taper == 0:
        return Boxes.empty()
    inner = (lanes.offset[lanes.ending] + lanes.offset[lanes.adjacent]) / 2
    outer = 2 * lanes.offset[lanes.ending] - inner
    end = lanes.end + rng.uniform(*CONE_ROW)
    s = np.arange(lanes.end - lanes.taper, end, CONE_SPACING)
    d = np.interp(s, [lanes.end - lanes.taper, lanes.end], [outer, inner])
    n = len(s)
    horizontal = lanes.road.position(s, d) + CONE_DEVIATION * rng.standard_normal((n, 2))
    position = np.column_stack([horizontal, np.full(n, CONE[2] / 2)])
    size = np.tile(np.array(CONE), (n, 1))
    return Boxes(np.full(n, "traffic_cone"), position, size, np.zeros(n), np.zeros((n, 2)))


def _intervals(
    window: tuple[float, float], length: tuple[float, float], gap: tuple[float, float], rng: np.random.Generator
) -> FloatArray:
    """Random intervals over the window, separated by gaps: starts and ends (K, 2), m."""
    s, intervals = window[0] - rng.uniform(0, length[1]), []
    while s < window[1]:
        end = s + rng.uniform(*length)
        intervals.append((s, end))
        s = end + rng.uniform(*gap)
    return np.array(intervals)


def _row(road: Road, intervals: FloatArray, d: float, width: float, height: float, label: str) -> Boxes:
    middle = intervals.mean(axis=1)
    offset = np.full(len(middle), d)
    length = (intervals[:, 1] - intervals[:, 0]) * (1 - road.curvature_at(middle) * d)
    return _boxes(
        road, middle, offset, np.stack([length, np.full_like(length, width), np.full_like(length, height)], 1), label
    )


def _parked(
    road: Road,
    d: float,
    side: float,
    window: tuple[float, float],
    rng: np.random.Generator,
) -> Boxes:
    place = np.arange(window[0], window[1], 6.5)
    place = place[rng.random(len(place)) < PARKING_OCCUPANCY]
    kind = rng.choice([CAR, VAN, TRUCK], size=len(place), p=[0.74, 0.2, 0.06])
    size = sample_sizes(kind, rng)
    trucks = np.flatnonzero(kind == TRUCK)
    clear = np.ones(len(place), dtype=np.bool_)
    for row in trucks:  # a truck takes the neighbouring places too
        near = np.abs(place - place[row]) < 6.5 + size[row, 0] / 2
        clear &= ~near | (np.arange(len(place)) == row)
    label = np.array([k.label for k in KINDS])[kind]
    offset = d + rng.uniform(-0.15, 0.15, len(place))
    boxes = _boxes(road, place, offset, size, label)
    yaw = boxes.yaw + (np.pi if side > 0 else 0.0) + rng.normal(0, 0.02, len(place))
    return Boxes(boxes.label, boxes.position, boxes.size, yaw, boxes.velocity).select(clear)


def _boxes(road: Road, s: FloatArray, d: FloatArray, size: FloatArray, label: object) -> Boxes:
    position = np.column_stack([road.position(s, d), size[:, 2] / 2])
    return Boxes(np.broadcast_to(np.asarray(label), len(s)), position, size, road.heading_at(s), np.zeros((len(s), 2)))
