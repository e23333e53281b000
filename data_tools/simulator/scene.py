"""Scenes assembled: traffic, people and surroundings simulated, looked at by sensors on one of the cars.

Annotators who see a whole recording label an object from the first moment they see it to the last, also where it is
hidden in between unless it stays hidden for long. So does the ground truth here: an object is annotated at the
keyframes at which some sensor sees enough of it, and where it is hidden for a while between two of these, always
within the annotation range.
"""

from __future__ import annotations

import numpy as np

from data_tools.simulator.fleet import CAR
from data_tools.simulator.occlusion import visible_share
from data_tools.simulator.pedestrians import walk
from data_tools.simulator.scenario import Scenario, draw_scenario
from data_tools.simulator.sensors import in_view, observe, viewpoint
from data_tools.simulator.settings import SimulatorSettings
from data_tools.simulator.surroundings import draw_surroundings
from data_tools.simulator.traffic import Traffic, TrafficHistory, drive
from data_tools.simulator.trajectories import Trajectories, standing, together
from saga_fg.arrays import BoolArray, FloatArray
from saga_fg.boxes import Boxes
from saga_fg.dataset import Annotations, Scene
from saga_fg.errors import InputError
from saga_fg.frame import Frame
from saga_fg.geometry import yaw_transform

EPOCH = 1_600_000_000.0  # s, when scenes take place


def simulate_scene(settings: SimulatorSettings, seed: int, name: str = "") -> Scene:
    """One scene, the same for the same settings and seed; its `name` is made from the seed unless given.

    Frames are in world coordinates and carry the pose of the vehicle. Times count from `EPOCH`.
    """
    streams = np.random.default_rng(seed).spawn(6)
    scenario = draw_scenario(settings, streams[0])
    history = simulate_traffic(scenario, settings, streams[1])
    vehicles = vehicle_trajectories(scenario, history)
    ego = choose_ego(scenario, history, streams[2])
    focus = (scenario.focus - 300.0, scenario.focus + 400.0)
    walkable = (scenario.lanes.ending < 0, True)
    around = draw_surroundings(
        scenario.lanes.road, scenario.edges, scenario.hedge, focus, walkable, settings.surroundings, streams[3]
    )
    near = (scenario.focus - 150.0, scenario.focus + 100.0)
    people = walk(scenario.lanes, around.pavements, near, history.time, settings.pedestrians, streams[4])
    parked = standing(_ids("parked", len(around.parked)), around.parked, history.time)
    others = vehicles.select(np.delete(np.arange(len(vehicles)), ego))
    world = _World(together([others, people, parked]), around.occluders, vehicles, ego)

    start = float(history.time[0])
    keyframes = start + _times(settings.duration, settings.keyframe_rate, 0.0)
    noise = streams[5].spawn(len(settings.sensors))
    frames = []
    for (sensor_name, sensor), rng in zip(sorted(settings.sensors.items()), noise, strict=True):
        for time in start + _times(settings.duration, sensor.rate, sensor.offset):
            pose = world.ego_pose(time)
            boxes, share = world.seen_from(viewpoint(sensor, pose), time, sensor.max_range)
            detections = observe(sensor, pose, boxes, share, rng)
            frames.append(Frame(round(EPOCH + time - start, 6), sensor_name, detections, pose))
    frames.sort(key=lambda frame: (frame.timestamp, frame.sensor))
    poses = np.array([world.ego_pose(time) for time in keyframes])
    return Scene(
        name=name or f"simulated-{seed}",
        timestamps=np.round(EPOCH + keyframes - start, 6),
        world_T_ego=poses,
        tokens=("",) * len(keyframes),
        frames=tuple(frames),
        ground_truth=_annotate(world, keyframes, poses, settings),
    )


class SimulatedTraffic:
    """A dataset of simulated scenes, made when they are asked for."""

    def __init__(self, settings: SimulatorSettings | None = None, scenes: int = 4, seed: int = 0) -> None:
        if scenes < 1:
            raise InputError(f"scenes: expected at least 1, got {scenes}")
        self._settings = settings or SimulatorSettings()
        self._seeds = {
            f"scene-{k + 1:04d}": int(np.random.SeedSequence([seed, k]).generate_state(1)[0]) for k in range(scenes)
        }

    @property
    def scenes(self) -> tuple[str, ...]:
        """The names of the scenes."""
        return tuple(self._seeds)

    def scene(self, name: str) -> Scene:
        """Simulate one scene; raises `InputError` for an unknown name."""
        if name not in self._seeds:
            raise InputError(f"scene {name!r}: expected one of {', '.join(self._seeds)}")
        return simulate_scene(self._settings, self._seeds[name], name)


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
    )
    for _ in range(round(settings.warm_up / settings.step)):
        traffic.step()
    return drive(traffic, int(np.ceil(settings.duration / settings.step)) + 2)


