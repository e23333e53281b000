"""Disturbances of the traffic flow: stop lines of traffic lights, and temporary slow zones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class ClosingLine:
    """A line at travelled distance s, m, in some lanes, closed during red intervals (K, 2), s."""

    lanes: IntArray
    s: float
    red: FloatArray

    def closed(self, time: float) -> bool:
        """True while the light is red."""
        return bool(((self.red[:, 0] <= time) & (time < self.red[:, 1])).any())


@dataclass(frozen=True, eq=False)
class SlowZone:
    """Section [start, end), m, of some lanes with a speed limit `speed`, m/s, during intervals `active` (K, 2), s."""

    lanes: IntArray
    start: float
    end: float
    speed: float
    active: FloatArray

    def limit(self, lane: IntArray, s: FloatArray, time: float) -> FloatArray:
        """Speed limit (N,), m/s, infinite outside the zone."""
        if not ((self.active[:, 0] <= time) & (time < self.active[:, 1])).any():
            return np.full(len(s), np.inf)
        inside: BoolArray = np.isin(lane, self.lanes) & (s >= self.start) & (s < self.end)
        return np.where(inside, self.speed, np.inf)


def sample_intervals(
    on: tuple[float, float], off: tuple[float, float], until: float, rng: np.random.Generator
) -> FloatArray:
    """On intervals (K, 2), s, of alternating on and off durations, from a random phase at time 0 up to `until`."""
    time = -rng.uniform(0, on[1] + off[1])
    intervals = []
    while time < until:
        duration = rng.uniform(*on)
        intervals.append((time, time + duration))
        time += duration + rng.uniform(*off)
    return np.array(intervals)
