"""Everything that stands and moves in one scene, at any time, with one of the cars as the ego vehicle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data_tools.simulator.cyclists import ride
from data_tools.simulator.fleet import CAR
from data_tools.simulator.lights import Signal, map_of, signals_of
from data_tools.simulator.occlusion import visible_share
from data_tools.simulator.pedestrians import walk
from data_tools.simulator.roadworks import draw_cones
from data_tools.simulator.scenario import Scenario, draw_scenario
from data_tools.simulator.settings import SimulatorSettings
from data_tools.simulator.surroundings import draw_surroundings
from data_tools.simulator.towing import parted
from data_tools.simulator.traffic import Traffic, TrafficHistory, drive
from data_tools.simulator.trajectories import Trajectories, standing, together
from saga_fg.numerics.arrays import BoolArray, FloatArray, StrArray
from saga_fg.numerics.geometry import yaw_transform
from saga_fg.types.boxes import Boxes
from saga_fg.types.road_map import RoadMap

FURNISHED = (-300.0, 400.0)  # m around the place where traffic is disturbed
WALKED = (-150.0, 100.0)
UPSTREAM = (15.0, 140.0)  # m before that place, where the ego vehicle starts
OCCLUDER_MARGIN = 20.0  # m, half the length of the largest occluder and more


@dataclass(frozen=True, eq=False)
class World:
    """objects: all that can be seen and annotated; occluders: what only hides; ego: the vehicle that looks.

    signals: the traffic lights; road_map: what frames bring along of them and of the lanes, if anything; scenario: what
    all this was made from; history: how the vehicles drove
    """

    objects: Trajectories
    occluders: Boxes
    ego: Trajectories
    signals: tuple[Signal, ...]
    road_map: RoadMap | None
    scenario: Scenario
    history: TrafficHistory

    @property
    def start(self) -> float:
        """Time of the first moment, s."""
        return float(self.objects.time[0])

    def ego_pose(self, time: float) -> FloatArray:
        """world_T_ego (4, 4) at `time`, on the ground z = 0 below the middle of the vehicle."""
        boxes, _ = self.ego.at(time)
        return yaw_transform(float(boxes.position[0, 0]), float(boxes.position[0, 1]), 0.0, float(boxes.yaw[0]))

    def seen_from(self, point: FloatArray, time: float, reach: float) -> tuple[Boxes, BoolArray, FloatArray]:
        """What stands within `reach`, m, of a point (3,) at `time`.

        Returns all N objects, which of them are so near (N,), and the visible share of these.
        """
        boxes, present = self.objects.at(time)
        near = present & (np.linalg.norm(boxes.position[:, :2] - point[:2], axis=1) <= reach)
        away = np.linalg.norm(self.occluders.position[:, :2] - point[:2], axis=1)
        around = Boxes.concatenate([boxes.select(near), self.occluders.select(away <= reach + OCCLUDER_MARGIN)])
        return boxes, near, visible_share(point, around, np.arange(int(near.sum())))


def build_world(settings: SimulatorSettings, seed: int) -> World:
    """The world of one scene: the same for the same seed, whatever the sensors."""
    streams = np.random.default_rng(seed).spawn(8)
    scenario = draw_scenario(settings, streams[0])
    history = simulate_traffic(scenario, settings, streams[1])
    vehicles, trailers = parted(vehicle_trajectories(scenario, history), scenario.lanes, history, scenario.trailer)
    ego = choose_ego(scenario, history, streams[2])
    around = draw_surroundings(
        scenario.lanes.road,
        scenario.edges,
        scenario.hedge,
        (scenario.focus + FURNISHED[0], scenario.focus + FURNISHED[1]),
        (scenario.lanes.ending < 0, True),
        settings.surroundings,
        streams[3],
    )
    walked = (scenario.focus + WALKED[0], scenario.focus + WALKED[1])
    people = walk(scenario.lanes.road, around.pavements, walked, history.time, settings.pedestrians, streams[4])
    parked = standing(_ids("parked", len(around.parked)), around.parked, history.time)
    others = vehicles.select(np.delete(np.arange(len(vehicles)), ego))
    riders = ride(scenario.lanes.road, scenario.edges, walked, history.time, settings.cyclists, streams[5])
    boxes = draw_cones(scenario.lanes, settings.roadworks, streams[6])
    cones = standing(_ids("cone", len(boxes)), boxes, history.time)
    signals = signals_of(scenario.lanes, scenario.stop_lines, settings.lights)
    road_map = None
    if settings.lights.mapped:
        road_map = map_of(scenario.lanes, scenario.focus, scenario.stop_lines, signals, settings.lights, streams[7])
    return World(
        together([others, trailers, people, parked, riders, cones]),
        around.occluders,
        vehicles.select(np.array([ego])),
        signals,
        road_map,
        scenario,
        history,
    )


def simulate_traffic(scenario: Scenario, settings: SimulatorSettings, rng: np.random.Generator) -> TrafficHistory:
    """Warm the traffic up, then note a little more than the scene's duration."""
    traffic = Traffic(
        scenario.lanes,
        scenario.fleet,
        scenario.lane,
        scenario.s,
        scenario.speed,
        settings.drivers,
        rng,
        scenario.stop_lines,
        scenario.slow_zones,
        settings.step,
        early=settings.roadworks.early if scenario.lanes.taper > 0 else 0.0,
    )
    for _ in range(round(settings.warm_up / settings.step)):
        traffic.step()
    return drive(traffic, int(np.ceil(settings.duration / settings.step)) + 2)


def vehicle_trajectories(scenario: Scenario, history: TrafficHistory) -> Trajectories:
    """The vehicles' motion in world coordinates, each in one piece."""
    position, heading = scenario.lanes.pose(history.lane, history.s, history.offset, history.slope)
    direction = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    fleet = scenario.fleet
    return Trajectories(
        _ids("vehicle", len(fleet)),
        fleet.label,
        fleet.size,
        history.time,
        position,
        history.speed[..., None] * direction,
        np.unwrap(heading, axis=0),
        history.on_road,
    )


def choose_ego(scenario: Scenario, history: TrafficHistory, rng: np.random.Generator) -> int:
    """One of the cars that drive towards the place where traffic is disturbed (row)."""
    lanes = scenario.lanes
    cars = (scenario.fleet.kind == CAR) & (lanes.direction[history.lane[0]] > 0) & history.on_road[0]
    ahead = scenario.focus - history.s[0]
    good = np.flatnonzero(cars & (ahead > UPSTREAM[0]) & (ahead < UPSTREAM[1]) & (history.lane[0] != lanes.ending))
    if len(good) == 0:
        return int(np.argmin(np.where(cars, np.abs(ahead - np.mean(UPSTREAM)), np.inf)))
    return int(rng.choice(good))


def _ids(kind: str, count: int) -> StrArray:
    return np.array([f"{kind}-{k:03d}" for k in range(count)], dtype=np.str_)
