"""Recorded traffic as datasets of the command: trajectories are recorded, detections are made from them.

Recorded traffic seen by simulated sensors from a chosen viewpoint.

    mast        6 m above the middle of the traffic; vehicles hide those behind them
    above       100 m above the vehicles, with them: nothing is hidden, and noise does not grow with the distance
    vehicle     on the roof of one of the vehicles, that which is there longest and nearest to the middle
    X,Y,Z       a place in the world, m
    the id of a vehicle

A vehicle that carries the sensors is not among the objects, and the scene lasts as long as it is there. Noise, misses,
clutter, occlusion and annotation are the simulator's. Where the colours of lights are known they are reported as by the
signal controller, without errors: in the first frame, each second, and when one changes.
"""

from __future__ import annotations

import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np

from benchmarks.recordings.ngsim import MAPS, WINDOWS, ngsim_windows
from benchmarks.recordings.openacc import FILE, openacc_platoons
from benchmarks.recordings.traffic import PERIOD, RecordedTraffic, Recordings
from data_tools.datasets.source import ChosenScenes, DatasetSource, option
from data_tools.files import local_tree
from data_tools.simulator import SimulatorSettings
from data_tools.simulator.sensed_world import HEIGHT, SensedWorld
from data_tools.simulator.settings import SensorSettings, lidar
from data_tools.simulator.traffic import SimulatedTrajectories
from data_tools.simulator.world import scene_from_world
from saga_fg.errors import InputError, unknown_name
from saga_fg.numerics import FloatArray, yaw_transform
from saga_fg.types import MAX_POSITION, Annotations, Boxes, Detections, Frame, Scene

MAST, ABOVE, VEHICLE = "mast", "above", "vehicle"
MAST_HEIGHT, ABOVE_HEIGHT = 6.0, 100.0  # m
ABOVE_RANGE = 300.0  # m
REPORT_INTERVAL = 1.0  # s between reports of the lights


def default_sensors() -> SimulatorSettings:
    """A LiDAR, and ground truth of all objects, seen or not."""
    return SimulatorSettings(sensors={"lidar": lidar()}, annotation_range=np.inf, memory=np.inf)


def sensed_scene(traffic: RecordedTraffic, viewpoint: str, settings: SimulatorSettings | None, seed: int) -> Scene:
    """Detections of recorded traffic, and ground truth. `settings`: their sensors and what is annotated.

    Raises `InputError` for a viewpoint that is none of the above.
    """
    settings = settings or default_sensors()
    sensors, row = settings.sensors, _carrier(traffic, viewpoint)
    if row is None:
        ego, sensors = _stationary(traffic.vehicles, viewpoint, sensors)
    else:
        there = np.flatnonzero(traffic.vehicles.present[:, row])
        traffic = traffic.moments(slice(int(there[0]), int(there[-1]) + 1))
        all_of_them = traffic.vehicles
        ego = np.column_stack([all_of_them.position[:, row], all_of_them.yaw[:, row]])
        traffic = replace(traffic, vehicles=all_of_them.select(np.delete(np.arange(len(all_of_them)), row)))
    duration = PERIOD * (len(traffic) - 1) + 1e-6
    settings = replace(settings, sensors=sensors, duration=duration, keyframe_rate=1 / PERIOD)
    number = int(np.random.SeedSequence([seed, zlib.crc32(traffic.name.encode())]).generate_state(1)[0])
    time = traffic.vehicles.time

    def ego_pose(at: float) -> FloatArray:
        x, y, yaw = (float(np.interp(at, time, column)) for column in ego.T)
        return yaw_transform(x, y, 0.0, yaw)

    world = SensedWorld(traffic.vehicles, Boxes.empty(), ego_pose, (), traffic.road_map)
    scene = scene_from_world(world, settings, number, traffic.name, epoch=0.0)
    return replace(scene, frames=_with_colours(scene.frames, traffic)) if traffic.colours else scene


