"""Covariances in the plane, along directions and across them, and probabilities of tracks, each in one pass."""

from __future__ import annotations

import math

import numpy as np

from saga_fg.kernels.array_types import BoolArray, FloatArray, IntArray
from saga_fg.kernels.compilation import kernel


@kernel("f2 f1 f1 f1 f1 f1 f1 f3")
def measured_covariances(
    offset: FloatArray,
    own: FloatArray,
    along: FloatArray,
    across: FloatArray,
    velocity: FloatArray,
    growth: FloatArray,
    probability: FloatArray,
    reported: FloatArray,
) -> FloatArray:
    """R (m, 4, 4) of positions and velocities, see `saga_fg.model.sensor.Sensor.position_covariance`.

    offset (m, 2) from the sensor; deviations (m,): own, m, along and across the line of sight, shares of the range, and
    of the velocity; growth at low scores, probability (m,); reported (m, 2, 2), in place of the sensor's where finite
    """
    m = len(offset)
    R = np.zeros((m, 4, 4))
    for k in range(m):
        x, y = offset[k, 0], offset[k, 1]
        factor = (1 + growth[k] * (1 - probability[k])) ** 2
        isotropic = factor * (own[k] ** 2 + across[k] ** 2 * (x * x + y * y))
        ray = factor * (along[k] ** 2 - across[k] ** 2)
        if math.isfinite(reported[k, 0, 0]):
            for a in range(2):
                for b in range(2):
                    R[k, a, b] = reported[k, a, b]
        else:
            R[k, 0, 0], R[k, 1, 1] = isotropic + ray * (x * x), isotropic + ray * (y * y)
            R[k, 0, 1] = R[k, 1, 0] = ray * (x * y)
        R[k, 2, 2] = R[k, 3, 3] = factor * velocity[k] ** 2
    return R


@kernel("f3 f1 f1 f1")
def biased_covariances(P: FloatArray, yaw: FloatArray, scale: FloatArray, bias: FloatArray) -> FloatArray:
    """Reported covariances (n, 2, 2), m^2, of positions: scale^2 P + bias^2 u u^T, u the direction of the heading.

    P (n, 2, 2), yaw (n,), scale (n,) on the deviations, bias (n,) its deviation, m. Where the heading is unknown, half
    of the variance of the bias goes to each axis.
    """
    n = len(yaw)
    result = np.empty((n, 2, 2))
    for k in range(n):
        xx, xy, yy = 0.5, 0.0, 0.5
        if math.isfinite(yaw[k]):
            c, s = math.cos(yaw[k]), math.sin(yaw[k])
            xx, xy, yy = c * c, c * s, s * s
        by_scale, by_bias = scale[k] ** 2, bias[k] ** 2
        result[k, 0, 0], result[k, 0, 1] = by_scale * P[k, 0, 0] + by_bias * xx, by_scale * P[k, 0, 1] + by_bias * xy
        result[k, 1, 0], result[k, 1, 1] = by_scale * P[k, 1, 0] + by_bias * xy, by_scale * P[k, 1, 1] + by_bias * yy
    return result


@kernel("f1 f1 f1 f1 f1")
def velocities_along(
    yaw: FloatArray, speed: FloatArray, variance: FloatArray, any_way: FloatArray, lateral: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Velocities (k, 2) of a `speed` (k,) ahead with its variance (k,), and their covariances (k, 2, 2).

    Deviations (k,): `lateral` across a known yaw (k,), `any_way` where it is NaN, of a velocity that is 0 in the mean
    """
    k = len(yaw)
    velocity, P = np.zeros((k, 2)), np.zeros((k, 2, 2))
    for t in range(k):
        P[t, 0, 0] = P[t, 1, 1] = any_way[t] ** 2
        if math.isfinite(yaw[t]):
            c, s, across = math.cos(yaw[t]), math.sin(yaw[t]), lateral[t] ** 2
            along = variance[t] - across
            velocity[t, 0], velocity[t, 1] = speed[t] * c, speed[t] * s
            P[t, 0, 0], P[t, 1, 1] = across + along * (c * c), across + along * (s * s)
            P[t, 0, 1] = P[t, 1, 0] = along * (c * s)
    return velocity, P


@kernel("f1 b1 f2 f3")
def speeds_ahead(
    yaw: FloatArray, moves: BoolArray, velocity: FloatArray, P: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Headings (n,), that of the velocity (n, 2) where the yaw (n,) of one that moves is NaN; speeds along them (n,)
    and their variances (n,), of velocities with covariances P (n, 2, 2)."""
    n = len(yaw)
    heading, speed, variance = np.empty(n), np.empty(n), np.empty(n)
    for k in range(n):
        h = yaw[k]
        if moves[k] and not math.isfinite(h):
            h = math.atan2(velocity[k, 1], velocity[k, 0])
        c, s = math.cos(h), math.sin(h)
        heading[k], speed[k] = h, c * velocity[k, 0] + s * velocity[k, 1]
        variance[k] = c * c * P[k, 0, 0] + c * s * (P[k, 0, 1] + P[k, 1, 0]) + s * s * P[k, 1, 1]
    return heading, speed, variance


@kernel("f1 b1 f1 i1 f1 f f")
def existences(
    before: FloatArray,
    missed: BoolArray,
    chance: FloatArray,
    rows: IntArray,
    probability: FloatArray,
    survival: float,
    neutral: float,
) -> FloatArray:
    """Existence (n,) of tracks after a frame, see `saga_fg.tracking.existence`.

        missed: r (1 - c) / (1 - r c) survival,   detected: odds of r times p (1 - neutral) / ((1 - p) neutral)

    missed (n,) ones, by the chance (n,) to detect them; detections of a probability (k,) of the tracks `rows` (k,)
    """
    after = before.copy()
    for i in range(len(before)):
        if missed[i]:
            after[i] = before[i] * (1 - chance[i]) / max(1 - before[i] * chance[i], 1e-9) * survival
    for e in range(len(rows)):
        odds = probability[e] / (1 - probability[e]) * (1 - neutral) / neutral
        r = min(max(before[rows[e]], 1e-3), 1 - 1e-3)
        odds *= r / (1 - r)
        after[rows[e]] = min(max(odds / (1 + odds), 0.0), 0.999)
    return after
