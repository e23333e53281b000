"""Sensors' models from samples: noise, scores, detection probability, field of view, confused classes, usual sizes.

A class with few samples takes the values of all classes together.

Measurement noise from known errors: the sensor's noise model by robust maximum likelihood.

    (along, across) ~ (1 - e) N(0, f^2 (position^2 + (range_noise r)^2)) N(0, f^2 (position^2 + (bearing_noise r)^2))
                      + e / (area of the gate),                  f = 1 + low_score_growth (1 - p)

The uniform part models wrong matches. All parameters are positive and are estimated as logarithms; a normal prior of
width 1 about the values of all classes decides where there is little data.

Score calibration: the logistic model of the probability that a detection with a given score is true.

    logit P(true) = offset + slope s,   s the logit of the score        maximum likelihood, with two weak priors:
    slope ~ N(1, 1), offset ~ N(0, 1.5^2)                               for classes with few detections

Source: Platt, Probabilistic outputs for support vector machines, 1999. Solved by Newton's method.

Confused classes, and the usual sizes of objects:

    n_cz = sum of the probabilities of detections of class z that are of objects of class c

Detections are matched to objects of their own class first, then those that are left to objects that are left, of any
class, within half the gate: reports of another class *in place of* the right one. A detection that is left *beside* one
of the right class says something else: the detector has an output for every class, and reports one object as several.
Each class of such a detector is tracked by itself, with what it says of the class; on recordings, beliefs made these
worse. So a sensor confuses classes only if more of its detections stand in place of the right one than beside it, those
that are a share `MIN_SHARE` of the detections of a class at least.

Rows are counts, which tell how frequent the classes are as well (`saga_fg.tracking.class_belief`).
"""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize

from saga_fg.errors import InputError
from saga_fg.learning.labelled_scene import GATE, DetectionSample, SampledDetections, SampledObjects, match_to_truth
from saga_fg.model import FieldOfView, NoiseModel, ScoreCalibration, Sensor, sensor_model
from saga_fg.numerics import BoolArray, FloatArray, assign
from saga_fg.tracking import ConfusedClasses, TypicalSize
from saga_fg.types import DEFAULT, Scene

PRIOR = NoiseModel(position=0.2, range_noise=0.005, bearing_noise=0.005, low_score_growth=0.3)
PRIOR_WIDTH = 1.0  # of the logarithms
WRONG = 0.05  # share of wrong matches expected
POSITION = ("position", "range_noise", "bearing_noise", "low_score_growth")
MIN_PARAMETER = 1e-4  # smaller parameters count as zero
NINE_IN_TEN = 1.6448536269514722  # standard deviations of a normal distribution
FEWEST = 10  # errors, for a standard deviation


def fit_position_noise(
    along: FloatArray,
    across: FloatArray,
    distance: FloatArray,
    probability: FloatArray,
    gate: float,
    prior: NoiseModel = PRIOR,
) -> NoiseModel:
    """`prior` with the most probable noise of positions whose errors (N,), m, and ranges (N,), m, are these.

    probability (N,): calibrated scores; gate: the largest error a match may have, m. Raises `InputError` for no error.
    """
    if len(along) == 0:
        raise InputError("along: expected at least one error")
    start = np.log([max(getattr(prior, name), MIN_PARAMETER) for name in POSITION])
    spread = 1 - probability

    odds = math.log(WRONG / (1 - WRONG))

    def cost(theta: FloatArray) -> float:
        position, range_noise, bearing_noise, low_score_growth = np.exp(theta[:4])
        wrong = 1 / (1 + math.exp(-theta[4]))
        f = 1 + low_score_growth * spread
        var_along = (f**2) * (position**2 + (range_noise * distance) ** 2)
        var_across = (f**2) * (position**2 + (bearing_noise * distance) ** 2)
        density = np.exp(-0.5 * (along**2 / var_along + across**2 / var_across)) / (
            2 * np.pi * np.sqrt(var_along * var_across)
        )
        likelihood = np.log((1 - wrong) * density + wrong / (np.pi * gate**2))
        penalty = 0.5 * (((theta[:4] - start) / PRIOR_WIDTH) ** 2).sum() + 0.5 * (theta[4] - odds) ** 2
        return float(penalty - likelihood.sum()) / len(along)

    bounds = [(math.log(MIN_PARAMETER), math.log(30.0))] * 4 + [(-7.0, 1.0)]
    found = min(
        (
            minimize(cost, np.append(first, odds), method="L-BFGS-B", bounds=bounds)
            for first in (start, *_starts(prior))
        ),
        key=lambda result: float(result.fun),
    )
    fitted = {name: float(value) for name, value in zip(POSITION, np.exp(found.x[:4]), strict=True)}
    return replace(prior, **fitted)


def _starts(prior: NoiseModel) -> list[FloatArray]:
    """Starts near a good and near a poor sensor (logarithms): the cost also has a minimum with all matches wrong."""
    low = max(prior.low_score_growth, 0.1)
    return [np.log([0.1, 0.005, 0.005, low]), np.log([0.3, 0.03, 0.01, low])]


def robust_deviation(errors: FloatArray) -> float:
    """Standard deviation of the errors (N,), NaN left out, by the 90 % quantile.

    NaN for less than ten errors. Errors of velocity and heading have long tails, which a median would ignore.
    """
    known = errors[np.isfinite(errors)]
    return float(np.quantile(np.abs(known), 0.9)) / NINE_IN_TEN if len(known) >= FEWEST else math.nan


