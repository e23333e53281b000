"""Sensors' models, process noise and clock offsets from recordings, as pieces of configuration.

With ground truth, detections are compared with the true objects next to them. Without, the tracker with the present
settings assigns detections to objects; then once more with the settings learned from that.

The offsets of several scenes (`--learn-offsets`) are joined by their weights, with a deviation that allows for scenes
that differ:

    o = sum_k o_k / s_k^2 / sum_k 1 / s_k^2,   s^2 = max(1, chi^2 / (n - 1)) / sum_k 1 / s_k^2
"""

import logging
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import yaml

from pipelines.config import TrackConfig
from pipelines.tracking import Progress
from saga_fg.errors import InputError
from saga_fg.learning import (
    GATE,
    DetectedTrajectory,
    DetectionSample,
    MeasuredTrajectory,
    fit_acceleration_noise_by_class,
    fit_curvilinear_by_class,
    fit_sensor,
    fit_trajectory_noise,
    learn_confusion,
    learn_sizes,
    measured_trajectories,
    sample_with_tracker,
    sample_with_truth,
)
from saga_fg.model import ConstantVelocity, Curvilinear, Motion, NoiseModel, Sensor, sensor_model
from saga_fg.tracking import ClassSettings, SensorTime, Tracker
from saga_fg.types import DEFAULT, Dataset, Scene, class_settings

log = logging.getLogger(__name__)

PASSES = 2  # of tracking, each with the noise learned in the one before
FEW_DETECTIONS = 200  # of a sensor, that a standard deviation is known to 5 %
FEWEST_TRAJECTORIES = 5  # a class with fewer has the noise of all together


@dataclass(frozen=True, eq=False)
class LearnedNoise:
    """config: with what was learned; detections: how many of each sensor that rests on; classes: with process noise."""

    config: TrackConfig
    detections: dict[str, int]
    classes: tuple[str, ...]


def learn_noise(
    dataset: Dataset, scenes: Sequence[str], config: TrackConfig, with_truth: bool, progress: Progress | None = None
) -> LearnedNoise:
    """Learn from some scenes of a dataset, starting from `config`.

    Raises `InputError` for scenes that lack ground truth where it is asked for, or in which no sensor sees anything.
    """
    learned = LearnedNoise(config, {}, ())
    passes = 1 if with_truth else PASSES
    for k in range(passes):
        reported = _reported(dataset, scenes, f" {k + 1}/{passes}" if passes > 1 else "", progress)
        learned = _from_truth(reported, learned.config) if with_truth else _from_tracker(reported, learned.config)
    if not any(learned.detections.values()):
        raise InputError(f"{', '.join(scenes)}: expected detections to learn from, there is none")
    for name, count in learned.detections.items():
        if count < FEW_DETECTIONS:
            enough = f"from {FEW_DETECTIONS} on, a deviation is known to 5 %"
            log.warning("%s: learned from %d detections only; %s", name, count, enough)
    return learned


def _reported(dataset: Dataset, names: Sequence[str], suffix: str, progress: Progress | None) -> Iterable[Scene]:
    for done, name in enumerate(names):
        yield dataset.scene(name)
        if progress is not None:
            progress(f"learning{suffix}", done + 1, len(names))


def _from_truth(scenes: Iterable[Scene], config: TrackConfig) -> LearnedNoise:
    kept = list(scenes)
    for name, rows in learn_confusion(kept, config.sensors).items():
        sensor = replace(sensor_model(config.sensors, name), confusion=rows)
        config = replace(config, sensors={**config.sensors, name: sensor})
    classes = dict(config.tracker.classes)
    for label, size in learn_sizes(kept, config.sensors).items():
        classes[label] = replace(class_settings(classes, ClassSettings, label), typical_size=size)
    config = replace(config, tracker=replace(config.tracker, classes=classes))
    pooled = sample_with_truth(kept, config.sensors)
    learned = {name: fit_sensor(sample, sensor_model(config.sensors, name), GATE) for name, sample in pooled.items()}
    config = replace(config, sensors={**config.sensors, **learned})
    motions = learned_motions(measured_trajectories(kept, config.sensors), config)
    return _with_motions(config, motions, pooled)


def learned_motions(
    objects: Mapping[str, Sequence[MeasuredTrajectory]], config: TrackConfig
) -> dict[str, ConstantVelocity | Curvilinear]:
    """The motions of classes whose objects were measured, of the kinds that they are configured with."""
    if not any(len(found) >= 3 for same in objects.values() for found in same):
        return {}
    noise = fit_acceleration_noise_by_class(objects)
    return _of_constant_velocity(config, noise) | fit_curvilinear_by_class(objects, lambda c: _motion(config, c))


def _from_tracker(scenes: Iterable[Scene], config: TrackConfig) -> LearnedNoise:
    trajectories: list[DetectedTrajectory] = []
    samples: dict[str, list[DetectionSample]] = {}
    for scene in scenes:
        tracker = config.new_tracker("kf")
        assert isinstance(tracker, Tracker)
        found, of_sensors = sample_with_tracker(scene, tracker, config.sensors)
        trajectories += found
        for name, sample in of_sensors.items():
            samples.setdefault(name, []).append(sample)
    pooled = {name: DetectionSample.pool(parts) for name, parts in samples.items()}
    noise, process = _trajectory_noise(trajectories, config)
    sensors: dict[str, Sensor] = {}
    for name, sample in pooled.items():
        base = sensor_model(config.sensors, name)
        sensors[name] = fit_sensor(sample, replace(base, noise={**base.noise, **noise.get(name, {})}), GATE)
    config = replace(config, sensors={**config.sensors, **sensors})
    objects: dict[str, list[MeasuredTrajectory]] = {}
    for one in trajectories:
        objects.setdefault(one.label, []).append(one.measured(config.sensors))
    curvilinear = fit_curvilinear_by_class(objects, lambda c: _motion(config, c))
    return _with_motions(config, _of_constant_velocity(config, process) | curvilinear, pooled)


