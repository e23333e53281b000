"""Stationary or moving tracks, see `saga_fg.tracking.stationarity`: a probability s, a place N(a, D) beside N(m, P)."""

from __future__ import annotations

import math

import numpy as np

from saga_fg.kernels.array_types import BoolArray, FloatArray, IntArray
from saga_fg.kernels.compilation import kernel

Places = tuple[FloatArray, FloatArray, FloatArray]


@kernel("f1 f2 f3 f2 f2 f3 f3 f f f f f")
def predicted_places(
    s: FloatArray,
    place: FloatArray,
    D: FloatArray,
    position: FloatArray,
    velocity: FloatArray,
    P: FloatArray,
    P_velocity: FloatArray,
    dt: float,
    start: float,
    stop: float,
    drift: float,
    halting_speed: float,
) -> Places:
    """s (n,), a (n, 2), D (n, 2, 2) after `dt` s; start, stop: rates, 1/s."""
    n, h2 = len(s), halting_speed**2
    later, places, covariance = np.empty(n), np.empty((n, 2)), np.empty((n, 2, 2))
    for k in range(n):
        x, y = velocity[k, 0], velocity[k, 1]
        a, b, c = P_velocity[k, 0, 0] + h2, P_velocity[k, 0, 1], P_velocity[k, 1, 1] + h2
        det = a * c - b * b
        halting = stop * (h2 * math.exp(-0.5 * ((c * x * x - 2 * b * x * y + a * y * y) / det + np.log(det))))
        rate = start + halting
        balance, lost = halting / max(rate, 1e-12), -math.expm1(-rate * dt)
        halts = (1 - s[k]) * balance * lost
        later[k] = s[k] * (1 - (1 - balance) * lost) + halts
        new = halts / max(later[k], 1e-12)
        for i in range(2):
            places[k, i] = place[k, i] + new * (position[k, i] - place[k, i])
            for j in range(2):
                apart = (position[k, i] - place[k, i]) * (position[k, j] - place[k, j])
                covariance[k, i, j] = (1 - new) * D[k, i, j] + new * P[k, i, j] + new * (1 - new) * apart
            covariance[k, i, i] += drift**2 * dt
    return later, places, covariance


@kernel("f1 f2 f3 i1 f2 f3 f2 f2 f3 f3 b1 f")
def updated_places(
    s: FloatArray,
    place: FloatArray,
    D: FloatArray,
    rows: IntArray,
    z: FloatArray,
    R: FloatArray,
    position: FloatArray,
    velocity: FloatArray,
    P: FloatArray,
    P_velocity: FloatArray,
    with_velocity: BoolArray,
    most_log_odds: float,
) -> Places:
    """s (k,), a (k, 2), D (k, 2, 2) of the tracks `rows` (k,) after detections z (k, 4) of covariance R (k, 4, 4); the
    other arrays (k, ...) are of these tracks."""
    n = len(rows)
    later, places, covariance = np.empty(n), np.empty((n, 2)), np.empty((n, 2, 2))
    for k in range(n):
        i = rows[k]
        x, y = z[k, 0] - place[i, 0], z[k, 1] - place[i, 1]
        a, b, c = D[i, 0, 0] + R[k, 0, 0], D[i, 0, 1] + R[k, 0, 1], D[i, 1, 1] + R[k, 1, 1]
        det = a * c - b * b
        evidence = -0.5 * ((c * x * x - 2 * b * x * y + a * y * y) / det + np.log(det))
        for p in range(2):  # gain D S^-1
            g, h = (c * D[i, 0, p] - b * D[i, 1, p]) / det, (a * D[i, 1, p] - b * D[i, 0, p]) / det
            places[k, p] = place[i, p] + g * x + h * y
            for q in range(2):
                covariance[k, p, q] = D[i, p, q] - g * D[i, 0, q] - h * D[i, 1, q]
        for part in range(3):  # if it moves: its position; its velocity against none
            if part > 0 and not with_velocity[k]:
                break
            at = 0 if part == 0 else 2
            u, v = z[k, at], z[k, at + 1]
            a, b, c = R[k, at, at], R[k, at, at + 1], R[k, at + 1, at + 1]
            if part == 0:
                u, v = u - position[k, 0], v - position[k, 1]
                a, b, c = a + P[k, 0, 0], b + P[k, 0, 1], c + P[k, 1, 1]
            elif part == 1:
                u, v = u - velocity[k, 0], v - velocity[k, 1]
                a, b, c = a + P_velocity[k, 0, 0], b + P_velocity[k, 0, 1], c + P_velocity[k, 1, 1]
            det = a * c - b * b
            density = -0.5 * ((c * u * u - 2 * b * u * v + a * v * v) / det + np.log(det))
            evidence += density if part == 2 else -density
        before = min(max(s[i], 1e-9), 1 - 1e-9)
        odds = math.log(before / (1 - before)) + evidence
        odds = min(max(odds, -most_log_odds), most_log_odds)
        later[k] = 1 / (1 + math.exp(-odds))
    return later, places, covariance


@kernel("f1 b1 f2 f2 f3 f3 f2 f3")
def reported_moments(
    s: FloatArray,
    unseen: BoolArray,
    position: FloatArray,
    velocity: FloatArray,
    P: FloatArray,
    P_velocity: FloatArray,
    place: FloatArray,
    D: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Position, velocity (n, 2) and covariances (n, 2, 2) over both cases; positions of `unseen` (n,) tracks alone."""
    n = len(s)
    x, v = np.empty((n, 2)), np.empty((n, 2))
    X, V = np.empty((n, 2, 2)), np.empty((n, 2, 2))
    for k in range(n):
        share, still = s[k], s[k] if unseen[k] else 0.0
        for i in range(2):
            v[k, i] = velocity[k, i] - share * velocity[k, i]
            x[k, i] = position[k, i] + still * (place[k, i] - position[k, i])
            for j in range(2):
                spread = share * (1 - share) * (velocity[k, i] * velocity[k, j])
                V[k, i, j] = (1 - share) * P_velocity[k, i, j] + spread
                spread = still * (1 - still) * ((place[k, i] - position[k, i]) * (place[k, j] - position[k, j]))
                X[k, i, j] = (1 - still) * P[k, i, j] + still * D[k, i, j] + spread
    return x, v, X, V
