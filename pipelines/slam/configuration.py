"""The configuration of SLAM: that of tracking, which registers detections, and a section of its own."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pipelines.config import TrackConfig, load_config
from pipelines.configuration import load_settings
from pipelines.slam.laser_slam import LaserSettings
from pipelines.slam.lidar_slam import LidarSlamSettings
from pipelines.slam.localisation import LocaliserSettings
from saga_fg.errors import InputError
from saga_fg.graph import FactorProvider
from saga_fg.model.landmarks.detector import LandmarkDetector
from saga_fg.settings import setting, settings_group
from saga_fg.slam.joint import JointSettings
from saga_fg.slam.sensors import SensorSettings
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
