"""A sensor's model from a sample: noise, calibration, detection probability and field of view, class by class.

A class with few samples takes the values of all classes together.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from saga_fg.learning.detection_sample import DetectionSample, SampledDetections, SampledObjects
from saga_fg.learning.measurement_noise import FEWEST, fit_position_noise, robust_deviation
from saga_fg.learning.score_calibration import fit_score_calibration
from saga_fg.model.sensor import NoiseModel, ScoreCalibration, Sensor
from saga_fg.model.sensor_geometry import FieldOfView
from saga_fg.types.by_class import DEFAULT

FEWEST_CHANCES = 20  # to detect an object of a class, for a detection probability of its own
FEWEST_DETECTIONS = 200  # to find the sector that a sensor does not see
BLIND = math.radians(45)  # a sector as wide as this without any detection is out of view
PRIOR_CHANCES = 4.0  # as many chances as the expected probability counts for


def fit_sensor(sample: DetectionSample, base: Sensor, gate: float) -> Sensor:
    """`base` with the values that the sample determines; gate: the largest error a match may have, m."""
    seen = sample.detections
    overall_calibration = fit_score_calibration(seen.logit, seen.true)
    calibration: dict[str, ScoreCalibration] = {DEFAULT: overall_calibration}
    for label in np.unique(seen.label).tolist():
        part = seen.select(seen.label == label)
        calibration[label] = fit_score_calibration(part.logit, part.true, overall_calibration)
    view = fit_field_of_view(seen, base.field_of_view)
    model = replace(base, calibration=calibration, field_of_view=view)
    in_view = sample.objects.select(view.holds(sample.objects.range, sample.objects.azimuth))
    overall, by_class = detection_probabilities(in_view, base.detection_probability)
    noise = fit_noise(seen, model, gate)
    return replace(model, noise=noise, detection_probability=overall, class_detection_probability=by_class)


def fit_field_of_view(sample: SampledDetections, known: FieldOfView) -> FieldOfView:
    """`known`; where that looks all around, the sector and the range of the detections."""
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


def fit_noise(sample: SampledDetections, sensor: Sensor, gate: float) -> dict[str, NoiseModel]:
    """The noise of every class with enough known errors, and of all together under `default`."""
    noise = dict(sensor.noise)
    if np.isfinite(sample.along).sum() < FEWEST:
        return noise
    noise = {DEFAULT: _class_noise(sample, sensor, gate, sensor.noise.get(DEFAULT, NoiseModel()))}
    for label in np.unique(sample.label).tolist():
        part = sample.select(sample.label == label)
        if np.isfinite(part.along).sum() >= FEWEST:
            noise[label] = _class_noise(part, sensor, gate, noise[DEFAULT])
    return noise


def detection_probabilities(objects: SampledObjects, expected: float) -> tuple[float, dict[str, float]]:
    """The share of objects in view that were detected: of all, and of each class that was often in view."""

    def share(part: SampledObjects, prior: float) -> float:
        return float((part.detected.sum() + PRIOR_CHANCES * prior) / (len(part) + PRIOR_CHANCES))

    overall = share(objects, expected)
    labels, count = np.unique(objects.label, return_counts=True)
    often = labels[count >= FEWEST_CHANCES].tolist()
    return overall, {label: share(objects.select(objects.label == label), overall) for label in often}


def _class_noise(sample: SampledDetections, sensor: Sensor, gate: float, prior: NoiseModel) -> NoiseModel:
    known = np.isfinite(sample.along)
    p = sensor.calibrated(sample.logit, sample.label)
    noise = fit_position_noise(sample.along[known], sample.across[known], sample.range[known], p[known], gate, prior)
    others = {
        "velocity": robust_deviation(sample.velocity.ravel()),
        "yaw": robust_deviation(sample.yaw),
        "height": robust_deviation(sample.height),
    }
    return replace(noise, **{name: max(value, 0.01) for name, value in others.items() if not math.isnan(value)})
