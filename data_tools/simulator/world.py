"""Simulated traffic as a dataset of the command: the world of a scene, its frames, its ground truth, and plain tables.

Tables (columns as in `detection_files`): detections, with colours of lights, and truth.

detections.csv   a row per detection of every sensor, world coordinates, with the pose of the vehicle
truth.csv        a row per annotated object and keyframe; `id` is its name, `visible` is 1 while a sensor sees it
"""

import hashlib
import re
import zlib
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Self

import numpy as np

from data_tools.datasets import DatasetSource, HeldScene, OpenedPart, Part, Parts, option, write_rows
from data_tools.simulator.road import CAR
from data_tools.simulator.scene_layout import SceneLayout, sample_cones, sample_layout, sample_surroundings
from data_tools.simulator.sensed_world import (
    SensedWorld,
    annotate,
    detect,
    detect_lights,
    outside_outages,
    range_drifts,
    sample_map,
    sensor_position,
    signals_of,
)
from data_tools.simulator.settings import SimulatorSettings
from data_tools.simulator.traffic import (
    SimulatedTrajectories,
    Traffic,
    TrafficHistory,
    concatenated,
    record_traffic,
    simulate_pedestrians,
    split_trailers,
    static_objects,
)
from saga_fg.errors import InputError
from saga_fg.numerics import FloatArray, StrArray, yaw_of, yaw_transform
from saga_fg.types import Dataset, Detections, Frame, Scene

SURROUNDED = (-300.0, 400.0)  # m along the road from the focus: extent of buildings, hedges, parked cars
POPULATED = (-150.0, 100.0)  # m along the road from the focus: start positions of pedestrians
UPSTREAM = (15.0, 140.0)  # m before the focus: start positions of the ego vehicle
BEFORE, ASIDE = 20.0, 2.0  # m before the focus, and beside all traffic: the mast
EARLY_MERGE = 10.0  # distance between the earliest and the latest positions of leaving the lane, m
STEP = 0.05  # integration step, s


@dataclass(frozen=True, eq=False)
class World(SensedWorld):
    """A world made from settings.

    ego      the vehicle that carries the sensors
    layout   road, lanes, disturbances and fleet
    history  states of all vehicles over time
    """

    ego: SimulatedTrajectories
    layout: SceneLayout
    history: TrafficHistory


def pose_on_ground(vehicle: SimulatedTrajectories, time: float) -> FloatArray:
    """world_T_vehicle (4, 4) of the only vehicle at `time`, on the ground z = 0 below its middle."""
    boxes, _ = vehicle.at(time)
    return yaw_transform(float(boxes.position[0, 0]), float(boxes.position[0, 1]), 0.0, float(boxes.yaw[0]))


def build_world(settings: SimulatorSettings, seed: int) -> World:
    """The world of one scene; it depends on the seed, not on the sensors."""
    streams = np.random.default_rng(seed).spawn(8)
    layout = sample_layout(settings, streams[0])
    history = simulate_traffic(layout, settings, streams[1])
    vehicles, trailers = split_trailers(vehicle_trajectories(layout, history), layout.lanes, history, layout.trailer)
    ego = choose_ego(layout, history, streams[2])
    surrounded = (layout.focus + SURROUNDED[0], layout.focus + SURROUNDED[1])
    around = sample_surroundings(layout, surrounded, settings.parking_probability, streams[3])
    populated = (layout.focus + POPULATED[0], layout.focus + POPULATED[1])
    people = simulate_pedestrians(
        layout.lanes.road, around.pavements, populated, history.time, settings.pedestrian_groups, streams[4]
    )
    parked = static_objects(_ids("parked", len(around.parked)), around.parked, history.time)
    others = vehicles if settings.mast else vehicles.select(np.delete(np.arange(len(vehicles)), ego))
    boxes = sample_cones(layout.lanes, streams[6])
    cones = static_objects(_ids("cone", len(boxes)), boxes, history.time)
    signals = signals_of(layout.lanes, layout.stop_lines)
    road_map = None
    if settings.mapped:
        road_map = sample_map(layout.lanes, layout.focus, layout.stop_lines, signals, streams[7])
    carrier = vehicles.select(np.array([ego]))
    objects = concatenated([others, trailers, people, parked, cones])
    beside = layout.lanes.road.position(np.array(layout.focus - BEFORE), np.array(layout.borders[0] - ASIDE))
    mast = yaw_transform(float(beside[0]), float(beside[1]), 0.0, 0.0)
    ego_pose = (lambda time: mast) if settings.mast else partial(pose_on_ground, carrier)
    return World(objects, around.occluders, ego_pose, signals, road_map, carrier, layout, history)


