"""Prior of the speeds of new tracks, see `saga_fg.tracking.speed_prior`."""

from __future__ import annotations

import math

import numpy as np

from saga_fg.kernels.array_types import FloatArray, IntArray
from saga_fg.kernels.compilation import kernel

Prior = tuple[FloatArray, FloatArray, FloatArray]


@kernel("i1 i1 f2 f1 f1 f1 f1 i1 i1 f2 f1 f1 f1 f1 i1 f2 f1 f1 f f f f f f f f")
def prior_of_traffic(
    left: IntArray,
    left_class: IntArray,
    left_position: FloatArray,
    left_heading: FloatArray,
    left_speed: FloatArray,
    left_variance: FloatArray,
    left_stationary: FloatArray,
    latest: IntArray,
    latest_class: IntArray,
    latest_position: FloatArray,
    latest_heading: FloatArray,
    latest_speed: FloatArray,
    latest_variance: FloatArray,
    latest_stationary: FloatArray,
    new_class: IntArray,
    position: FloatArray,
    heading: FloatArray,
    variance: FloatArray,
    stationary: float,
    weight: float,
    ahead_scale: float,
    lateral_scale: float,
    heading_scale: float,
    spread: float,
    most_variance: float,
    farthest: float,
) -> Prior:
    """Probability of being stationary, speed ahead and its variance (k,) of new tracks at `position` (k, 2).

    Of passages, in two sets: ids of tracks, numbers of classes, position (n, 2), heading, speed, variance, stationary
    (n,), used where the variance is below `most_variance`; of k new tracks: class, position, heading, NaN: unknown, and
    variance without neighbours; farthest: exponent from which a passage does not count
    """
    sets = (left, latest)
    classes, places, headings = (
        (left_class, latest_class),
        (left_position, latest_position),
        (left_heading, latest_heading),
    )
    speeds, variances = (left_speed, latest_speed), (left_variance, latest_variance)
    resting = (left_stationary, latest_stationary)
    k = len(new_class)
    still, mean, spreads = np.empty(k), np.empty(k), np.empty(k)
    low, high = 0, -1
    for which in range(2):
        for i in sets[which]:
            low, high = (i, i) if high < low else (min(low, i), max(high, i))
    largest = np.zeros(high - low + 1)  # of each track
    nearest = np.empty(high - low + 1, dtype=np.int64)
    for t in range(k):
        c, s = math.cos(heading[t]), math.sin(heading[t])
        largest[:] = 0.0
        for which in range(2):
            begin = which * len(left)
            for p in range(len(sets[which])):
                if classes[which][p] != new_class[t] or not variances[which][p] < most_variance:
                    continue
                x, y = places[which][p, 0] - position[t, 0], places[which][p, 1] - position[t, 1]
                ahead, lateral = (x * c + y * s) / ahead_scale, (y * c - x * s) / lateral_scale
                exponent = ahead**2 + lateral**2
                if not exponent < farthest:
                    continue
                turn = (headings[which][p] - heading[t] + math.pi) % (2 * math.pi) - math.pi
                exponent += (turn / heading_scale) ** 2
                if exponent < farthest:
                    share, slot = weight * math.exp(-exponent / 2), sets[which][p] - low
                    if share >= largest[slot]:
                        largest[slot], nearest[slot] = share, begin + p
        total, moving, resting_total, speed, square = 0.0, 0.0, 0.0, 0.0, 0.0
        for slot in range(len(largest)):
            share = largest[slot]
            if share > 0:
                which = 1 if nearest[slot] >= len(left) else 0
                p = nearest[slot] - which * len(left)
                total += share
                resting_total += share * resting[which][p]
                share *= 1 - resting[which][p]
                v = speeds[which][p]
                moving += share
                speed += share * v
                square += share * (v**2 + variances[which][p] + spread**2)
        still[t] = (stationary + resting_total) / (1 + total)
        norm = 1 - stationary + moving
        mean[t] = speed / norm
        spreads[t] = ((1 - stationary) * variance[t] + square) / norm - mean[t] ** 2
    return still, mean, spreads