def _trajectory_noise(
    trajectories: Sequence[DetectedTrajectory], config: TrackConfig
) -> tuple[dict[str, dict[str, NoiseModel]], dict[str, float]]:
    """Sensor -> class -> noise, and class -> acceleration noise, of classes seen often enough and `default`."""
    labels, count = np.unique([one.label for one in trajectories], return_counts=True)
    groups = {DEFAULT: trajectories} if trajectories else {}
    for label in labels[count >= FEWEST_TRAJECTORIES].tolist():
        groups[label] = [one for one in trajectories if one.label == label]
    noise: dict[str, dict[str, NoiseModel]] = {}
    process: dict[str, float] = {}
    for label, group in groups.items():
        settings = class_settings(config.tracker.classes, ClassSettings, label)
        q = settings.motion.acceleration_noise if isinstance(settings.motion, ConstantVelocity) else 1.0
        of_sensors, process[label] = fit_trajectory_noise(
            group, config.sensors, label, q, settings.initial_speed_deviation
        )
        for name, model in of_sensors.items():
            noise.setdefault(name, {})[label] = model
    return noise, process


def _motion(config: TrackConfig, label: str) -> Motion:
    return class_settings(config.tracker.classes, ClassSettings, label).motion


def _of_constant_velocity(config: TrackConfig, noise: Mapping[str, float]) -> dict[str, ConstantVelocity | Curvilinear]:
    """The noise of the classes that move at constant velocity."""
    return {
        label: ConstantVelocity(acceleration_noise=q)
        for label, q in noise.items()
        if isinstance(_motion(config, label), ConstantVelocity)
    }


def _with_motions(
    config: TrackConfig,
    motions: Mapping[str, ConstantVelocity | Curvilinear],
    samples: dict[str, DetectionSample],
) -> LearnedNoise:
    counts = {name: len(sample.detections) for name, sample in samples.items()}
    return LearnedNoise(config.with_motions(motions), counts, tuple(motions))


DIGITS = 4


def offset_fragment(
    scenes: Iterable[Mapping[str, SensorTime]], sensors: Mapping[str, Sensor], origin: str
) -> tuple[str, dict[str, float]]:
    """The YAML text for `--config`, and the new `time_offset` (s) of each sensor that shares objects with others.

    scenes: clocks of the sensors in each; sensors: their models so far; origin: what it was learned from
    """
    found: dict[str, list[SensorTime]] = {}
    for clocks in scenes:
        for name, each in clocks.items():
            if each.objects:
                found.setdefault(name, []).append(each)
    offsets, comments = {}, []
    for name, parts in sorted(found.items()):
        offset, deviation = _joined(parts)
        offsets[name] = round(sensor_model(sensors, name).time_offset - offset, DIGITS)
        objects = sum(each.objects for each in parts)
        comments.append(f"# {name}: {-offset:+.4f} s, deviation {deviation:.4f} s, from {objects} objects in common\n")
    data = {"sensors": {name: {"time_offset": offset} for name, offset in offsets.items()}}
    head = f"# Offsets of clocks, learned from {origin}; pass it to --config.\n"
    return head + "".join(comments) + str(yaml.safe_dump(data, sort_keys=False)), offsets


def _joined(parts: list[SensorTime]) -> tuple[float, float]:
    """Weighted mean of the offsets of one sensor, s, and its standard deviation."""
    weights = [1 / each.deviation**2 for each in parts]
    total = sum(weights)
    mean = sum(w * each.offset for w, each in zip(weights, parts, strict=True)) / total
    chi2 = sum(w * (each.offset - mean) ** 2 for w, each in zip(weights, parts, strict=True))
    return mean, math.sqrt(max(1.0, chi2 / max(len(parts) - 1, 1)) / total)


LEARNED = (
    "noise",
    "calibration",
    "detection_probability",
    "class_detection_probability",
    "field_of_view",
    "confusion",
    "calibrate_noise",
)
KINDS: dict[type, str] = {ConstantVelocity: "constant_velocity", Curvilinear: "curvilinear"}


def learned_fragment(learned: LearnedNoise, origin: str) -> str:
    """The YAML text; `origin` says in its first line what it was learned from."""
    sensors = {}
    for name in learned.detections:
        values = asdict(learned.config.sensors[name])
        sensors[name] = {key: _rounded(values[key]) for key in LEARNED if values[key] != {}}
    written: dict[str, dict[str, Any]] = {}
    for label, settings in learned.config.tracker.classes.items():
        if label in learned.classes:
            assert isinstance(settings.motion, ConstantVelocity | Curvilinear)
            motion = {"kind": KINDS[type(settings.motion)], **_rounded(asdict(settings.motion))}
            written.setdefault(label, {})["motion"] = motion
        if settings.typical_size is not None:
            written.setdefault(label, {})["typical_size"] = _rounded(asdict(settings.typical_size))
    tracker: dict[str, Any] = {"classes": written} if written else {}
    data: dict[str, Any] = {"sensors": sensors, **({"tracker": tracker} if tracker else {})}
    text: str = yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=110)
    return f"# Learned by saga-fg learn noise from {origin}; pass it to --config.\n{text}"


def _rounded(value: Any) -> Any:
    """Plain numbers of a few digits."""
    if isinstance(value, dict):
        return {key: _rounded(part) for key, part in value.items()}
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value
