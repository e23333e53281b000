"""A sensor's model from what recordings show of it: noise, calibration, chance and field of view, class by class.

A class that was seldom seen takes what was found of all classes together.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from saga_fg.learning.detection_sample import DetectionSample
from saga_fg.learning.measurement_noise import FEWEST, fit_position_noise, robust_deviation
from saga_fg.learning.score_calibration import fit_score_calibration
from saga_fg.types.by_class import DEFAULT
from saga_fg.types.sensor import FieldOfView, NoiseModel, ScoreCalibration, Sensor

FEWEST_CHANCES = 20  # to see an object of a class, for a detection probability of its own
FEWEST_DETECTIONS = 200  # to tell where a sensor does not look
BLIND = math.radians(45)  # a sector as wide as this without any detection is out of view
PRIOR_CHANCES = 4.0  # as many chances as the expected probability counts for


def fit_sensor(sample: DetectionSample, base: Sensor, gate: float) -> Sensor:
    """`base` with everything that the sample tells of; gate: the largest error a match may have, m."""
    calibration: dict[str, ScoreCalibration] = {DEFAULT: fit_score_calibration(sample.logit, sample.true)}
    labels = [str(label) for label in np.unique(sample.label)]
    for label in labels:
        part = sample.of_class(label)
        calibration[label] = fit_score_calibration(part.logit, part.true, calibration[DEFAULT])
    model = replace(base, calibration=calibration, field_of_view=fit_field_of_view(sample, base.field_of_view))
    in_view = model.field_of_view.holds(sample.object_range, sample.object_azimuth)
    sample = sample.select(np.ones(len(sample), dtype=bool), in_view)
    overall, by_class = detection_probabilities(sample, base.detection_probability)
    noise = fit_noise(sample, model, gate)
    return replace(model, noise=noise, detection_probability=overall, class_detection_probability=by_class)


def fit_field_of_view(sample: DetectionSample, known: FieldOfView) -> FieldOfView:
    """`known`, or where that looks all around, the sector and the range that the detections come from."""
    if known.max_azimuth - known.min_azimuth < 2 * np.pi - 1e-6:
        return known
    azimuth = np.sort(sample.azimuth[np.isfinite(sample.azimuth)])
    if len(azimuth) < FEWEST_DETECTIONS:
        return known
    reach = min(known.max_range, 1.02 * float(sample.range[np.isfinite(sample.range)].max()))
    gap = np.diff(azimuth, append=azimuth[0] + 2 * np.pi)
    widest = int(gap.argmax())
    if gap[widest] < BLIND:
        return replace(known, max_range=reach)
    first = azimuth[(widest + 1) % len(azimuth)]
    return FieldOfView(float(first), float(first + 2 * np.pi - gap[widest]), reach)


def fit_noise(sample: DetectionSample, sensor: Sensor, gate: float) -> dict[str, NoiseModel]:
    """The noise of every class with enough known errors, and of all together under `default`."""
    noise = dict(sensor.noise)
    if np.isfinite(sample.along).sum() < FEWEST:
        return noise
    noise = {DEFAULT: _class_noise(sample, sensor, gate, sensor.noise.get(DEFAULT, NoiseModel()))}
    for label in np.unique(sample.label):
        part = sample.of_class(str(label))
        if np.isfinite(part.along).sum() >= FEWEST:
            noise[str(label)] = _class_noise(part, sensor, gate, noise[DEFAULT])
    return noise


def detection_probabilities(sample: DetectionSample, expected: float) -> tuple[float, dict[str, float]]:
    """The share of objects in view that were detected: of all, and of each class that was often in view."""

    def share(part: DetectionSample, prior: float) -> float:
        return float((part.detected.sum() + PRIOR_CHANCES * prior) / (len(part.detected) + PRIOR_CHANCES))

    overall = share(sample, expected)
    classes: Mapping[str, DetectionSample] = {
        str(label): sample.of_class(str(label)) for label in np.unique(sample.object_label)
    }
    return overall, {
        label: share(part, overall) for label, part in classes.items() if len(part.detected) >= FEWEST_CHANCES
    }


def _class_noise(sample: DetectionSample, sensor: Sensor, gate: float, prior: NoiseModel) -> NoiseModel:
    known = np.isfinite(sample.along)
    p = sensor.calibrated(sample.logit, sample.label)
    noise = fit_position_noise(sample.along[known], sample.across[known], sample.range[known], p[known], gate, prior)
    others = {
        "velocity": robust_deviation(sample.velocity.ravel()),
        "yaw": robust_deviation(sample.yaw),
        "height": robust_deviation(sample.height),
    }
    return replace(noise, **{name: max(value, 0.01) for name, value in others.items() if not math.isnan(value)})
