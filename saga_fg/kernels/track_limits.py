"""Which tracks can go on: see `saga_fg.tracking.kinematics` and `saga_fg.tracking.relinking`."""

from __future__ import annotations

import math

import numpy as np

from saga_fg.kernels.array_types import BoolArray, FloatArray
from saga_fg.kernels.compilation import kernel


@kernel("f2 f2 f3 f3 f1 f f")
def states_within(
    position: FloatArray,
    velocity: FloatArray,
    P: FloatArray,
    P_velocity: FloatArray,
    origin: FloatArray,
    farthest: float,
    fastest: float,
) -> BoolArray:
    """(n,) which positions from `origin` (2,), velocities (n, 2) and their deviations are within limits, m and m/s."""
    n = len(position)
    within = np.empty(n, dtype=np.bool_)
    for k in range(n):
        fits = True
        for i in range(2):
            p, v = P[k, i, i], P_velocity[k, i, i]
            fits = fits and abs(position[k, i] + origin[i]) <= farthest and abs(velocity[k, i]) <= fastest
            fits = fits and p > 0 and p <= farthest**2 and v >= 0 and v <= fastest**2
        within[k] = fits
    return within


@kernel("f3 f3 f1 f1")
def log_peaks(P: FloatArray, D: FloatArray, stationary: FloatArray, log_survival: FloatArray) -> FloatArray:
    """(n,) log of the greatest density of each track, moving or stationary, times its survival."""
    n, log_2_pi = len(P), math.log(2 * math.pi)
    result = np.empty(n)
    for k in range(n):
        s = min(max(stationary[k], 0.0), 1 - 1e-9)
        one = math.log1p(-s) - 0.5 * np.log(P[k, 0, 0] * P[k, 1, 1] - P[k, 0, 1] * P[k, 0, 1])
        other = math.log(max(s, 1e-300)) - 0.5 * np.log(D[k, 0, 0] * D[k, 1, 1] - D[k, 0, 1] * D[k, 0, 1])
        high, low = max(one, other), min(one, other)
        result[k] = log_survival[k] + high + math.log1p(math.exp(low - high)) - log_2_pi
    return result