PRIOR_MEAN = np.array([0.0, 1.0])  # offset, slope
PRIOR_PRECISION = np.array([1 / 1.5**2, 1.0])
MIN_SLOPE = 0.05  # a falling calibration is taken for one without information


def fit_score_calibration(
    logit: FloatArray, true: BoolArray, prior: ScoreCalibration | None = None
) -> ScoreCalibration:
    """The most probable calibration of detections with these logits of their scores (N,), true or not (N,).

    prior: for classes with few detections, in place of the identity.
    """
    mean = PRIOR_MEAN if prior is None else np.array([prior.offset, prior.slope])
    X = np.column_stack([np.ones(len(logit)), logit])
    y = np.asarray(true, dtype=np.float64)
    beta = mean.copy()
    for _ in range(100):
        p = 1 / (1 + np.exp(-np.clip(X @ beta, -50, 50)))
        gradient = X.T @ (y - p) - PRIOR_PRECISION * (beta - mean)
        hessian = X.T @ (X * (p * (1 - p))[:, None]) + np.diag(PRIOR_PRECISION)
        step = np.linalg.solve(hessian, gradient)
        beta = beta + step * min(1.0, 2.0 / max(float(np.abs(step).max()), 1e-12))
        if np.abs(step).max() < 1e-9:
            break
    return ScoreCalibration(slope=max(float(beta[1]), MIN_SLOPE), offset=float(beta[0]))


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
    model = replace(base, calibration=calibration, field_of_view=view, calibrate_noise=False)
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


MIN_DETECTIONS = 20.0  # expected detections of a class, for a row or a size of its own
MIN_SHARE = 0.02  # share of the detections of a class below which those of another one are chance
MIN_SPREAD = 0.05  # of sizes, relative; objects in other recordings differ by more than a few do in these


def learn_confusion(scenes: Iterable[Scene], sensors: Mapping[str, Sensor]) -> dict[str, dict[str, dict[str, float]]]:
    """Sensor -> true class -> reported class -> expected number; a sensor that confuses nothing has no rows.

    Raises `InputError` for a scene without ground truth.
    """
    instead: dict[str, dict[tuple[str, str], float]] = defaultdict(lambda: defaultdict(float))
    beside: dict[str, float] = defaultdict(float)
    for scene in scenes:
        for matched in match_to_truth(scene, sensors):
            boxes, truth, name = matched.detections.boxes, matched.annotations.boxes, matched.frame.sensor
            p = sensor_model(sensors, name).probability(matched.detections.score, boxes.label)
            free, missed = np.ones(len(boxes), dtype=bool), np.ones(len(truth), dtype=bool)
            free[matched.detection], missed[matched.truth] = False, False
            distance = np.hypot(*np.moveaxis(boxes.position[:, None, :2] - truth.position[None, :, :2], -1, 0))
            near = (distance < GATE / 2) & free[:, None] & (boxes.label[:, None] != truth.label)
            d, t = assign(distance, near & missed, unmatched=GATE)
            near[d] = False
            beside[name] += float(p[(near & ~missed).any(axis=1)].sum())
            d, t = np.append(matched.detection, d), np.append(matched.truth, t)
            for c, z, chance in zip(truth.label[t].tolist(), boxes.label[d].tolist(), p[d].tolist(), strict=True):
                instead[name][c, z] += chance
    return {name: _rows(counts, beside[name]) for name, counts in instead.items()}


def _rows(instead: Mapping[tuple[str, str], float], beside: float) -> dict[str, dict[str, float]]:
    """The rows of one sensor; beside: expected number of its detections beside one of another class."""
    total = {c: sum(n for (d, _), n in instead.items() if d == c) for c, _ in instead}
    known = [c for c in sorted(total) if total[c] >= MIN_DETECTIONS and instead[c, c] > 0]
    pairs = [(c, z) for c, z in instead if c in known and c != z and instead[c, z] >= MIN_SHARE * total[c]]
    if sum(instead[pair] for pair in pairs) <= beside:
        return {}
    mixed = [c for c in known if any(c in pair for pair in pairs)]
    return {c: {z: round(instead[c, z], 1) for z in sorted(total) if z == c or (c, z) in pairs} for c in mixed}


def learn_sizes(scenes: Iterable[Scene], sensors: Mapping[str, Sensor]) -> dict[str, TypicalSize]:
    """The sizes of the detections of each class that these sensors confuse, of an object of that class.

    Raises `InputError` for a scene without ground truth.
    """
    confused = ConfusedClasses.of(sensors, {})
    found: dict[str, list[FloatArray]] = {label: [np.empty((0, 3))] for label in confused.classes}
    for matched in (each for scene in scenes if len(confused) for each in match_to_truth(scene, sensors)):
        for name in found:
            rows = matched.detection[matched.annotations.boxes.label[matched.truth] == name]
            found[name].append(np.log(matched.detections.boxes.size[rows]))
    sizes = {}
    for name, parts in found.items():
        logs = np.concatenate(parts)
        logs = logs[np.isfinite(logs).all(axis=1)]
        if len(logs) >= MIN_DETECTIONS:
            length, width, height = np.exp(np.median(logs, axis=0)).tolist()
            sizes[name] = TypicalSize(length, width, height, max(float(np.sqrt(logs.var(axis=0).mean())), MIN_SPREAD))
    return sizes