def true_scene(traffic: RecordedTraffic) -> Scene:
    """Ground truth alone: all vehicles, all visible."""
    vehicles, truth = traffic.vehicles, []
    for time in vehicles.time.tolist():
        boxes, present = vehicles.at(time)
        truth.append(Annotations(vehicles.id[present], boxes.select(present)))
    return Scene(traffic.name, np.round(vehicles.time, 6), ground_truth=truth)


def _carrier(traffic: RecordedTraffic, viewpoint: str) -> int | None:
    """Row of the vehicle that carries the sensors, None where none does."""
    if viewpoint in (MAST, ABOVE) or "," in viewpoint:
        return None
    vehicles, names = traffic.vehicles, tuple(traffic.vehicles.id.tolist())
    count = vehicles.present.sum(axis=0)
    if viewpoint == VEHICLE:
        away = np.hypot(*(vehicles.position.mean(axis=0) - _middle(vehicles)).T)
        row = int(np.lexsort((away, -count))[0])
    elif viewpoint in names:
        row = names.index(viewpoint)
    else:
        known = (MAST, ABOVE, VEHICLE, "X,Y,Z", *names)
        raise InputError(f"--viewpoint: {traffic.name}: {unknown_name('viewpoint', viewpoint, known)}")
    if count[row] < 2:
        raise InputError(f"--viewpoint {viewpoint}: {traffic.name}: expected a vehicle that is there for some time")
    return row


def _stationary(
    vehicles: SimulatedTrajectories, viewpoint: str, sensors: Mapping[str, SensorSettings]
) -> tuple[FloatArray, dict[str, SensorSettings]]:
    """Poses (K, 3) without a vehicle, and the sensors at the height of the viewpoint."""
    if viewpoint == ABOVE:
        return np.column_stack([vehicles.position.mean(axis=1), np.zeros(len(vehicles.time))]), {
            name: replace(
                sensor,
                position=(0.0, 0.0, ABOVE_HEIGHT),
                max_range=ABOVE_RANGE,
                reach=10 * ABOVE_RANGE,
                range_noise=(sensor.range_noise[0], 0.0),
                bearing_noise=(sensor.bearing_noise[0], 0.0),
            )
            for name, sensor in sensors.items()
        }
    x, y, z = (*_middle(vehicles), MAST_HEIGHT) if viewpoint == MAST else _place(viewpoint)
    at = {name: replace(sensor, position=(0.0, 0.0, float(z))) for name, sensor in sensors.items()}
    return np.tile([x, y, 0.0], (len(vehicles.time), 1)), at


def _middle(vehicles: SimulatedTrajectories) -> FloatArray:
    """(2,) m, of all recorded positions."""
    return np.asarray(np.median(vehicles.position[vehicles.present], axis=0))


def _place(text: str) -> tuple[float, float, float]:
    try:
        x, y, z = (float(part) for part in text.split(","))
        if not (np.abs([x, y, z]) <= MAX_POSITION).all() or z < 0:
            raise ValueError
    except ValueError:
        raise InputError(f"--viewpoint: expected X,Y,Z of finite numbers, m, Z not below 0, got {text!r:.60}") from None
    return x, y, z


def _with_colours(frames: Sequence[Frame], traffic: RecordedTraffic) -> Sequence[Frame]:
    """The frames with reports of the lights among the detections of some."""
    if traffic.road_map is None:
        return frames
    lights = {light.name: light.position for light in traffic.road_map.lights}
    names = [name for name in traffic.colours if name in lights]
    result: list[Frame] = []
    last_time, last_shown = -np.inf, [""] * len(names)
    for frame in frames:
        moment = min(int(frame.timestamp / PERIOD + 1e-6), len(traffic) - 1)
        shown = [str(traffic.colours[name][moment]) for name in names]
        if frame.timestamp - last_time >= REPORT_INTERVAL - 1e-6 or shown != last_shown:
            last_time, last_shown = frame.timestamp, shown
            lit = [k for k, colour in enumerate(shown) if colour]
            labels = [f"traffic_light_{shown[k]}" for k in lit]
            places = np.array([(*lights[names[k]], HEIGHT) for k in lit]).reshape(-1, 3)
            reports = Detections(Boxes.of(labels, places), np.ones(len(lit)))
            frame = replace(frame, detections=Detections.concatenate([frame.detections, reports]))
        result.append(frame)
    return result


