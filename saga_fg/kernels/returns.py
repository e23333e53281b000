"""Evidence that two tracks are of one object, see `saga_fg.tracking.handover`, over all pairs that may be."""

from __future__ import annotations

import math

import numpy as np

from saga_fg.kernels.array_types import BoolArray, FloatArray, IntArray
from saga_fg.kernels.compilation import kernel


@kernel("i1 i1 i1 f1 f1 f2 f3 f2 f3 f")
def returned_pairs(
    new: IntArray,
    old: IntArray,
    group: IntArray,
    initiated: FloatArray,
    last_detected: FloatArray,
    position: FloatArray,
    P: FloatArray,
    place: FloatArray,
    D: FloatArray,
    farthest: float,
) -> tuple[IntArray, IntArray, IntArray]:
    """Rows of pairs of `new` and `old` tracks (e,), and the number (e,) of new ones of the group.

    They share a group, the old one was last detected before the new one's start, and the squared distance of their
    positions, N(position, P), or of their stationary places, N(place, D), is below `farthest`.
    """
    first, second, others = [0][:0], [0][:0], [0][:0]
    for i in new:
        alike = 0
        for j in new:
            alike += group[j] == group[i]
        for j in old:
            if group[j] != group[i] or not last_detected[j] < initiated[i]:
                continue
            for still in range(2):
                mean, covariance = (place, D) if still else (position, P)
                x, y = mean[i, 0] - mean[j, 0], mean[i, 1] - mean[j, 1]
                a = covariance[i, 0, 0] + covariance[j, 0, 0]
                b = covariance[i, 0, 1] + covariance[j, 0, 1]
                c = covariance[i, 1, 1] + covariance[j, 1, 1]
                if (c * x * x - 2 * b * x * y + a * y * y) / (a * c - b * b) < farthest:
                    first.append(i)
                    second.append(j)
                    others.append(alike)
                    break
    return np.array(first), np.array(second), np.array(others)


@kernel("f2 f3 f2 f3 b1 f3 f1 f1 f1 f2 f3")
def return_evidence(
    mean: FloatArray,
    P: FloatArray,
    old_mean: FloatArray,
    old_P: FloatArray,
    moves: BoolArray,
    V: FloatArray,
    p: FloatArray,
    s: FloatArray,
    old_s: FloatArray,
    apart: FloatArray,
    D: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Logs of `moving` and `stationary` (e,), as `saga_fg.tracking.handover` defines them.

    mean (e, 4), P (e, 4, 4): position and velocity of the new tracks, and old_... of the old ones; moves (e,): whether
    the state has a velocity; V (e, 2, 2) its prior; p, s, old_s (e,) probabilities of being stationary; apart (e, 2), D
    (e, 2, 2) of the stationary places
    """
    e = len(p)
    moving, still = np.empty(e), np.empty(e)
    log_2_pi = math.log(2 * math.pi)
    g = np.empty((2, 2))
    S = np.empty((4, 4))
    x = np.empty(4)
    for k in range(e):
        for i in range(4):
            x[i] = mean[k, i] - old_mean[k, i]
            for j in range(4):
                S[i, j] = P[k, i, j] + old_P[k, i, j]
        det = S[0, 0] * S[1, 1] - S[0, 1] * S[0, 1]
        d2 = (S[1, 1] * x[0] * x[0] - 2 * S[0, 1] * x[0] * x[1] + S[0, 0] * x[1] * x[1]) / det
        total = -0.5 * (d2 + math.log(det) + 2 * log_2_pi)
        if moves[k]:
            for i in range(2):  # the velocity given the position
                u, v = S[0, 2 + i], S[1, 2 + i]
                g[i, 0], g[i, 1] = (S[1, 1] * u - S[0, 1] * v) / det, (S[0, 0] * v - S[0, 1] * u) / det
                x[2 + i] -= g[i, 0] * x[0] + g[i, 1] * x[1]
            a = S[2, 2] - g[0, 0] * S[0, 2] - g[0, 1] * S[1, 2]
            b = S[2, 3] - g[0, 0] * S[0, 3] - g[0, 1] * S[1, 3]
            c = S[3, 3] - g[1, 0] * S[0, 3] - g[1, 1] * S[1, 3]
            det = a * c - b * b
            d2 = (c * x[2] * x[2] - 2 * b * x[2] * x[3] + a * x[3] * x[3]) / det
            prior = math.log(V[k, 0, 0] * V[k, 1, 1] - V[k, 0, 1] * V[k, 0, 1])
            total += 0.5 * (prior - d2 - math.log(det))
        prior_p = min(max(p[k], 1e-9), 1 - 1e-9)
        one, other = min(max(s[k], 0.0), 1 - 1e-9), min(max(old_s[k], 0.0), 1 - 1e-9)
        moving[k] = math.log1p(-one) + math.log1p(-other) - math.log1p(-prior_p) + total
        a, b, c = D[k, 0, 0], D[k, 0, 1], D[k, 1, 1]
        det = a * c - b * b
        u, v = apart[k, 0], apart[k, 1]
        density = -0.5 * ((c * u * u - 2 * b * u * v + a * v * v) / det + math.log(det) + 2 * log_2_pi)
        still[k] = np.log(one) + np.log(other) - math.log(prior_p) + density
    return moving, still
