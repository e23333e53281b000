"""Riders on bicycles at the edges of the road, two objects that move as one.

The speed of a rider goes up and down about what he likes (an Ornstein-Uhlenbeck process). A detector sees the bicycle
and the person on it, who sways a little.
"""

from __future__ import annotations

import numpy as np

from data_tools.simulator.pedestrians import BODY
from data_tools.simulator.road import Road
from data_tools.simulator.settings import CyclistSettings
from data_tools.simulator.trajectories import Trajectories, together
from saga_fg.numerics.arrays import FloatArray

BICYCLE = (1.75, 0.6, 1.1)  # length, width, height, m
SLOWEST = 1.0  # m/s
SWAY, SWAY_TIME = 0.08, 1.2  # m of the rider's body, s of a period


def ride(
    road: Road,
    edges: tuple[float, float],
    window: tuple[float, float],
    time: FloatArray,
    settings: CyclistSettings,
    rng: np.random.Generator,
) -> Trajectories:
    """Bicycles, then their riders, that start at road s within `window`, m, inside the outer borders `edges` (d, m)."""
    parts = []
    for sense, edge in ((1.0, edges[0] + 0.7), (-1.0, edges[1] - 0.7)):
        n = int(rng.integers(settings.count[0], settings.count[1] + 1))
        likes = rng.uniform(*settings.speed, n)
        h = float(time[1] - time[0])
        decay = np.exp(-h / settings.change_time)
        kick = settings.spread * np.sqrt(1 - decay**2) * rng.standard_normal((len(time), n))
        change = np.zeros((len(time), n))
        change[0] = settings.spread * rng.standard_normal(n)
        for k in range(1, len(time)):
            change[k] = decay * change[k - 1] + kick[k]
        speed = np.maximum(likes + change, SLOWEST)
        travelled = np.concatenate([np.zeros((1, n)), np.cumsum((speed[1:] + speed[:-1]) / 2 * h, axis=0)])
        s = rng.uniform(*window, n) + sense * travelled
        phase = 2 * np.pi * (time[:, None] / SWAY_TIME + rng.random(n))
        parts.append((s, np.full_like(s, edge), speed, sense, SWAY * np.sin(phase)))
    count = sum(part[0].shape[1] for part in parts)
    names = [f"{k:03d}" for k in range(count)]
    s, d, speed, sway = (np.concatenate([part[k] for part in parts], axis=1) for k in (0, 1, 2, 4))
    onward = np.concatenate([np.full(part[0].shape[1], part[3] > 0) for part in parts])
    heading = road.heading_at(s) + np.where(onward, 0.0, np.pi)
    ground = speed * (1 - road.curvature_at(s) * d)
    velocity = ground[..., None] * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    present = np.ones(s.shape, dtype=np.bool_)
    kinds = [("bicycle", BICYCLE, d), ("pedestrian", BODY, d + sway)]
    return together(
        [
            Trajectories(
                np.array([f"{'rider' if label == 'pedestrian' else label}-{name}" for name in names], dtype="<U16"),
                np.full(count, label),
                np.tile(np.array(size), (count, 1)),
                time,
                road.position(s, offset),
                velocity,
                heading,
                present,
            )
            for label, size, offset in kinds
        ]
    )
