"""The configuration of smoothing: that of tracking, and what is known offline only."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from pipelines.config import TrackConfig, load_config, shipped_settings
from pipelines.configuration import load_settings, read_settings
from saga_fg.model.sensor import Sensor
from saga_fg.settings import settings_group
from saga_fg.smoothing import SmoothingSettings
from saga_fg.types.by_class import DEFAULT


@dataclass(frozen=True)
class SmoothConfig:
    """Configuration of labels: the online pass in `tracking`, the rest in `smoothing`."""

    tracking: TrackConfig = settings_group(TrackConfig, "online pass: trackers and sensors")
    sensors: Mapping[str, Sensor] = settings_group(
        lambda: {DEFAULT: Sensor()},
        "models of the sensors offline, with noise as measured, without margin for association",
    )
    smoothing: SmoothingSettings = settings_group(SmoothingSettings, "smoothing of its tracks to labels")


def load_smooth_config(family: str | Path, path: Path | None = None) -> SmoothConfig:
    """The defaults shipped for a kind of data, with what a YAML file overrides; kinds are those of `load_config`.

    Raises `InputError` for a kind that has none, and naming the file and the dotted key of what is wrong in it.
    """
    shipped = shipped_settings("file" if isinstance(family, Path) else family, "smoothing")
    tracking = load_config(family)
    config = SmoothConfig(tracking=tracking, sensors=tracking.sensors)
    config = read_settings(SmoothConfig, shipped.read_text(encoding="utf-8"), shipped.name, config)
    return config if path is None else load_settings(SmoothConfig, path, config)