_VIEWPOINT = "Place of the sensors: mast (6 m above the middle), above, vehicle, the id of one, or X,Y,Z in m."


class TrafficScenes:
    """The scenes of recorded traffic, each made when it is asked for: with detections, or of ground truth alone.

    chosen  names with commas between them, None for all
    """

    def __init__(
        self, recordings: Recordings, sense: Callable[[RecordedTraffic], Scene], chosen: str | None = None
    ) -> None:
        self.scenes, self._read, self._sense = recordings.names, recordings.read, sense
        if chosen is not None:
            self.scenes = ChosenScenes(self, chosen).scenes

    def scene(self, name: str) -> Scene:
        """Make one scene; raises `InputError` for an unknown name or a broken record."""
        return self._sense(self._recording(name))

    def true_scene(self, name: str) -> Scene:
        """Ground truth of all objects of one scene, without frames; raises as `scene`."""
        return true_scene(self._recording(name))

    def _recording(self, name: str) -> RecordedTraffic:
        if name not in self.scenes:
            raise InputError(unknown_name("recording", name, self.scenes))
        return self._read(name)


@dataclass(frozen=True, kw_only=True)
class TrafficSource(DatasetSource, ABC):
    """Recorded trajectories, and detections made from them by the sensors of the simulator."""

    family = "traffic"
    dataroot: str
    scenes: str | None = option("Recordings with commas between them; all if left out.", None)
    viewpoint: str = option(_VIEWPOINT, MAST)
    seed: int = option("The same seed makes the same detections.", 0, least=0)
    simulator: SimulatorSettings | None = option(
        "YAML file of the sensors; see `saga-fg config --simulator`. A LiDAR if left out.", None, metavar="FILE"
    )

    @abstractmethod
    def recordings(self) -> AbstractContextManager[Recordings]:
        """The recorded trajectories, for the length of a block."""

    @contextmanager
    def open(self, truth: bool = False) -> Iterator[TrafficScenes]:
        sense = partial(sensed_scene, viewpoint=self.viewpoint, settings=self.simulator, seed=self.seed)
        with self.recordings() as recordings:
            yield TrafficScenes(recordings, sense, self.scenes)


@dataclass(frozen=True, kw_only=True)
class Ngsim(TrafficSource):
    """NGSIM windows of dense traffic: a motorway, and crossings with lanes, stop lines and signals."""

    name = "benchmarks.recordings:Ngsim"
    example = "--dataroot data/ngsim --scenes USA_Lanker-2_6_T-1"
    dataroot: str = option("Folder of windows.csv.gz and maps.json.gz, or its URL.")
    road: Literal["signals", "map", "none"] = option(
        "Of the road is given: map and colours of the lights (signals), the map alone, or nothing.", "signals"
    )

    @contextmanager
    def recordings(self) -> Iterator[Recordings]:
        with local_tree(self.dataroot, [*WINDOWS, *MAPS]) as root:
            yield ngsim_windows(root, self.road)


@dataclass(frozen=True, kw_only=True)
class OpenAcc(TrafficSource):
    """OpenACC platoons of cars on test tracks, driven by people and by adaptive cruise control; needs [parquet]."""

    name = "benchmarks.recordings:OpenAcc"
    example = "--dataroot data/openacc --scenes short_setting-dynamic_part4"
    dataroot: str = option("Folder of platoons.parquet, or its URL.")
    viewpoint: str = option(_VIEWPOINT, VEHICLE)

    @contextmanager
    def recordings(self) -> Iterator[Recordings]:
        with local_tree(self.dataroot, [FILE]) as root:
            yield openacc_platoons(root)
