"""Recordings that hold the same traffic: windows of one site may overlap in time without telling so.

Two recordings overlap if they hold the same motion of `VEHICLES` or more vehicles at one shift of time: `MOMENTS`
speeds in a row, none of which repeats the one before. A shift of the frame leaves speeds as they are.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from itertools import combinations

import numpy as np

from data_tools.datasets.recorded_traffic import RecordedTraffic
from saga_fg.numerics.arrays import BoolArray

MOMENTS = 8
VEHICLES = 3
DIGITS = 2  # of speeds in m/s

_Motion = dict[tuple[float, ...], list[tuple[str, int, int]]]


def overlapping(recordings: Iterable[RecordedTraffic]) -> dict[str, str]:
    """The first recording, by name, of the group of overlapping ones that each is in, by name."""
    motion: _Motion = defaultdict(list)
    first: dict[str, str] = {}
    for traffic in recordings:
        first[traffic.name] = traffic.name
        speed = np.round(np.hypot(traffic.velocity[..., 0], traffic.velocity[..., 1]), DIGITS)
        changes = np.diff(speed, axis=0) != 0
        for vehicle, present in enumerate(traffic.present.T):
            for k in _whole(present[1:] & present[:-1] & changes[:, vehicle]):
                motion[tuple(speed[k : k + MOMENTS, vehicle].tolist())].append((traffic.name, vehicle, k))
    shared: dict[tuple[str, str], dict[int, set[tuple[int, int]]]] = defaultdict(lambda: defaultdict(set))
    for places in motion.values():
        for (name, vehicle, k), (other, same, there) in combinations(places, 2):
            if name != other:
                shared[name, other][there - k].add((vehicle, same))
    for (name, other), by_shift in shared.items():
        if max(map(len, by_shift.values())) >= VEHICLES:
            joined = (first[name], first[other])
            first = {each: joined[0] if own in joined else own for each, own in first.items()}
    return first


def _whole(steps: BoolArray) -> list[int]:
    """The moments from which on `MOMENTS` - 1 steps hold."""
    n = MOMENTS - 1
    total = np.concatenate([[0], np.cumsum(steps)])
    return np.flatnonzero(total[n:] - total[:-n] == n).tolist() if len(steps) >= n else []
