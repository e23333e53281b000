"""Poles beside a simulated road, and their observations by a LiDAR.

Poles are on both sides of the driven path, `offset` m from it, `gap` m apart with some scatter. From each pose those
within `reach` are observed, each with the chance `seen`, with independent noise ahead and to the left.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from saga_fg.model.landmarks.pole import PoleLandmark
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import inverse_transform, transform_points
from saga_fg.settings import Fraction, Positive, Settings, setting
from saga_fg.slam.joint import Observations
from saga_fg.types.frame import Frame
from saga_fg.types.landmark import Observation


@dataclass(frozen=True)
class SimulatedPoleSettings(Settings):
    """Poles and their observation."""

    gap: Positive = setting(25.0, "mean distance between poles of one side, m")
    offset: Positive = setting(9.0, "mean distance of a pole from the path, m")
    reach: Positive = setting(30.0, "farther poles are not seen, m")
    seen: Fraction = setting(0.8, "chance to see a pole within reach")
    noise: Positive = setting(0.1, "standard deviation of an observation, m")


def observe_poles(world_T_ego: FloatArray, seed: int, settings: SimulatedPoleSettings | None = None) -> Observations:
    """Observe poles from true poses (n, 4, 4); the same seed gives the same poles and noise."""
    settings = settings or SimulatedPoleSettings()
    rng = np.random.default_rng(seed)
    poles = _poles(world_T_ego, settings, rng)
    kind, R = PoleLandmark(), settings.noise**2 * np.eye(2)
    result = []
    for pose in world_T_ego:
        local = transform_points(inverse_transform(pose), poles)
        near = (np.hypot(*local[:, :2].T) <= settings.reach) & (rng.random(len(local)) < settings.seen)
        local[:, :2] += settings.noise * rng.standard_normal((len(local), 2))
        result.append([Observation(kind, point, R) for point in local[near]])
    return result


def poles_at(frames: Sequence[Frame], seed: int) -> Observations:
    """Observe poles at frames with true poses."""
    return observe_poles(np.stack([frame.world_T_ego for frame in frames if frame.world_T_ego is not None]), seed)


def _poles(world_T_ego: FloatArray, settings: SimulatedPoleSettings, rng: np.random.Generator) -> FloatArray:
    """Return places (m, 3), 1.5 m high, along the path and straight on beyond its end."""
    steps = np.linalg.norm(np.diff(world_T_ego[:, :3, 3], axis=0), axis=1)
    driven = np.concatenate([[0.0], np.cumsum(steps)])
    places = []
    for side in (-1.0, 1.0):
        along = np.arange(0.0, driven[-1] + settings.reach, settings.gap)
        along = along + rng.uniform(-0.3, 0.3, len(along)) * settings.gap
        for s in along.tolist():
            row = min(int(np.searchsorted(driven, s)), len(driven) - 1)
            ahead, across = s - driven[row], side * (settings.offset + rng.normal(0, 1.0))
            places.append(transform_points(world_T_ego[row], np.array([[ahead, across, 1.5]]))[0])
    return np.stack(places)
