"""Sensors' models and process noise from recordings, with ground truth or without.

With ground truth, detections are compared with the true objects next to them. Without, the tracker with the present
settings assigns detections to objects; then once more with the settings learned from that.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

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
    measured_trajectories,
    sample_with_tracker,
    sample_with_truth,
)
from saga_fg.model.motion import ConstantVelocity, Curvilinear, Motion
from saga_fg.model.sensor import NoiseModel, Sensor, sensor_model
from saga_fg.tracking import ClassSettings, Tracker
from saga_fg.types.by_class import DEFAULT, class_settings
from saga_fg.types.dataset import Dataset, Scene

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
    samples: dict[str, list[DetectionSample]] = {}
    kept, groups = list(scenes), config.tracker.class_groups
    for scene in kept:
        for name, sample in sample_with_truth(scene, config.sensors, groups=groups).items():
            samples.setdefault(name, []).append(sample)
    pooled = {name: DetectionSample.pool(parts) for name, parts in samples.items()}
    learned = {name: fit_sensor(sample, sensor_model(config.sensors, name), GATE) for name, sample in pooled.items()}
    for name, tables in (learn_confusion(kept, config.sensors, groups) if groups else {}).items():
        learned[name] = replace(learned[name], confusion={**learned[name].confusion, **tables})
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
