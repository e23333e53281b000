"""Simulated scenes: frames of the ego vehicle's sensors, and ground truth."""

from __future__ import annotations

import zlib

import numpy as np

from data_tools.simulator.annotation import annotate
from data_tools.simulator.lights import detect_lights
from data_tools.simulator.sensed_world import SensedWorld
from data_tools.simulator.sensors import detect, outside_outages, range_drifts, sensor_position
from data_tools.simulator.settings import SimulatorSettings
from data_tools.simulator.world import build_world
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.types.dataset import Scene
from saga_fg.types.frame import Detections, Frame

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
        self._settings = settings or SimulatorSettings()
        self._seeds = {
            f"scene-{k + 1:04d}": int(np.random.SeedSequence([seed, k]).generate_state(1)[0]) for k in range(scenes)
        }

    @property
    def settings(self) -> SimulatorSettings:
        """The settings of all scenes."""
        return self._settings

    @property
    def scenes(self) -> tuple[str, ...]:
        """The names of the scenes."""
        return tuple(self._seeds)

    @property
    def mounts(self) -> dict[str, tuple[float, float, float]]:
        """Position of each sensor on the vehicle by its name, m."""
        return {name: sensor.position for name, sensor in self._settings.sensors.items()}

    def scene(self, name: str) -> Scene:
        """Simulate one scene; raises `InputError` for an unknown name."""
        if name not in self._seeds:
            raise InputError(f"scene {name!r}: expected one of {', '.join(self._seeds)}")
        return simulate_scene(self._settings, self._seeds[name], name)


def scene_from_world(
    world: SensedWorld, settings: SimulatorSettings, seed: int, name: str = "", epoch: float | None = None
) -> Scene:
    """Simulate the sensors in a world built with the same settings and seed; `epoch`: time of its start, s."""
    date = (EPOCH + 60.0 * (seed % 100_000) if epoch is None else epoch) - world.start
    frames = []
    for sensor_name, sensor in settings.sensors.items():
        rng = np.random.default_rng([seed, zlib.crc32(sensor_name.encode())])  # independent of the other sensors
        own = np.random.default_rng([seed, zlib.crc32(sensor_name.encode()), 1])  # the detections' noise stays
        times = world.start + _times(settings.duration, sensor.rate, sensor.offset)
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
    keyframes = world.start + _times(settings.duration, settings.keyframe_rate, 0.0)
    poses = np.array([world.ego_pose(time) for time in keyframes])
    return Scene(
        name=name or f"simulated-{seed}",
        timestamps=np.round(date + keyframes, 6),
        world_T_ego=poses,
        tokens=("",) * len(keyframes),
        frames=tuple(frames),
        ground_truth=annotate(world, keyframes, poses, settings),
    )


def _times(duration: float, rate: float, offset: float) -> FloatArray:
    """Times offset + k / rate, s, before the end."""
    return offset + np.arange(max(0, int(np.ceil((duration - offset) * rate - 1e-9)))) / rate
