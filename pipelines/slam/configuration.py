"""The configuration of SLAM, and the options of sensors that take part."""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast, get_args

import gtsam
import numpy as np

from data_tools.datasets.kitti.dataset import world_position
from data_tools.recordings import ScanRecording
from data_tools.sensor_logs import SensorLog, plausible_inertial, read_sensor_log
from pipelines.config import TrackConfig, load_config
from pipelines.configuration import load_settings
from pipelines.slam.drive import Origin
from pipelines.slam.laser_slam import LaserSettings
from pipelines.slam.lidar_slam import LidarSlamSettings
from pipelines.slam.localisation import LocaliserSettings
from saga_fg import InputError
from saga_fg.graph import FactorProvider
from saga_fg.model import LandmarkDetector
from saga_fg.numerics import FloatArray
from saga_fg.parts import new_part
from saga_fg.providers.vehicle_sensors import mounting
from saga_fg.settings import setting, settings_group
from saga_fg.slam.sensors import SensorName, SensorSettings


@dataclass(frozen=True)
class SlamSettings:
    """Settings of `saga-fg slam`."""

    providers: tuple[str | FactorProvider, ...] = setting(
        (), "factor providers, MODULE:NAME or {kind: MODULE:NAME, ...settings}, asked at every pose"
    )
    landmarks: tuple[str | LandmarkDetector, ...] = setting(
        (), "your own detectors of landmarks, as providers are named, asked at every pose"
    )
    sensors: SensorSettings = settings_group(SensorSettings, "scans: GPS, IMU and wheels of the vehicle, also in a map")
    lidar: LidarSlamSettings = settings_group(LidarSlamSettings, "scans: LiDAR SLAM, with objects")
    localisation: LocaliserSettings = settings_group(LocaliserSettings, "scans --map: localisation in a map")
    laser: LaserSettings = settings_group(LaserSettings, "laser: planar laser and wheels")

    def new_providers(self) -> list[FactorProvider]:
        """Fresh providers. Raises `InputError` for a name that cannot be resolved."""
        return [new_part("providers", given, FactorProvider) for given in self.providers]

    def new_detectors(self) -> list[LandmarkDetector]:
        """Fresh detectors of landmarks. Raises `InputError` for a name that cannot be resolved."""
        return [new_part("landmarks", name, LandmarkDetector) for name in self.landmarks]


@dataclass(frozen=True)
class SlamConfig(TrackConfig):
    """Configuration of SLAM with objects."""

    slam: SlamSettings = settings_group(SlamSettings, "SLAM")

    def __post_init__(self) -> None:
        if self.tracker.providers:
            raise InputError("tracker.providers: expected under slam, for a graph of vehicle and objects")


def load_slam_config(family: str | Path, path: Path | None = None) -> SlamConfig:
    """Return the defaults shipped for a kind of data, with the overrides of a YAML file.

    Raises `InputError` naming the file and the dotted key of an error in it.
    """
    config = SlamConfig(**vars(load_config(family)))
    return config if path is None else load_settings(SlamConfig, path, config)


_TILTED = 25.0  # deg, beyond which no vehicle stands or drives
_log = logging.getLogger(__name__)


def sensor_log(
    recording: ScanRecording,
    sensors: str,
    files: Sequence[str],
    settings: SensorSettings | None = None,
    origin: Callable[[], Origin] | None = None,
) -> SensorLog | None:
    """Measurements of the sensors named, like "gps,imu", of a recording, and of files like "imu=FILE".

    settings: noise and places of the sensors; where they are left as they are, places are those of the recording.
    origin: gives latitude, longitude (deg) and altitude (m) of the origin of another world than the recording's, for
    fixes. Raises `InputError` for a sensor that is unknown, named twice or not in the recording, and for a file without
    a row within the drive.
    """
    named = [one.strip() for one in sensors.split(",") if one.strip()]
    given = [one.partition("=") for one in files]
    if unfinished := [name for name, _, path in given if not path]:
        raise InputError(f"--sensor-log: expected SENSOR=FILE, such as imu=imu.csv, got {unfinished[0][:40]!r}")
    known = get_args(SensorName)
    both = [*(("--sensors", name) for name in named), *(("--sensor-log", name) for name, _, _ in given)]
    for row, (option, name) in enumerate(both):
        if name not in known:
            raise InputError(f"{option}: expected some of {', '.join(known)}, got {name[:40]!r}")
        if any(name == other for _, other in both[:row]):
            raise InputError(f"{name}: expected either --sensors or --sensor-log, once")
    if not both:
        return None
    place, tables = settings or SensorSettings(), dict[SensorName, FloatArray]()
    recorded = recording.sensors() if named else {}
    for name in named:
        if name not in recorded:
            raise InputError(
                f"--sensors {name}: expected a sensor of the recording, it has {', '.join(recorded) or 'none'}"
            )
        tables[cast(SensorName, name)] = recorded[cast(SensorName, name)]
    if origin is not None and "gps" in tables and recording.origin is not None:
        latitude, longitude, altitude = (np.array([value]) for value in recording.origin)
        off = world_position(latitude, longitude, altitude, np.array(origin()))[0]
        tables["gps"] = tables["gps"] + np.concatenate([[0.0], off])
    for name, _, path in given:
        table = read_sensor_log(path, cast(SensorName, name), origin or _origin_of(recording))
        _check_times(path, table[:, 0], recording.timestamps)
        tables[cast(SensorName, name)] = table
    place = _placed(place, recording.mounts)
    if "imu" in tables:
        tables["imu"] = plausible_inertial(tables["imu"])
        up = mounting("mounted", place.imu.mounted).matrix()[:3, :3] @ np.median(tables["imu"][:, 1:4], axis=0)
        tilt = np.degrees(np.arccos(up[2] / max(np.linalg.norm(up), 1e-9)))
        if tilt > _TILTED:
            _log.warning(
                "imu: gravity is %.0f deg off the vehicle's vertical: check where it is mounted "
                "(/tf, slam.sensors.imu), and its axes",
                tilt,
            )
    return SensorLog({name: np.asarray(table) for name, table in tables.items()}, place)


def _origin_of(recording: ScanRecording) -> Callable[[], Origin] | None:
    return None if recording.origin is None else lambda: cast(Origin, recording.origin)


def _placed(settings: SensorSettings, mounts: Mapping[SensorName, FloatArray]) -> SensorSettings:
    """The settings with the places of sensors that are left at their defaults."""
    default = SensorSettings()
    if "gps" in mounts and settings.gps.antenna == default.gps.antenna:
        x, y, z = mounts["gps"][:3, 3].tolist()
        settings = replace(settings, gps=replace(settings.gps, antenna=(x, y, z)))
    if "imu" in mounts and settings.imu.mounted == default.imu.mounted:
        yaw, pitch, roll = gtsam.Rot3(mounts["imu"][:3, :3]).ypr().tolist()
        x, y, z = mounts["imu"][:3, 3].tolist()
        settings = replace(settings, imu=replace(settings.imu, mounted=(x, y, z, roll, pitch, yaw)))
    return settings


def _check_times(path: str, times: FloatArray, timestamps: FloatArray) -> None:
    first, last = float(timestamps[0]), float(timestamps[-1])
    if not ((times >= first) & (times <= last)).any():
        got = f"rows from {times[0]:.3f} to {times[-1]:.3f} s" if len(times) else "no rows"
        raise InputError(f"{path}: time: expected rows within the drive, from {first:.3f} to {last:.3f} s, got {got}")