def simulate_traffic(layout: SceneLayout, settings: SimulatorSettings, rng: np.random.Generator) -> TrafficHistory:
    """Run the warm-up, then record slightly more than the scene's duration."""
    early = EARLY_MERGE if layout.lanes.taper > 0 else 0.0
    traffic = Traffic(layout, rng, STEP, early, takers=settings.traffic.takers)
    for _ in range(round(settings.warm_up / STEP)):
        traffic.step()
    return record_traffic(traffic, int(np.ceil(settings.duration / STEP)) + 2)


def vehicle_trajectories(layout: SceneLayout, history: TrafficHistory) -> SimulatedTrajectories:
    """Motion of the vehicles in world coordinates, a truck and its trailer as one object."""
    position, heading = layout.lanes.pose(history.lane, history.s, history.offset, history.slope)
    direction = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    fleet = layout.fleet
    return SimulatedTrajectories(
        id=_ids("vehicle", len(fleet)),
        label=fleet.label,
        size=fleet.size,
        time=history.time,
        position=position,
        velocity=history.speed[..., None] * direction,
        yaw=np.unwrap(heading, axis=0),
        present=history.on_road,
    )


def choose_ego(layout: SceneLayout, history: TrafficHistory, rng: np.random.Generator) -> int:
    """Row of a random car that drives towards the focus."""
    lanes = layout.lanes
    cars = (layout.fleet.kind == CAR) & (lanes.direction[history.lane[0]] > 0) & history.on_road[0]
    ahead = layout.focus - history.s[0]
    good = np.flatnonzero(cars & (ahead > UPSTREAM[0]) & (ahead < UPSTREAM[1]) & (history.lane[0] != lanes.ending))
    if len(good) == 0:
        return int(np.argmin(np.where(cars, np.abs(ahead - np.mean(UPSTREAM)), np.inf)))
    return int(rng.choice(good))


def _ids(kind: str, count: int) -> StrArray:
    return np.array([f"{kind}-{k:03d}" for k in range(count)], dtype=np.str_)


EPOCH = 1_600_000_000.0  # s, time of the scene of seed 0


def simulate_scene(settings: SimulatorSettings, seed: int, name: str = "") -> Scene:
    """Simulate one scene; the seed determines it, and its default name.

    Frames are in world coordinates and carry the pose of the vehicle. Raises `InputError` for a negative seed.
    """
    if seed < 0:
        raise InputError(f"seed: expected a number of at least 0, got {seed}")
    return scene_from_world(build_world(settings, seed), settings, seed, name)


class SimulatedTraffic:
    """A dataset of simulated scenes, each simulated when it is requested; settings and seed determine them.

    A larger dataset begins with the scenes of a smaller one. Raises `InputError` for less than one scene and
    for a negative seed.
    """

    def __init__(self, settings: SimulatorSettings | None = None, scenes: int = 4, seed: int = 0) -> None:
        for name, value, least in (("scenes", scenes, 1), ("seed", seed, 0)):
            if value < least:
                raise InputError(f"{name}: expected a number of at least {least}, got {value}")
        self.settings = settings or SimulatorSettings()
        self._seeds = {
            f"scene-{k + 1:04d}": int(np.random.SeedSequence([seed, k]).generate_state(1)[0]) for k in range(scenes)
        }
        self.scenes = tuple(self._seeds)

    @property
    def mounts(self) -> dict[str, tuple[float, float, float]]:
        """Position of each sensor on the vehicle by its name, m."""
        return {name: sensor.position for name, sensor in self.settings.sensors.items()}

    def scene(self, name: str) -> Scene:
        """Simulate one scene; raises `InputError` for an unknown name."""
        if name not in self._seeds:
            raise InputError(f"scene {name!r}: expected one of {', '.join(self._seeds)}")
        return simulate_scene(self.settings, self._seeds[name], name)


def scene_from_world(
    world: SensedWorld, settings: SimulatorSettings, seed: int, name: str = "", epoch: float | None = None
) -> Scene:
    """Simulate the sensors in a world built with the same settings and seed; `epoch`: time of its start, s."""
    date = (EPOCH + 60.0 * (seed % 100_000) if epoch is None else epoch) - world.start
    frames = []
    for sensor_name, sensor in settings.sensors.items():
        rng = np.random.default_rng([seed, zlib.crc32(sensor_name.encode())])  # independent of the other sensors
        own = np.random.default_rng([seed, zlib.crc32(sensor_name.encode()), 1])  # the detections' noise stays
        times = world.start + _sampling_times(settings.duration, sensor.rate, sensor.offset)
        times = outside_outages(sensor, times, own)
        drifts = range_drifts(sensor, times, len(world.objects), own)
        for time, drift in zip(times.tolist(), drifts, strict=True):
            pose = world.ego_pose(time)
            boxes, near, share = world.visible_from(sensor_position(sensor, pose), time, sensor.max_range)
            detections = detect(sensor, pose, boxes.select(near), share, rng, drift[near])
            lights = detect_lights(sensor, pose, world.signals, time, rng)
            if len(lights):
                detections = Detections.concatenate([detections, lights])
            frames.append(Frame(round(date + time, 6), sensor_name, detections, pose, road_map=world.road_map))
    frames.sort(key=lambda frame: (frame.timestamp, frame.sensor))
    keyframes = world.start + _sampling_times(settings.duration, settings.keyframe_rate, 0.0)
    poses = np.array([world.ego_pose(time) for time in keyframes])
    return Scene(
        name=name or f"simulated-{seed}",
        timestamps=np.round(date + keyframes, 6),
        world_T_ego=poses,
        frames=tuple(frames),
        ground_truth=annotate(world, keyframes, poses, settings),
    )


