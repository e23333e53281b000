"""A scene: the world looked at by the sensors of the ego vehicle, with ground truth."""

from __future__ import annotations

import zlib

import numpy as np

from data_tools.simulator.annotation import annotate
from data_tools.simulator.lights import see_lights
from data_tools.simulator.sensors import observe, viewpoint
from data_tools.simulator.settings import SimulatorSettings
from data_tools.simulator.world import World, build_world
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.types.dataset import Scene
from saga_fg.types.frame import Detections, Frame

EPOCH = 1_600_000_000.0  # s, when the scene of seed 0 takes place


def simulate_scene(settings: SimulatorSettings, seed: int, name: str = "") -> Scene:
    """One scene, the same for the same settings and seed; its `name` is made from the seed unless given.

    Frames are in world coordinates and carry the pose of the vehicle. Raises `InputError` for a negative seed.
    """
    if seed < 0:
        raise InputError(f"seed: expected a number of at least 0, got {seed}")
    return scene_in(build_world(settings, seed), settings, seed, name)


def scene_in(world: World, settings: SimulatorSettings, seed: int, name: str = "") -> Scene:
    """The scene in a world that was built with the same settings and seed."""
    date = EPOCH + 60.0 * (seed % 100_000) - world.start
    frames = []
    for sensor_name, sensor in settings.sensors.items():
        rng = np.random.default_rng([seed, zlib.crc32(sensor_name.encode())])  # no sensor disturbs another
        for time in world.start + _times(settings.duration, sensor.rate, sensor.offset):
            pose = world.ego_pose(time)
            boxes, near, share = world.seen_from(viewpoint(sensor, pose), time, sensor.max_range)
            detections = observe(sensor, pose, boxes.select(near), share, rng)
            lights = see_lights(sensor, pose, world.signals, time, settings.lights, rng)
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
    """Times offset + k / rate, s, up to and without the end."""
    return offset + np.arange(max(0, int(np.ceil((duration - offset) * rate - 1e-9)))) / rate
