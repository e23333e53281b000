"""Sensor and detector model of the simulator: noise, misses, false detections, occlusion.

Noise is Gaussian along the line of sight and across it, with standard deviations base + slope * range, and
independent from frame to frame. A camera's range may also drift, by a relative error for each object. A radar adds the
range rate: the velocity over ground along the line of sight; that of false detections is around 0, as of a static
object. Classes are confused independently from frame to frame. The logit of a score is, for a true detection,

    true_logit + 2 (visible share - 1) - range / 40 m + noise,          for a false one    clutter_logit + noise.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from data_tools.simulator.fleet import KINDS
from data_tools.simulator.road_users import BODY
from data_tools.simulator.settings import CLEAR_SHARE, HIDDEN_SHARE, SensorSettings
from saga_fg.numerics.arrays import BoolArray, FloatArray, StrArray
from saga_fg.numerics.geometry import transform_points, wrap_angle, yaw_of
from saga_fg.types.boxes import Boxes
from saga_fg.types.frame import Detections

CLUTTER = (("pedestrian", BODY), *((kind.label, kind.size) for kind in KINDS))
CLUTTER_SHARES = (0.4, 0.4, 0.1, 0.07, 0.03)
DRIFT_TIME = 2.0  # correlation time of the drift of a range, s
OUTAGE_DURATION = (1.0, 3.0)  # of an outage, in which no frame comes, s
FADING = 6.0  # width of the fall of the probability of detection around the reach, m


def sensor_position(sensor: SensorSettings, world_T_ego: FloatArray) -> FloatArray:
    """Position (3,) of the sensor in the world, m."""
    return np.asarray(transform_points(world_T_ego, np.array([sensor.position]))[0])


def in_view(sensor: SensorSettings, world_T_ego: FloatArray, points: FloatArray) -> BoolArray:
    """Mask (N,) of the points (N, 3), world coordinates, within the sensor's field of view and range."""
    offset = (points - sensor_position(sensor, world_T_ego))[:, :2]
    bearing = wrap_angle(np.arctan2(offset[:, 1], offset[:, 0]) - yaw_of(world_T_ego))
    near = np.linalg.norm(offset, axis=1) <= sensor.max_range
    return np.asarray(near & (np.abs(bearing) <= sensor.field_of_view / 2))


def detection_probability(sensor: SensorSettings, origin: FloatArray, boxes: Boxes, share: FloatArray) -> FloatArray:
    """Detection probability (N,) of `boxes` seen from `origin` (3,), of which a `share` (N,) is visible."""
    ramp = np.clip((share - HIDDEN_SHARE) / (CLEAR_SHARE - HIDDEN_SHARE), 0.0, 1.0)
    if sensor.resolution is not None:
        n = points_on(sensor.resolution, origin, boxes, share)
        return np.asarray(sensor.detection_probability * ramp * n**2 / (n**2 + sensor.enough_points**2))
    distance = np.linalg.norm((boxes.position - origin)[:, :2], axis=1)
    return np.asarray(sensor.detection_probability * ramp / (1 + np.exp((distance - sensor.reach) / FADING)))


def points_on(resolution: tuple[float, float], origin: FloatArray, boxes: Boxes, share: FloatArray) -> FloatArray:
    """Number (N,) of points or pixels on the visible share (N,) of the silhouettes of boxes seen from `origin` (3,)."""
    offset = (boxes.position - origin)[:, :2]
    aspect = boxes.yaw - np.arctan2(offset[:, 1], offset[:, 0])
    width = np.abs(boxes.size[:, 0] * np.sin(aspect)) + np.abs(boxes.size[:, 1] * np.cos(aspect))
    solid_angle = width * boxes.size[:, 2] / np.maximum((offset**2).sum(axis=1), 1.0)
    return np.asarray(share * solid_angle / (resolution[0] * resolution[1]))


def range_drifts(sensor: SensorSettings, time: FloatArray, objects: int, rng: np.random.Generator) -> FloatArray:
    """Relative errors (K, N) of the range of N objects at `time` (K,), s: a Gauss-Markov process for each."""
    drift = sensor.range_drift * rng.standard_normal((len(time), objects))
    kept = np.exp(-np.diff(time) / DRIFT_TIME)
    for k, share in enumerate(kept, start=1):
        drift[k] = share * drift[k - 1] + math.sqrt(1 - share**2) * drift[k]
    return drift


def outside_outages(sensor: SensorSettings, time: FloatArray, rng: np.random.Generator) -> FloatArray:
    """The times of the frames that come, of all at `time` (K,), s."""
    if sensor.outage_interval == math.inf or len(time) == 0:
        return time
    working, end = np.ones(len(time), dtype=np.bool_), time[0]
    while end <= time[-1]:
        begin = end + rng.exponential(sensor.outage_interval)
        end = begin + rng.uniform(*OUTAGE_DURATION)
        working &= (time < begin) | (time >= end)
    return time[working]


