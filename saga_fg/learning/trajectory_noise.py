"""Noise of sensors and motion without ground truth, from the trajectories of a tracker.

    theta* = argmax_theta  sum over detections of  log( (1 - e) N( z - H m ; 0, H P H^T + R(theta) ) + e / area )

m and P are the predictions of each object's own constant-velocity filter, in which all sensors take part; theta holds
the noise of each sensor (`position`, `range_noise`, `bearing_noise`) and the acceleration's spectral density. All are
positive and sought as logarithms, with a normal prior of width 1 around what the sensors' models say. (Prediction error
decomposition; Harvey 1989, section 3.4.)

The noise of headings, heights and measured velocities, which the filter does not use, follows from differences of one
sensor's successive detections of an object, whose variance is twice that of the noise (von Neumann 1941).

Trajectories of objects in a recording without annotations: the detections that a tracker assigned to one track.

A trajectory counts as an object when it is long and was detected most of the times that it was in view; detections that
belong to no such trajectory count as false. The tracker's word stands for the truth: clutter that stays in one place
passes for an object, and an object detected only now and then for clutter.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from saga_fg.learning.labelled_scene import DetectionSample, SampledDetections, SampledObjects
from saga_fg.learning.process_noise import MeasuredTrajectory, innovation_likelihood
from saga_fg.learning.sensor_fit import FEWEST, MIN_PARAMETER, PRIOR_WIDTH, robust_deviation
from saga_fg.model import NoiseModel, Sensor, sensor_model
from saga_fg.numerics import FloatArray, IntArray, StrArray, wrap_angle
from saga_fg.tracking import Tracker
from saga_fg.types import Detections, Frame, Scene, class_settings

FEWEST_DETECTIONS = 5  # of a trajectory that counts as an object
DETECTED_SHARE = 0.5  # of the frames in which it was in view, at least


@dataclass(frozen=True, eq=False)
class DetectedTrajectory:
    """T detections of one object in order of time, world coordinates; NaN where something was not measured.

    label; sensor (T,) names; time (T,) s; position (T, 2), velocity (T, 2); origin (T, 2) places of the sensors;
    logit (T,) of the scores; yaw (T,), height (T,)
    """

    label: str
    sensor: StrArray
    time: FloatArray
    position: FloatArray
    velocity: FloatArray
    origin: FloatArray
    logit: FloatArray
    yaw: FloatArray
    height: FloatArray

    def __len__(self) -> int:
        return len(self.time)

    def measured(self, sensors: Mapping[str, Sensor]) -> MeasuredTrajectory:
        """The positions and headings, with the noise that the sensors' models give them."""
        R, yaw_noise = np.empty((len(self), 2, 2)), np.empty(len(self))
        origin = np.where(np.isfinite(self.origin), self.origin, self.position)
        for name in np.unique(self.sensor).tolist():
            rows = np.flatnonzero(self.sensor == name)
            model, label = sensor_model(sensors, name), np.full(len(rows), self.label)
            p = model.calibrated(self.logit[rows], label)
            R[rows] = model.position_covariance(label, self.position[rows], p, origin[rows])
            (yaw_noise[rows],) = model.deviations(label, "yaw")
        return MeasuredTrajectory(self.time, self.position, R, self.yaw, yaw_noise)


class _Linked(NamedTuple):
    """A frame in world coordinates, at the time of measurement, with the track (N,) of each detection, -1 for none."""

    frame: Frame
    sensor: Sensor
    time: float
    detections: Detections
    track: IntArray

    @property
    def polar(self) -> tuple[FloatArray, FloatArray]:
        """Range and azimuth of the detections from the sensor."""
        return self.sensor.polar(self.detections.boxes.position[:, :2], self.frame.world_T_ego)


