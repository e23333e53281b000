"""Cyclists at the outer borders of the road: a bicycle and a rider, two objects that move together.

The speed of a cyclist is an Ornstein-Uhlenbeck process about a preferred speed. The rider's body sways sideways.
"""

from __future__ import annotations

import numpy as np

from data_tools.simulator.pedestrians import BODY
from data_tools.simulator.road import Road
from data_tools.simulator.settings import CyclistSettings
from data_tools.simulator.trajectories import SimulatedTrajectories, concatenated
from saga_fg.numerics.arrays import FloatArray

BICYCLE = (1.75, 0.6, 1.1)  # length, width, height, m
SLOWEST = 1.0  # m/s
CYCLIST_SPEED = (3.5, 6.5)  # preferred speed of a cyclist, m/s
SPEED_SPREAD = 1.0  # standard deviation of a cyclist's speed about the preferred one, m/s
CHANGE_TIME = 2.5  # correlation time of a cyclist's speed, s
SWAY, SWAY_PERIOD = 0.08, 1.2  # amplitude, m, and period, s, of the rider's body


def simulate_cyclists(
    road: Road,
    borders: tuple[float, float],
    window: tuple[float, float],
    time: FloatArray,
    settings: CyclistSettings,
    rng: np.random.Generator,
) -> SimulatedTrajectories:
    """Bicycles, then their riders, that start at road s within `window`, m, inside the outer borders (d, m)."""
    h = float(time[1] - time[0])
    decay = float(np.exp(-h / CHANGE_TIME))
    parts = []
    for sense, lateral in ((1.0, borders[0] + 0.7), (-1.0, borders[1] - 0.7)):
        n = int(rng.integers(settings.count[0], settings.count[1] + 1))
        preferred = rng.uniform(*CYCLIST_SPEED, n)
        noise = SPEED_SPREAD * np.sqrt(1 - decay**2) * rng.standard_normal((len(time), n))
        deviation = np.zeros((len(time), n))
        deviation[0] = SPEED_SPREAD * rng.standard_normal(n)
        for k in range(1, len(time)):
            deviation[k] = decay * deviation[k - 1] + noise[k]
        speed = np.maximum(preferred + deviation, SLOWEST)
        travelled = np.concatenate([np.zeros((1, n)), np.cumsum((speed[1:] + speed[:-1]) / 2 * h, axis=0)])
        s = rng.uniform(*window, n) + sense * travelled
        phase = 2 * np.pi * (time[:, None] / SWAY_PERIOD + rng.random(n))
        parts.append((s, np.full_like(s, lateral), speed, np.full_like(s, sense), SWAY * np.sin(phase)))
    s, d, speed, directions, sway = (np.concatenate(columns, axis=1) for columns in zip(*parts, strict=True))
    count = s.shape[1]
    heading = road.heading_at(s) + np.where(directions > 0, 0.0, np.pi)
    ground_speed = speed * (1 - road.curvature_at(s) * d)
    velocity = ground_speed[..., None] * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    return concatenated(
        [
            SimulatedTrajectories(
                np.array([f"{name}-{k:03d}" for k in range(count)], dtype="<U16"),
                np.full(count, label),
                np.tile(np.array(size), (count, 1)),
                time,
                road.position(s, offset),
                velocity,
                heading,
                np.ones(s.shape, dtype=np.bool_),
            )
            for name, label, size, offset in (
                ("bicycle", "bicycle", BICYCLE, d),
                ("rider", "pedestrian", BODY, d + sway),
            )
        ]
    )