def _sampling_times(duration: float, rate: float, offset: float) -> FloatArray:
    """Times offset + k / rate, s, before the end."""
    return offset + np.arange(max(0, int(np.ceil((duration - offset) * rate - 1e-9)))) / rate


@dataclass(frozen=True, kw_only=True)
class SimulatedSource(DatasetSource):
    """Simulated traffic, whose ground truth has the hidden objects too."""

    name = "simulated"
    family = "simulated"
    example = "--scenes 2 --seed 0"
    scenes: int = option("Number of scenes.", 4, least=1)
    seed: int = option("The same seed makes the same scenes.", 0, least=0)
    simulator: SimulatorSettings | None = option("YAML file; see `saga-fg config --simulator`.", None, metavar="FILE")

    @contextmanager
    def open(self, truth: bool = False) -> Iterator[Dataset]:
        yield SimulatedTraffic(self.simulator, self.scenes, self.seed)

    def restricted(self, scenes: Collection[str]) -> Self:
        numbers = (re.fullmatch(r"scene-([0-9]{4,6})", name) for name in scenes)
        last = max((int(number[1]) for number in numbers if number), default=1)
        return replace(self, scenes=max(last, 1))

    @contextmanager
    def parts(self) -> Iterator[Parts]:
        scenes = SimulatedTraffic(self.simulator, self.scenes, self.seed).scenes
        yield Parts(scenes, (Part(name, partial(opened_scene, self, name)) for name in scenes))


@contextmanager
def opened_scene(source: SimulatedSource, name: str) -> Iterator[OpenedPart]:
    """Open one scene, which is made at the worker, with the digest of the settings, seed and name."""
    made_from = f"{source.simulator or SimulatorSettings()!r} {source.seed} {name}"
    traffic = SimulatedTraffic(source.simulator, source.scenes, source.seed)
    digests = {"simulator": hashlib.sha256(made_from.encode()).hexdigest()}
    yield OpenedPart(digests, lambda: HeldScene(traffic.scene(name)))


BOX = ("x", "y", "z", "length", "width", "height", "yaw", "vx", "vy")
DETECTIONS = (
    *("scene", "timestamp", "sensor", "label", *BOX, "range_rate", "score"),
    *("ego_x", "ego_y", "ego_z", "ego_yaw"),
)
TRUTH = ("scene", "timestamp", "id", "label", *BOX, "visible")


def write_tables(folder: Path, scene: Scene) -> None:
    """Write `detections.csv` and `truth.csv` of one simulated scene into an existing folder."""
    write_rows(folder / "detections.csv", DETECTIONS, (row for frame in scene.frames for row in _rows(scene, frame)))
    write_rows(folder / "truth.csv", TRUTH, _truth(scene))


def _rows(scene: Scene, frame: Frame) -> Iterator[list[Any]]:
    pose = frame.world_T_ego
    assert pose is not None
    ego = [*pose[:3, 3].tolist(), yaw_of(pose)]
    start = [scene.name, frame.timestamp, frame.sensor]
    boxes = frame.detections.boxes
    if len(boxes) == 0:
        yield [*start, *[None] * (len(DETECTIONS) - 7), *ego]
    numbers = np.column_stack([boxes.position, boxes.size, boxes.yaw, boxes.velocity])
    numbers = np.column_stack([numbers, frame.detections.range_rate, frame.detections.score])
    for label, values in zip(boxes.label.tolist(), numbers.tolist(), strict=True):
        yield [*start, label, *_known(values), *ego]


def _truth(scene: Scene) -> Iterator[list[Any]]:
    assert scene.ground_truth is not None
    for time, truth in zip(scene.timestamps.tolist(), scene.ground_truth, strict=True):
        boxes = truth.boxes
        numbers = np.column_stack([boxes.position, boxes.size, boxes.yaw, boxes.velocity]).tolist()
        for name, label, values, visible in zip(
            truth.id.tolist(), boxes.label.tolist(), numbers, truth.visible.tolist(), strict=True
        ):
            yield [scene.name, time, name, label, *_known(values), int(visible)]


def _known(values: list[float]) -> list[float | None]:
    return [None if value != value else value for value in values]
