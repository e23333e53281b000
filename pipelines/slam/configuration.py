"""The configuration of SLAM, and the options of sensors that take part."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast, get_args

import numpy as np

from data_tools.datasets.kitti.dataset import FRAME_PERIOD, read_origin, world_position
from data_tools.sensor_logs import SensorLog, kitti_sensor_log, read_sensor_log
from pipelines.config import TrackConfig, load_config
from pipelines.configuration import load_settings
from pipelines.slam.laser_slam import LaserSettings
from pipelines.slam.lidar_slam import LidarSlamSettings
from pipelines.slam.localisation import LocaliserSettings
from saga_fg.errors import InputError
from saga_fg.graph import FactorProvider
from saga_fg.model.landmarks import LandmarkDetector
from saga_fg.numerics.arrays import FloatArray
from saga_fg.settings import setting, settings_group
from saga_fg.slam.joint import JointSettings
from saga_fg.slam.sensors import SensorName, SensorSettings
from saga_fg.tracking.by_name import made_by_name, new_provider


@dataclass(frozen=True)
class SlamSettings:
    """Settings of `saga-fg slam simulated` and `saga-fg slam kitti`."""

    providers: tuple[str | FactorProvider, ...] = setting(
        (), "factor providers, MODULE:NAME or {kind: MODULE:NAME, ...settings}, asked at every pose"
    )
    landmarks: tuple[str, ...] = setting((), "your own detectors of landmarks, MODULE:NAME, asked at every pose")
    joint: JointSettings = settings_group(JointSettings, "simulated: ego path and objects together")
    sensors: SensorSettings = settings_group(SensorSettings, "kitti: GPS, IMU and wheels of the vehicle, also in a map")
    lidar: LidarSlamSettings = settings_group(LidarSlamSettings, "kitti: LiDAR SLAM, with objects")
    localisation: LocaliserSettings = settings_group(LocaliserSettings, "kitti --map: localisation in a map")
    laser: LaserSettings = settings_group(LaserSettings, "laser: planar laser and wheels")

    def new_providers(self) -> list[FactorProvider]:
        """Fresh providers. Raises `InputError` for a name that cannot be resolved."""
        return [new_provider(name) for name in self.providers]

    def new_detectors(self) -> list[LandmarkDetector]:
        """Fresh detectors of landmarks. Raises `InputError` for a name that cannot be resolved."""
        expected = "a detector of landmarks, which has a method observations"
        return [made_by_name("landmarks", name, expected) for name in self.landmarks]


@dataclass(frozen=True)
class SlamConfig(TrackConfig):
    """Configuration of SLAM with objects."""

    slam: SlamSettings = settings_group(SlamSettings, "SLAM")

    def __post_init__(self) -> None:
        if self.tracker.providers:
            raise InputError("tracker.providers: expected under slam, for a graph of vehicle and objects")


def load_laser_settings(path: Path | None = None) -> LaserSettings:
    """Settings of planar laser SLAM, with the overrides of a YAML file. Raises `InputError` naming file and key."""
    start = SlamConfig()
    return (start if path is None else load_settings(SlamConfig, path, start)).slam.laser


def load_slam_config(family: str | Path, path: Path | None = None) -> SlamConfig:
    """Return the defaults shipped for a kind of data, with the overrides of a YAML file.

    Raises `InputError` naming the file and the dotted key of an error in it.
    """
    config = SlamConfig(**vars(load_config(family)))
    return config if path is None else load_settings(SlamConfig, path, config)


GPS_NOISE, WHEELS_NOISE = 1.0, 0.05  # m and m/s, of the fixes and speeds made from GPS/IMU records


def sensor_log(
    records: Path,
    sensors: str,
    files: Sequence[str],
    seed: int,
    timestamps: FloatArray,
    origin: Callable[[], tuple[float, float, float]] | None = None,
    settings: SensorSettings | None = None,
) -> SensorLog | None:
    """Measurements of the sensors named, like "gps,imu", from KITTI's GPS/IMU records, and of files like "imu=FILE".

    timestamps: (K,) s, of the drive; origin: gives latitude, longitude (deg) and altitude (m) of the world's origin,
    asked for where fixes are so, by default where the records begin; settings: noise and places of the sensors.
    Raises `InputError` for an unknown sensor, for one that is named twice, and for a file without a row within the
    drive.
    """
    named = [one.strip() for one in sensors.split(",") if one.strip()]
    given = [one.partition("=") for one in files]
    if unfinished := [name for name, _, path in given if not path]:
        raise InputError(f"--sensor-log: expected SENSOR=FILE, such as imu=imu.csv, got {unfinished[0][:40]!r}")
    known = get_args(SensorName)
    for option, names in (("--sensors", named), ("--sensor-log", [name for name, _, _ in given])):
        for name in names:
            if name not in known:
                raise InputError(f"{option}: expected some of {', '.join(known)}, got {name[:40]!r}")
    twice = [name for name in known if (*named, *(name for name, _, _ in given)).count(name) > 1]
    if twice:
        raise InputError(f"{twice[0]}: expected either --sensors or --sensor-log, once")
    if not named and not given:
        return None
    tables: dict[SensorName, FloatArray] = {}
    if named:
        chosen = tuple(cast(SensorName, name) for name in named)
        tables |= kitti_sensor_log(records, chosen, FRAME_PERIOD, GPS_NOISE, WHEELS_NOISE, seed).tables
        if origin is not None and "gps" in tables:
            latitude, longitude, altitude = (np.array([value]) for value in read_origin(records))
            off = world_position(latitude, longitude, altitude, np.array(origin()))[0]
            tables["gps"] = tables["gps"] + np.concatenate([[0.0], off])
    for name, _, path in given:
        table = read_sensor_log(path, cast(SensorName, name), origin or (lambda: read_origin(records)))
        _check_times(path, table[:, 0], timestamps)
        tables[cast(SensorName, name)] = table
    return SensorLog({name: np.asarray(table) for name, table in tables.items()}, settings or SensorSettings())


def _check_times(path: str, times: FloatArray, timestamps: FloatArray) -> None:
    first, last = float(timestamps[0]), float(timestamps[-1])
    if not ((times >= first) & (times <= last)).any():
        got = f"rows from {times[0]:.3f} to {times[-1]:.3f} s" if len(times) else "no rows"
        raise InputError(f"{path}: time: expected rows within the drive, from {first:.3f} to {last:.3f} s, got {got}")
