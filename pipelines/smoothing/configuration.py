"""The configuration of labels, and models of trackers as sensors, for labels from their tracks.

Several trackers of one recording mostly saw the same detections: their errors are one error. So each has the variance
of n sensors, and together they tell as much as one.

Scores of which all lie in [0, 1] are probabilities, whatever the detector's scores are: trackers turn them into such.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from data_tools.datasets.given_tracks import GivenTracks, sensor_names
from pipelines.config import TrackConfig, load_config, shipped_settings
from pipelines.configuration import load_settings, read_settings
from saga_fg.model import ScoreCalibration, Sensor, sensor_model
from saga_fg.settings import settings_group
from saga_fg.smoothing import SmoothingSettings
from saga_fg.types import DEFAULT


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


def for_given_tracks(config: SmoothConfig, results: GivenTracks) -> SmoothConfig:
    """The configuration with a model of each tracker, from the sensor's that it names for all others."""
    scores = [np.concatenate([each.found.score for each in result.values()]) for result in results]
    together = max((sum(name in result for result in results) for one in results for name in one), default=1)
    probable = [bool(((score >= 0) & (score <= 1)).all()) for score in scores]

    def models(sensors: Mapping[str, Sensor]) -> dict[str, Sensor]:
        named = zip(sensor_names(len(results)), probable, strict=True)
        usual = {name: _tracker(sensor_model(sensors, name), sure, together) for name, sure in named}
        return {**usual, **sensors}

    tracking = replace(config.tracking, sensors=models(config.tracking.sensors))
    return replace(config, tracking=tracking, sensors=models(config.sensors))


def _tracker(sensor: Sensor, probable: bool, count: int) -> Sensor:
    """A tracker of `count`; probable: its scores are probabilities."""
    scale = float(np.sqrt(count))
    noise = {
        label: replace(
            model,
            position=scale * model.position,
            range_noise=scale * model.range_noise,
            bearing_noise=scale * model.bearing_noise,
        )
        for label, model in sensor.noise.items()
    }
    sensor = replace(sensor, noise=noise)
    if probable and sensor.score == "logit":
        sensor = replace(sensor, score="probability", calibration={DEFAULT: ScoreCalibration()})
    return sensor
