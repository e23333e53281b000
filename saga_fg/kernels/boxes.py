"""Sizes, heights and headings of tracks, see `saga_fg.tracking.box_filter`."""

from __future__ import annotations

import math

import numpy as np

from saga_fg.kernels.array_types import BoolArray, FloatArray, IntArray
from saga_fg.kernels.compilation import kernel

Shapes = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]


@kernel("f2 f1 f1 f1 f1 f1 f1 i1 f2 f1 f1 f1 f1 f1 f f")
def updated_boxes(
    size: FloatArray,
    size_weight: FloatArray,
    z: FloatArray,
    z_variance: FloatArray,
    yaw: FloatArray,
    yaw_variance: FloatArray,
    votes: FloatArray,
    rows: IntArray,
    seen_size: FloatArray,
    weight: FloatArray,
    seen_z: FloatArray,
    z_noise: FloatArray,
    seen_yaw: FloatArray,
    yaw_noise: FloatArray,
    most_weight: float,
    most_votes: float,
) -> Shapes:
    """Sizes (k, 3), their weights, heights, headings with their variances, votes (k,) of the tracks `rows` (k,)."""
    k = len(rows)
    sizes, others = np.empty((k, 3)), np.empty((6, k))
    for e in range(k):
        i = rows[e]
        total = size_weight[i] + weight[e]
        share = weight[e] / total if total > 0 else 0.0
        known = math.isfinite(seen_size[e, 0]) and math.isfinite(seen_size[e, 1]) and math.isfinite(seen_size[e, 2])
        for p in range(3):
            old = size[i, p] if math.isfinite(size[i, p]) else seen_size[e, p]
            sizes[e, p] = old + share * (seen_size[e, p] - old) if known else size[i, p]
        others[0, e] = min(total, most_weight) if known else size_weight[i]
        gain = z_variance[i] / (z_variance[i] + z_noise[e] ** 2)
        others[1, e], others[2, e] = z[i] + gain * (seen_z[e] - z[i]), z_variance[i] * (1 - gain)
        heading, variance, vote = yaw[i], yaw_variance[i], votes[i]
        if math.isfinite(seen_yaw[e]):
            if not math.isfinite(heading):
                heading, variance, gain = seen_yaw[e], yaw_noise[e] ** 2, 0.0
            else:
                gain = variance / (variance + yaw_noise[e] ** 2)
            apart = (seen_yaw[e] - heading + math.pi) % (2 * math.pi) - math.pi
            against = abs(-math.pi if apart >= math.pi else apart) > math.pi / 2
            if against:
                apart = (apart + 2 * math.pi) % (2 * math.pi) - math.pi
            heading = (heading + gain * apart + math.pi) % (2 * math.pi) - math.pi
            variance *= 1 - gain
            vote = min(vote + (-weight[e] if against else weight[e]), most_votes)
        if vote < 0:
            heading, vote = (heading + 2 * math.pi) % (2 * math.pi) - math.pi, -vote
        others[3, e], others[4, e], others[5, e] = -math.pi if heading >= math.pi else heading, variance, vote
    return sizes, others[0], others[1], others[2], others[3], others[4], others[5]


@kernel("f1 f1 f2 f f")
def faced_boxes(
    yaw: FloatArray, votes: FloatArray, velocity: FloatArray, moving: float, most_votes: float
) -> tuple[FloatArray, FloatArray]:
    """Headings and votes (n,) where clear motions, velocity (n, 2), decide on the front."""
    headings, later = np.empty(len(yaw)), np.empty(len(yaw))
    for i in range(len(yaw)):
        along = math.cos(yaw[i]) * velocity[i, 0] + math.sin(yaw[i]) * velocity[i, 1]
        headings[i], later[i] = yaw[i], most_votes if abs(along) > moving else abs(votes[i])
        if along < -moving:
            angle = (yaw[i] + 2 * math.pi) % (2 * math.pi) - math.pi
            headings[i] = -math.pi if angle >= math.pi else angle
    return headings, later


@kernel("f1 f2 f2 b1 f")
def turned_headings(
    yaw: FloatArray, before: FloatArray, after: FloatArray, coasting: BoolArray, moving: float
) -> FloatArray:
    """Headings (n,) of coasting tracks turned as their velocities (n, 2) are, where these are above `moving`."""
    headings = np.empty(len(yaw))
    for i in range(len(yaw)):
        u, v, turn = before[i, 0], before[i, 1], 0.0
        if coasting[i] and math.hypot(u, v) > moving:
            turn = math.atan2(u * after[i, 1] - v * after[i, 0], u * after[i, 0] + v * after[i, 1])
        angle = (yaw[i] + turn + math.pi) % (2 * math.pi) - math.pi
        headings[i] = -math.pi if angle >= math.pi else angle
    return headings
