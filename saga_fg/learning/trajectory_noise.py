r"""Noise of sensors and motion from the trajectories of a tracker, without ground truth.

    theta* = argmax_theta  sum over detections of  log( (1 - e) N( z - H m ; 0, H P H^T + R(theta) ) + e / area )

m and P are the predictions of each object's own constant-velocity filter, in which all sensors take part; theta holds
the noise of each sensor (`position`, `range_noise`, `bearing_noise`) and the acceleration's spectral density. All are
positive and sought as logarithms, with a normal prior of width 1 around what the sensors' models say. (Prediction error
decomposition; Harvey 1989, section 3.4.)

The noise of headings, heights and measured velocities, which the filter does not use, follows from differences of one
sensor's successive detections of an object, whose variance is twice that of the noise (von Neumann 1941).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize

from saga_fg.learning.measurement_noise import FEWEST, LEAST, PRIOR_WIDTH, robust_deviation
from saga_fg.learning.process_noise import innovation_likelihood
from saga_fg.learning.tracked_trajectories import DetectedTrajectory
from saga_fg.model.sensor import NoiseModel, Sensor, sensor_model
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.geometry import wrap_angle
from saga_fg.types.by_class import class_settings

POSITION = ("position", "range_noise", "bearing_noise")
LONGEST = 40  # detections filtered in one piece: longer trajectories are cut, and side by side take less time
MOST = 4000  # detections used of a class, from evenly spread pieces
WRONG = 0.02  # share of detections that the tracker assigned to the wrong object
LONGEST_PAUSE = 0.7  # s; differences over longer times tell nothing about noise


def fit_trajectory_noise(
    trajectories: Sequence[DetectedTrajectory],
    sensors: Mapping[str, Sensor],
    label: str,
    acceleration_noise: float,
    initial_speed_deviation: float,
) -> tuple[dict[str, NoiseModel], float]:
    """The noise of each sensor for a class and the class's acceleration noise, m^2/s^3.

    trajectories: of the class; label: whose noise in the sensors' models is the start; initial_speed_deviation:
    standard deviation of a velocity component before the second detection, m/s. A sensor with fewer than ten detections
    keeps its noise.
    """
    pieces = _pieces(trajectories)
    if not pieces:
        return {}, acceleration_noise
    lengths = np.array([len(rows) for _, rows in pieces])
    time, position, origin, logit = (
        np.concatenate([getattr(one, name)[rows] for one, rows in pieces])
        for name in ("time", "position", "origin", "logit")
    )
    sensor_of = np.concatenate([one.sensor[rows] for one, rows in pieces])
    names, count = np.unique(sensor_of, return_counts=True)
    fitted = [str(name) for name, n in zip(names, count, strict=True) if n >= FEWEST]
    models = {str(name): sensor_model(sensors, str(name)) for name in names}
    origin = np.where(np.isfinite(origin), origin, position)

    def covariances(theta: FloatArray) -> FloatArray:
        R = np.zeros((len(time), 2, 2))
        for name, model in models.items():
            rows = sensor_of == name
            if name in fitted:
                at = 3 * fitted.index(name)
                values = dict(zip(POSITION, np.exp(theta[at : at + 3]).tolist(), strict=True))
                model = replace(model, noise={label: replace(class_settings(model.noise, NoiseModel, label), **values)})
            labels = np.full(int(rows.sum()), label)
            p = model.calibrated(logit[rows], labels)
            R[rows] = model.position_covariance(labels, position[rows], p, origin[rows])
        return R

    start = [
        max(getattr(class_settings(models[name].noise, NoiseModel, label), part), LEAST)
        for name in fitted
        for part in POSITION
    ]
    start_logs = np.log([*start, max(acceleration_noise, LEAST)])

    def cost(theta: FloatArray) -> float:
        q = float(np.exp(theta[-1]))
        likelihood = innovation_likelihood(
            lengths, time, position, covariances(theta), q, initial_speed_deviation, WRONG
        )
        return float(0.5 * (((theta - start_logs) / PRIOR_WIDTH) ** 2).sum() - likelihood) / len(time)

    bounds = [(math.log(LEAST), math.log(30.0))] * (len(start_logs) - 1) + [(math.log(1e-3), math.log(1e2))]
    first = np.maximum(start_logs, math.log(2e-3))  # a parameter near 0 has no slope to follow
    found = minimize(cost, first, method="L-BFGS-B", bounds=bounds, options={"maxiter": 60}).x
    noise = {}
    for k, name in enumerate(fitted):
        values = dict(zip(POSITION, np.exp(found[3 * k : 3 * k + 3]).tolist(), strict=True))
        others = _of_differences(trajectories, name, float(np.exp(found[-1])))
        noise[name] = replace(class_settings(models[name].noise, NoiseModel, label), **values, **others)
    return noise, float(np.exp(found[-1]))


def _pieces(trajectories: Sequence[DetectedTrajectory]) -> list[tuple[DetectedTrajectory, IntArray]]:
    """Rows of trajectories, at most `LONGEST` a piece and `MOST` in all, the longest pieces first."""
    pieces = [
        (one, rows)
        for one in trajectories
        for rows in np.array_split(np.arange(len(one)), math.ceil(len(one) / LONGEST))
        if len(rows) >= 3
    ]
    total = sum(len(rows) for _, rows in pieces)
    kept = pieces[:: max(1, math.ceil(total / MOST))]
    return sorted(kept, key=lambda piece: len(piece[1]), reverse=True)


def _of_differences(
    trajectories: Sequence[DetectedTrajectory], sensor: str, acceleration_noise: float
) -> dict[str, float]:
    """Standard deviations of heading, height and velocity, of those that one sensor measured often enough."""
    dt, yaw, height, velocity = ([np.empty(0)], [np.empty(0)], [np.empty(0)], [np.empty((0, 2))])
    for one in trajectories:
        rows = np.flatnonzero(one.sensor == sensor)
        near = np.diff(one.time[rows]) < LONGEST_PAUSE
        dt.append(np.diff(one.time[rows])[near])
        yaw.append(wrap_angle(2 * np.diff(one.yaw[rows])[near]) / 2)
        height.append(np.diff(one.height[rows])[near])
        velocity.append(np.diff(one.velocity[rows], axis=0)[near])
    values = {
        "yaw": robust_deviation(np.concatenate(yaw)) / math.sqrt(2),
        "height": robust_deviation(np.concatenate(height)) / math.sqrt(2),
    }
    change = robust_deviation(np.concatenate(velocity).ravel()) ** 2
    moved = acceleration_noise * float(np.concatenate(dt).mean()) if len(np.concatenate(dt)) else 0.0
    if change > 2 * moved:  # else it is the object's own motion that the differences show
        values["velocity"] = math.sqrt((change - moved) / 2)
    return {name: max(value, 0.01) for name, value in values.items() if not math.isnan(value)}