def sample_with_tracker(
    scene: Scene, tracker: Tracker, sensors: Mapping[str, Sensor]
) -> tuple[list[DetectedTrajectory], dict[str, DetectionSample]]:
    """The objects that a new tracker finds in a scene, and a sample of each sensor, whose errors are not known."""
    linked = []
    for frame in scene.frames:
        tracker.step(frame)
        track, sensor = np.full(len(frame), -1, dtype=np.int64), sensor_model(sensors, frame.sensor)
        track[tracker.assignment.detection] = tracker.assignment.id
        linked.append(_Linked(frame, sensor, sensor.measured_at(frame), sensor.in_world(frame), track))
    trajectories = _trajectories(linked)
    in_view = _in_view(trajectories, linked)
    count = Counter(number for tracks, _ in in_view.values() for number in tracks.tolist())
    objects = {
        number: trajectory
        for number, trajectory in trajectories.items()
        if len(trajectory) >= max(FEWEST_DETECTIONS, DETECTED_SHARE * count[number])
    }
    ids = np.array(list(objects), dtype=np.int64)
    samples = {}
    for name in scene.sensors:
        detections = [
            SampledDetections.without_errors(
                e.detections.boxes.label, e.sensor.logit(e.detections.score), *e.polar, np.isin(e.track, ids)
            )
            for e in linked
            if e.frame.sensor == name
        ]
        tracks, seen = in_view.get(name, (ids[:0], SampledObjects.empty()))
        samples[name] = DetectionSample(SampledDetections.concatenate(detections), seen.select(np.isin(tracks, ids)))
    return list(objects.values()), samples


def _trajectories(linked: Sequence[_Linked]) -> dict[int, DetectedTrajectory]:
    """Track -> the detections linked to it."""
    if not linked:
        return {}
    parts = []
    for frame, sensor, time, detections, track in linked:
        rows = np.flatnonzero(track >= 0)
        boxes, n, origin = detections.boxes, len(rows), sensor.origin(frame)
        parts.append(
            (
                track[rows],
                boxes.label[rows],
                np.full(n, frame.sensor),
                np.full(n, time),
                boxes.position[rows, :2],
                boxes.velocity[rows],
                np.tile(np.full(2, np.nan) if origin is None else origin, (n, 1)),
                sensor.logit(detections.score[rows]),
                boxes.yaw[rows],
                boxes.position[rows, 2],
            )
        )
    track, label, *columns = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.lexsort((columns[1], track))
    found = {}
    for rows in np.split(order, np.flatnonzero(np.diff(track[order])) + 1):
        if len(rows):
            names, count = np.unique(label[rows], return_counts=True)
            columns_of = (column[rows] for column in columns)
            found[int(track[rows[0]])] = DetectedTrajectory(str(names[count.argmax()]), *columns_of)
    return found


def _in_view(
    trajectories: Mapping[int, DetectedTrajectory], linked: Sequence[_Linked]
) -> dict[str, tuple[IntArray, SampledObjects]]:
    """Sensor -> tracks (M,), and these as objects in view of the frames between their first and last detection.

    The first and last detection themselves are left out: a trajectory has them by definition.
    """
    ids = np.array(list(trajectories), dtype=np.int64)
    label = np.array([one.label for one in trajectories.values()], dtype=np.str_)
    times = np.array([entry.time for entry in linked])
    first, last = (np.array([one.time[end] for one in trajectories.values()]) for end in (0, -1))
    place = np.array(
        [[np.interp(times, one.time, one.position[:, axis]) for axis in (0, 1)] for one in trajectories.values()]
    )
    parts: dict[str, list[tuple[IntArray, SampledObjects]]] = {}
    for k, (frame, sensor, time, _, track) in enumerate(linked):
        alive = np.flatnonzero((first < time) & (time < last))
        if len(alive):
            distance, azimuth = sensor.polar(place[alive, :, k], frame.world_T_ego)
            inside = sensor.field_of_view.holds(distance, azimuth)
            rows = alive[inside]
            seen = SampledObjects(label[rows], distance[inside], azimuth[inside], np.isin(ids[rows], track))
            parts.setdefault(frame.sensor, []).append((ids[rows], seen))
    return {
        name: (np.concatenate([track for track, _ in part]), SampledObjects.concatenate([seen for _, seen in part]))
        for name, part in parts.items()
    }


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
        max(getattr(class_settings(models[name].noise, NoiseModel, label), part), MIN_PARAMETER)
        for name in fitted
        for part in POSITION
    ]
    start_logs = np.log([*start, max(acceleration_noise, MIN_PARAMETER)])

    def cost(theta: FloatArray) -> float:
        q = float(np.exp(theta[-1]))
        likelihood = innovation_likelihood(
            lengths, time, position, covariances(theta), q, initial_speed_deviation, WRONG
        )
        return float(0.5 * (((theta - start_logs) / PRIOR_WIDTH) ** 2).sum() - likelihood) / len(time)

    bounds = [(math.log(MIN_PARAMETER), math.log(30.0))] * (len(start_logs) - 1) + [(math.log(1e-3), math.log(1e2))]
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