def vehicle_trajectories(scenario: Scenario, history: TrafficHistory) -> Trajectories:
    """The vehicles' motion in world coordinates."""
    position, heading, _ = scenario.lanes.pose(history.lane, history.s, history.offset, history.slope)
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
    good = np.flatnonzero(cars & (ahead > 15.0) & (ahead < 140.0) & (history.lane[0] != lanes.ending))
    if len(good) == 0:
        return int(np.argmin(np.where(cars, np.abs(ahead - 70.0), np.inf)))
    return int(rng.choice(good))


class _World:
    """Everything that stands and moves, at any time."""

    def __init__(self, objects: Trajectories, occluders: Boxes, vehicles: Trajectories, ego: int) -> None:
        self.objects, self.occluders = objects, occluders
        self._ego = vehicles.select(np.array([ego]))

    def ego_pose(self, time: float) -> FloatArray:
        """world_T_ego at `time`, z = 0 on the ground."""
        boxes, _ = self._ego.at(time)
        return yaw_transform(float(boxes.position[0, 0]), float(boxes.position[0, 1]), 0.0, float(boxes.yaw[0]))

    def seen_from(self, point: FloatArray, time: float, reach: float) -> tuple[Boxes, FloatArray]:
        """The objects within `reach`, m, of a point (3,), and the visible share of each."""
        boxes, _, share = self._look(point, time, reach)
        return boxes, share

    def _look(self, point: FloatArray, time: float, reach: float) -> tuple[Boxes, BoolArray, FloatArray]:
        boxes, present = self.objects.at(time)
        near = present & (np.linalg.norm(boxes.position[:, :2] - point[:2], axis=1) <= reach)
        chosen = boxes.select(near)
        hiding = np.linalg.norm(self.occluders.position[:, :2] - point[:2], axis=1) <= reach + 20.0
        everything = Boxes.concatenate([chosen, self.occluders.select(hiding)])
        return chosen, near, visible_share(point, everything, np.arange(len(chosen)))

    def shares(self, point: FloatArray, time: float, reach: float) -> FloatArray:
        """The visible share (N,) of all objects, NaN for those farther than `reach`, m, from a point (3,)."""
        _, near, share = self._look(point, time, reach)
        result = np.full(len(self.objects), np.nan)
        result[near] = share
        return result


def _annotate(
    world: _World, keyframes: FloatArray, poses: FloatArray, settings: SimulatorSettings
) -> tuple[Annotations, ...]:
    """Ground truth at the keyframes."""
    moments = [world.objects.at(time)[0] for time in keyframes]
    visible = np.zeros((len(keyframes), len(world.objects)), dtype=np.bool_)
    near = np.zeros_like(visible)
    for k, (time, pose, boxes) in enumerate(zip(keyframes, poses, moments, strict=True)):
        for sensor in settings.sensors.values():
            share = world.shares(viewpoint(sensor, pose), time, settings.annotation_range)
            visible[k] |= (share >= settings.visible_share) & in_view(sensor, pose, boxes.position)
        distance = np.linalg.norm(boxes.position[:, :2] - pose[:2, 3], axis=1)
        near[k] = distance <= settings.annotation_range
    visible &= near
    annotated = near & _bridged(keyframes, visible, settings.longest_gap)
    return tuple(
        Annotations(world.objects.id[rows], boxes.select(rows), visible[k, rows])
        for k, (boxes, rows) in enumerate(zip(moments, annotated, strict=True))
    )


def _bridged(time: FloatArray, visible: BoolArray, longest: float) -> BoolArray:
    """Where (K, N) objects are visible, or hidden between two sightings at most `longest` s apart."""
    seen = np.where(visible, time[:, None], np.nan)
    before = np.fmax.accumulate(seen, axis=0)
    after = np.fmin.accumulate(seen[::-1], axis=0)[::-1]
    with np.errstate(invalid="ignore"):
        return np.asarray(after - before <= longest + 1e-9)


def _times(duration: float, rate: float, offset: float) -> FloatArray:
    """Times offset + k / rate, s, up to and without the end."""
    return offset + np.arange(int(np.ceil((duration - offset) * rate - 1e-9))) / rate


def _ids(kind: str, count: int) -> np.ndarray[tuple[int, ...], np.dtype[np.str_]]:
    return np.array([f"{kind}-{k:03d}" for k in range(count)], dtype=np.str_)