def detect(
    sensor: SensorSettings,
    world_T_ego: FloatArray,
    boxes: Boxes,
    share: FloatArray,
    rng: np.random.Generator,
    drift: FloatArray | None = None,
) -> Detections:
    """Detections of `boxes`, of which a `share` (N,) is visible, and false detections; in world coordinates.

    drift (N,): relative errors of the range, see `range_drifts`; None: no drift
    """
    origin = sensor_position(sensor, world_T_ego)
    offset = (boxes.position - origin)[:, :2]
    distance = np.linalg.norm(offset, axis=1)
    chance = detection_probability(sensor, origin, boxes, share) * in_view(sensor, world_T_ego, boxes.position)
    seen = np.flatnonzero(rng.random(len(boxes)) < chance)
    n = len(seen)
    error, line_of_sight = position_errors(sensor, offset[seen], distance[seen], rng)
    position = boxes.position[seen].copy()
    position[:, :2] += error
    if drift is not None:
        position[:, :2] += drift[seen, None] * offset[seen]
    position[:, 2] += sensor.height_noise * rng.standard_normal(n)
    velocity = np.full((n, 2), np.nan)
    if sensor.velocity_noise is not None:
        velocity = boxes.velocity[seen] + sensor.velocity_noise * rng.standard_normal((n, 2))
    logit = (
        sensor.true_logit + 2 * (share[seen] - 1) - distance[seen] / 40 + sensor.logit_noise * rng.standard_normal(n)
    )
    true = Boxes(
        _reported_classes(sensor, boxes.label[seen], rng),
        position,
        boxes.size[seen] * np.exp(sensor.size_noise * rng.standard_normal((n, 3))),
        boxes.yaw[seen] + sensor.yaw_noise * rng.standard_normal(n),
        velocity,
    )
    rate = np.sum(boxes.velocity[seen] * line_of_sight, axis=1)
    false, false_logit = _clutter(sensor, world_T_ego, rng)
    order = rng.permutation(n + len(false))
    logits = np.concatenate([logit, false_logit])
    reported = Boxes.concatenate([true, false])
    if not sensor.boxes:
        reported = replace(reported, size=np.full_like(reported.size, np.nan), yaw=np.full(len(reported), np.nan))
    rates = np.full(len(reported), np.nan)
    if sensor.range_rate_noise is not None:
        rates = np.concatenate([rate, np.zeros(len(false))])
        rates = rates + sensor.range_rate_noise * rng.standard_normal(len(rates))
    return Detections(reported, 1 / (1 + np.exp(-logits)), rates).select(order)


def position_errors(
    sensor: SensorSettings, offset: FloatArray, distance: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Random position errors (n, 2), m, and lines of sight (n, 2), at `offset` (n, 2) and `distance` (n,) from here."""
    line_of_sight = offset / np.maximum(distance, 0.1)[:, None]
    across = np.stack([-line_of_sight[:, 1], line_of_sight[:, 0]], axis=1)
    along_error = (sensor.range_noise[0] + sensor.range_noise[1] * distance) * rng.standard_normal(len(distance))
    across_error = (sensor.bearing_noise[0] + sensor.bearing_noise[1] * distance) * rng.standard_normal(len(distance))
    return along_error[:, None] * line_of_sight + across_error[:, None] * across, line_of_sight


def _reported_classes(sensor: SensorSettings, label: StrArray, rng: np.random.Generator) -> StrArray:
    """Reported classes (n,) of objects of classes `label` (n,): vehicles are confused with one another."""
    if sensor.class_accuracy == 1:
        return label
    kinds = np.array(sorted({kind.label for kind in KINDS}))
    k = np.searchsorted(kinds, label)
    known = kinds[np.minimum(k, len(kinds) - 1)] == label
    wrong = known & (rng.random(len(label)) > sensor.class_accuracy)
    other = kinds[(k + rng.integers(1, len(kinds), len(label))) % len(kinds)]
    return np.where(wrong, other, label)


def _clutter(sensor: SensorSettings, world_T_ego: FloatArray, rng: np.random.Generator) -> tuple[Boxes, FloatArray]:
    """False detections, Poisson in number and uniform over the area in view, and the logits of their scores."""
    n = int(rng.poisson(sensor.clutter_rate))
    bearing = yaw_of(world_T_ego) + sensor.field_of_view * (rng.random(n) - 0.5)
    distance = sensor.max_range * np.sqrt(rng.random(n))
    kind = rng.choice(len(CLUTTER), size=n, p=CLUTTER_SHARES)
    size = np.array([size for _, size in CLUTTER])[kind] * np.exp(0.1 * rng.standard_normal((n, 3)))
    origin = sensor_position(sensor, world_T_ego)
    position = np.column_stack(
        [
            origin[0] + distance * np.cos(bearing),
            origin[1] + distance * np.sin(bearing),
            size[:, 2] / 2 + sensor.height_noise * rng.standard_normal(n),
        ]
    )
    velocity = np.full((n, 2), np.nan)
    if sensor.velocity_noise is not None:
        velocity = sensor.velocity_noise * rng.standard_normal((n, 2))
    label = np.array([label for label, _ in CLUTTER])[kind]
    boxes = Boxes(label, position, size, rng.uniform(-np.pi, np.pi, n), velocity)
    return boxes, sensor.clutter_logit + sensor.logit_noise * rng.standard_normal(n)
