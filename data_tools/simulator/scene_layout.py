"""The layout of a scene, sampled from its settings: road, lanes, disturbances, vehicles and their initial states."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from data_tools.simulator.disturbances import ClosingLine, SlowZone, sample_intervals
from data_tools.simulator.driver_models import equilibrium_gap
from data_tools.simulator.fleet import Fleet, attach_trailers, sample_fleet
from data_tools.simulator.lanes import Lanes
from data_tools.simulator.road import curved_road
from data_tools.simulator.settings import RoadSettings, RoadworkSettings, SimulatorSettings, TrafficSettings
from saga_fg.numerics.arrays import FloatArray, IntArray

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
    lanes, hedge = _sample_lanes(settings.road, settings.roadworks, rng)
    focus = FOCUS * ROAD_LENGTH
    until = settings.warm_up + settings.duration
    stop_lines, slow_zones = _sample_disturbances(lanes, focus, until, settings.traffic, rng)
    desired_speed = float(rng.uniform(*DESIRED_SPEED))
    fleet, trailer, lane, s = _sample_vehicles(lanes, desired_speed, settings, rng)
    speed = np.full(len(fleet), _start_speed(desired_speed))
    return SceneLayout(lanes, focus, hedge, fleet, lane, s, speed, stop_lines, slow_zones, trailer)


def _start_speed(desired_speed: float) -> float:
    return 0.6 * desired_speed


def _sample_lanes(
    settings: RoadSettings, roadworks: RoadworkSettings, rng: np.random.Generator
) -> tuple[Lanes, float | None]:
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
    if merge and roadworks.probability > 0 and rng.random() < roadworks.probability:
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
    fleet = Fleet(fleet.kind[chosen], fleet.size[chosen], fleet.drivers.select(chosen))
    return fleet, trailer[chosen], np.array(lane), np.array(s)
