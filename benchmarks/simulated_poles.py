"""Poles beside a simulated road, and their observations by a LiDAR.

Poles are on both sides of the driven path, about OFFSET m from it, about GAP m apart. From each pose those within reach
are observed, each with the chance SEEN, with independent noise ahead and to the left.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from saga_fg.model.landmarks.pole import PoleLandmark
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import inverse_transform, transform_points
from saga_fg.slam.joint import Observations
from saga_fg.types.frame import Frame
from saga_fg.types.landmark import Observation

GAP, OFFSET = 25.0, 9.0  # m, means
SEEN = 0.8


def observe_poles(world_T_ego: FloatArray, seed: int, reach: float = 30.0, noise: float = 0.1) -> Observations:
    """Observe poles within `reach`, m, from true poses (n, 4, 4); noise: standard deviation, m."""
    rng = np.random.default_rng(seed)
    poles = _poles(world_T_ego, reach, rng)
    kind, R = PoleLandmark(), noise**2 * np.eye(2)
    result = []
    for pose in world_T_ego:
        local = transform_points(inverse_transform(pose), poles)
        near = (np.hypot(*local[:, :2].T) <= reach) & (rng.random(len(local)) < SEEN)
        local[:, :2] += noise * rng.standard_normal((len(local), 2))
        result.append([Observation(kind, point, R) for point in local[near]])
    return result


def poles_at(frames: Sequence[Frame], seed: int) -> Observations:
    """Observe poles at frames with true poses."""
    return observe_poles(np.stack([frame.world_T_ego for frame in frames if frame.world_T_ego is not None]), seed)


def _poles(world_T_ego: FloatArray, reach: float, rng: np.random.Generator) -> FloatArray:
    """Return places (m, 3), 1.5 m high, along the path and straight on beyond its end."""
    steps = np.linalg.norm(np.diff(world_T_ego[:, :3, 3], axis=0), axis=1)
    driven = np.concatenate([[0.0], np.cumsum(steps)])
    places = []
    for side in (-1.0, 1.0):
        along = np.arange(0.0, driven[-1] + reach, GAP)
        along = along + rng.uniform(-0.3, 0.3, len(along)) * GAP
        for s in along.tolist():
            row = min(int(np.searchsorted(driven, s)), len(driven) - 1)
            ahead, across = s - driven[row], side * (OFFSET + rng.normal(0, 1.0))
            places.append(transform_points(world_T_ego[row], np.array([[ahead, across, 1.5]]))[0])
    return np.stack(places)
