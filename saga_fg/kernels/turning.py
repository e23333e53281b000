"""Turn rates of tracks, see `saga_fg.tracking.turn_rate`, and motions along courses, `saga_fg.model.known_course`."""

from __future__ import annotations

import math

import numpy as np

from saga_fg.kernels.array_types import FloatArray, IntArray
from saga_fg.kernels.compilation import kernel

Turning = tuple[FloatArray, FloatArray, FloatArray]


@kernel("f1 f1 f3 f f1 f f")
def predicted_turning(
    heading: FloatArray,
    rate: FloatArray,
    P: FloatArray,
    dt: float,
    fading_time: FloatArray,
    deviation: float,
    least_time: float,
) -> Turning:
    """Headings, rates (n,) and covariances (n, 2, 2) after `dt` s."""
    n, variance = len(rate), deviation**2
    headings, rates, covariance = np.empty(n), np.empty(n), np.empty((n, 2, 2))
    for k in range(n):
        tau = max(fading_time[k], least_time)
        kept = math.exp(-dt / tau)
        turned = tau * (1 - kept)
        angle = (heading[k] + turned * rate[k] + math.pi) % (2 * math.pi) - math.pi
        headings[k] = -math.pi if angle >= math.pi else angle
        rates[k] = kept * rate[k]
        p, q, r, s = P[k, 0, 0], P[k, 0, 1], P[k, 1, 0], P[k, 1, 1]
        covariance[k, 0, 0] = p + turned * r + (q + turned * s) * turned
        covariance[k, 0, 0] += variance * tau * (2 * dt - tau * (3 - 4 * kept + kept**2))
        both = variance * turned * (1 - kept)
        covariance[k, 0, 1], covariance[k, 1, 0] = (q + turned * s) * kept + both, kept * (r + s * turned) + both
        covariance[k, 1, 1] = kept * s * kept + variance * (1 - kept**2)
    return headings, rates, covariance


@kernel("f1 f1 f3 i1 f1 f1 f")
def updated_turning(
    heading: FloatArray,
    rate: FloatArray,
    P: FloatArray,
    rows: IntArray,
    yaw: FloatArray,
    yaw_noise: FloatArray,
    outlier: float,
) -> Turning:
    """Headings, rates (k,) and covariances (k, 2, 2) of the tracks `rows` (k,) after headings `yaw` (k,), NaN: none."""
    k = len(rows)
    headings, rates, covariance = np.empty(k), np.empty(k), np.empty((k, 2, 2))
    for e in range(k):
        i = rows[e]
        h, p, q, r, s = heading[i], P[i, 0, 0], P[i, 0, 1], P[i, 1, 0], P[i, 1, 1]
        headings[e], rates[e] = h, rate[i]
        covariance[e, 0, 0], covariance[e, 0, 1], covariance[e, 1, 0], covariance[e, 1, 1] = p, q, r, s
        if not math.isfinite(yaw[e]):
            continue
        variance = yaw_noise[e] ** 2
        if not math.isfinite(h):
            headings[e] = yaw[e]
            covariance[e, 0, 0], covariance[e, 0, 1], covariance[e, 1, 0] = variance, 0.0, 0.0
            continue
        twice = (2 * (yaw[e] - h) + math.pi) % (2 * math.pi) - math.pi
        innovation = (-math.pi if twice >= math.pi else twice) / 2
        S = max(p + variance, (innovation / outlier) ** 2)
        g, w = p / S, r / S
        angle = (h + g * innovation + math.pi) % (2 * math.pi) - math.pi
        headings[e] = -math.pi if angle >= math.pi else angle
        rates[e] = rate[i] + w * innovation
        covariance[e, 0, 0], covariance[e, 0, 1] = p - g * p, q - g * q
        covariance[e, 1, 0], covariance[e, 1, 1] = r - w * p, s - w * q
    return headings, rates, covariance


@kernel("f1 f3 i1 f f f")
def known_turning(
    rate: FloatArray, P: FloatArray, rows: IntArray, share: float, turning: float, straight: float
) -> tuple[FloatArray, FloatArray]:
    """Rates (k,) of tracks `rows` (k,) to predict with, and their variances (k,)."""
    known, variances = np.empty(len(rows)), np.empty(len(rows))
    for e in range(len(rows)):
        w, p = rate[rows[e]], P[rows[e], 1, 1]
        one, other = p + straight**2, p + turning**2
        log_odds = math.log(share / (1 - share)) + 0.5 * math.log(one / other)
        odds = min(max(-log_odds - 0.5 * w**2 * (1 / one - 1 / other), -50.0), 50.0)
        turns = 1 / (1 + math.exp(odds))
        if_turning, if_straight = turning**2 / other, straight**2 / one
        kept = turns * if_turning + (1 - turns) * if_straight
        known[e] = w * kept
        variances[e] = p * kept + turns * (1 - turns) * (w * (if_turning - if_straight)) ** 2
    return known, variances


