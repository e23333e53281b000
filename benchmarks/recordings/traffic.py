"""Recorded trajectories of traffic on a common time grid, with the road they were driven on.

Two recordings overlap if they hold the same motion of `SHARED_VEHICLES` or more vehicles at one shift of time:
`SHARED_MOMENTS` speeds in a row, none of which repeats the one before. A shift of the frame leaves speeds as they are.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Self

import numpy as np

from data_tools.simulator.traffic import SimulatedTrajectories
from saga_fg.errors import InputError
from saga_fg.numerics import BoolArray, FloatArray, IntArray, StrArray
from saga_fg.types import RoadMap

PERIOD = 0.1  # s between moments
MAX_STATES = 20_000_000  # moments times vehicles of one recording
TRUCK_LENGTH = 7.0  # m, from which a vehicle recorded as a car is a truck
HEIGHTS = {"car": 1.5, "truck": 3.2, "bus": 3.2, "motorcycle": 1.6, "bicycle": 1.7, "pedestrian": 1.7}
"""Assumed heights, m: the recordings have none, and what hides what depends on them."""
SHARED_MOMENTS = 8
SHARED_VEHICLES = 3
SPEED_DIGITS = 2  # of speeds in m/s


@dataclass(frozen=True, eq=False)
class RecordedTraffic:
    """N vehicles at K moments, every 0.1 s from time 0; where one was not recorded, its states are the nearest ones.

    road_map  or None
    colours   (K,) colours of each light of the map by its name; "" while it shows none
    """

    name: str
    vehicles: SimulatedTrajectories
    road_map: RoadMap | None = None
    colours: Mapping[str, StrArray] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.vehicles.time)

    def moments(self, kept: slice) -> Self:
        """Successive moments, the first of which is at time 0 again."""
        states = {key: getattr(self.vehicles, key)[kept] for key in ("position", "velocity", "yaw", "present")}
        vehicles = replace(self.vehicles, time=PERIOD * np.arange(len(states["yaw"]), dtype=np.float64), **states)
        return replace(self, vehicles=vehicles, colours={light: shown[kept] for light, shown in self.colours.items()})


@dataclass(frozen=True)
class Recordings:
    """A collection of recordings by name; `read` reads one, and raises `InputError` for a broken record."""

    names: tuple[str, ...]
    read: Callable[[str], RecordedTraffic]

    def middle(self, longest: float) -> Recordings:
        """The middle of each recording, at most `longest` s of it."""

        def part(name: str) -> RecordedTraffic:
            whole = self.read(name)
            moments = round(min(longest / PERIOD, len(whole) - 1)) + 1
            first = (len(whole) - moments) // 2
            return whole.moments(slice(first, first + moments))

        return Recordings(self.names, part)


def on_grid(
    name: str,
    moment: IntArray,
    vehicle: StrArray,
    states: tuple[FloatArray, FloatArray, FloatArray],
    sizes: Mapping[str, tuple[str, float, float]],
) -> RecordedTraffic:
    """Recorded states, one a row, as traffic; `sizes` are class, length and width by vehicle.

    moment  (n,) from 0; vehicle (n,); states: position (n, 2), velocity (n, 2), yaw (n,)

    Raises `InputError` for fewer than two moments, for two rows of one vehicle at one moment, and for a recording that
    does not fit into memory.
    """
    names, column = np.unique(vehicle, return_inverse=True)
    K, N = int(moment.max(initial=-1)) + 1, len(names)
    if K < 2:
        raise InputError(f"{name}: expected at least two moments, got {K}")
    if K * N > MAX_STATES:
        raise InputError(f"{name}: expected at most {MAX_STATES:.0e} moments times vehicles, got {K} times {N}")
    cells, count = np.unique(moment * N + column, return_counts=True)
    if (count > 1).any():
        k, n = divmod(int(cells[np.argmax(count > 1)]), N)
        raise InputError(f"{name}: vehicle {names[n]}: expected one state at {k * PERIOD:.1f} s, there are more")
    row = np.full((K, N), -1)
    row[moment, column] = np.arange(len(moment))
    present = row >= 0
    row = row[_nearest(present), np.arange(N)]
    kind, length, width = zip(*(sizes[each] for each in names.tolist()), strict=True)
    label = np.where((np.array(kind) == "car") & (np.array(length) > TRUCK_LENGTH), "truck", np.array(kind))
    size = np.column_stack([length, width, [HEIGHTS.get(each, HEIGHTS["car"]) for each in label.tolist()]])
    position, velocity, yaw = (values[row] for values in states)
    time = PERIOD * np.arange(K, dtype=np.float64)
    vehicles = SimulatedTrajectories(
        id=names,
        label=label,
        size=size,
        time=time,
        position=position,
        velocity=velocity,
        yaw=np.unwrap(yaw, axis=0),
        present=present,
    )
    return RecordedTraffic(name, vehicles)


def _nearest(present: BoolArray) -> IntArray:
    """(K, N) the moment nearest to each at which the vehicle is present; it is so at one at least."""
    K, N = present.shape
    k = np.arange(K)[:, None] * np.ones(N, dtype=np.int64)
    before = np.maximum.accumulate(np.where(present, k, -K), axis=0)
    after = np.minimum.accumulate(np.where(present, k, 2 * K)[::-1], axis=0)[::-1]
    return np.where(k - before <= after - k, before, after)


def overlapping(recordings: Iterable[RecordedTraffic]) -> dict[str, str]:
    """The first recording, by name, of the group of overlapping ones that each is in, by name."""
    motion: dict[tuple[float, ...], list[tuple[str, int, int]]] = defaultdict(list)
    first: dict[str, str] = {}
    for traffic in recordings:
        first[traffic.name] = traffic.name
        velocity, present = traffic.vehicles.velocity, traffic.vehicles.present
        speed = np.round(np.hypot(velocity[..., 0], velocity[..., 1]), SPEED_DIGITS)
        new = present[1:] & present[:-1] & (np.diff(speed, axis=0) != 0)
        runs = np.cumsum(np.concatenate([np.zeros_like(new[:1]), new]), axis=0, dtype=np.int64)
        steps = SHARED_MOMENTS - 1
        for k, vehicle in np.argwhere(runs[steps:] - runs[:-steps] == steps).tolist():
            motion[tuple(speed[k : k + SHARED_MOMENTS, vehicle].tolist())].append((traffic.name, vehicle, k))
    shared: dict[tuple[str, str], dict[int, set[tuple[int, int]]]] = defaultdict(lambda: defaultdict(set))
    for places in motion.values():
        for (name, vehicle, k), (other, same, there) in combinations(places, 2):
            if name != other:
                shared[name, other][there - k].add((vehicle, same))
    for (name, other), by_shift in shared.items():
        if max(map(len, by_shift.values())) >= SHARED_VEHICLES:
            joined = (first[name], first[other])
            first = {each: joined[0] if own in joined else own for each, own in first.items()}
    return first