@kernel("f1 f1 f1 f2 f1 f1 f1 f f f3 f3")
def course_motions(
    heading: FloatArray,
    theta: FloatArray,
    lateral_noise: FloatArray,
    brake: FloatArray,
    settling: FloatArray,
    pull: FloatArray,
    scale: FloatArray,
    dt: float,
    least: float,
    F_axis: FloatArray,
    Q_axis: FloatArray,
) -> Turning:
    """F (n, 6, 6), b (n, 6), Q (n, 6, 6) of motions that turn by `theta` (n,), rad.

    F_axis, Q_axis (3, 3, 3): of one axis, along and across the heading, and across it of white noise of density 1
    """
    n = len(heading)
    F, b, Q = np.empty((n, 6, 6)), np.zeros((n, 6)), np.empty((n, 6, 6))
    ahead, aside = np.empty((2, 2)), np.empty((2, 2))
    turn, chord, faded = np.empty((2, 2)), np.empty((2, 2)), np.empty((2, 2))
    row, fades = np.empty((2, 7)), False
    for k in range(n):
        fades = fades or settling[k] > 0
    for k in range(n):
        u = math.cos(heading[k]), math.sin(heading[k])
        for p in range(2):
            for q in range(2):
                ahead[p, q] = u[p] * u[q]
                aside[p, q] = (1.0 if p == q else 0.0) - u[p] * u[q]
        for i in range(3):
            for j in range(3):
                noise = Q_axis[1, i, j] + lateral_noise[k] * Q_axis[2, i, j]
                for p in range(2):
                    for q in range(2):
                        F[k, 2 * i + p, 2 * j + q] = F_axis[0, i, j] * ahead[p, q] + F_axis[1, i, j] * aside[p, q]
                        Q[k, 2 * i + p, 2 * j + q] = scale[k] * (Q_axis[0, i, j] * ahead[p, q] + noise * aside[p, q])
        for i in range(6):
            b[k, i] = -(F[k, i, 4] * brake[k, 0] + F[k, i, 5] * brake[k, 1])
        for p in range(2):
            b[k, p] += dt * dt / 2 * (pull[k] * u[p])
            b[k, 2 + p] += dt * (pull[k] * u[p])
        half = theta[k] / 2
        share = math.sin(half) / half if half != 0 else 1.0
        c, s = math.cos(half), math.sin(half)
        chord[0, 0], chord[0, 1], chord[1, 0], chord[1, 1] = share * c, -share * s, share * s, share * c
        c, s = math.cos(theta[k]), math.sin(theta[k])
        turn[0, 0], turn[0, 1], turn[1, 0], turn[1, 1] = c, -s, s, c
        if fades:
            passed = max(settling[k] * dt, least)
            lost = -math.expm1(-passed)
            for which in range(2):
                angle = heading[k] + (half if which == 0 else theta[k]) + math.pi / 2
                less = 1 - lost / passed if which == 0 else lost
                x, y = math.cos(angle), math.sin(angle)
                m = chord if which == 0 else turn
                for q in range(2):
                    along = x * m[0, q] + y * m[1, q]
                    faded[0, q], faded[1, q] = m[0, q] - less * x * along, m[1, q] - less * y * along
                for p in range(2):
                    for q in range(2):
                        m[p, q] = faded[p, q]
        for part in range(3):
            m, first = (chord, 2) if part == 0 else (turn, 0)
            for p in range(2):
                for j in range(6):
                    row[p, j] = m[p, 0] * F[k, 2 * part, j] + m[p, 1] * F[k, 2 * part + 1, j]
                row[p, 6] = m[p, 0] * b[k, 2 * part] + m[p, 1] * b[k, 2 * part + 1]
            for p in range(2):
                for j in range(first, 6):
                    F[k, 2 * part + p, j] = row[p, j]
                b[k, 2 * part + p] = row[p, 6]
    return F, b, Q


@kernel("f1 f1 f2 f3 f f")
def mean_courses(
    yaw: FloatArray, variance: FloatArray, velocity: FloatArray, P: FloatArray, astray: float, least: float
) -> FloatArray:
    """Means (k,) of headings (k,), rad, with their variances, and the directions of velocities (k, 2) with covariances
    P (k, 2, 2), by information, where they differ by less than `astray`."""
    result = yaw.copy()
    for k in range(len(yaw)):
        x, y = velocity[k, 0], velocity[k, 1]
        square = max(x * x + y * y, least)
        off = (math.atan2(y, x) - yaw[k] + math.pi) % (2 * math.pi) - math.pi
        if abs(off) < astray:
            across = y * y * P[k, 0, 0] - x * y * (P[k, 0, 1] + P[k, 1, 0]) + x * x * P[k, 1, 1]
            result[k] += variance[k] / (variance[k] + across / square**2) * off
    return result


@kernel("f1 f1 f2 f1 f1 f f")
def course_inputs(
    heading: FloatArray,
    rate_variance: FloatArray,
    mean: FloatArray,
    settling: FloatArray,
    across: FloatArray,
    dt: float,
    correlation: float,
) -> tuple[FloatArray, FloatArray]:
    """Lateral noise (n,) and accelerations that are taken away (n, 2), of states `mean` (n, 6), see
    `saga_fg.model.known_course`."""
    n = len(heading)
    noise, brake = np.empty(n), np.zeros((n, 2))
    for k in range(n):
        c, s = math.cos(heading[k]), math.sin(heading[k])
        speed, acceleration = mean[k, 2] * c + mean[k, 3] * s, mean[k, 4] * c + mean[k, 5] * s
        if acceleration < 0 and speed + acceleration * dt < 0:
            brake[k, 0], brake[k, 1] = acceleration * c, acceleration * s
        square = mean[k, 2] ** 2 + mean[k, 3] ** 2
        noise[k] = 2 * (correlation * rate_variance[k] * square + settling[k] * across[k])
    return noise, brake
